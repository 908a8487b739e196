"""Compiled sums of the windows of a record, at the speed of memory.

The loops add up in double precision. Only where the sum of a window is NaN they add it up again value by value.
"""

from __future__ import annotations

from threading import Lock
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array

_FAST = {"reassoc", "contract", "nsz", "arcp"}
_ONE = Lock()
"""Not all of numba's ways to run threads allow calls from several of ours."""


@numba.njit(cache=True, nogil=True, fastmath=_FAST)
def _valid_sum(x: NDArray[Any], start: int, end: int, step: int) -> tuple[float, int]:  # pragma: no cover - compiled
    """Sum and count the values that are not NaN."""
    total, valid = 0.0, 0
    for i in range(start, end, step):
        if not np.isnan(x[i]):
            total += np.float64(x[i])
            valid += 1
    return total, valid


@numba.njit(cache=True, nogil=True, parallel=True, fastmath=_FAST)
def _sum_rows(
    x: NDArray[Any], edges: NDArray[np.int64], sums: Array, counts: NDArray[np.int64]
) -> None:  # pragma: no cover - compiled
    """Sum ``x`` (channel, sample) between consecutive ``edges``."""
    channels, windows = sums.shape
    for job in numba.prange(channels * windows):
        channel, window = job // windows, job % windows
        row = x[channel, edges[window] : edges[window + 1]]
        total, valid = 0.0, row.size
        for i in range(row.size):
            total += np.float64(row[i])
        if np.isnan(total):
            total, valid = _valid_sum(row, 0, row.size, 1)
        sums[channel, window] = total
        counts[channel, window] = valid


@numba.njit(cache=True, nogil=True, parallel=True, fastmath=_FAST)
def _sum_columns(
    x: NDArray[Any], edges: NDArray[np.int64], sums: Array, counts: NDArray[np.int64]
) -> None:  # pragma: no cover - compiled
    """Sum ``x`` (sample, channel) between consecutive ``edges``.

    The samples form one long row in pieces of 16 samples, so that every lane of a vector keeps its channel.
    """
    channels, windows = sums.shape
    piece = 16 * channels
    flat = x.reshape(x.size)
    for window in numba.prange(windows):
        total = np.zeros(piece)
        start, end = edges[window] * channels, edges[window + 1] * channels
        whole = start + (end - start) // piece * piece
        pieces = flat[start:whole].reshape(-1, piece)
        for k in range(pieces.shape[0]):
            for i in range(piece):
                total[i] += np.float64(pieces[k, i])
        for i in range(end - whole):
            total[i] += np.float64(flat[whole + i])
        for channel in range(channels):
            sums[channel, window] = total[channel::channels].sum()
            counts[channel, window] = edges[window + 1] - edges[window]
            if np.isnan(sums[channel, window]):
                kept, valid = _valid_sum(flat, start + channel, end, channels)
                sums[channel, window] = kept
                counts[channel, window] = valid


def sums(
    values: NDArray[np.floating[Any]], edges: NDArray[np.int64], threads: int | None = None
) -> tuple[Array, NDArray[np.int64]]:
    """Return sums and numbers of the values that are not NaN, see `averaging.window_sums`."""
    total = np.empty((len(values), edges.size - 1))
    counts = np.empty(total.shape, np.int64)
    with _ONE:
        before = numba.get_num_threads()
        numba.set_num_threads(threads or before)
        try:
            if values.T.flags.c_contiguous and not values.flags.c_contiguous:
                _sum_columns(values.T, edges, total, counts)
            else:
                _sum_rows(np.ascontiguousarray(values), edges, total, counts)
        finally:
            numba.set_num_threads(before)
    return total, counts
