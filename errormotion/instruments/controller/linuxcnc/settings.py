"""Settings of a machine under LinuxCNC."""

from __future__ import annotations

from pydantic import Field

from errormotion.datasets.units import Time
from errormotion.plugins import PluginSettings


class LinuxCNCSettings(PluginSettings):
    """Settings of ``linuxcnc``."""

    timeout: Time = Field(default=3.0, description="time limit without data from the bridge, also during motion", gt=0)
    trip_delay: Time = Field(
        default=0.0,
        description="delay from the contact until LinuxCNC latches the position; touches are corrected by its travel",
        ge=0,
        le=0.1,
    )
