"""Interfaces of the devices of a virtual world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np


class Stream(Protocol):
    """A channel that receives samples.

    ``start`` and ``position`` are the numbers of its first and next sample since time 0, ``taken`` is the number that
    its reader has delivered, None if unknown. A stream that has ``ended`` receives no further samples. Its readings are
    relative to the start of its ``measuring_range`` (m).
    """

    rate: float
    sync: str
    start: int
    position: int
    taken: int | None
    ended: bool
    measuring_range: float

    @property
    def channel(self) -> str:
        """Name of its beam."""

    def push(self, distances: np.ndarray[Any, Any]) -> None:
        """Send the next samples, m; may wait for the reader."""


class TriggeredStream(Protocol):
    """A device that a moving axis triggers.

    ``seen`` is the time of the last sample that its reader has delivered, None before the first one.
    """

    @property
    def channel(self) -> str:
        """Name, for messages."""

    @property
    def seen(self) -> float | None:
        """Time, s."""


@runtime_checkable
class Carried(Protocol):
    """A simulated device that is moved between stations beside the machine."""

    def carry_to(self, position: Sequence[float]) -> None:
        """Move it near a position in machine coordinates, m, and lock it on to its reflector again."""


class Device(Protocol):
    """A simulated device in a world."""

    def close(self) -> None:
        """End the device."""
