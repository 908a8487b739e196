"""Averages of fixed length over records of any length.

A drift record of billions of samples is reduced to one mean every half second. It is read in slices, so that it needs
constant memory. Numpy adds up what fits into the cache of a core at a time.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from xarray.indexes import RangeIndex

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.spindle_drift.identification.times import (
    EvenTimes,
    Times,
    first_and_last,
    first_samples,
    time_sums,
    usual_interval,
    values_of,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

_SLICE_BYTES = 32 << 20
"""Size of the slices in which a record is read."""
_BLOCK = 1 << 17
"""Samples of windows of several lengths that are added up at a time, as numbers of double precision: a megabyte."""
_MIN_WINDOW = 0.5
"""Share of the last window below which it is ignored: run-out does not average away in a part of it."""


def window_sums(values: NDArray[np.floating[Any]], edges: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
    """Return sums and numbers of the values that are not NaN, between consecutive edges.

    Parameters
    ----------
    values : ndarray, float32 or float64, (channel, sample)
        In either memory order; the transposed view of a (sample, channel) array is not copied.
    edges : ndarray, int64, (window + 1,)
        Sample indices, not decreasing.

    Returns
    -------
    sums, counts : ndarray (channel, window)
    """
    if values.dtype not in (np.dtype(np.float32), np.dtype(np.float64)):
        values = values.astype(np.float64)
    samples = np.diff(edges)
    sums, counts = np.empty((len(values), samples.size)), np.empty((len(values), samples.size), np.int64)
    for part in _groups(samples):
        inside = slice(edges[part.start], edges[part.stop])
        for channel, row in enumerate(values):
            sums[channel, part], counts[channel, part] = _totals(row[inside], samples[part]), samples[part]
            if np.isnan(sums[channel, part]).any():
                valid = ~np.isnan(row[inside])
                sums[channel, part] = _totals(np.where(valid, row[inside], values.dtype.type(0.0)), samples[part])
                counts[channel, part] = _totals(valid, samples[part])
    return sums, counts


def missing_places(
    values: NDArray[np.floating[Any]], edges: NDArray[np.int64], counts: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return the sums of the places in their windows of the values that are NaN, (channel, window).

    ``counts`` are the numbers of the others, from `window_sums`. The first value of a window has the place 0.
    """
    missing = np.zeros(counts.shape, np.int64)
    for channel in np.flatnonzero((counts < np.diff(edges)).any(axis=1)):
        lost = np.flatnonzero(np.isnan(values[channel, edges[0] : edges[-1]])) + edges[0]
        window = np.searchsorted(edges, lost, side="right") - 1
        missing[channel] = np.bincount(window, weights=lost - edges[window], minlength=counts.shape[1])
    return missing


def _groups(samples: NDArray[np.int64]) -> Iterator[slice]:
    """Yield slices of the windows: all but the first and the last one where these are of one length, else blocks."""
    middle = samples[1:-1]
    if middle.size and middle[0] > 0 and (middle == middle[0]).all():
        yield from (slice(0, 1), slice(1, samples.size - 1), slice(samples.size - 1, samples.size))
        return
    ends = np.cumsum(samples)
    first = 0
    while first < samples.size:
        last = int(np.searchsorted(ends, ends[first] - samples[first] + _BLOCK, side="right"))
        yield slice(first, max(last, first + 1))
        first = max(last, first + 1)


def _totals(row: NDArray[Any], samples: NDArray[np.int64]) -> Array:
    """Return the sums of consecutive values; numpy adds them pairwise, which keeps the rounding error small."""
    if samples[0] > 0 and (samples == samples[0]).all():
        return np.asarray(row.reshape(samples.size, -1).sum(axis=1, dtype=np.float64))
    full = np.flatnonzero(samples)
    total = np.zeros(samples.size)
    if full.size:
        total[full] = np.add.reduceat(row.astype(np.float64), (np.cumsum(samples) - samples)[full])
    return total


@dataclass(frozen=True)
class Averages:
    """Window means of a drift record.

    Attributes
    ----------
    time : ndarray, (window,)
        Mean time of the samples of each window, s, on the record's own clock.
    mean : ndarray, (channel, window)
        Mean of the valid samples, m; NaN where fewer than ``minimum`` of a full window's are valid.
    count : ndarray, int64, (channel, window)
        Number of valid samples.
    expected : ndarray, int64, (window,)
        Number of samples, valid or not.
    lag : ndarray, (channel, window)
        Mean time of the valid samples minus ``time``, s; 0 where none is missing.
    """

    time: Array
    mean: Array
    count: NDArray[np.int64]
    expected: NDArray[np.int64]
    lag: Array


@dataclass(frozen=True)
class Windows:
    """Which windows some samples are in.

    Attributes
    ----------
    first, last : int
        Numbers of the windows of the first and the last sample.
    edges : ndarray, int64, (window + 1,)
        Indices of their first samples, and the number of samples.
    """

    first: int
    last: int
    edges: NDArray[np.int64]


class Averager:
    """Averages of a stream of blocks in windows of fixed length; at most one unfinished window is in memory.

    Window k covers the times from ``start + k * length`` to ``start + (k + 1) * length``. Where the interval
    of the samples is longer than half a window, every sample is its own window.
    """

    def __init__(self, channels: int, length: float, minimum: float = 0.5) -> None:
        self._length, self._minimum = length, minimum
        self._start = np.nan
        self._single: bool | None = None
        self._first: tuple[Array, NDArray[np.floating[Any]]] | None = None
        self._tolerance = self._full = 0.0
        self._index = -1
        self._sum = np.zeros(channels)
        self._count = np.zeros(channels, np.int64)
        self._missing = np.zeros(channels, np.int64)
        self._time = 0.0
        self._samples = 0

    def update(self, time: Times, values: NDArray[np.floating[Any]]) -> Averages:
        """Add ``values`` (channel, sample) at ``time`` (sample,); return the windows that are now complete."""
        if time.size == 0:
            return self._none()
        if self._first is not None:
            time, values = np.append(self._first[0], values_of(time)), np.concatenate([self._first[1], values], axis=1)
            self._first = None
        if self._single is None and time.size == 1:  # the interval of the samples is not known yet
            self._first = values_of(time).copy(), values.copy()
            return self._none()
        windows = self.windows(time)
        if windows is None:
            return _samples_as_windows(values_of(time), values)
        sums, counts = window_sums(values, windows.edges)
        return self.add(time, windows, sums, counts, missing_places(values, windows.edges, counts))

    def windows(self, time: Times) -> Windows | None:
        """Return the windows of the samples at ``time``, the next ones; None where `update` has to have the values."""
        if self._first is not None or time.size == 0 or (self._single is None and time.size == 1):
            return None
        if self._single is None:
            self._start = first_and_last(time)[0]
            interval = usual_interval(time)
            self._single = interval > 0.5 * self._length
            self._tolerance = 0.5 * interval / self._length
            self._full = self._length / interval
        if self._single:
            return None
        # The tolerance of half a sample covers the rounding of times that were written as decimals.
        start, end = first_and_last(time)
        first = int(np.floor((start - self._start) / self._length + self._tolerance))
        last = int(np.floor((end - self._start) / self._length + self._tolerance))
        bounds = np.asarray(self._start + (np.arange(first + 1, last + 1) - self._tolerance) * self._length, np.float64)
        return Windows(first, last, np.concatenate([[0], first_samples(time, bounds), [time.size]]).astype(np.int64))

    def add(
        self, time: Times, windows: Windows, sums: Array, counts: NDArray[np.int64], missing: NDArray[np.int64]
    ) -> Averages:
        """Add the sums and numbers (channel, window) of values at ``time``; return the complete windows.

        ``missing`` are the sums of the places of missing values, from `missing_places`.
        """
        samples = np.diff(windows.edges)
        times = time_sums(time, windows.edges) + samples * first_and_last(time)[0]
        if self._samples:  # the window that the blocks before have left open goes on, or was their last one
            if windows.first == self._index:
                missing[:, 0] += self._missing + self._samples * (samples[0] - counts[:, 0])
                sums[:, 0] += self._sum
                counts[:, 0] += self._count
                times[0] += self._time
                samples[0] += self._samples
            else:
                sums, counts = np.column_stack([self._sum, sums]), np.column_stack([self._count, counts])
                missing = np.column_stack([self._missing, missing])
                times, samples = np.append(self._time, times), np.append(self._samples, samples)
        self._index = windows.last
        self._sum, self._count, self._missing = sums[:, -1].copy(), counts[:, -1].copy(), missing[:, -1].copy()
        self._time, self._samples = float(times[-1]), int(samples[-1])
        done = np.flatnonzero(samples[:-1])
        return self._averages(sums[:, done], counts[:, done], missing[:, done], times[done], samples[done])

    def finish(self) -> Averages:
        """Return the last window, if it is long enough to average out the run-out."""
        if self._first is not None:
            return _samples_as_windows(*self._first)
        if not self._samples or self._samples < _MIN_WINDOW * self._full:
            return self._none()
        last = self._averages(
            self._sum[:, None],
            self._count[:, None],
            self._missing[:, None],
            np.array([self._time]),
            np.array([self._samples]),
        )
        self._samples = 0
        return last

    def _none(self) -> Averages:
        channels = self._sum.size
        none = np.zeros((channels, 0), np.int64)
        return self._averages(np.zeros((channels, 0)), none, none, np.zeros(0), np.zeros(0, np.int64))

    def _averages(
        self,
        total: Array,
        count: NDArray[np.int64],
        missing: NDArray[np.int64],
        times: Array,
        expected: NDArray[np.int64],
    ) -> Averages:
        enough = count >= np.maximum(1, self._minimum * np.maximum(expected, 0.99 * self._full))
        mean = np.where(enough, total / np.maximum(count, 1), np.nan)
        middle = (expected - 1) / 2
        place = (expected * middle - missing) / np.maximum(count, 1)  # mean of the valid samples
        lag = np.where(count > 0, place - middle, 0.0) * (self._length / self._full if self._full else 0.0)
        return Averages(times / np.maximum(expected, 1), mean, count, expected, lag)


def _samples_as_windows(time: Array, values: NDArray[np.floating[Any]]) -> Averages:
    """Return every sample as its own window."""
    counts = np.isfinite(values).astype(np.int64)
    nothing = np.zeros(values.shape)
    return Averages(time.copy(), values.astype(np.float64), counts, np.ones(time.size, np.int64), nothing)


def join(parts: list[Averages]) -> Averages:
    """Join consecutive averages."""
    return Averages(
        np.concatenate([part.time for part in parts]),
        np.concatenate([part.mean for part in parts], axis=1),
        np.concatenate([part.count for part in parts], axis=1),
        np.concatenate([part.expected for part in parts]),
        np.concatenate([part.lag for part in parts], axis=1),
    )


def slices(raw: xr.Dataset) -> Iterator[tuple[Times, xr.Dataset]]:
    """Yield (time, slice of the dataset) of a record along ``time``, `_SLICE_BYTES` at a time, in whole chunks.

    The time comes from the variable ``time``, or from the attributes ``sample_rate`` (Hz) and ``time_start`` (s).
    """
    distance = raw["distance"]
    samples = distance.sizes["time"]
    step = max(1, _SLICE_BYTES // (distance.sizes["channel"] * distance.dtype.itemsize))
    chunk = distance.encoding.get("preferred_chunks", {}).get("time", 1)
    if chunk > 1:
        step = max(1, step // chunk) * chunk
    for first in range(0, samples, step):
        part = raw.isel(time=slice(first, first + step))
        clock = part.xindexes.get("time")
        time: Times
        if isinstance(clock, RangeIndex):
            time = EvenTimes(float(clock.start), float(clock.step), part.sizes["time"])
        elif "time" in raw.variables:
            time = np.asarray(part["time"].values, np.float64)
        elif "sample_rate" in raw.attrs:
            interval = 1.0 / float(raw.attrs["sample_rate"])
            time = EvenTimes(float(raw.attrs.get("time_start", 0.0)) + first * interval, interval, part.sizes["time"])
        else:
            raise MethodError(
                "The raw dataset has no time: expected a coordinate 'time' (s) or the attribute 'sample_rate' (Hz).",
                code="raw.time.missing",
            )
        yield time, part
