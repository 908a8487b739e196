"""Blocks of values on the data port of a confocalDT 24x1: a header of 28 bytes and frames of 32-bit values.

Header (24x1 p. 115 and 116), all little-endian: preamble, order number, serial number, flags 1, flags 2 (32 bit each),
number of frames and bytes of a frame (16 bit each), counter of the first frame (32 bit). The flags state which values
a frame has. One distance, and nothing else, is read here.

As in the blocks of the capaNCDT, the preamble is read as ``MEAS`` and as the little-endian word ``SAEM``, and the
number of frames ahead of the bytes of a frame or behind: of one distance a frame has 4 bytes.
"""

from __future__ import annotations

import re
import struct
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.point_lds.counted import CountedReadings

PREAMBLES = (b"SAEM", b"MEAS")
PREAMBLE_BYTES = 4
HEADER = struct.Struct("<4sIIIIHHI")
BYTES_OF_VALUE = 4
MAX_BLOCK_BYTES = 65536
"""Longest block: it is one TCP packet (24x1 p. 115)."""
LONGEST_GAP = 1_000_000
"""Readings: a larger jump of the counter is none that was lost, but another sequence."""

MEASURED, DISTANCE_1 = 1 << 18, 1 << 19
"""Bits of flags 1 for values, and for the distance of peak 1 (24x1 p. 116)."""
RATE_BITS = 0xF << 28
"""Bits of flags 2 that state the measuring rate, no value."""

RESOLUTION = 1e-9
"""m (24x1 p. 112)."""
FIRST_ERROR = 0x7FFFFF00
"""Values from here on are no distances."""

VALID, NO_PEAK, IN_FRONT, BEHIND, NOT_CALCULATED, UNKNOWN, GARBLED, LOST = range(8)
REASONS = ("", "no peak", "under range", "over range", "not calculated", "unknown code", "garbled", "lost")
"""Why a reading is NaN, by code."""
ERRORS = {0x7FFFFFFB: NO_PEAK, 0x7FFFFFFA: IN_FRONT, 0x7FFFFFF9: BEHIND, 0x7FFFFFF8: NOT_CALCULATED}
"""Error values: those of the optoNCDT 2300 (2300 p. 98); the pages of the 24x1 at hand print none (assumption)."""

Array = np.ndarray[Any, Any]

_PREAMBLE = re.compile(b"|".join(PREAMBLES))


@dataclass(frozen=True)
class Block:
    """Values of the distance.

    Attributes
    ----------
    counter : int
        Number of the first value, modulo 2**32.
    values : ndarray, int64
        As they came; of a block that is not intact only their number counts.
    intact : bool
        Whether a block, or nothing, follows; else bytes of it have been lost or added.
    """

    counter: int
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

        Raises
        ------
        InstrumentError
            The controller sends other values than one distance.
        """
        self._buffer += data
        blocks: list[Block] = []
        start = 0
        while (found := self._next(start, last)) is not None:
            block, start = found
            if block is not None:
                blocks.append(block)
        del self._buffer[:start]
        return blocks

    def _next(self, start: int, last: bool) -> tuple[Block | None, int] | None:
        """Return the block at a position, or None with the position where the search goes on; None: wait for bytes."""
        buffer = self._buffer
        if len(buffer) - start < PREAMBLE_BYTES:
            return None
        if buffer[start : start + PREAMBLE_BYTES] not in PREAMBLES:
            return None, self._skip(start, start + 1)
        if len(buffer) - start < HEADER.size:
            return None
        _, _, _, flags, others, one, other, counter = HEADER.unpack_from(buffer, start)
        frames = other if one == BYTES_OF_VALUE else one
        length = HEADER.size + frames * BYTES_OF_VALUE
        whole = BYTES_OF_VALUE in (one, other) and frames > 0 and length <= MAX_BLOCK_BYTES
        if not whole or not _one_distance(flags, others):
            if _plausible(flags, one, other):
                raise _other_values(flags, others, max(one, other))
            return None, self._skip(start, start + 1)
        end = start + length
        follows = len(buffer) - end
        if follows < 0 or (follows < PREAMBLE_BYTES and not last):
            return None
        intact = follows < PREAMBLE_BYTES or buffer[end : end + PREAMBLE_BYTES] in PREAMBLES
        if not intact:  # the block may end earlier: the search for the next one goes on within it
            return Block(counter, np.zeros(frames, dtype=np.int64), False), min(
                self._preamble(start + HEADER.size), end
            )
        values = np.frombuffer(bytes(buffer[start + HEADER.size : end]), dtype="<i4").astype(np.int64)
        return Block(counter, values), end

    def _skip(self, start: int, search: int) -> int:
        end = self._preamble(search)
        self.stray += end - start
        return end

    def _preamble(self, start: int) -> int:
        """Return the first position from ``start`` on where a preamble is or may begin."""
        found = _PREAMBLE.search(self._buffer, start)
        return found.start() if found else max(start, len(self._buffer) - PREAMBLE_BYTES + 1)


def _one_distance(flags: int, others: int) -> bool:
    return flags & ~MEASURED == DISTANCE_1 and not others & ~RATE_BITS


def _plausible(flags: int, one: int, other: int) -> bool:
    """Whether a header that is not of one distance is one of other values: it has a distance and whole frames."""
    return bool(flags & DISTANCE_1) and 0 < one <= MAX_BLOCK_BYTES and other > 0 and flags >> 28 == 0


def _other_values(flags: int, others: int, size: int) -> InstrumentError:
    return InstrumentError(
        f"The controller sends frames of {size} bytes (flags {flags:08X} and {others:08X}); expected one distance of "
        f"{BYTES_OF_VALUE} bytes. Select the measurement program 'distance' and linearized values in its web page"
    )


def scale(raws: Array) -> tuple[Array, Array]:
    """Return readings, m from the start of the range, and the code of each."""
    codes = np.full(raws.shape, VALID, dtype=np.int8)
    codes[raws >= FIRST_ERROR] = UNKNOWN
    for value, code in ERRORS.items():
        codes[raws == value] = code
    return np.where(codes == VALID, raws * RESOLUTION, np.nan), codes


class Sequence(CountedReadings):
    """Collects readings in the order of their counter; gaps are lost readings."""

    def __init__(self) -> None:
        super().__init__(lost=LOST, garbled=GARBLED, longest_gap=LONGEST_GAP)

    def add_block(self, block: Block) -> None:
        """Add a block; ProtocolError where the counter jumps back, or too far."""
        self.add(block.counter, len(block.values), (lambda: scale(block.values)) if block.intact else None)


def reasons(codes: Array) -> dict[str, int]:
    """Return why readings are NaN: reason to count."""
    counts = Counter(codes.tolist())
    return {REASONS[code]: counts[code] for code in sorted(counts) if code}
