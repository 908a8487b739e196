"""Readings of one channel in the order of their counter, in blocks of equal size."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.point_lds.capancdt.blocks import (
    GARBLED,
    LOST,
    REASONS,
    Block,
    scale,
)
from errormotion.instruments.point_lds.capancdt.codec import Channel
from errormotion.instruments.point_lds.counted import CountedReadings

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


class Sequence(CountedReadings):
    """Collects readings of one channel; gaps of the counter are lost readings.

    Parameters
    ----------
    number : int
        Of the channel.
    channel : Channel
        Its range.
    """

    def __init__(self, number: int, channel: Channel) -> None:
        super().__init__(lost=LOST, garbled=GARBLED, longest_gap=LONGEST_GAP)
        self._number = number
        self._channel = channel

    def add_block(self, block: Block) -> None:
        """Add a block; ProtocolError where the counter jumps back, or too far."""
        self.add(block.counter, len(block.values), (lambda: self._readings(block)) if block.intact else None)

    def _readings(self, block: Block) -> tuple[Array, Array]:
        return scale(column(block, self._number), self._channel.offset, self._channel.measuring_range)


def reasons(codes: Array) -> dict[str, int]:
    """Return why readings are NaN: reason to count."""
    counts = Counter(codes.tolist())
    return {REASONS[code]: counts[code] for code in sorted(counts) if code}
