"""Caches of results of slow functions, shared by all clients."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Generic, TypeVar

T = TypeVar("T")


class Cache(Generic[T]):
    """The results used last, by key; one result is computed at a time.

    Parameters
    ----------
    most : int
        Number of results that are kept.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._lock = threading.Lock()
        self._kept: OrderedDict[Hashable, T] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], T]) -> T:
        """Return the result of a key; it is computed if it is not in the cache."""
        with self._lock:
            if key not in self._kept:
                self._kept[key] = make()
                while len(self._kept) > self._most:
                    self._kept.popitem(last=False)
            self._kept.move_to_end(key)
            return self._kept[key]


class TimedCache(Generic[T]):
    """The last result of each key, computed again when it is outdated; computing takes at most a fifth of the time.

    Parameters
    ----------
    interval : float
        Shortest time after which a result is outdated, s; longer if computing takes long.
    most : int
        Number of results that are kept.
    """

    def __init__(self, interval: float, most: int = 8) -> None:
        self._interval, self._most = interval, most
        self._lock = threading.Lock()
        self._kept: dict[Hashable, tuple[float, T]] = {}

    def get(self, key: Hashable, make: Callable[[], T]) -> T:
        """Return the result of a key; while it is computed for another client, the previous one if there is one."""
        known = self._kept.get(key)
        if known is not None and (time.monotonic() < known[0] or self._lock.locked()):
            return known[1]
        with self._lock:
            start = time.monotonic()
            known = self._kept.get(key)
            if known is None or start >= known[0]:
                result, end = make(), time.monotonic()
                self._kept.pop(key, None)
                self._kept[key] = known = (end + max(self._interval, 4.0 * (end - start)), result)
                while len(self._kept) > self._most:
                    del self._kept[next(iter(self._kept))]
            return known[1]


def stamp(path: Path) -> tuple[str, int, int]:
    """Return path, modification time and size of a file, which identify its content."""
    state = path.stat()
    return str(path), state.st_mtime_ns, state.st_size
