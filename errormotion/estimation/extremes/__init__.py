"""Figures that are extreme values of noisy curves: their mean excess by noise, and their uncertainty.

The largest of noisy values is too large on average, and the range of a curve at rest is that of its noise. Standards do
not correct for this ``bias``. Two estimates of it:

`of_noisy_values`, by added noise
    For any curve. Noise of the same size is added once more, which increases a figure by d on average (SIMEX: Cook,
    Stefanski, J. Am. Stat. Assoc. 89 (1994) 1314). The bias of a curve that is flat about its extremes is proportional
    to the standard deviation of the noise, so that it is ``d / (sqrt(2) - 1)``; that of a curve with pointed extremes
    is proportional to the variance, so that it is d. The first is stated.
`by_true_values`, by draws of the true values
    For curves whose departures from a line are alike at all positions: `errormotion.estimation.extremes.true_curves`
    draws the true curve given the readings. The bias is the excess over the median of the figures of these draws.

A bias depends on assumptions about the curve. Half of it is added to the standard deviation of the figure as its
standard uncertainty (root sum of squares).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from errormotion.arrays import Array

SEED = 230
DRAWS = 300
BIAS_UNCERTAINTY = 0.5
"""Standard uncertainty of a bias, relative to it."""
FLAT = 1.0 / (np.sqrt(2.0) - 1.0)
"""Ratio of the bias of a figure to its change by additional noise of the same size, for flat curves."""
POINTED = 1.0
"""The same ratio for curves with pointed extremes."""
_VALUES = 1_000_000
"""Largest number of simulated values; fewer draws are made for longer curves."""
_FEWEST = 100
_OUTER, _INNER = 15, 10
"""Pairs of draws from which the scatter of a corrected figure follows."""


@dataclass(frozen=True)
class Extremes:
    """Figures that are extreme values, or one of them; NaN = unknown.

    Attributes
    ----------
    value : ndarray, (figure,) or ()
        Of the measured values.
    bias : ndarray, (figure,) or ()
        Typical excess over the true figure.
    u : ndarray, (figure,) or ()
        Standard uncertainty of ``value - bias``.
    covariance : ndarray, (figure, figure) or (), optional
        Covariance of ``value - bias``, of figures of noisy values.
    """

    value: Array
    bias: Array
    u: Array
    covariance: Array | None = None


def expanded(bias: Array | float, u: Array | float) -> Array:
    """Return the expanded uncertainty (k = 2) of a value that is not corrected for its bias (JCGM 100, F.2.4.5)."""
    return np.asarray(2.0 * np.asarray(u) + np.abs(bias))


def of_noisy_values(
    figures: Callable[[Array], Array],
    values: Array,
    independent: Array,
    shared: Array,
    *,
    draws: int | None = None,
    seed: int = SEED,
    bias_uncertainty: float = BIAS_UNCERTAINTY,
    skewed: bool = False,
    corrected: bool = False,
) -> Extremes:
    """Return figures of measured values with their bias and uncertainty, by noise that is added once more.

    State ``value - bias`` with u, or value with `expanded`. The bias is itself a function of the noisy values: with the
    mean G of figures F with further noise, ``C = F - FLAT (G - F)``. Where few places compete for an extreme, C
    scatters more than F. The ratio of both is that over values with further noise.

    Parameters
    ----------
    figures : callable
        From values of this shape, with any leading dimensions (...), to figures (...) or (..., figure).
    values : ndarray, of any shape
        Measured, in any unit.
    independent : ndarray, of the same shape
        Standard uncertainty that is independent from value to value.
    shared : ndarray, (source, ...)
        Effect of one standard uncertainty of each source that the values share.
    draws : int, optional
        Number of simulations; default: `DRAWS`, fewer for more than 3000 values.
    seed : int
        Of the simulated noise; the result is the same in each call.
    bias_uncertainty : float
        Standard uncertainty of a bias, relative to it.
    skewed : bool
        Whether u is increased to half of the 95 % deviation on the longer side, where that is larger.
    corrected : bool
        Whether u is that of ``value - bias`` (C), and not of the value (F).
    """
    if draws is None:
        draws = int(np.clip(_VALUES // max(values.size, 1), _FEWEST, DRAWS))
    draw = np.random.default_rng(seed).standard_normal
    half = independent * draw((draws // 2, *values.shape))
    half += np.tensordot(draw((draws // 2, len(shared))), shared, axes=1)
    first = figures(values)
    noise = np.concatenate([half, -half])  # in pairs, so that the draws cause no bias
    again = figures(values + noise)
    mean, deviation = again.mean(axis=0), again.std(axis=0, ddof=1)
    bias = FLAT * (mean - first)
    more = _scatter_of_corrected(figures, values, half, again) if corrected else np.ones_like(deviation)
    deviation = deviation * more
    extra = np.square(bias_uncertainty * bias)
    if skewed:
        tail = np.abs(np.quantile(again, (0.025, 0.975), axis=0) - mean).max(axis=0) / 2.0
        extra = extra + np.maximum(tail**2 - deviation**2, 0.0)
    covariance = np.multiply.outer(more, more) * np.cov(again.T) + (np.diag(extra) if extra.ndim else extra)
    return Extremes(first, bias, np.hypot(deviation, np.sqrt(extra)), covariance)


def _scatter_of_corrected(figures: Callable[[Array], Array], values: Array, half: Array, again: Array) -> Array:
    """Return the ratio of the standard deviations of C and F, at least 1; see `of_noisy_values`.

    The same inner draws for all outer ones: their number then makes no scatter of C.
    """
    outer, inner = half[:_OUTER], half[_OUTER : _OUTER + _INNER]
    beside = np.concatenate([inner, -inner])
    F, C = [], []
    for k, noise in enumerate(outer):
        for its, plus in ((again[k], noise), (again[len(half) + k], -noise)):
            F.append(its)
            C.append(its - FLAT * (figures(values + plus + beside).mean(axis=0) - its))
    of_F, of_C = (np.var(each, axis=0, ddof=1) for each in (F, C))
    return np.asarray(np.sqrt(np.maximum(of_C / np.where(of_F > 0, of_F, np.inf), 1.0)))


def range_from_reference(values: Array, variance: Array, shared: Array) -> Extremes:
    """Return the range of a curve and of its reference state, whose value is 0 by definition.

    Parameters
    ----------
    values, variance : ndarray, (n,)
        Values and the variance that is independent from value to value.
    shared : ndarray, (source, n)
        Effect of one standard uncertainty of each source that the values share.
    """
    return of_noisy_values(_range, values, np.sqrt(variance), shared)


@dataclass(frozen=True)
class Largest:
    """The largest of noisy errors, or lengths of error vectors.

    Attributes
    ----------
    place : int
        Its index.
    value : float
        With the sign of the error; a length is not negative.
    bias : float
        Typical excess of its magnitude over the true largest one, and over the true one at its place.
    u : float
        Standard uncertainty of the magnitude less the bias.
    """

    place: int
    value: float
    bias: float
    u: float

    @property
    def expanded(self) -> float:
        """Expanded uncertainty of ``value``, k = 2; see `expanded`."""
        return float(expanded(self.bias, self.u))


def largest(errors: Array, covariance: Array, shared: Array) -> Largest:
    """Return the largest of errors, or the longest of error vectors.

    Parameters
    ----------
    errors : ndarray, (n, m)
        Finite; n > 0.
    covariance : ndarray, (n, m, m)
        Of the contributions that are independent from place to place.
    shared : ndarray, (source, n, m)
        Effect of one standard uncertainty of each source that the places share.
    """
    length = np.linalg.norm(errors, axis=-1)
    place = int(length.argmax())
    value = float(errors[place, 0] if errors.shape[1] == 1 else length[place])
    distribution = _of_lengths(lambda lengths: lengths.max(axis=-1), errors, covariance, shared)
    return Largest(place, value, float(distribution.bias), float(distribution.u))


def root_mean_square(errors: Array, covariance: Array, shared: Array) -> Extremes:
    """Return the root mean square of errors, or of the lengths of error vectors; parameters as of `largest`."""
    return _of_lengths(lambda lengths: np.sqrt(np.mean(lengths**2, axis=-1)), errors, covariance, shared)


def _of_lengths(figure: Callable[[Array], Array], errors: Array, covariance: Array, shared: Array) -> Extremes:
    """Return a figure of lengths (..., n) with bias and uncertainty; NaN where a covariance is unknown.

    Lengths are the same in the principal axes of the covariances, in which the coordinates are independent.
    """

    def figures(e: Array) -> Array:
        return np.asarray(figure(np.linalg.norm(e, axis=-1)))

    if not (np.isfinite(covariance).all() and np.isfinite(shared).all()):
        return Extremes(figures(errors), np.asarray(np.nan), np.asarray(np.nan))
    variances, axes = np.linalg.eigh(covariance)
    u = np.sqrt(np.maximum(variances, 0.0))  # those that are negative by rounding are 0
    turned = np.einsum("tji,...tj->...ti", axes, np.concatenate([errors[None], shared]))
    return of_noisy_values(figures, turned[0], u, turned[1:])


def by_true_values(value: Array, true: Array) -> Extremes:
    """Return figures with their bias and uncertainty, by the figures of draws of the true values.

    Parameters
    ----------
    value : ndarray, (figure,)
        Figures of the measured values; NaN is unknown.
    true : ndarray, (trial, figure)
        Figures of draws of the true values, given the measured ones.
    """
    bias = value - np.median(true, axis=0)
    return Extremes(value, bias, np.hypot(true.std(axis=0, ddof=1), BIAS_UNCERTAINTY * bias))


def _range(values: Array) -> Array:
    return np.asarray(np.maximum(values.max(axis=-1), 0.0) - np.minimum(values.min(axis=-1), 0.0))
