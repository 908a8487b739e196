"""Times of samples: listed one by one, or even, which takes no memory however many they are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True)
class EvenTimes:
    """Times at equal intervals, which are not stored: ``start + k * interval`` for sample k.

    Attributes
    ----------
    start, interval : float
        s.
    size : int
        Number of samples.
    """

    start: float
    interval: float
    size: int

    def values(self) -> Array:
        """Return the times, (sample,), s."""
        return np.asarray(self.start + np.arange(self.size, dtype=np.float64) * self.interval)


Times = Array | EvenTimes


def values_of(time: Times) -> Array:
    """Return times as an array (sample,), s."""
    return time.values() if isinstance(time, EvenTimes) else time


def first_and_last(time: Times) -> tuple[float, float]:
    """Return the first and the last of some times, s."""
    if isinstance(time, EvenTimes):
        return time.start, time.start + (time.size - 1) * time.interval
    return float(time[0]), float(time[-1])


def increases(time: Times) -> bool:
    """Return whether every time is later than the one before it."""
    if isinstance(time, EvenTimes):
        return time.interval > 0 or time.size < 2
    return bool((time[1:] > time[:-1]).all())


def usual_interval(time: Times) -> float:
    """Return the median of the first intervals, s."""
    return time.interval if isinstance(time, EvenTimes) else float(np.median(np.diff(time[:1000])))


def first_samples(time: Times, bounds: Array) -> NDArray[np.int64]:
    """Return the first sample at or after each bound."""
    if isinstance(time, EvenTimes):
        samples = np.ceil((bounds - time.start) / time.interval)
        return np.clip(samples, 0, time.size).astype(np.int64)
    return np.searchsorted(time, bounds)


def time_sums(time: Times, edges: NDArray[np.int64]) -> Array:
    """Return the sum of the times between consecutive edges, s, relative to the first time: a day would cost digits."""
    samples = np.diff(edges)
    if isinstance(time, EvenTimes):
        return np.asarray(0.5 * time.interval * samples * (edges[:-1] + edges[1:] - 1))
    return np.asarray(np.add.reduceat(time - time[0], np.minimum(edges[:-1], time.size - 1)) * (samples > 0))
