"""Weighted ridge regression over campaigns, with cross-validation that leaves out one campaign."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.compensation.thermal_model.features import Feature, matrix
from errormotion.compensation.thermal_model.record import Record

STRENGTHS = 10.0 ** np.arange(-7.0, 1.0)
"""Candidates of the regularisation, relative to the sum of weights; features have unit mean square."""

BLOCKS = 4
"""Number of blocks of a single campaign for cross-validation."""


class Columns:
    """Features of all campaigns, each computed once.

    Parameters
    ----------
    records : sequence of Record
    """

    def __init__(self, records: Sequence[Record]) -> None:
        self.records = records
        self._known: dict[Feature, Array] = {}

    def of(self, features: Sequence[Feature]) -> tuple[Array, Array]:
        """Return the features divided by their root mean square, (n, feature), and this, (feature,)."""
        for feature in features:
            if feature not in self._known:
                self._known[feature] = np.vstack([matrix(r.inputs, [feature]) for r in self.records])[:, 0]
        X = np.column_stack([self._known[feature] for feature in features])
        scale = np.sqrt(np.nanmean(X**2, axis=0))
        scale[~(scale > 0)] = 1.0
        return X / scale, scale


def groups(records: Sequence[Record]) -> NDArray[np.int64]:
    """Return the number of the campaign of each row; a single campaign is divided into blocks in time."""
    if len(records) > 1:
        return np.repeat(np.arange(len(records)), [record.inputs.time.size for record in records])
    n = records[0].inputs.time.size
    return np.arange(n) * BLOCKS // n


def target(records: Sequence[Record], freedom: int) -> tuple[Array, Array]:
    """Return one error of all campaigns and its weights, mean 1, 0 where the error is unknown."""
    y = np.concatenate([record.errors[:, freedom] for record in records])
    variance = np.concatenate([record.variance[:, freedom] for record in records])
    good = np.isfinite(y) & np.isfinite(variance)
    if not good.any():
        return y, np.zeros(y.size)
    floor = np.median(variance[good & (variance > 0)]) if (variance[good] > 0).any() else 1.0
    # The reference state has no variance: its weight is limited.
    weight = np.where(good, 1 / np.maximum(variance, floor), 0.0)
    return y, weight / weight[good].mean()


def solve(X: Array, y: Array, weight: Array, strengths: Array) -> Array:
    """Return the coefficients of weighted ridge regressions without constant, (strength, feature).

    One singular value decomposition serves all strengths.
    """
    use = weight > 0
    root = np.sqrt(weight[use])
    left, size, right = np.linalg.svd(X[use] * root[:, None], full_matrices=False)
    ridge = strengths[:, None] * float(weight[use].sum())
    found: Array = size * (left.T @ (y[use] * root)) / (size**2 + ridge) @ right
    return found


def left_out_residuals(X: Array, y: Array, weight: Array, group: NDArray[np.int64]) -> Array:
    """Return measured minus predicted of each row by models fitted without its campaign, (n, strength).

    NaN where the row, or every other campaign, is unknown.
    """
    known = (weight > 0) & np.isfinite(X).all(axis=1)
    residual = np.full((y.size, STRENGTHS.size), np.nan)
    rows = np.flatnonzero(known)
    campaigns = np.unique(group[rows])
    for left_out in campaigns if campaigns.size > 1 else ():
        test, train = rows[group[rows] == left_out], rows[group[rows] != left_out]
        residual[test] = y[test, None] - X[test] @ solve(X[train], y[train], weight[train], STRENGTHS).T
    return residual


def mean_square(residual: Array, weight: Array) -> float:
    """Return the weighted mean square of the known values; infinite if there are none."""
    known = np.isfinite(residual) & (weight > 0)
    return float(np.average(residual[known] ** 2, weights=weight[known])) if known.any() else float("inf")


def best_strength(X: Array, y: Array, weight: Array, group: NDArray[np.int64]) -> tuple[float, float, Array]:
    """Return the regularisation with the smallest mean square error, this error, and the residuals."""
    residual = left_out_residuals(X, y, weight, group)
    scores = [mean_square(column, weight) for column in residual.T]
    best = int(np.argmin(scores))
    return float(STRENGTHS[best]), scores[best], residual[:, best]


def effective_count(residual: Array, group: NDArray[np.int64]) -> float:
    """Return the effective number of independent residuals: neighbours in time are correlated (AR(1))."""
    total = 0.0
    for number in np.unique(group):
        values = residual[group == number]
        values = values[np.isfinite(values)]
        if values.size < 3 or not (values**2).sum() > 0:
            total += float(bool(values.size))
            continue
        correlation = float(np.clip((values[1:] * values[:-1]).sum() / (values**2).sum(), 0.0, 0.99))
        total += max(1.0, values.size * (1 - correlation) / (1 + correlation))
    return total


def covariance(
    X: Array, weight: Array, strength: float, square: float, residual: Array, group: NDArray[np.int64]
) -> Array:
    """Return the covariance of the coefficients for a mean square residual; neighbours in time count once, (p, p)."""
    known = (weight > 0) & np.isfinite(X).all(axis=1)
    normal = (X[known] * weight[known, None]).T @ X[known]
    inverse = np.linalg.inv(normal + strength * weight[known].sum() * np.eye(X.shape[1]))
    correlated = known.sum() / max(effective_count(residual, group), 1.0)  # rows for each independent one
    return np.asarray(square * correlated * inverse)
