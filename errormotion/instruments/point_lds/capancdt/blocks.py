"""Blocks of values on the data port of a capaNCDT 6200: a header of 32 bytes and frames of one value for each channel.

Layout (6200 p. 55), all little-endian: preamble, order number, serial number (32 bit each), channels (64 bit, two bits
each), status (32 bit, not used), number of frames and bytes of a frame (16 bit each), counter of the first frame
(32 bit), values (32 bit each).

In the manual, the preamble is ``MEAS`` and the number of frames precedes the bytes of a frame. Three independent
drivers read the preamble as a little-endian word, ``SAEM``, and two read the bytes of a frame first. Both are accepted:
the bytes of a frame follow from the channels.
"""

from __future__ import annotations

import re
import struct
from functools import lru_cache
from typing import Any

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.point_lds.blocks import BYTES_OF_VALUE, MAX_BLOCK_BYTES, Block, BlockDecoder, Header
from errormotion.instruments.point_lds.capancdt.codec import Channel
from errormotion.instruments.point_lds.counted import GARBLED, LOST, CountedReadings

HEADER = struct.Struct("<4sIIQIHHI")
CHANNELS = 32
MAX_GAP = 100_000
"""Largest number of readings that can be lost at once; a larger jump of the counter is an error."""

FULL_SCALE = 0xFFFFFF
"""Value at the end of the measuring range; at its start it is 0 (6200 p. 56)."""

VALID, UNDER, OVER, UNKNOWN = range(4)
REASONS = ("", "under range", "over range", "unknown code", GARBLED, LOST)
"""Why a reading is NaN, by code."""

Array = np.ndarray[Any, Any]

_LOW_BITS = int("01" * CHANNELS, 2)  # the lower of the two bits of each channel
_SIZE = b"[%s]\\x00" % re.escape(bytes(range(BYTES_OF_VALUE, BYTES_OF_VALUE * CHANNELS + 1, BYTES_OF_VALUE)))
_POSSIBLE = b".{20}(?:%s..|..%s).{4}" % (_SIZE, _SIZE)  # one of the two numbers is the size of a frame


def block_decoder() -> BlockDecoder:
    """Return a decoder of the blocks of a capaNCDT."""
    return BlockDecoder(HEADER.size, _POSSIBLE, _header)


def _header(buffer: bytearray, start: int) -> Header | None:
    _, _, _, field, _, one, other, counter = HEADER.unpack_from(buffer, start)
    present = (field | field >> 1) & _LOW_BITS
    size = present.bit_count() * BYTES_OF_VALUE
    if not size or size not in (one, other):
        return None
    frames = other if one == size else one
    if frames == 0 or HEADER.size + frames * size > MAX_BLOCK_BYTES:
        return None
    return Header(counter, frames, _channels(present))


@lru_cache(64)
def _channels(present: int) -> tuple[int, ...]:
    return tuple(number + 1 for number in range(CHANNELS) if present >> 2 * number & 1)


def scale(raws: Array, low: float, span: float) -> tuple[Array, Array]:
    """Return readings, m, and the code of each.

    A value at either end of the 24 bits is clipped: the surface is beyond the range (assumption).
    """
    codes = np.full(raws.shape, VALID, dtype=np.int8)
    codes[raws <= 0] = UNDER
    codes[raws >= FULL_SCALE] = OVER
    codes[(raws < 0) | (raws > FULL_SCALE)] = UNKNOWN
    readings = low + raws / FULL_SCALE * span
    return np.where(codes == VALID, readings, np.nan), codes


def column(block: Block, channel: int) -> Array:
    """Return the values of a channel in a block.

    Raises
    ------
    InstrumentError
        The controller does not send this channel.
    """
    if channel not in block.channels:
        sent = ", ".join(map(str, block.channels))
        raise InstrumentError(
            f"The controller sends the channels {sent}; expected channel {channel} among them",
            code="sensor.channel.missing",
        )
    return np.asarray(block.values[:, block.channels.index(channel)])


def readings_of(number: int, channel: Channel) -> CountedReadings:
    """Return an empty collection of readings of a channel with this number and range."""
    return CountedReadings(
        REASONS,
        lambda raws: scale(raws, channel.offset, channel.measuring_range),
        lambda block: column(block, number),
        longest_gap=MAX_GAP,
    )
