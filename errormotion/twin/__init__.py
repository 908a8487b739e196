"""The virtual machine: kinematic errors, heat, artefacts and sensors, and the truth for everything.

``VirtualMachine`` is one seeded individual. ``Event`` says what it is told to do while it warms up, ``StepProgram`` how
it steps a sphere through the beams.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from errormotion.twin.schedule import Event, StepProgram

if TYPE_CHECKING:
    from errormotion.twin.machine import VirtualMachine

__all__ = ["Event", "StepProgram", "VirtualMachine"]


def __getattr__(name: str) -> Any:
    """Load the machine, and numba with it, when it is asked for."""
    if name == "VirtualMachine":
        from errormotion.twin.machine import VirtualMachine

        return VirtualMachine
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
