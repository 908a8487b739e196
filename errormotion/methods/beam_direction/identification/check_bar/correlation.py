"""Correlation of neighbouring residuals of a fit."""

from __future__ import annotations

import numpy as np

from errormotion.arrays import Array

__all__ = ["neighbour_correlation"]


def neighbour_correlation(f: Array, M: Array) -> tuple[float, float]:
    """Return the correlation of neighbouring residuals, and the probability of it or a larger one by noise.

    Parameters
    ----------
    f : ndarray (m,)
        Residuals in their order in space or time.
    M : ndarray (m, m)
        Projection from noise to residuals, I - J J^+ with J the derivative by the parameters.

    Returns
    -------
    float
        Correlation of neighbours minus that caused by the fit itself; about 0 for noise.
    float
        The probability, from 0 to 1.

    Notes
    -----
    Durbin and Watson's ratio of squared differences to squares, with its mean and variance for the residuals of this
    fit, and a beta distribution between its limits 0 and 4 (Biometrika 37 (1950) 409, 38 (1951) 159).
    """
    from scipy.special import betainc

    m = len(f)
    freedoms = round(float(np.trace(M)))
    # Residuals at the level of rounding errors have no meaningful pattern.
    if freedoms < 3 or not f @ f > 0:
        return 0.0, 1.0
    D = np.diff(np.eye(m), axis=0)
    MA = M @ (D.T @ D)
    P, Q = float(np.trace(MA)), float(np.sum(MA * MA.T))
    mean = P / freedoms
    variance = 2 * (Q - P * mean) / (freedoms * (freedoms + 2))
    ratio = float(np.sum(np.diff(f) ** 2) / (f @ f))
    x, spread = mean / 4, variance / 16
    size = x * (1 - x) / spread - 1
    return (mean - ratio) / 2, float(betainc(size * x, size * (1 - x), np.clip(ratio / 4, 0, 1)))
