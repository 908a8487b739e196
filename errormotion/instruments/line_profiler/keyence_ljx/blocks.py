"""Received profiles in the order of their trigger counts, for blocks of equally spaced rows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from errormotion.instruments.line_profiler.keyence_ljx.codec import LOST, TRIGGER_WORD

Array = np.ndarray[Any, Any]


class SpacedRows:
    """Fills blocks with packed profiles so that successive rows have successive trigger counts.

    If the trigger count of the received profiles jumps, the rest of the block up to the next profile is lost. A gap
    that extends beyond the end of a block is skipped and counted, so that a gap needs the memory of one block at most.

    Parameters
    ----------
    receive : callable
        Fills two arrays, (n, words) uint32 and (n,) uint8, with the next profiles of the stream and their reasons.
    batch : int
        Largest number of profiles received at once.
    words : int
        Words of a profile.
    """

    def __init__(self, receive: Callable[[Array, Array], None], batch: int, words: int) -> None:
        self._receive = receive
        self._rows = np.empty((batch, words), dtype=np.uint32)
        self._reasons = np.empty(batch, dtype=np.uint8)
        self._missing = np.zeros(batch, dtype=np.int64)  # number of missing rows before each received row
        self._used = self._received = 0
        self._last: int | None = None  # trigger count of the last received row
        self._gap = 0

    def fill(self, packed: Array, reasons: Array) -> None:
        """Fill both arrays with the next rows, at most ``batch`` of them."""
        done, size = 0, len(packed)
        while done < size:
            if self._used == self._received:
                self._take(size - done)
            if not self._gap and self._missing[self._used]:
                self._gap, self._missing[self._used] = int(self._missing[self._used]), 0
            if self._gap:
                n = min(self._gap, size - done)
                packed[done : done + n], reasons[done : done + n] = 0, LOST
                self._gap -= n
            else:
                n = min(self._rows_without_gap(), size - done)
                part = slice(self._used, self._used + n)
                packed[done : done + n], reasons[done : done + n] = self._rows[part], self._reasons[part]
                self._used += n
            done += n

    def skip_gap(self) -> int:
        """Skip the lost profiles between the last row and the next one; return their number."""
        gap, self._gap = self._gap, 0
        return gap

    def _take(self, n: int) -> None:
        n = min(n, len(self._rows))
        self._receive(self._rows[:n], self._reasons[:n])
        triggers = self._rows[:n, TRIGGER_WORD].astype(np.int64)
        before = np.concatenate(([triggers[0] - 1 if self._last is None else self._last], triggers[:-1]))
        self._missing[:n] = (triggers - before - 1) & 0xFFFFFFFF
        self._last = int(triggers[-1])
        self._used, self._received = 0, n

    def _rows_without_gap(self) -> int:
        gaps = np.flatnonzero(self._missing[self._used : self._received])
        return int(gaps[0]) if gaps.size else self._received - self._used
