"""Generalised least squares with a variance between runs, and three estimates of this variance.

The model of the values is ``y = X b + m + e``: e has the stated covariance V0, m is the variation of machine and set-up
from run to run, independent with the standard deviation tau, the reproducibility. Estimates of tau:

* Paule and Mandel (J. Res. NBS 87 (1982) 377): tau such that the weighted sum of squared residuals equals its
  expectation, ``r' (V0 + tau^2)^-1 r = n - p``; here with a full covariance and p parameters.
* Moving ranges, as in a chart of individual values (ISO 7870-2): ``E|y_k - y_(k-1)| = sqrt(2 / pi) sd`` for normal
  values, where ``sd^2 = 2 tau^2 + v_k`` and v_k follows from V0; tau such that the sum of the ranges equals its
  expectation. A step affects one range only, and a trend has little effect.
* DerSimonian and Laird (Control. Clin. Trials 7 (1986) 177): the first one without iteration, for many means at once.

All are 0 if the stated uncertainties alone explain the scatter.

m may be alike in neighbouring runs, since machines age and sites have seasons: its correlation over the time d is then
``exp(-d / T)``. T is one of some multiples of the mean interval, or 0 for independent runs, with the restricted
likelihood of each, in which the scale of the covariance is eliminated, times the prior of `correlated.TYPICAL` for the
correlation of neighbours. Parameters are means over T with these weights, so that their covariance contains what T is
unknown by.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import brentq
from scipy.special import chdtr, stdtrit

from errormotion.arrays import Array, filled
from errormotion.estimation.checks.correlated import TYPICAL

COVERAGE = 0.95
"""Coverage probability of the intervals of trend and steps."""
FEWEST = 8
"""Runs without which they are taken as independent: they could not show a correlation."""
ODDS = 0.5
"""Logarithm of the mean likelihood of runs that are alike relative to that of independent ones, from which they are."""
_MULTIPLES = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
"""Times over which runs may be alike, in mean intervals."""
_OWN = 1e-6
"""Share of the variance that runs at the same time do not have in common."""


@dataclass(frozen=True)
class RunFit:
    """Parameters of a fit.

    Attributes
    ----------
    parameters, half_width : ndarray, (p,)
        Parameters, and half widths of their intervals (``COVERAGE``).
    covariance : ndarray, (p, p)
    tau : float
        Reproducibility by Paule and Mandel.
    chi2, p : float
        Chi-square of the residuals for the stated uncertainties only (tau = 0), and probability of a smaller value.
    degrees : int
    fitted, fitted_half_width : ndarray, (n,)
    duration : float
        Most likely T, in the unit of the times; 0 for independent runs.
    """

    parameters: Array
    half_width: Array
    covariance: Array
    tau: float
    chi2: float
    p: float
    degrees: int
    fitted: Array
    fitted_half_width: Array
    duration: float = 0.0


def fit_runs(X: Array, y: Array, V0: Array, time: Array | None = None) -> RunFit | None:
    """Return the fit of ``y = X b``; None without degrees of freedom, or for dependent columns.

    Parameters
    ----------
    X : ndarray, (n, p)
    y : ndarray, (n,)
        Values, in any unit, which is also that of tau.
    V0 : ndarray, (n, n)
        Stated covariance of the values.
    time : ndarray, (n,), optional
        Of the runs, not decreasing; by default the runs are independent.

    Notes
    -----
    The quantile is that of Student's distribution with n - p degrees of freedom, with which tau is estimated.
    """
    n, p = X.shape
    if n <= p or np.linalg.matrix_rank(X) < p:
        return None
    one = np.eye(n)
    chi2 = float(_residual_square(X, y, V0, 0.0, one))
    durations = alike(time, n)
    fits, logs = [], []
    for T, prior in durations:
        R = correlation(time, n, T)
        tau = paule_mandel(X, y, V0, R)
        V = V0 + tau**2 * R
        factor = cho_factor(V)
        C = np.asarray(np.linalg.inv(X.T @ cho_solve(factor, X)), dtype=float)
        b: Array = C @ (X.T @ cho_solve(factor, y))
        rest = y - X @ b
        square = float(rest @ cho_solve(factor, rest))
        logs.append(_restricted(2.0 * float(np.log(np.diag(factor[0])).sum()), C, square, n - p) + prior)
        fits.append((b, C, tau))
    weight = np.exp(np.array(logs) - max(logs))
    weight /= weight.sum()
    best = int(np.argmax(weight))
    mean: Array = sum(w * b for w, (b, _, _) in zip(weight, fits, strict=True))
    whole: Array = sum(w * (C + np.outer(b - mean, b - mean)) for w, (b, C, _) in zip(weight, fits, strict=True))
    quantile = float(stdtrit(n - p, 0.5 + COVERAGE / 2))
    spread: Array = np.sqrt(np.einsum("ni,ij,nj->n", X, whole, X))
    below = float(chdtr(n - p, chi2))
    half_width: Array = quantile * np.sqrt(np.diag(whole))
    fitted: Array = X @ mean
    tau = fits[best][2]
    return RunFit(
        mean, half_width, whole, tau, chi2, below, n - p, fitted, quantile * spread, durations[best][0] if tau else 0.0
    )


def _restricted(log_determinant: float, C: Array, square: float, degrees: int) -> float:
    """Return the restricted log likelihood of a covariance whose scale is eliminated.

    ``C`` is the covariance of the parameters, and ``square`` the sum of squares of the residuals.
    """
    return float(-0.5 * log_determinant + 0.5 * np.linalg.slogdet(C)[1] - 0.5 * degrees * np.log(max(square, 1e-300)))


def variations(X: Array, y: Array, V0: Array, time: Array, tau: float) -> list[tuple[float, float, float]]:
    """Return possible variations between runs: standard deviation, time T over which they are alike, and weight.

    Runs are independent, with ``tau``, unless the mean likelihood of runs that are alike exceeds theirs by e^`ODDS`.

    Parameters
    ----------
    X, y, V0, time
        See `fit_runs`.
    tau : float
        Standard deviation between independent runs.
    """
    n, p = X.shape
    possible, logs = list[tuple[float, float]](), list[float]()
    for T, prior in alike(time, n) if n > p else ():
        R = correlation(time, n, T)
        size = paule_mandel(X, y, V0, R)
        V = V0 + size**2 * R
        WX, Wy = np.linalg.solve(V, X), np.linalg.solve(V, y)
        C = np.linalg.inv(X.T @ WX)
        square = float((y - X @ (C @ (X.T @ Wy))) @ Wy)
        possible.append((size if T else tau, T))
        logs.append(_restricted(float(np.linalg.slogdet(V)[1]), C, square, n - p) + prior)
    if len(logs) < 2 or np.log(np.mean(np.exp(np.array(logs[1:]) - logs[0]))) < ODDS:
        return [(tau, 0.0, 1.0)]
    weight = np.exp(np.array(logs) - max(logs))
    weight /= weight.sum()
    return [(size, T, float(w)) for (size, T), w in zip(possible, weight, strict=True)]


def alike(time: Array | None, n: int) -> list[tuple[float, float]]:
    """Return the times T over which n runs may be alike, with their log priors; T = 0 alone for few runs."""
    candidates = [(0.0, 0.0)]
    extent = 0.0 if time is None else float(np.ptp(time))
    if n < FEWEST or not extent > 0:
        return candidates
    interval = extent / (n - 1)
    for multiple in _MULTIPLES:
        if multiple * interval <= extent:
            candidates.append((multiple * interval, -0.5 * float(np.arctanh(np.exp(-1 / multiple)) / TYPICAL) ** 2))
    return candidates


def correlation(time: Array | None, n: int, T: float) -> Array:
    """Return the correlation of n runs that are alike over the time T, (n, n)."""
    if time is None or not T > 0:
        return np.eye(n)
    return np.asarray((1.0 - _OWN) * np.exp(-np.abs(np.subtract.outer(time, time)) / T) + _OWN * np.eye(n))


def by_moving_ranges(residual: Array, V0: Array, used: Array | None = None) -> float:
    """Return tau from the moving ranges of residuals (n,) with the stated covariance V0 (n, n).

    ``used`` (n - 1,) selects ranges, such as all but those across steps.
    """
    d = np.abs(np.diff(residual))
    v = difference_variance(V0)
    if used is not None:
        d, v = d[used], v[used]
    if not d.size:
        return 0.0
    total = float(np.sum(d) * np.sqrt(np.pi / 2))

    def excess(tau: float) -> float:
        return float(np.sum(np.sqrt(2 * tau**2 + v))) - total

    return 0.0 if excess(0.0) >= 0 else float(brentq(excess, 0.0, total / d.size, xtol=1e-6 * total / d.size))


def difference_variance(V: Array) -> Array:
    """Return the variance of the differences of neighbours, (n - 1,); equal effects of a shared source cancel."""
    diagonal = np.diag(V)
    variance: Array = np.maximum(diagonal[1:] + diagonal[:-1] - 2 * np.diag(V, 1), 0.0)
    return variance


def variance_between(value: Array, variance: Array) -> tuple[Array, Array, Array]:
    """Return weighted means over m datasets, with a variance between datasets (DerSimonian and Laird 1986).

    Parameters
    ----------
    value, variance : ndarray, (m, n, d)
        Values of each dataset at n points with d freedoms, and their stated variances; NaN is unknown, and a value
        without variance is not used.

    Returns
    -------
    value, u : ndarray, (n, d)
        Mean and its standard uncertainty; NaN if unknown to all.
    tau : ndarray, (d,)
        Standard deviation between datasets of each freedom, from all points together.
    """
    known = np.isfinite(value) & (variance > 0)
    w = np.where(known, 1.0 / np.where(known, variance, 1.0), 0.0)
    total = w.sum(axis=0)
    y = filled(value)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = (w * y).sum(axis=0) / total
    Q = np.nansum((w * (y - filled(mean)) ** 2), axis=0)
    degrees = np.maximum(known.sum(axis=0) - 1, 0)
    c = np.where(total > 0, total - (w**2).sum(axis=0) / np.where(total > 0, total, 1.0), 0.0)
    weight = c.sum(axis=0)
    tau2 = np.maximum((Q - degrees).sum(axis=0), 0.0) / np.where(weight > 0, weight, np.inf)
    w = np.where(known, 1.0 / np.where(known, variance + tau2, 1.0), 0.0)
    total = w.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean, u = (w * y).sum(axis=0) / total, np.sqrt(1.0 / total)
    return np.where(total > 0, mean, np.nan), np.where(total > 0, u, np.nan), np.sqrt(tau2)


def paule_mandel(X: Array, y: Array, V0: Array, R: Array) -> float:
    """Return tau of a variation with the correlation R (n, n) between runs.

    The sum of squares decreases with tau, so that there is at most one root.
    """
    degrees = int(X.shape[0] - X.shape[1])

    def excess(tau: float) -> float:
        return float(_residual_square(X, y, V0, tau, R)) - degrees

    if excess(0.0) <= 0:
        return 0.0
    # with tau only, the sum of squares about the line is n - p at this value
    factor = np.linalg.cholesky(R)
    WX, Wy = np.linalg.solve(factor, X), np.linalg.solve(factor, y)
    rest = Wy - WX @ np.linalg.lstsq(WX, Wy, rcond=None)[0]
    high = float(np.sqrt(rest @ rest / degrees))
    return float(brentq(excess, 0.0, high, xtol=1e-6 * high)) if excess(high) < 0 else high


def _residual_square(X: Array, y: Array, V0: Array, tau: float, R: Array) -> float:
    factor = cho_factor(V0 + tau**2 * R)
    WX, Wy = cho_solve(factor, X), cho_solve(factor, y)
    b = np.linalg.solve(X.T @ WX, X.T @ Wy)
    return float((y - X @ b) @ (Wy - WX @ b))
