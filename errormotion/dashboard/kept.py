"""Results of work that takes time, kept for the next client that asks for the same."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Generic, TypeVar

T = TypeVar("T")


class Kept(Generic[T]):
    """The last few results by their keys; one is made at a time.

    Parameters
    ----------
    most : int
        Results that are kept.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._lock = threading.Lock()
        self._kept: OrderedDict[Hashable, T] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], T]) -> T:
        """Return the result of a key, made now if it is not known."""
        with self._lock:
            if key not in self._kept:
                self._kept[key] = make()
                while len(self._kept) > self._most:
                    self._kept.popitem(last=False)
            self._kept.move_to_end(key)
            return self._kept[key]


class Lately(Generic[T]):
    """The last result of each key, made anew when it is old: at most a fifth of the time is work.

    Parameters
    ----------
    interval : float
        Shortest time after which a result is old, s; more where it took long.
    most : int
        Results that are kept.
    """

    def __init__(self, interval: float, most: int = 8) -> None:
        self._interval, self._most = interval, most
        self._lock = threading.Lock()
        self._kept: dict[Hashable, tuple[float, T]] = {}

    def get(self, key: Hashable, make: Callable[[], T]) -> T:
        """Return the result of a key; while it is being made for another client, the one before, if there is one."""
        known = self._kept.get(key)
        if known is not None and (time.monotonic() < known[0] or self._lock.locked()):
            return known[1]
        with self._lock:
            begin = time.monotonic()
            known = self._kept.get(key)
            if known is None or begin >= known[0]:
                result, end = make(), time.monotonic()
                self._kept.pop(key, None)
                self._kept[key] = known = (end + max(self._interval, 4.0 * (end - begin)), result)
                while len(self._kept) > self._most:
                    del self._kept[next(iter(self._kept))]
            return known[1]


def stamp(path: Path) -> tuple[str, int, int]:
    """Return what changes with the content of a file: its path, time of change and size."""
    state = path.stat()
    return str(path), state.st_mtime_ns, state.st_size
