"""Settings of a channel of a capaNCDT 6200."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from errormotion.datasets.units import Frequency, Length, Time
from errormotion.instruments.point_lds.capancdt.codec import NUMBERS, RATES
from errormotion.plugins import PluginSettings

Averaging = Literal["none", "moving", "arithmetic", "median", "dynamic noise rejection"]


class CapaSettings(PluginSettings):
    """Settings of one channel. Settings without a value are not changed in the controller."""

    channel: int = Field(
        default=1, description="channel of the controller to which the sensor is connected", ge=1, le=4
    )
    measuring_range: Length | None = Field(
        default=None,
        description="measuring range of the sensor, compared with the one that the controller reports",
        gt=0,
    )
    rate: Frequency | None = Field(
        default=None,
        description="data rate of all channels, written to the controller, which selects the next available one",
        ge=RATES[0],
        le=RATES[1],
    )
    averaging: Averaging | None = Field(
        default=None, description="averaging of all channels, written to the controller"
    )
    averaging_number: int | None = Field(
        default=None,
        description="number of values in an average, written to the controller",
        ge=NUMBERS[0],
        le=NUMBERS[1],
    )
    noise: Length = Field(default=0.0, description="standard deviation of a single reading; 0: unknown", ge=0)
    timeout: Time = Field(default=1.0, description="time limit for an answer", gt=0)

    @model_validator(mode="after")
    def _belong_together(self) -> Self:
        if self.averaging_number is not None and self.averaging in (None, "none"):
            raise ValueError(
                "'averaging_number' needs 'averaging': moving, arithmetic, median or dynamic noise rejection"
            )
        return self
