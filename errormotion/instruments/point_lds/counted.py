"""Readings in the order of a counter, for drivers of devices that number the values that they send."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from typing import Any

import numpy as np

from errormotion.errors import ProtocolError
from errormotion.instruments.point_lds.blocks import Block

Array = np.ndarray[Any, Any]

MODULUS = 1 << 32
"""Number of values of the counter."""
GARBLED, LOST = "garbled", "lost"
"""Reasons for readings that were damaged, and for readings that were not received."""


class CountedReadings:
    """Collects readings in the order of their counter; gaps are lost readings.

    A gap takes no memory until its readings are taken.

    Parameters
    ----------
    reasons : tuple of str
        Why a reading is NaN, by code; must contain `GARBLED` and `LOST`; code 0 is a valid reading.
    scale : callable
        Takes values as received; returns readings, m, and the code of each.
    column : callable
        Takes a block; returns the values to be read.
    longest_gap : int
        Largest number of readings that can be lost at once; a larger jump of the counter is an error.

    Attributes
    ----------
    waiting : int
        Readings that can be taken.
    """

    def __init__(
        self,
        reasons: tuple[str, ...],
        scale: Callable[[Array], tuple[Array, Array]],
        column: Callable[[Block], Array],
        *,
        longest_gap: int,
    ) -> None:
        self._reasons, self._scale, self._column, self._longest_gap = reasons, scale, column, longest_gap
        self._garbled, self._lost = reasons.index(GARBLED), reasons.index(LOST)
        self._expected: int | None = None
        self._parts: deque[tuple[Array | None, int, int]] = deque()  # values, number of readings, code without values
        self.waiting = 0

    def add(self, block: Block) -> None:
        """Add the readings of a block.

        Raises
        ------
        ProtocolError
            The counter jumps back, or too far.
        """
        gap = 0 if self._expected is None else (block.counter - self._expected) % MODULUS
        if gap > self._longest_gap:
            raise ProtocolError(
                f"The counter of measured values jumps from {self._expected} to {block.counter}; "
                "check that no other program has set up the controller",
                code="protocol.counter.jump",
            )
        self._expected = (block.counter + block.count) % MODULUS
        if gap:
            self._append(None, gap, self._lost)
        if block.intact:
            self._append(self._column(block), block.count, 0)
        else:
            self._append(None, block.count, self._garbled)

    def take(self, size: int) -> tuple[Array, Array]:
        """Return the next ``size`` readings, m, and the code of each."""
        raws, codes = np.zeros(size, dtype=np.int64), np.zeros(size, dtype=np.int8)
        filled = 0
        while filled < size:
            values, count, code = self._parts.popleft()
            used = min(count, size - filled)
            part = slice(filled, filled + used)
            if values is None:
                codes[part] = code
            else:
                raws[part] = values[:used]
            if used < count:
                self._parts.appendleft((None if values is None else values[used:], count - used, code))
            filled += used
        self.waiting -= size
        readings, own = self._scale(raws)
        missing = codes > 0
        return np.where(missing, np.nan, readings), np.where(missing, codes, own)

    def counts(self, codes: Array) -> dict[str, int]:
        """Return why readings are NaN: reason to count."""
        found = Counter(codes.tolist())
        return {self._reasons[code]: found[code] for code in sorted(found) if code}

    def _append(self, values: Array | None, count: int, code: int) -> None:
        self._parts.append((values, count, code))
        self.waiting += count
