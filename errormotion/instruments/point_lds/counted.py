"""Readings in the order of a counter: what drivers share whose devices number the values that they send."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from errormotion.errors import ProtocolError

Array = np.ndarray[Any, Any]

MODULUS = 1 << 32
"""Of the counter."""


class CountedReadings:
    """Collects readings in the order of their counter; gaps are lost readings.

    Parameters
    ----------
    lost, garbled : int
        Codes of readings that were not received, and that were damaged.
    longest_gap : int
        Readings: a larger jump of the counter is none that was lost, but another sequence.

    Attributes
    ----------
    waiting : int
        Readings that can be taken.
    """

    def __init__(self, *, lost: int, garbled: int, longest_gap: int) -> None:
        self._lost, self._garbled, self._longest_gap = lost, garbled, longest_gap
        self._expected: int | None = None
        self._parts: deque[tuple[Array, Array]] = deque()
        self.waiting = 0

    def add(self, counter: int, count: int, readings: Callable[[], tuple[Array, Array]] | None) -> None:
        """Add readings that were received together.

        Parameters
        ----------
        counter : int
            Number of the first one.
        count : int
            How many they are.
        readings : callable or None
            Returns them, m, and the code of each; None where they were damaged.

        Raises
        ------
        ProtocolError
            The counter jumps back, or too far.
        """
        gap = 0 if self._expected is None else (counter - self._expected) % MODULUS
        if gap > self._longest_gap:
            raise ProtocolError(
                f"The counter of measured values jumps from {self._expected} to {counter}; "
                "was the controller set up by another program?"
            )
        self._expected = (counter + count) % MODULUS
        if gap:
            self._append(np.full(gap, np.nan), np.full(gap, self._lost, dtype=np.int8))
        if readings is None:
            self._append(np.full(count, np.nan), np.full(count, self._garbled, dtype=np.int8))
        else:
            self._append(*readings())

    def take(self, size: int) -> tuple[Array, Array]:
        """Return the next ``size`` readings, m, and the code of each."""
        values, codes = np.empty(size), np.empty(size, dtype=np.int8)
        filled = 0
        while filled < size:
            head, code = self._parts.popleft()
            used = min(len(head), size - filled)
            values[filled : filled + used], codes[filled : filled + used] = head[:used], code[:used]
            if used < len(head):
                self._parts.appendleft((head[used:], code[used:]))
            filled += used
        self.waiting -= size
        return values, codes

    def _append(self, values: Array, codes: Array) -> None:
        self._parts.append((values, codes))
        self.waiting += len(values)
