"""A box along the axes."""

from __future__ import annotations

from typing import Self

from pydantic import Field, model_validator

from errormotion.datasets.units import Length
from errormotion.plugins import PluginSettings

Place = tuple[Length, Length, Length]


class Box(PluginSettings):
    """A box along the axes; of no extent in a direction where both corners agree."""

    low: Place = Field(description="corner with the smallest coordinates")
    high: Place = Field(description="corner with the largest coordinates")

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if any(a > b for a, b in zip(self.low, self.high, strict=True)):
            raise ValueError(f"expected low <= high in every coordinate; found {self.low} and {self.high}; swap them")
        return self
