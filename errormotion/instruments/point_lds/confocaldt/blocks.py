"""Blocks of values on the data port of a confocalDT 24x1: a header of 28 bytes and frames of 32-bit values.

Header (24x1 p. 115 and 116), all little-endian: preamble, order number, serial number, flags 1, flags 2 (32 bit each),
number of frames and bytes of a frame (16 bit each), counter of the first frame (32 bit). The flags state which values a
frame has. Only frames of one distance are read.

As in the blocks of the capaNCDT, the preamble may be ``MEAS`` or the little-endian word ``SAEM``, and the number of
frames may precede or follow the bytes of a frame: a frame of one distance has 4 bytes.
"""

from __future__ import annotations

import re
import struct
from typing import Any

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.point_lds.blocks import BYTES_OF_VALUE, MAX_BLOCK_BYTES, BlockDecoder, Header
from errormotion.instruments.point_lds.counted import GARBLED, LOST, CountedReadings

HEADER = struct.Struct("<4sIIIIHHI")
MAX_GAP = 1_000_000
"""Largest number of readings that can be lost at once; a larger jump of the counter is an error."""

MEASURED, DISTANCE_1 = 1 << 18, 1 << 19
"""Bits of flags 1 for values, and for the distance of peak 1 (24x1 p. 116)."""
RATE_BITS = 0xF << 28
"""Bits of flags 2 that state the measuring rate and not a value."""

RESOLUTION = 1e-9
"""m (24x1 p. 112)."""
FIRST_ERROR = 0x7FFFFF00
"""Lowest value that is not a distance."""

VALID, NO_PEAK, IN_FRONT, BEHIND, NOT_CALCULATED, UNKNOWN = range(6)
REASONS = ("", "no peak", "under range", "over range", "not calculated", "unknown code", GARBLED, LOST)
"""Why a reading is NaN, by code."""
ERRORS = {0x7FFFFFFB: NO_PEAK, 0x7FFFFFFA: IN_FRONT, 0x7FFFFFF9: BEHIND, 0x7FFFFFF8: NOT_CALCULATED}
"""Error values: those of the optoNCDT 2300 (2300 p. 98); the available pages of the 24x1 state none (assumption)."""

Array = np.ndarray[Any, Any]

_WITH_DISTANCE = re.escape(bytes(byte for byte in range(256) if byte << 16 & DISTANCE_1))
_POSSIBLE = b".{10}[%s][\\x00-\\x0f].{12}" % _WITH_DISTANCE  # flags 1 contain the distance, and no bit above 27


def block_decoder() -> BlockDecoder:
    """Return a decoder of the blocks of a confocalDT; it refuses frames of other values than one distance."""
    return BlockDecoder(HEADER.size, _POSSIBLE, _header)


def _header(buffer: bytearray, start: int) -> Header | None:
    _, _, _, flags, others, one, other, counter = HEADER.unpack_from(buffer, start)
    frames = other if one == BYTES_OF_VALUE else one
    whole = BYTES_OF_VALUE in (one, other) and 0 < frames <= (MAX_BLOCK_BYTES - HEADER.size) // BYTES_OF_VALUE
    if whole and _one_distance(flags, others):
        return Header(counter, frames)
    if _plausible(flags, one, other):
        raise _other_values(flags, others, max(one, other))
    return None


def _one_distance(flags: int, others: int) -> bool:
    return flags & ~MEASURED == DISTANCE_1 and not others & ~RATE_BITS


def _plausible(flags: int, one: int, other: int) -> bool:
    """Whether a header announces other values than one distance: it contains a distance and complete frames."""
    return bool(flags & DISTANCE_1) and 0 < one <= MAX_BLOCK_BYTES and other > 0 and flags >> 28 == 0


def _other_values(flags: int, others: int, size: int) -> InstrumentError:
    return InstrumentError(
        f"The controller sends frames of {size} bytes (flags {flags:08X} and {others:08X}); expected one distance of "
        f"{BYTES_OF_VALUE} bytes. Select the measurement program 'distance' and linearized values on its web page",
        code="sensor.output.form",
    )


def scale(raws: Array) -> tuple[Array, Array]:
    """Return readings, m from the start of the range, and the code of each."""
    codes = np.full(raws.shape, VALID, dtype=np.int8)
    codes[raws >= FIRST_ERROR] = UNKNOWN
    for value, code in ERRORS.items():
        codes[raws == value] = code
    return np.where(codes == VALID, raws * RESOLUTION, np.nan), codes


def readings() -> CountedReadings:
    """Return an empty collection of readings."""
    return CountedReadings(REASONS, scale, lambda block: np.asarray(block.values[:, 0]), longest_gap=MAX_GAP)
