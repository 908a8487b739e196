"""Which targets to measure: what a choice is to make small, as settings say it."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np
from pydantic import Field, model_validator

from errormotion.arrays import Array
from errormotion.datasets.units import Angle, Length, Time
from errormotion.errors import MethodError
from errormotion.methods.multilateration.planning.box import Box, Place
from errormotion.plugins import PluginSettings


class Choosing(PluginSettings):
    """Which targets of a grid of candidates are worth their time."""

    count: int | None = Field(default=None, ge=1, description="targets to choose")
    time: Time | None = Field(default=None, gt=0, description="what one set-up may take, in place of count")
    time_per_target: Time = Field(default=15.0, gt=0, description="way to a target, wait and reading")
    candidates: tuple[int, int, int] = Field(default=(7, 7, 7), description="candidates along X, Y and Z")
    low: Place | None = Field(
        default=None, description="corner of the box of candidates, axis positions; without: that of the layout"
    )
    high: Place | None = Field(default=None, description="opposite corner")
    travel: Box | None = Field(default=None, description="travel of the axes, in which the candidates have to lie")
    uncertainty: Literal["axes", "target"] = Field(
        default="axes",
        description="of what, anywhere in the box: the error that follows from the errors of the axes, or that of a "
        "target measured there",
    )
    max_order: int = Field(default=4, ge=1, le=15, description="highest order of error motions that are reckoned with")
    expected_displacement: Length = Field(
        default=10e-6, gt=0, description="size of error motions to expect, displacements"
    )
    expected_rotation: Angle = Field(default=20e-6, gt=0, description="size of error motions to expect, rotations")

    @model_validator(mode="after")
    def _one_budget(self) -> Self:
        if (self.count is None) == (self.time is None):
            raise ValueError("expected count, a number of targets, or time, what a set-up may take: one of both")
        if (self.low is None) != (self.high is None):
            raise ValueError("expected low and high, both corners of the box of candidates; found one of them")
        if min(self.candidates) < 1:
            raise ValueError(f"candidates: expected 1 or more along every axis; found {self.candidates}")
        return self

    @property
    def wanted(self) -> int:
        """Targets to choose."""
        if self.count is not None:
            return self.count
        return int((self.time or 0.0) / self.time_per_target)


def positions(choosing: Choosing, low: Place, high: Place) -> Array:
    """Return the axis positions of the candidates, (k, 3), m; ``low`` and ``high`` are the layout's corners.

    Raises
    ------
    MethodError
        A box without extent, or beyond the travel.
    """
    a = np.array(choosing.low if choosing.low is not None else low, np.float64)
    b = np.array(choosing.high if choosing.high is not None else high, np.float64)
    if (a > b).any():
        raise MethodError(
            f"candidates: expected low <= high in every coordinate; found {_mm(a)} and {_mm(b)}; swap them"
        )
    if (travel := choosing.travel) is not None and ((a < travel.low) | (b > travel.high)).any():
        raise MethodError(
            f"candidates: the box from {_mm(a)} to {_mm(b)} reaches beyond the travel from {_mm(travel.low)} to "
            f"{_mm(travel.high)}. Make it smaller (planning.targets.low, high)."
        )
    axes = [np.linspace(x, y, k) if k > 1 else np.array([(x + y) / 2])
            for x, y, k in zip(a, b, choosing.candidates, strict=True)]  # fmt: skip
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def refuse_count(wanted: int, candidates: int, stations: int) -> None:
    """Refuse more targets than there are candidates, and fewer than determine the stations.

    Raises
    ------
    MethodError
    """
    least = -((6 - 4 * stations) // (stations - 3))
    if wanted > candidates:
        raise MethodError(
            f"expected at most {candidates} targets, the candidates that three stations see; found {wanted}. Choose "
            "fewer, or give more candidates (planning.targets.candidates)."
        )
    if wanted < least:
        raise MethodError(
            f"expected at least {least} targets, which {stations} stations with unknown places and dead paths need; "
            f"found {wanted}. Choose more, allow more time, or add a station."
        )


def _mm(place: Array | Place) -> str:
    return "({:.0f}, {:.0f}, {:.0f}) mm".format(*(1e3 * float(x) for x in place))
