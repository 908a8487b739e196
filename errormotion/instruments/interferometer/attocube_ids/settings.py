"""Settings of an IDS3010."""

from __future__ import annotations

import math
from typing import Literal, Self

from pydantic import Field, model_validator

from errormotion.datasets.units import Length, Time
from errormotion.plugins import PluginSettings

AXES = 3
AVERAGE_STEP = 40e-9
"""Averaging time for the parameter 0, s; each step doubles it."""
MAX_AVERAGE = 24


class AngleChannel(PluginSettings):
    """An angle from the difference of two parallel beams."""

    plus: int = Field(ge=1, le=AXES, description="axis whose displacement increases with the angle")
    minus: int = Field(ge=1, le=AXES, description="axis whose displacement decreases with the angle")
    base: Length = Field(gt=0, description="distance between the two beams")


class IdsSettings(PluginSettings):
    """Settings of ``attocube_ids``."""

    axes: tuple[int, ...] = Field(
        default=(1,), min_length=1, description="axes with a reflector, 1 to 3, as labelled on the device"
    )
    angles: dict[str, AngleChannel] = Field(
        default_factory=dict, description="channels of angles, by name: two axes and the distance between their beams"
    )
    passes: Literal["as_set", "single", "dual"] = Field(
        default="as_set",
        description="number of passes of the light to the reflector; a device in another mode is refused",
    )
    averaging: Time | None = Field(
        default=None, gt=0, le=1.0, description="averaging time, 40 ns times a power of 2; default: unchanged"
    )
    initialisation: Literal["as_set", "accurate", "quick"] = Field(
        default="as_set", description="type of initialisation when the driver starts a measurement"
    )
    start: bool = Field(default=True, description="start the measurement if the device is idle; else refuse the device")
    start_timeout: Time = Field(default=90.0, gt=0, description="time limit for starting and stopping a measurement")
    after_break: Literal["restart", "clear"] = Field(
        default="restart",
        description="action of the first zero after a beam was broken: restart the measurement, as the manufacturer "
        "recommends, or clear the error",
    )
    timeout: Time = Field(default=3.0, gt=0, description="time limit for an answer")

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if unknown := [axis for axis in self.axes if not 1 <= axis <= AXES]:
            raise ValueError(f"axes: expected numbers from 1 to {AXES}; found {unknown[0]}")
        if len(set(self.axes)) < len(self.axes):
            raise ValueError(f"axes: expected each once; found {', '.join(map(str, self.axes))}")
        for name, angle in self.angles.items():
            if angle.plus == angle.minus or not {angle.plus, angle.minus} <= set(self.axes):
                raise ValueError(
                    f"angles.{name}: expected two of the axes {', '.join(map(str, self.axes))}; found {angle.plus} and "
                    f"{angle.minus}"
                )
            if name in map(axis_name, self.axes):
                raise ValueError(f"angles.{name}: expected another name than that of an axis")
        return self

    @property
    def average_parameter(self) -> int | None:
        """Parameter of the low pass with the longest averaging time up to ``averaging``; None: unchanged."""
        if self.averaging is None:
            return None
        return min(max(math.floor(math.log2(self.averaging / AVERAGE_STEP) + 1e-9), 0), MAX_AVERAGE)


def axis_name(axis: int) -> str:
    """Return the name of the channel of an axis, counted from 1."""
    return f"axis{axis}"
