"""Settings of an SHDR adapter: keys and units of quantities."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Literal

from pydantic import Field, field_validator

from errormotion.datasets.units import Time
from errormotion.plugins import PluginSettings

KEYS = (
    *("position", "position.X", "position.Y", "position.Z"),
    *("commanded_position", "commanded_position.X", "commanded_position.Y", "commanded_position.Z"),
    *("spindle_speed", "spindle_load", "feed", "mode", "program", "execution", "estop", "availability"),
)
"""Quantities that a key can report; ``position`` and ``commanded_position`` are three numbers in one value."""

DEFAULT_ITEMS: Mapping[str, str] = {
    **{f"position.{axis}": f"{axis}act" for axis in "XYZ"},
    **{f"commanded_position.{axis}": f"{axis}com" for axis in "XYZ"},
    "spindle_speed": "spindle_speed",
    "spindle_load": "Cload",
    "feed": "path_feedrate",
    "mode": "mode",
    "program": "program",
    "execution": "execution",
    "estop": "estop",
    "availability": "avail",
}
"""Keys of the device VMC-3Axis of the reference agent, by quantity."""

LENGTHS: Mapping[str, float] = {"mm": 1e-3, "inch": 25.4e-3, "um": 1e-6, "m": 1.0}
FEEDS: Mapping[str, float] = {
    "mm/s": 1e-3,
    "mm/min": 1e-3 / 60,
    "inch/min": 25.4e-3 / 60,
    "inch/s": 25.4e-3,
    "m/s": 1.0,
}
SPEEDS: Mapping[str, float] = {"1/min": 1.0, "1/s": 60.0, "degree/s": 1.0 / 6.0}
LOADS: Mapping[str, float] = {"%": 0.01, "1": 1.0}
ANGLES: Mapping[str, float] = {"degree": math.pi / 180, "rad": 1.0}
"""Factors to SI (speeds of rotation: 1/min)."""


class ShdrSettings(PluginSettings):
    """Settings of an SHDR adapter."""

    items: dict[str, str] = Field(
        default_factory=dict,
        description="keys of the adapter by quantity, in addition to those of the reference device: "
        "'position.X' = 'X1actm', spindle_speed = 'S1speed'; an empty key: the adapter has none",
    )
    temperatures: dict[str, str] = Field(default_factory=dict, description="keys by name: spindle = 'Stemp'")
    angles: dict[str, str] = Field(default_factory=dict, description="keys of rotary axes by name: B = 'Babs'")
    length_unit: Literal["mm", "inch", "um", "m"] = Field(default="mm", description="unit of positions")
    feed_unit: Literal["mm/s", "mm/min", "inch/min", "inch/s", "m/s"] = Field(
        default="mm/s", description="unit of the feed"
    )
    speed_unit: Literal["1/min", "1/s", "degree/s"] = Field(default="1/min", description="unit of the spindle speed")
    load_unit: Literal["%", "1"] = Field(default="%", description="unit of the spindle load")
    angle_unit: Literal["degree", "rad"] = Field(default="degree", description="unit of the angles")
    temperature_unit: Literal["degC", "degF", "K"] = Field(default="degC", description="unit of the temperatures")
    device: str = Field(
        default="", description="name of the device before the keys, as in name:Xact; other devices are ignored"
    )
    conditions: tuple[str, ...] = Field(
        default=(), description="keys of conditions, if their lines also contain other values"
    )
    messages: tuple[str, ...] = Field(
        default=(), description="keys of messages, if their lines also contain other values"
    )
    series: tuple[str, ...] = Field(
        default=(), description="keys of time series, if their lines also contain other values"
    )
    lenient: bool = Field(
        default=False,
        description="whether lines that do not follow the protocol are ignored and counted; if not, they are errors",
    )
    timeout: Time = Field(default=2.0, description="time limit for an answer", gt=0)
    silence: Time = Field(
        default=600.0, description="time limit without data from an adapter without a heartbeat", gt=0
    )

    @field_validator("items")
    @classmethod
    def _known(cls, items: dict[str, str]) -> dict[str, str]:
        unknown = sorted(set(items) - set(KEYS))
        if unknown:
            raise ValueError(f"expected {', '.join(KEYS)}; found {', '.join(unknown)}")
        return items
