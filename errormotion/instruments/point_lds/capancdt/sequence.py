"""Readings of one channel in the order of their counter, in blocks of equal size."""

from __future__ import annotations

from collections import Counter, deque
from typing import Any

import numpy as np

from errormotion.errors import InstrumentError, ProtocolError
from errormotion.instruments.point_lds.capancdt.blocks import (
    COUNTER,
    GARBLED,
    LOST,
    REASONS,
    Block,
    scale,
)
from errormotion.instruments.point_lds.capancdt.codec import Channel

Array = np.ndarray[Any, Any]

LONGEST_GAP = 100_000
"""Readings: a larger jump of the counter is none that was lost, but another sequence."""


def column(block: Block, channel: int) -> Array:
    """Return the values of a channel in a block.

    Raises
    ------
    InstrumentError
        The controller does not send this channel.
    """
    if channel not in block.channels:
        sent = ", ".join(map(str, block.channels))
        raise InstrumentError(f"The controller sends the channels {sent}; expected channel {channel} among them")
    return block.values[:, block.channels.index(channel)]


class Sequence:
    """Collects readings; gaps of the counter are lost readings.

    Parameters
    ----------
    number : int
        Of the channel.
    channel : Channel
        Its range.
    """

    def __init__(self, number: int, channel: Channel) -> None:
        self._number = number
        self._channel = channel
        self._expected: int | None = None
        self._parts: deque[tuple[Array, Array]] = deque()
        self.waiting = 0

    def add(self, block: Block) -> None:
        """Add a block.

        Raises
        ------
        ProtocolError
            The counter jumps back, or too far.
        """
        frames = len(block.values)
        gap = 0 if self._expected is None else (block.counter - self._expected) % COUNTER
        if gap > LONGEST_GAP:
            raise ProtocolError(
                f"The counter of measured values jumps from {self._expected} to {block.counter}; "
                "was the controller set up by another program?"
            )
        self._expected = (block.counter + frames) % COUNTER
        if gap:
            self._append(np.full(gap, np.nan), np.full(gap, LOST, dtype=np.int8))
        if not block.intact:
            self._append(np.full(frames, np.nan), np.full(frames, GARBLED, dtype=np.int8))
            return
        self._append(*scale(column(block, self._number), self._channel.offset, self._channel.measuring_range))

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


def reasons(codes: Array) -> dict[str, int]:
    """Return why readings are NaN: reason to count."""
    counts = Counter(codes.tolist())
    return {REASONS[code]: counts[code] for code in sorted(counts) if code}
