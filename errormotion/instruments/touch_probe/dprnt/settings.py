"""Settings of contacts that a machine prints."""

from __future__ import annotations

import re
from typing import Literal

from pydantic import Field, field_validator

from errormotion.datasets.units import Length, Time
from errormotion.instruments.touch_probe.dprnt.codec import PATTERN
from errormotion.instruments.touch_probe.settings import ProbeSettings


class DprntSettings(ProbeSettings):
    """Settings of contacts that a machine prints."""

    pattern: str = Field(
        default=PATTERN, description="regular expression of a line, with groups x, y, z, and optionally number and time"
    )
    length_unit: Literal["mm", "in"] = Field(default="mm", description="unit of printed positions")
    time_unit: Literal["ms", "s"] = Field(default="ms", description="unit of printed times")
    first_number: int = Field(default=1, description="number of the first touch, if touches are numbered", ge=0)
    margin: Length = Field(default=1e-3, description="largest distance of a position from the path of its touch", gt=0)
    free: Length = Field(default=0.2e-3, description="first part of a path, in which a trip counts as false", ge=0)
    at_target: Length = Field(
        default=5e-6, description="distance from the target within which a touch counts as one without a trip", ge=0
    )
    start_timeout: Time = Field(default=600.0, description="time limit for the first line of a cycle", gt=0)
    timeout: Time = Field(default=60.0, description="time limit from one line to the next", gt=0)
    most_unreadable: int = Field(
        default=10, description="largest accepted number of unreadable lines in one cycle", ge=0
    )
    line_end: Literal["lf", "cr"] = Field(
        default="lf", description="last character of a line: line feed (FANUC), or carriage return (Haas)"
    )
    code: Literal["ascii", "iso"] = Field(
        default="ascii", description="characters: ASCII, or ISO code, with even parity in the eighth bit"
    )
    baudrate: int = Field(default=4800, description="baud rate of a serial line", gt=0)
    control: str = Field(default="FANUC", description="name of the control, written to the identity")

    @field_validator("pattern")
    @classmethod
    def _has_groups(cls, pattern: str) -> str:
        try:
            groups = re.compile(pattern).groupindex
        except re.error as error:
            raise ValueError(f"expected a regular expression; {error}") from None
        if missing := [name for name in "xyz" if name not in groups]:
            raise ValueError(f"expected groups x, y and z, as in (?P<x>...); missing {', '.join(missing)}")
        return pattern
