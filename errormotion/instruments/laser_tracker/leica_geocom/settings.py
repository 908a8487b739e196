"""Settings of a station with GeoCOM."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from errormotion.datasets.units import Angle, Length, Time
from errormotion.plugins import PluginSettings


class GeoComSettings(PluginSettings):
    """Settings of ``leica_geocom``."""

    move: bool = Field(
        default=False,
        description="whether the driver may turn the station to a target; if not, the operator points it",
    )
    search_angle: Angle = Field(
        default=0.02, description="range of the search for a reflector around a target, in both angles", gt=0, le=3.1
    )
    distance_mode: Literal["as_set", "standard", "fast", "precise"] = Field(
        default="as_set", description="mode of the distance meter; as_set: not changed; precise: TS30, TM30 and later"
    )
    inclination: Literal["measured", "automatic", "plane"] = Field(
        default="automatic",
        description="inclination for the correction of the angles: measured each time, chosen by the station "
        "(automatic), or from the last plane",
    )
    noise: Length = Field(default=0.6e-3, description="standard deviation of a distance, constant part", ge=0)
    noise_per_length: float = Field(
        default=1e-6, description="standard deviation of a distance, part proportional to the distance", ge=0, le=1e-3
    )
    angle_noise: Angle = Field(default=2.4e-6, description="standard deviation of an angle", ge=0)
    baudrate: int = Field(default=115200, description="baud rate of a serial line", gt=0)
    timeout: Time = Field(default=3.0, description="time limit for an answer", gt=0)
    measuring_timeout: Time = Field(default=15.0, description="time limit for a distance measurement", gt=0, le=60)
    motion_timeout: Time = Field(default=60.0, description="time limit for a motion or a search", gt=0)
