"""Settings of a machine under LinuxCNC."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from errormotion.datasets.units import Time
from errormotion.instruments.interlock import ArmedSettings


class LinuxCNCSettings(ArmedSettings):
    """Settings of ``linuxcnc``."""

    token_file: Path = Field(
        default=Path("~/.errormotion/linuxcnc.token"),
        description="file with the token of the bridge, which only its user may read",
    )
    timeout: Time = Field(default=3.0, description="time limit without data from the bridge, also during motion", gt=0)
    trip_delay: Time = Field(
        default=0.0,
        description="delay from the contact until LinuxCNC latches the position, for the correction of touches",
        ge=0,
        le=0.1,
    )
