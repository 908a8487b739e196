"""What the virtual world knows of those who stream from it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np


class Stream(Protocol):
    """A channel that wants samples.

    ``start`` and ``position`` are the numbers of its first and next sample since time 0, ``taken`` is how many its
    reader has passed on, None where it is unknown. A stream that has ``ended`` wants no more. Its readings count
    from the start of its ``measuring_range`` (m).
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
    """A device that samples where a moving axis triggers it.

    ``seen`` is the time of the last sample that its reader has passed on, None before the first one.
    """

    @property
    def channel(self) -> str:
        """Name, for messages."""

    @property
    def seen(self) -> float | None:
        """Time, s."""


@runtime_checkable
class Carried(Protocol):
    """A simulated device that is carried from station to station beside the machine."""

    def carry_to(self, position: Sequence[float]) -> None:
        """Put it near a position in machine coordinates, m, and have it take up its beam again."""


class Device(Protocol):
    """A simulated device in a world."""

    def close(self) -> None:
        """End the device."""
