"""Settings of an MTConnect agent."""

from __future__ import annotations

from pydantic import Field, field_validator

from errormotion.datasets.units import Time
from errormotion.plugins import PluginSettings

KEYS = (
    *("position.X", "position.Y", "position.Z"),
    *("commanded_position.X", "commanded_position.Y", "commanded_position.Z"),
    *("spindle_speed", "spindle_load", "feed", "mode", "program", "execution", "estop", "availability"),
)
"""Quantities that can be assigned to a data item."""


class MTConnectSettings(PluginSettings):
    """Settings of an MTConnect agent."""

    axes: tuple[str, str, str] = Field(
        default=("X", "Y", "Z"), description="names of the machine's linear axes X, Y and Z in the agent"
    )
    spindle: str = Field(
        default="", description="name of the rotary axis that is the spindle; empty: the only one with a speed"
    )
    items: dict[str, str] = Field(
        default_factory=dict,
        description="ids of data items, if type and name are ambiguous: spindle_speed = 'S2rpm'",
    )
    count: int = Field(default=1000, description="largest number of observations in one request", ge=1)
    most_bytes: int = Field(default=16 << 20, description="largest accepted document, bytes", ge=1024)
    timeout: Time = Field(default=2.0, description="time limit without data", gt=0)

    @field_validator("items")
    @classmethod
    def _known(cls, items: dict[str, str]) -> dict[str, str]:
        unknown = sorted(set(items) - set(KEYS))
        if unknown:
            raise ValueError(f"expected {', '.join(KEYS)}; found {', '.join(unknown)}")
        return items
