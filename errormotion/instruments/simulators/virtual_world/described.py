"""The machine of ``sim://machine``, which the bench file describes in its table ``[machine]``."""

from __future__ import annotations

from errormotion.errors import InstrumentError
from errormotion.kinematics.description import MachineDescription

NAME = "machine"
"""Host of the addresses of devices on the described machine."""

_described: MachineDescription | None = None


def describe(machine: MachineDescription | None) -> None:
    """Set the machine of ``sim://machine`` for the devices that are opened from now on."""
    global _described
    _described = machine


def described(name: str) -> str | MachineDescription:
    """Return the machine for a name in a simulated address.

    Raises
    ------
    InstrumentError
        No machine is described, or it moves other axes than X, Y and Z.
    """
    if name != NAME:
        return name
    if _described is None:
        raise InstrumentError(
            f"'sim://{NAME}' is the machine of the bench: expected a table [machine] in the bench file; found none",
            code="simulator.machine.missing",
        )
    if _described.moving_axes != ("X", "Y", "Z"):
        raise InstrumentError(
            f"'sim://{NAME}': the simulated control moves X, Y and Z; found {', '.join(_described.moving_axes)}. "
            "Fix the rotary axes in [machine]",
            code="simulator.machine.axes",
        )
    return _described
