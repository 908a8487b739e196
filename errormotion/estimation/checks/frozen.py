"""Readings that do not change: an instrument that hangs, or a column of a file that repeats one value.

Neighbours with a noise s are equal with a small probability p: 0 for unrounded readings, and about
``q / (2 sqrt(pi) s)`` for a step q of their scale. A run of L equal pairs among P has a probability of about ``P p^L``.
Neighbours on a scale whose step is coarse against their noise are often equal without any fault, and are not examined;
rounding is then a part of their uncertainty (`errormotion.estimation.checks.resolution`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.estimation.checks.resolution import step_of
from errormotion.estimation.robust import scale_about_zero

__all__ = ["Frozen", "frozen"]

FALSE_ALARM = 1e-4
"""Probability of so many equal readings by accident."""
FEWEST = 5
"""Equal readings in a row that are noticed."""
FINE = 1.0
"""Noise in steps of the scale above which equal neighbours are rare: a quarter of all."""
OTHERS = 10
"""Pairs of other neighbours that show how often neighbours are equal."""


@dataclass(frozen=True)
class Frozen:
    """The longest run of equal readings.

    Attributes
    ----------
    value : float
        Of the readings; NaN for vectors.
    count : int
        Number of readings in the run.
    series, first : int
        Its series, and its first reading.
    every : bool
        Whether all readings are equal.
    """

    value: float
    count: int
    series: int
    first: int
    every: bool = False


def frozen(readings: Array) -> Frozen | None:
    """Return the run of readings that do not change, if there is one by no accident.

    Parameters
    ----------
    readings : ndarray, (series, n) or (series, n, k)
        Series of neighbours, of numbers or of vectors, of which all numbers must be equal; NaN is unknown.
    """
    y = readings[..., None] if readings.ndim == 2 else readings
    known: NDArray[np.bool_] = np.asarray(np.isfinite(y).all(axis=2))
    if known.sum() < FEWEST:
        return None
    some = y[known]
    if np.all(some == some[0]):
        series, first = np.argwhere(known)[0]
        return Frozen(_number(some[0]), len(some), int(series), int(first), every=True)
    pairs = known[:, 1:] & known[:, :-1]
    equal = pairs & np.asarray(np.all(y[:, 1:] == y[:, :-1], axis=2))
    length = np.zeros((len(y), y.shape[1]), dtype=int)  # equal pairs up to each reading
    for t in range(equal.shape[1]):
        length[:, t + 1] = np.where(equal[:, t], length[:, t] + 1, 0)
    series, last = (int(i) for i in np.unravel_index(length.argmax(), length.shape))
    longest = int(length[series, last])
    if longest < FEWEST - 1:
        return None
    # neighbours outside of long runs show how often they are equal
    inside = np.zeros(length.shape, dtype=bool)
    for i, t in np.argwhere(length >= FEWEST - 1):
        inside[i, t - length[i, t] : t + 1] = True
    other = pairs & ~(inside[:, 1:] & inside[:, :-1])
    if other.sum() < OTHERS or not _fine(y, inside):
        return None
    p = (equal & other).sum() + 1
    if pairs.sum() * (p / (other.sum() + 2)) ** longest > FALSE_ALARM:
        return None
    return Frozen(_number(y[series, last]), longest + 1, series, last - longest)


def _fine(y: Array, inside: Array) -> bool:
    """Return whether the noise of the readings outside of runs exceeds the step of their scale."""
    for one in np.moveaxis(np.where(inside[..., None], np.nan, y), 2, 0):
        step = step_of(one)
        d = one[:, 1:-1] - (one[:, :-2] + one[:, 2:]) / 2
        if step > 0 and not scale_about_zero(d) / np.sqrt(1.5) > FINE * step:
            return False
    return True


def _number(value: Array) -> float:
    return float(value[0]) if value.size == 1 else float("nan")
