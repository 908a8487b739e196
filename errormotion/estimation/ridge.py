"""Weighted ridge regression with cross-validation by groups, for residuals that are correlated along a group.

The model is ``y = X b + e`` without a constant; each row has a weight, 0 where its value is unknown. The regularisation
alpha is relative to the sum of the weights: ``b = (X' W X + alpha sum(w))^-1 X' W y``. Rows of a group, such as one
campaign, resemble each other, so that cross-validation leaves out whole groups. Along a group, residuals are regarded
as an AR(1) process: n of them with the correlation r count as ``n (1 - r) / (1 + r)`` independent ones (Bayley and
Hammersley, J. R. Stat. Soc. Suppl. 8 (1946) 184).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array

STRENGTHS = 10.0 ** np.arange(-7.0, 1.0)
"""Candidates of the regularisation, relative to the sum of weights; for columns of unit mean square."""


def solve(X: Array, y: Array, weight: Array, strengths: Array) -> Array:
    """Return the coefficients of weighted ridge regressions without constant, (strength, p).

    Parameters
    ----------
    X, y, weight : ndarray, (n, p), (n,), (n,)
        Rows of weight 0 are not used.
    strengths : ndarray, (strength,)
        Regularisation alpha. One singular value decomposition serves all.
    """
    use = weight > 0
    root = np.sqrt(weight[use])
    left, size, right = np.linalg.svd(X[use] * root[:, None], full_matrices=False)
    ridge = strengths[:, None] * float(weight[use].sum())
    solution: Array = size * (left.T @ (y[use] * root)) / (size**2 + ridge) @ right
    return solution


def left_out_residuals(X: Array, y: Array, weight: Array, group: NDArray[np.int64]) -> Array:
    """Return measured minus predicted of each row by models fitted without its group, (n, strength).

    ``group`` (n,) is the number of the group of each row, the strengths are ``STRENGTHS``. NaN where the row, or every
    other group, is unknown.
    """
    known = (weight > 0) & np.isfinite(X).all(axis=1)
    residual = np.full((y.size, STRENGTHS.size), np.nan)
    rows = np.flatnonzero(known)
    numbers = np.unique(group[rows])
    for left_out in numbers if numbers.size > 1 else ():
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
    """Return the effective number of independent residuals (n,), whose neighbours in a group are correlated (AR(1)).

    NaN is unknown. A group counts as one at least.
    """
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
    """Return the covariance of the coefficients for a mean square residual, (p, p).

    ``square * n / effective_count * (X' W X + alpha sum(w))^-1``: correlated neighbours do not count as independent.
    """
    known = (weight > 0) & np.isfinite(X).all(axis=1)
    normal = (X[known] * weight[known, None]).T @ X[known]
    inverse = np.linalg.inv(normal + strength * weight[known].sum() * np.eye(X.shape[1]))
    correlated = known.sum() / max(effective_count(residual, group), 1.0)  # rows for each independent one
    return np.asarray(square * correlated * inverse)
