"""``[machine]`` of a bench file: the description of a machine, and its comparison with limits and settings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from errormotion.campaign.sections.limits import AXES, Limits
from errormotion.datasets.files import tomlfile
from errormotion.datasets.units import Angle, Length, format_quantity
from errormotion.kinematics.description import DescriptionError, MachineDescription

_ROUNDING = 1e-9
"""Tolerance of comparisons with the travel, m."""


class Travel(BaseModel):
    """``[machine.travel]``: lowest and highest position of each axis."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    X: tuple[Length, Length] | None = None
    Y: tuple[Length, Length] | None = None
    Z: tuple[Length, Length] | None = None
    U: tuple[Length, Length] | None = None
    V: tuple[Length, Length] | None = None
    W: tuple[Length, Length] | None = None
    A: tuple[Angle, Angle] | None = None
    B: tuple[Angle, Angle] | None = None
    C: tuple[Angle, Angle] | None = None


class RotaryAxis(BaseModel):
    """``[machine.rotary.NAME]``: position of a rotary axis, and its angle if it is fixed."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    position: tuple[Length, Length, Length] = Field(
        description='a point on the axis with all axes at zero, such as ["0 mm", "0 mm", "-50 mm"]'
    )
    fixed: Angle | None = Field(default=None, description="angle of a fixed axis")


class MachineTable(BaseModel):
    """``[machine]``: the machine tool of a bench."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    name: str = Field(description="the name of the machine tool")
    chain: str = Field(
        description='the bodies and axes from workpiece to tool, such as "workpiece-X-Y-bed-Z-spindle-tool"'
    )
    travel: Travel = Field(default=Travel(), description="lowest and highest position of each axis")
    spindle_axis: str = Field(default="Z", description="direction of the axis of rotation of the spindle: X, Y or Z")
    rotary: dict[str, RotaryAxis] = Field(default={}, description="the rotary axes by name")


def read_machine(data: Mapping[str, Any], *, key: str = "machine") -> tuple[MachineDescription | None, list[str]]:
    """Return the description in a table, or None and every mistake in the table.

    Parameters
    ----------
    data : mapping
        Content of the table; units are compulsory.
    key : str
        Key of the table in its file, for messages.
    """
    table, mistakes = tomlfile.check(data, MachineTable, prefix=(key,))
    if table is None:
        return None, mistakes
    rotary = table.rotary
    try:
        description = MachineDescription(
            name=table.name,
            chain=table.chain,
            travel={axis: span for axis, span in table.travel if span is not None},
            spindle_axis=table.spindle_axis,
            positions={axis: each.position for axis, each in rotary.items()},
            fixed={axis: each.fixed for axis, each in rotary.items() if each.fixed is not None},
        )
    except DescriptionError as error:
        return None, [f"{key}.{name}: {text}" for name, text in error.mistakes.items()]
    return description, []


def completed(method: Any, settings: Any, machine: MachineDescription | None) -> Any:
    """Return the settings of a method; those that are not stated get the defaults of the machine."""
    if machine is None:
        return settings
    defaults = method().machine_defaults(machine, settings)
    given = {key: value for key, value in defaults.items() if key not in settings.model_fields_set}
    return settings.model_copy(update=given)


def contradictions(method: Any, settings: Any, machine: MachineDescription | None) -> Mapping[str, str]:
    """Return the contradictions between the settings of a method and the machine, by setting."""
    return {} if machine is None else dict(method().check_machine(settings, machine))


def limits_within(limits: Limits, machine: MachineDescription) -> tuple[Limits, list[str]]:
    """Return the limits, with the travel for axes without limits, and the limits that are outside the travel."""
    spans: dict[str, Any] = {}
    mistakes = []
    for axis in AXES:
        span, travel = getattr(limits, axis), machine.travel.get(axis)
        if span is None:
            spans[axis] = travel
        elif travel is None:
            mistakes.append(f"limits.{axis}: the chain '{machine.chain}' has no axis {axis}; remove the limits")
        elif span[0] < travel[0] - _ROUNDING or span[1] > travel[1] + _ROUNDING:
            mistakes.append(
                f"limits.{axis}: expected limits within the travel (machine.travel.{axis}), {_range(travel)}; "
                f"found {_range(span)}"
            )
    return limits.model_copy(update={axis: span for axis, span in spans.items() if span is not None}), mistakes


def _range(span: tuple[float, float]) -> str:
    return " to ".join(format_quantity(value, "mm", 7) for value in span)
