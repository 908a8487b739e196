"""Simulators: devices with the real protocols over real sockets and ptys, which read the truth from the twin.

All ``sim://`` addresses with the same machine name and seed share one `VirtualWorld`, that is one machine and one
clock. The name is ``cframe``, ``gantry``, or ``machine`` for the machine that the bench file describes.
``world("cframe", seed=3)`` returns the world, so that tests can compare with the truth.

Parameters of every address: ``seed`` (0), ``pace`` (simulated seconds per second; default: as fast as the readers
read), ``warm`` (1; 0: the sensors have just been switched on), ``wire`` (``tcp`` or ``pty``), and the faults of
`simulators.faults`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from errormotion.instruments.simulators.virtual_world.world import VirtualWorld


def world(machine: str = "cframe", seed: int = 0, *, warm: bool = True) -> VirtualWorld:
    """Return the world of a machine and seed, which is created at the first call."""
    from errormotion.instruments.simulators.virtual_world.world import world as find

    return find(machine, seed, warm=warm)


def in_steps(machine: str = "cframe", seed: int = 0, *, step: float = 1e-4) -> Callable[[int], None]:
    """Return a function that moves the X axis to its n-th position, ``step`` m apart, so that readings differ."""

    def move(number: int) -> None:
        world(machine, seed).move_to((step * (number + 1), 0.0, 0.0))

    return move


def reset() -> None:
    """End all worlds of this process and their threads."""
    from errormotion.instruments.simulators.virtual_world.world import reset as end_all

    end_all()


__all__ = ["in_steps", "reset", "world"]
