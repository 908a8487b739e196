"""Raw values of an optoNCDT and their bytes on RS422."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

Array = np.ndarray[Any, Any]

BAUD_OVERFLOW = 262075
NO_PEAK = 262076
BEFORE_RANGE = 262077
BEHIND_RANGE = 262078
NOT_CALCULABLE = 262080
LASER_OFF = 262082
FIRST_ERROR = 262073
"""Values from this one on are errors, not distances."""

STEPS = 65520 / 1.02
"""Raw values per measuring range."""
RESERVE = 0.01
"""Reserve on each side of the range as a fraction of the range; added before scaling."""
MASTERED = 0.51
"""Added before scaling once a master value is set."""

BITS = 18
BYTES_OF_VALUE = 3
BITS_ON_WIRE = 30
"""Bits of one value: three bytes with their start and stop bits."""


def raw_distances(distances: Array, measuring_range: float, largest: int) -> Array:
    """Return the raw values of distances from the start of the range, m; error values if missing."""
    steps = np.asarray(distances) / measuring_range
    steps += RESERVE
    steps *= STEPS
    raws = np.rint(steps, out=steps)
    if raws.size and raws.min() >= 0 and raws.max() <= largest:
        return raws.astype(np.int64)
    with np.errstate(invalid="ignore"):
        found = np.where(raws < 0, BEFORE_RANGE, np.where(raws > largest, BEHIND_RANGE, raws))
    return np.where(np.isnan(raws), NO_PEAK, found).astype(np.int64)


def mastered(raws: Array, distances: Array, reference: float, master: float, measuring_range: float) -> Array:
    """Return raw distances as they are sent after mastering: ``reference`` (m) is read as ``master`` (m)."""
    valid = raws < FIRST_ERROR
    relative = np.where(valid, (np.asarray(distances) - reference + master) / measuring_range, 0.0)
    values = np.rint((relative + MASTERED) * STEPS)
    values = np.where((values < 0) | (values >= FIRST_ERROR), NOT_CALCULABLE, values)
    return np.where(valid, values, raws).astype(np.int64)


def encode(values: Array) -> bytes:
    """Return the bytes of blocks of values, shape (block, value): L, M and H byte of each.

    Bit 6 of the H byte is clear in the first value of a block and set in the others.
    """
    values = np.ascontiguousarray(values, dtype=np.int64)
    data = np.empty((*values.shape, BYTES_OF_VALUE), dtype=np.uint8)
    _fill(values, data)
    return data.tobytes()


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator, unused-ignore]
def _fill(values: Array, data: Array) -> None:
    """Write the bytes of values; one call instead of many, between which other threads would wait for each other."""
    for i in range(values.shape[0]):
        for k in range(values.shape[1]):
            value = values[i, k]
            data[i, k, 0] = value & 0x3F
            data[i, k, 1] = 0x40 | value >> 6 & 0x3F
            data[i, k, 2] = (0xC0 if k else 0x80) | value >> 12 & 0x3F
