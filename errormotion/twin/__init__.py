"""The virtual machine: kinematic errors, heat, artefacts and sensors, and the true errors.

``VirtualMachine`` is one seeded individual. ``Event`` is a command during the warm-up, ``StepProgram`` the motion of a
sphere in steps through the beams.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from errormotion.twin.schedule import Event, StepProgram

if TYPE_CHECKING:
    from errormotion.twin.machine import VirtualMachine

__all__ = ["Event", "StepProgram", "VirtualMachine"]


def __getattr__(name: str) -> Any:
    """Load the machine, and numba with it, when it is first used."""
    if name == "VirtualMachine":
        from errormotion.twin.machine import VirtualMachine

        return VirtualMachine
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
