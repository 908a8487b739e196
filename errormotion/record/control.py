"""Control chart of individual values with their own uncertainties (Shewhart; ISO 7870-2 for equal ones).

Between two steps the centre is the generalised mean of the values without outliers, with weights w for the covariance
``V = V0 + tau^2``: V0 is the covariance that the runs state, and tau the reproducibility of machine and set-up from the
moving ranges. The limits are three standard deviations of the difference from this centre,
``Var(y_k - w'y) = V_kk - 2 (V w)_k + w'V w``: each value has its own limits, and a source that all runs share cancels.
Runs that are alike over some time, as machines age and sites have seasons, have smaller moving ranges than values. If
the values show this, V contains the correlation (`errormotion.estimation.between_runs`); centre and variance are then
means over its possible times, and the variance contains the differences between the centres.
The limit of a moving range is its expectation plus three standard deviations, for normal values
``(sqrt(2 / pi) + 3 sqrt(1 - 2 / pi)) sd = 2.606 sd``, where sd is that of the difference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.estimation.between_runs import by_moving_ranges, correlation, difference_variance, variations
from errormotion.record.series import Series
from errormotion.record.steps import Model

WIDTH = 3.0
"""Distance of the limits from the centre, standard deviations."""


@dataclass(frozen=True)
class Chart:
    """Centre and limits of each value (n,), moving ranges and their limits (n - 1,), and tau of the ranges; SI.

    A range across a step is NaN.
    """

    centre: Array
    lower: Array
    upper: Array
    moving_range: Array
    range_limit: Array
    tau: float

    def outside(self, value: Array) -> NDArray[np.bool_]:
        """Return which values are outside their limits, bool (n,)."""
        is_outside: NDArray[np.bool_] = (value < self.lower) | (value > self.upper)
        return is_outside


def chart(series: Series, model: Model) -> Chart:
    """Return the control chart of a series, with new limits after each step of its model."""
    y, n = series.value, series.size
    bounds = [0, *(step.index for step in model.steps), n]
    used = np.ones(max(n - 1, 0), dtype=bool)
    used[[k - 1 for k in bounds[1:-1]]] = False
    whole = used.copy()
    for k in model.departing:
        used[max(k - 1, 0) : k + 1] = False
    tau = by_moving_ranges(y, series.covariance, used)
    kept = np.setdiff1d(np.arange(n), model.departing)
    parts = np.array([(first <= kept) & (kept < last) for first, last in pairwise(bounds)], dtype=float).T
    V0, t = series.covariance, series.time
    # about the trend, against which the limits stand
    X = np.column_stack([parts[:, parts.any(axis=0)], series.years[kept]])
    X = X if np.linalg.matrix_rank(X) == X.shape[1] else X[:, :-1]
    possible = variations(X, y[kept], V0[np.ix_(kept, kept)], t[kept], tau)
    weight = np.array([share for _, _, share in possible])
    each = [V0 + size**2 * correlation(t, n, T) for size, T, _ in possible]
    centres, variances = (np.array(rows) for rows in zip(*(_centred(y, V, bounds, model) for V in each), strict=True))
    centre = weight @ centres
    width = WIDTH * np.sqrt(np.maximum(weight @ (variances + (centres - centre) ** 2), 0.0))
    of_ranges = np.sqrt(weight @ np.array([difference_variance(V) for V in each]))
    limit = (np.sqrt(2 / np.pi) + WIDTH * np.sqrt(1 - 2 / np.pi)) * of_ranges
    ranges = np.where(whole, np.abs(np.diff(y)), np.nan)
    return Chart(centre, centre - width, centre + width, ranges, limit, tau)


def _centred(y: Array, V: Array, bounds: Sequence[int], model: Model) -> tuple[Array, Array]:
    """Return the centre of each value, (n,), and the variance of its difference from it."""
    centre, variance = np.empty(len(y)), np.empty(len(y))
    for first, last in pairwise(bounds):
        inside = np.arange(first, last)
        kept = np.setdiff1d(inside, model.departing)
        kept = kept if kept.size else inside
        w = np.zeros(len(y))
        w[kept] = np.linalg.solve(V[np.ix_(kept, kept)], np.ones(kept.size))
        w /= w.sum()
        centre[inside] = w @ y
        variance[inside] = (np.diag(V) - 2 * V @ w + w @ V @ w)[inside]
    return centre, variance
