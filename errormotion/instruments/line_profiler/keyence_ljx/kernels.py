"""Compiled loops of the codec: finding profiles in a stream of words, unpacking and packing them, without the GIL."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from errormotion.instruments.line_profiler.keyence_ljx.codec import (
    HEADER_WORDS,
    MIN_HEIGHT,
    NOTIFY,
    SENTINELS,
    TRIGGER_WORD,
)

Array = np.ndarray[Any, Any]

LOWEST = MIN_HEIGHT - SENTINELS
MAX_GAP_PROFILES = 1 << 16
"""Largest number of lost profiles; a larger jump of the trigger count is an error."""
MAX_FILLED_PROFILES = 64
"""Longest gap that is filled with rows, profiles; a longer gap only appears as a jump of the trigger count."""

MORE, NOTICE, DAMAGED, LEAP = range(4)  # why `follow` stops


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator, unused-ignore]
def _sum(words: Array, first: int, n: int) -> np.uint32:
    total = np.uint32(0)
    for i in range(first, first + n):
        total = np.uint32(total + words[i])
    return total


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator, unused-ignore]
def follow(words: Array, size: int, trigger: Any, aheads: Array) -> tuple[int, int]:
    """Find consecutive profiles.

    Parameters
    ----------
    words : ndarray, uint32
        Start with a profile or a notify packet.
    size : int
        Words of a profile.
    trigger : int
        Expected trigger count of the first profile; negative: any.
    aheads : ndarray, int64
        Receives, for each profile, the number of missing profiles before it; size at least ``words.size // size``.

    Returns
    -------
    n : int
        Number of profiles found.
    why : int
        Why the search stopped. MORE: more words are needed; NOTICE: a notify packet follows; DAMAGED: the checksum is
        wrong; LEAP: the trigger count jumps.
    """
    n = first = 0
    while first < words.size:
        if words[first] == NOTIFY:
            return n, NOTICE
        if first + size > words.size:
            break
        if _sum(words, first, size - 1) != words[first + size - 1]:
            return n, DAMAGED
        count = np.int64(words[first + TRIGGER_WORD])
        ahead = (count - trigger) & 0xFFFFFFFF if trigger >= 0 else 0
        if ahead > MAX_GAP_PROFILES:
            return n, LEAP
        aheads[n] = ahead
        trigger = (count + 1) & 0xFFFFFFFF
        n += 1
        first += size
    return n, MORE


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator, unused-ignore]
def search(words: Array, size: int, trigger: int) -> int:
    """Return the index of the next profile with a valid checksum and a plausible trigger count; -1: none."""
    if words.size < size:
        return -1
    total = _sum(words, 0, size - 1)
    for first in range(words.size - size + 1):
        if total == words[first + size - 1] and words[first] != NOTIFY:
            count = np.int64(words[first + TRIGGER_WORD])
            if trigger < 0 or (count - trigger) & 0xFFFFFFFF <= MAX_GAP_PROFILES:
                return first
        total = np.uint32(total + words[first + size - 1] - words[first])
    return -1


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator, unused-ignore]
def unpack_heights(profiles: Array, unit: float, reasons: Array, heights: Array, counts: Array) -> None:
    """Unpack heights: 20 bits each, two's complement, from the least significant bit on.

    Parameters
    ----------
    profiles : ndarray, uint32, (n, words)
        Whole profiles.
    unit : float
        Height of one step.
    reasons : ndarray, uint8, (n,)
        Not 0 for missing profiles.
    heights : ndarray, float64, (n, point)
        Receives the heights; NaN where missing.
    counts : ndarray, int64, (len(REASONS),)
        Incremented by the number of missing heights by reason.
    """
    n, points = heights.shape
    for row in range(n):
        if reasons[row]:
            heights[row] = np.nan
            counts[reasons[row]] += points
            continue
        words, out = profiles[row, HEADER_WORDS:], heights[row]
        lowest = np.int32(0)
        for group in range(points // 8):
            k, i = 5 * group, 8 * group
            a, b, c, d, e = words[k], words[k + 1], words[k + 2], words[k + 3], words[k + 4]
            # Each value is shifted to the top of 32 bits and back, which repeats its sign.
            v0 = np.int32(a << np.uint32(12)) >> 12
            v1 = np.int32((b << np.uint32(24)) | ((a >> np.uint32(20)) << np.uint32(12))) >> 12
            v2 = np.int32(b << np.uint32(4)) >> 12
            v3 = np.int32((c << np.uint32(16)) | ((b >> np.uint32(28)) << np.uint32(12))) >> 12
            v4 = np.int32((d << np.uint32(28)) | ((c >> np.uint32(16)) << np.uint32(12))) >> 12
            v5 = np.int32(d << np.uint32(8)) >> 12
            v6 = np.int32((e << np.uint32(20)) | ((d >> np.uint32(24)) << np.uint32(12))) >> 12
            v7 = np.int32(e) >> 12
            out[i], out[i + 1], out[i + 2], out[i + 3] = v0 * unit, v1 * unit, v2 * unit, v3 * unit
            out[i + 4], out[i + 5], out[i + 6], out[i + 7] = v4 * unit, v5 * unit, v6 * unit, v7 * unit
            lowest = min(lowest, v0, v1, v2, v3, v4, v5, v6, v7)
        for i in range(points // 8 * 8, points):
            value = _field(words, 20 * i, 20)
            value = (value ^ 0x80000) - 0x80000
            out[i] = value * unit
            lowest = min(lowest, np.int32(value))
        if lowest < MIN_HEIGHT:
            for i in range(points):
                value = np.int64(np.rint(out[i] / unit))
                if value < MIN_HEIGHT:
                    out[i] = np.nan
                    counts[value - LOWEST] += 1


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator, unused-ignore]
def _field(words: Array, bit: int, width: int) -> Any:
    index, shift = bit // 32, bit % 32
    value = np.int64(words[index]) >> shift
    if shift + width > 32:
        value |= np.int64(words[index + 1]) << (32 - shift)
    return value & ((1 << width) - 1)


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator, unused-ignore]
def unpack_intensities(profiles: Array, reasons: Array, intensities: Array) -> None:
    """Unpack intensities: two in 20 bits, the first of them in the upper half, without padding after the heights.

    Parameters
    ----------
    profiles : ndarray, uint32, (n, words)
        Whole profiles with intensities.
    reasons : ndarray, uint8, (n,)
        Not 0 for missing profiles.
    intensities : ndarray, uint16, (n, point)
        Receives them; 0 for missing profiles, and for the last of an odd number if the profile ends before it.
    """
    n, points = intensities.shape
    for row in range(n):
        if reasons[row]:
            intensities[row] = 0
            continue
        words = profiles[row, HEADER_WORDS:]
        room = 32 * (words.size - 1)
        for i in range(points):
            bit = _intensity_bit(i, points)
            intensities[row, i] = _field(words, bit, 10) if bit + 10 <= room else 0


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator, unused-ignore]
def _intensity_bit(i: int, points: int) -> int:
    return 20 * points + 10 * (i - 1 if i % 2 else i + 1)


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator, unused-ignore]
def _put(words: Array, bit: int, value: int) -> None:
    index, shift = bit // 32, bit % 32
    shifted = np.uint64(value) << np.uint64(shift)
    words[index] |= np.uint32(shifted & np.uint64(0xFFFFFFFF))
    if shifted >> np.uint64(32):
        words[index + 1] |= np.uint32(shifted >> np.uint64(32))


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator, unused-ignore]
def pack(raws: Array, intensities: Array, trigger: int, encoder: int, words: Array) -> None:
    """Write one profile.

    Parameters
    ----------
    raws : ndarray, int32, (point,)
        Heights in steps; codes of points without height are below ``MIN_HEIGHT``.
    intensities : ndarray, uint16, (point,) or (0,)
    trigger, encoder : int
        Counts; their lower 32 bits are written.
    words : ndarray, uint32
        Receives the profile.
    """
    words[:] = 0
    words[TRIGGER_WORD] = np.uint32(trigger & 0xFFFFFFFF)
    words[TRIGGER_WORD + 1] = np.uint32(encoder & 0xFFFFFFFF)
    for i in range(raws.size):
        _put(words[HEADER_WORDS:], 20 * i, raws[i] & 0xFFFFF)
    room = 32 * (words.size - HEADER_WORDS - 1)
    for i in range(intensities.size):
        bit = _intensity_bit(i, intensities.size)
        if bit + 10 <= room:
            _put(words[HEADER_WORDS:], bit, intensities[i] & 0x3FF)
    words[-1] = _sum(words, 0, words.size - 1)
