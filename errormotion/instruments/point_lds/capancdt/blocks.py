"""Blocks of values on the data port of a capaNCDT 6200: a header of 32 bytes and frames of one value a channel.

Layout (6200 p. 55), all little-endian: preamble, order number, serial number (32 bit each), channels (64 bit, two bits
each), status (32 bit, not used), number of frames and bytes of a frame (16 bit each), counter of the first frame
(32 bit), values (32 bit each).

The manual names the preamble ``MEAS`` and the number of frames ahead of the bytes of a frame. Three independent
drivers find the preamble as a little-endian word, ``SAEM``, and two find the bytes of a frame first. Both are read:
the bytes of a frame follow from the channels.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np

PREAMBLES = (b"SAEM", b"MEAS")
HEADER = struct.Struct("<4sIIQIHHI")
BYTES_OF_VALUE = 4
CHANNELS = 32
MAX_BLOCK_BYTES = 65536
"""Longest block: it is one TCP packet (6200 p. 55)."""

FULL_SCALE = 0xFFFFFF
"""Value at the end of the measuring range; it is 0 at its start (6200 p. 56)."""

VALID, UNDER, OVER, UNKNOWN, GARBLED, LOST = range(6)
REASONS = ("", "under range", "over range", "unknown code", "garbled", "lost")
"""Why a reading is NaN, by code."""

Array = np.ndarray[Any, Any]

_PREAMBLE = re.compile(b"|".join(PREAMBLES))


@dataclass(frozen=True)
class Block:
    """Frames of all channels.

    Attributes
    ----------
    counter : int
        Number of the first frame, modulo 2**32.
    channels : tuple of int
        Numbers of the channels, from 1.
    values : ndarray, int64, (frame, channel)
        As they came.
    intact : bool
        Whether a block, or nothing, follows; else bytes of it have been lost or added.
    """

    counter: int
    channels: tuple[int, ...]
    values: Array
    intact: bool = True


class BlockDecoder:
    """Splits the bytes of the data port into blocks; stray bytes between them are discarded.

    Attributes
    ----------
    stray : int
        Number of discarded bytes.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.stray = 0

    def feed(self, data: bytes, *, last: bool = False) -> list[Block]:
        """Return the blocks that are complete.

        A block is returned when the start of the next one is seen, or at once where ``last`` states that none follows.
        """
        self._buffer += data
        blocks: list[Block] = []
        start = 0
        while (block := self._next(start, last)) is not None:
            found, start = block
            if found is not None:
                blocks.append(found)
        del self._buffer[:start]
        return blocks

    def _next(self, start: int, last: bool) -> tuple[Block | None, int] | None:
        """Return the block at a place, or None with the place where the search goes on; None: more bytes are needed."""
        buffer = self._buffer
        if len(buffer) - start < len(PREAMBLES[0]):
            return None
        if buffer[start : start + 4] not in PREAMBLES:
            place = self._preamble(start + 1)
            self.stray += place - start
            return None, place
        if len(buffer) - start < HEADER.size:
            return None
        shape = _shape(buffer, start)
        if shape is None:  # no header
            place = self._preamble(start + 1)
            self.stray += place - start
            return None, place
        channels, frames, counter = shape
        end = start + HEADER.size + frames * len(channels) * BYTES_OF_VALUE
        follows = len(buffer) - end
        if follows < 0 or (follows < len(PREAMBLES[0]) and not last):
            return None
        intact = follows < len(PREAMBLES[0]) or buffer[end : end + 4] in PREAMBLES
        if not intact:  # the block may end earlier: the search for the next one goes on within it
            end = min(self._preamble(start + HEADER.size), end)
        values = np.frombuffer(bytes(buffer[start + HEADER.size : end]), dtype="<i4") if intact else _nothing(frames)
        shaped = values.reshape(frames, -1).astype(np.int64) if intact else values
        return Block(counter, channels, shaped, intact), end

    def _preamble(self, start: int) -> int:
        """Return the first place from ``start`` on where a preamble is or may begin."""
        found = _PREAMBLE.search(self._buffer, start)
        return found.start() if found else max(start, len(self._buffer) - len(PREAMBLES[0]) + 1)


def _nothing(frames: int) -> Array:
    return np.empty((frames, 0), dtype=np.int64)


def _shape(buffer: bytearray, start: int) -> tuple[tuple[int, ...], int, int] | None:
    """Return channels, number of frames and counter of a header; None where it is none."""
    _, _, _, field, _, one, other, counter = HEADER.unpack_from(buffer, start)
    channels = tuple(number + 1 for number in range(CHANNELS) if field >> 2 * number & 3)
    size = len(channels) * BYTES_OF_VALUE
    if not channels or size not in (one, other):
        return None
    frames = other if one == size else one
    if frames == 0 or HEADER.size + frames * size > MAX_BLOCK_BYTES:
        return None
    return channels, frames, counter


def scale(raws: Array, low: float, span: float) -> tuple[Array, Array]:
    """Return readings, m, and the code of each.

    A value at either end of the 24 bits is one that was cut off there: beyond the range (assumption).
    """
    codes = np.full(raws.shape, VALID, dtype=np.int8)
    codes[raws <= 0] = UNDER
    codes[raws >= FULL_SCALE] = OVER
    codes[(raws < 0) | (raws > FULL_SCALE)] = UNKNOWN
    readings = low + raws / FULL_SCALE * span
    return np.where(codes == VALID, readings, np.nan), codes
