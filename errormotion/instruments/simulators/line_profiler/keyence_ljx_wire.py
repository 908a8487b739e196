"""Bytes that an LJ-X8000A sends: replies to commands, profiles, notices.

Written from the manufacturer's Linux library (LJX8_IF_Linux 1.0.0 and its ProfileDataConvert), not from this project's
driver. All numbers are little-endian.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]

LENGTH = 1e-8
"""Unit of lengths, m: 0.01 um."""
MAX_POINTS = 3200
"""Points of a profile."""
PROGRAMS = 16
"""Programs 0..15."""
MAX_DATA = 20 * 1024
"""Bytes of data in the largest request, that of a setting."""
MAX_REQUEST = 16 + 16 + MAX_DATA
"""Bytes of the longest request; a longer one ends the connection."""
PREFIX = bytes.fromhex("0300F000")
"""Bytes 4..7 of a request to an LJ-X; the LJ-V7 has 01 at their start."""
INTENSITY = 0x40
"""Bit of the kind of a profile: with intensities."""
ONE_PROFILE = 0x01
"""Bits of the kind of a profile other than 0x60 are the number of profiles: one."""
NO_HEIGHT = -(1 << 19) + 1
"""Raw 0x80001, invalid."""
MIN_HEIGHT = -(1 << 19) + 4
"""Steps: 0x80000 to 0x80003 are codes."""
STOPPED, BATCH_ENDED = 0x00000001, 0x00010000
"""Notices: a part in the low 16 bits ends the transmission; bit 16 is the end of a batch."""
HEADER_WORDS = 6
TRIGGER_WORD, ENCODER_WORD = 1, 2


class Code(IntEnum):
    """Return codes, byte 17 of a reply; the manufacturer's library adds 0x8000. Some depend on the command."""

    OK = 0x00
    OTHER_MODEL = 0x21
    UNKNOWN = 0x31
    WRONG_LENGTH = 0x32
    WRONG_STATE = 0x41
    WRONG_PARAMETER = 0x42
    REFUSED_BY_SETTING = 0x80  # 21: not the external trigger mode; 22, 23: batch measurement is off
    OTHER_BATCH_SETTING = 0x81  # 42: batch measurement is on; 43: it is off
    NO_SUCH_START = 0x81  # 47
    SAVE_AREA_BUSY = 0xA0  # 02
    LASER_OFF = 0xA0  # 22, 23
    NO_DATA = 0xA0  # 42, 43
    NO_CONNECTION = 0xA0  # 47, A0
    STREAMS_ALREADY = 0xA1
    OTHER_COMMAND_CODE = 0xA2
    OTHER_START_CODE = 0xA3
    DATA_CLEARED = 0xA4


Answer = tuple[int, bytes]
"""Return code and data of a reply."""


@dataclass(frozen=True)
class ProfileLayout:
    """Layout of the profiles of a stream.

    ``z_unit``, ``x_start`` and ``x_pitch`` are in m.
    """

    start_code: int
    kind: int
    points: int
    z_unit: float
    x_start: float
    x_pitch: float

    @property
    def with_intensity(self) -> bool:
        """Whether 10-bit intensities follow the heights."""
        return bool(self.kind & INTENSITY)

    @property
    def x(self) -> Array:
        """Positions of the points along the line, m."""
        return self.x_start + self.x_pitch * np.arange(self.points)

    def block(self) -> bytes:
        """Return the description of a profile in a reply: kind, points, unit of heights, start and step in X."""
        z_unit, start, pitch = (round(value / LENGTH) for value in (self.z_unit, self.x_start, self.x_pitch))
        return struct.pack("<B3xHHii", self.kind, self.points, z_unit, start, pitch)


def reply(opcode: int, code: int, program: int, data: bytes) -> bytes:
    """Return a reply: its length, the body's at 12, command at 16, return code at 17, active program at 24, data.

    Bytes 4..7 repeat those of the request (assumed); 8..11 and 18..23 are 0.
    """
    body = struct.pack("<BB6xB3x", opcode, code, program) + data
    return struct.pack("<I4sII", 12 + len(body), PREFIX, 0, len(body)) + body


def notice(kind: int) -> bytes:
    """Return a notice in the stream."""
    return struct.pack("<II", 0xFFFFFFFF, kind)


def words_in(bits: int) -> int:
    """Return the number of 32-bit words for a number of bits."""
    return -(-bits // 32)


def as_fetched(rows: Array, layout: ProfileLayout) -> bytes:
    """Return profiles as in replies: heights and intensities together are padded to whole words."""
    body = words_in((30 if layout.with_intensity else 20) * layout.points)
    kept = np.concatenate([rows[:, : HEADER_WORDS + body], rows[:, -1:]], axis=1)
    return kept.astype("<u4").tobytes()


def packed(layout: Any, heights: Array | None, triggers: Array, encoder: Array) -> Array:
    """Return profiles as they are streamed, uint32, (n, words).

    Fields of 20 bits, least significant bit first, without gaps: the heights, then two intensities per field, the first
    in its upper half. In the stream, heights and intensities are each padded to whole words.

    Parameters
    ----------
    layout : ProfileLayout
    heights : ndarray, (n, point), or None
        m; NaN: missing. None: all are missing.
    triggers, encoder : ndarray, (n,)
        Counts, from 0 to 2**32 - 1.
    """
    n, points = triggers.size, layout.points
    if heights is None:  # one packed profile, repeated with the counts
        blank = packed(layout, np.full((1, points), np.nan), np.zeros(1, np.int64), np.zeros(1, np.int64))
        words = np.repeat(blank, n, axis=0)
    else:
        fields = quantised(heights, layout.z_unit).astype(np.int64) & 0xFFFFF
        room = words_in(20 * points)
        if layout.with_intensity:
            pairs = np.zeros((n, points + points % 2), dtype=np.int64)
            pairs[:, :points] = _brightness(heights)
            fields = np.concatenate([fields, pairs[:, ::2] << 10 | pairs[:, 1::2]], axis=1)
            room += words_in(10 * points)
        words = np.zeros((n, HEADER_WORDS + room + 1), dtype=np.uint32)
        data = _words(fields)[:, :room]
        words[:, HEADER_WORDS : HEADER_WORDS + data.shape[1]] = data
    words[:, TRIGGER_WORD], words[:, ENCODER_WORD] = triggers, encoder
    words[:, -1] = words[:, :-1].sum(axis=1, dtype=np.uint64) & 0xFFFFFFFF
    return words


def _words(fields: Array) -> Array:
    """Return 20-bit fields, (n, field), as words, (n, word): 8 fields in 5 words."""
    n, count = fields.shape
    groups = -(-count // 8)
    f = np.zeros((n, 8 * groups), dtype=np.uint64)
    f[:, :count] = fields
    a, b, c, d, e, g, h, i = (f[:, k::8] for k in range(8))
    words = np.empty((n, groups, 5), dtype=np.uint64)
    words[:, :, 0] = a | b << 20
    words[:, :, 1] = b >> 12 | c << 8 | d << 28
    words[:, :, 2] = d >> 4 | e << 16
    words[:, :, 3] = e >> 16 | g << 4 | h << 24
    words[:, :, 4] = h >> 8 | i << 12
    return (words & 0xFFFFFFFF).astype(np.uint32).reshape(n, -1)


def quantised(heights: Array, unit: float) -> Array:
    """Return heights in steps of ``unit``, int32; the code for 'invalid' if missing or out of range."""
    steps = np.rint(heights / unit)
    fits = (steps >= MIN_HEIGHT) & (steps < 1 << 19)  # False for NaN
    return np.where(fits, steps, NO_HEIGHT).astype(np.int32)


def _brightness(heights: Array) -> Array:
    return np.where(np.isfinite(heights), 100 + np.arange(heights.shape[-1]) % 800, 0)
