"""Compiled loops of the codec: bytes to values, values to samples, samples to bytes. They run without the GIL."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from errormotion.instruments.point_lds.optoncdt.codec import (
    ABOVE,
    BELOW,
    ERROR_REASONS,
    FIRST_ERROR_CODE,
    GARBLED,
    LAST_ERROR_CODE,
    LOST,
    LOWEST,
    MAX_DISTANCE_CODE,
    OFFSET,
    SCALE,
    UNKNOWN,
)

Array = np.ndarray[Any, Any]

MASK = 0x3FFFF
FOLLOWING = 1 << 18  # the value is not the first of its sample
SUSPECT = 1 << 19  # bytes were discarded immediately before it: its first byte may be a stray byte
GARBLED_RAW = -1
REASON_OF_CODE = np.array(ERROR_REASONS, dtype=np.uint8)

# Positions in the state of `assemble`.
NUMBER, PENDING, HAS_PENDING, JUMP_RAW, JUMP_AHEAD, HAS_JUMP, ORPHANS, ANCHORED, BASE, DOUBT = range(10)
STATE_SIZE = 10


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator, unused-ignore]
def split(data: Array, values: Array, text: Array, after_text: bool) -> tuple[int, int, int, bool]:
    """Split bytes into tagged values and the rest.

    Parameters
    ----------
    data : ndarray, uint8
    values : ndarray, uint32
        Receives the values, with FOLLOWING and SUSPECT; room for a third of ``data``.
    text : ndarray, uint8
        Receives all other bytes; room for ``data``.
    after_text : bool
        Whether the bytes immediately before ``data`` were discarded.

    Returns
    -------
    consumed : int
        Bytes used; up to two at the end may be the start of a value and have to be passed again with the next ones.
    n_values, n_text : int
    after_text : bool
        For the next call.
    """
    size = data.size
    i = n_values = n_text = 0
    while i < size:
        low = data[i]
        prompt = low == 0x3E and i > 0 and data[i - 1] == 0x2D
        if low < 0x40:
            if i + 2 < size:
                middle, high = data[i + 1], data[i + 2]
                if 0x40 <= middle < 0x80 <= high:
                    value = np.uint32(low) | np.uint32(middle & 0x3F) << 6 | np.uint32(high & 0x3F) << 12
                    if high >= 0xC0:
                        value |= np.uint32(FOLLOWING)
                    if after_text:
                        value |= np.uint32(SUSPECT)
                        after_text = False
                    values[n_values] = value
                    n_values += 1
                    i += 3
                    continue
            elif not prompt and (i + 1 == size or 0x40 <= data[i + 1] < 0x80):
                break
        text[n_text] = low
        n_text += 1
        after_text = not prompt  # after a prompt the next byte starts a value
        i += 1
    return i, n_values, n_text, after_text


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator, unused-ignore]
def look_ahead(counter: bool, counter_first: bool) -> int:
    """Return the number of values after a distance that are needed to confirm it."""
    if not counter:
        return 1
    return 2 if counter_first else 0


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator, unused-ignore]
def assemble(values: Array, counter: bool, counter_first: bool, state: Array, raws: Array, numbers: Array) -> int:
    """Pair distances with their counters and number the samples; return how many there are.

    A jump of the counter is accepted if the next undamaged sample continues in the same direction modulo 18 bits:
    samples were lost. Otherwise damaged bytes caused the jump. Two distances with the same counter are both garbled,
    and so is a distance after a counter without a distance. Stray bytes are detected by the value after them: a
    distance that ends its sample is garbled if the next value is suspect or not the first of its sample, and, after a
    counter, also if the value after the next is suspect or the first of its sample: a burst of five bytes can look like
    one value.

    Parameters
    ----------
    values : ndarray, uint32
        From `split`. If a distance ends its sample, the last values are not consumed, and have to be passed again: see
        `look_ahead`.
    counter : bool
        Whether each sample is a distance and a counter, or a distance alone.
    counter_first : bool
        Whether the counter precedes the distance.
    state : ndarray, int64, (STATE_SIZE,)
        State between calls; NUMBER is the number of the next sample, BASE the counter of sample 0, ANCHORED whether
        BASE is known (if not, the first sample is number 0).
    raws : ndarray, int32
        Receives the raw distances, GARBLED_RAW where damaged; room for ``values`` and one more.
    numbers : ndarray, int64
        Receives the samples' numbers since the start of the stream.
    """
    count = 0
    for i in range(values.size - look_ahead(counter, counter_first)):
        value = values[i]
        suspect = value & SUSPECT != 0
        if not counter or (counter_first and value & FOLLOWING):
            suspect = suspect or values[i + 1] & (SUSPECT | FOLLOWING) != 0
        if counter_first and value & FOLLOWING:
            suspect = suspect or values[i + 2] & (SUSPECT | FOLLOWING) != FOLLOWING
        raw = np.int64(GARBLED_RAW) if suspect else np.int64(value & MASK)
        if not counter:
            if value & FOLLOWING:
                state[ORPHANS] += 1
                state[DOUBT] = 1
                continue
            if state[DOUBT]:
                raw, state[DOUBT] = np.int64(GARBLED_RAW), 0
            raws[count], numbers[count] = raw, state[NUMBER]
            state[NUMBER] += 1
            count += 1
            continue
        if not value & FOLLOWING:
            if state[HAS_PENDING]:
                state[ORPHANS] += 1
                raw = np.int64(GARBLED_RAW)
            if state[DOUBT]:
                raw, state[DOUBT] = np.int64(GARBLED_RAW), 0
            state[PENDING], state[HAS_PENDING] = raw, 1
            continue
        if not state[HAS_PENDING]:
            state[ORPHANS] += 1
            state[DOUBT] = 1
            continue
        state[HAS_PENDING] = 0
        if counter_first:
            reading = state[PENDING]
            if reading == GARBLED_RAW:  # a sample without a position: the next counter shows the gap
                state[ORPHANS] += 1
                continue
        else:
            reading = np.int64(value & MASK)
            raw = np.int64(GARBLED_RAW) if suspect else state[PENDING]
        if not state[ANCHORED]:
            if raw == GARBLED_RAW:
                state[ORPHANS] += 1
                continue
            state[ANCHORED], state[BASE] = 1, reading
        ahead = (reading - state[BASE] - state[NUMBER]) & MASK
        garbled = raw == GARBLED_RAW
        if state[HAS_JUMP] and state[JUMP_AHEAD] < ahead:
            if garbled:  # its counter may also be damaged: no confirmation
                state[ORPHANS] += 1
                continue
            state[NUMBER] += state[JUMP_AHEAD]
            raws[count], numbers[count] = state[JUMP_RAW], state[NUMBER]
            state[NUMBER] += 1
            count += 1
            ahead -= state[JUMP_AHEAD] + 1
        elif state[HAS_JUMP]:
            state[ORPHANS] += 1
        state[HAS_JUMP] = 0
        if ahead == 0:
            raws[count], numbers[count] = raw, state[NUMBER]
            state[NUMBER] += 1
            count += 1
        elif garbled:
            state[ORPHANS] += 1
        else:
            state[JUMP_RAW], state[JUMP_AHEAD], state[HAS_JUMP] = raw, ahead, 1
    return count


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator, unused-ignore]
def convert(
    raws: Array, numbers: Array, first: int, measuring_range: float, highest: int, distances: Array, reasons: Array
) -> None:
    """Convert numbered raw values to distances, without gaps in the numbers.

    Parameters
    ----------
    raws, numbers : ndarray
        From `assemble`.
    first : int
        Number of the first sample of ``distances``.
    measuring_range : float
        Unit of the result.
    highest : int
        Last raw value of the measuring range.
    distances : ndarray, float64
        Receives distances from the start of the range, NaN for no distance.
    reasons : ndarray, uint8
        Receives the position in `codec.REASONS` of the reason for NaN; 0 for a distance.
    """
    slope, offset = SCALE * measuring_range, OFFSET * measuring_range
    k = 0
    for i in range(raws.size):
        here = numbers[i] - first
        while k < here:
            distances[k], reasons[k] = np.nan, LOST
            k += 1
        raw = raws[i]
        if LOWEST <= raw <= highest:
            distances[k], reasons[k] = raw * slope - offset, 0
        else:
            distances[k] = np.nan
            if raw < 0:
                reasons[k] = GARBLED
            elif raw < LOWEST:
                reasons[k] = BELOW
            elif raw <= MAX_DISTANCE_CODE:
                reasons[k] = ABOVE
            elif FIRST_ERROR_CODE <= raw <= LAST_ERROR_CODE:
                reasons[k] = REASON_OF_CODE[raw - FIRST_ERROR_CODE]
            else:
                reasons[k] = UNKNOWN
        k += 1
