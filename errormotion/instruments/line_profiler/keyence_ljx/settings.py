"""Settings of an LJ-X8000A."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from errormotion.datasets.units import Frequency, Length, Time
from errormotion.instruments.line_profiler.keyence_ljx.codec import PROGRAMS
from errormotion.plugins import PluginSettings


class LJXSettings(PluginSettings):
    """Settings of one profiler. Settings without a value are not changed in the active program."""

    program: int | None = Field(default=None, description="program to activate", ge=0, lt=PROGRAMS)
    x_pitch: Length | None = Field(default=None, description="distance between points on the line", gt=0)
    rate: Frequency = Field(default=1000.0, description="profiles per second, as set in the program", gt=0)
    noise: Length = Field(default=0.5e-6, description="standard deviation of the height of one point", ge=0)
    generation: Literal["LJ-X8000", "LJ-V7000"] = Field(default="LJ-X8000", description="generation of the controller")
    timeout: Time = Field(default=1.0, description="time limit without data", gt=0)
