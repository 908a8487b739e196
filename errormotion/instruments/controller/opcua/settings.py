"""Settings of a control with an OPC UA server."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, field_validator

from errormotion.datasets.units import Time
from errormotion.plugins import PluginSettings

UNITS = {"position": "m", "commanded_position": "m", "spindle_speed": "1/min", "spindle_load": "1", "feed": "m/s"}
"""Numeric quantities, with the unit in which they are returned."""
NUMBERS = (
    *(f"{name}.{axis}" for name in ("position", "commanded_position") for axis in "XYZ"),
    *("spindle_speed", "spindle_load", "feed"),
)
TEXTS = ("mode", "program", "execution", "estop")
KEYS = (*NUMBERS, *TEXTS)
"""Quantities that can be assigned to a node."""


class OpcUaSettings(PluginSettings):
    """Settings of a control with an OPC UA server."""

    nodes: dict[str, str] = Field(
        default_factory=dict,
        description="ids of nodes, in addition to the CNC model or without it: spindle_speed = 'ns=2;s=...'",
    )
    units: dict[str, str] = Field(
        default_factory=dict,
        description="units of numbers whose unit the server does not state: position = 'mm', feed = 'mm/min'",
    )
    axes: tuple[str, str, str] = Field(default=("X", "Y", "Z"), description="names of the linear axes on the server")
    spindle: str = Field(default="", description="name of the spindle; empty: the only one")
    channel: str = Field(default="", description="name of the channel; empty: the only one")
    feedback: Literal["direct", "indirect"] = Field(
        default="direct", description="measuring system of the axes: scale (direct) or motor encoder (indirect)"
    )
    running: tuple[str, ...] = Field(
        default=("1", "2", "True", "Running", "Waiting", "ACTIVE"),
        description="values of the node 'execution' that mean that a program runs or waits",
    )
    stopped: tuple[str, ...] = Field(
        default=("1", "True", "TRIGGERED"), description="values of the node 'estop' that mean an emergency stop"
    )
    security: str = Field(
        default="", description="'Basic256Sha256,SignAndEncrypt,client.der,client.pem'; empty: no encryption"
    )
    user: str = Field(default="", description="name of the user; empty: anonymous")
    password_file: str = Field(default="", description="file whose first line is the user's password")
    timeout: Time = Field(default=4.0, description="time limit for one request", gt=0)

    @field_validator("nodes")
    @classmethod
    def _known(cls, nodes: dict[str, str]) -> dict[str, str]:
        unknown = sorted(set(nodes) - set(KEYS))
        if unknown:
            raise ValueError(f"expected {', '.join(KEYS)}; found {', '.join(unknown)}")
        return nodes

    @field_validator("units")
    @classmethod
    def _numbers(cls, units: dict[str, str]) -> dict[str, str]:
        unknown = sorted(set(units) - set(UNITS))
        if unknown:
            raise ValueError(f"expected {', '.join(UNITS)}; found {', '.join(unknown)}")
        return units
