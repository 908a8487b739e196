"""Random draws of true curves and true variances, given the estimates from noisy readings (JCGM 101).

Figures that are extreme values of a curve are too large on average if the curve is noisy. With draws of the true curve,
`errormotion.estimation.extremes.by_true_values` states their bias and uncertainty.

* A curve is a line plus a remainder r. The observed remainder contains noise of variance s^2, so the variance t^2 of
  the true one is that of the observed remainder less s^2, and the true remainder at a position has the mean ``B r_i``
  and the variance ``B s^2`` with ``B = t^2 / (t^2 + s^2)`` (Efron, Morris, J. Am. Stat. Assoc. 68 (1973) 117). This
  assumes that the remainders at all positions are alike: they are not if a curve is flat in one part and has a step in
  another one.
* A variance that is estimated with v degrees of freedom has a scaled inverse chi-square distribution. Variances that
  differ from position to position are treated like a curve without a line, by their logarithms.
"""

from __future__ import annotations

import numpy as np
from scipy import special

from errormotion.arrays import Array

LIMIT = 0.5
"""Largest shift of the logarithm of a variance towards the mean, in standard deviations of its estimate."""
SIGNIFICANT = 0.01
"""Probability below which a component of variance is significantly different from 0."""


def draw_curves(
    curve: Array, noise: Array, line: Array, z: Array, *, about_zero: bool, generator: np.random.Generator
) -> Array:
    """Return draws of the true curve, (trial, n), given an observed one.

    Parameters
    ----------
    curve : ndarray, (n,)
        Observed values, in any unit; NaN is unknown, and remains so.
    noise : ndarray, (trial, n)
        Draws of the variance of the observed values that is independent from position to position.
    line : ndarray, (trial, 2)
        Draws of the variance of an offset and of a slope that the whole curve has in addition.
    z : ndarray, (n,)
        Positions, in the unit for which ``line`` states the slope.
    about_zero : bool
        Whether the true curve is expected near 0, such as a reversal: its offset and slope are then shrunk towards 0
        like the remainder, with one degree of freedom each. Otherwise the observed line is the mean of the true ones.
    generator : numpy.random.Generator
    """
    known = np.isfinite(curve)
    m, trials = int(known.sum()), len(noise)
    if m < 2:  # no line
        out = np.full((trials, z.size), np.nan)
        spread = np.sqrt(noise[:, known] + line[:, :1])
        out[:, known] = curve[known] + spread * generator.standard_normal((trials, m))
        return out
    Z = np.stack([np.ones(m), z[known]], axis=1)
    normal = np.linalg.inv(Z.T @ Z)
    coefficient = normal @ Z.T @ curve[known]
    rest = curve[known] - Z @ coefficient
    variance = noise[:, known]
    typical = variance.mean(axis=1)
    of_line = typical[:, None] * np.diagonal(normal) + line
    B = _true_share(coefficient**2 / generator.chisquare(1.0, (trials, 2)), of_line)
    if not about_zero:
        B[:] = 1.0
    lines = B * coefficient + np.sqrt(B * of_line) * generator.standard_normal((trials, 2))
    B = _true_share(float(rest @ rest) / generator.chisquare(max(m - 2, 1), trials), typical)[:, None]
    remainder = B * rest + np.sqrt(B * variance) * generator.standard_normal((trials, m))
    out = np.full((trials, z.size), np.nan)
    out[:, known] = lines @ Z.T + remainder
    return out


def draw_variances(
    estimate: Array, freedom: float, trials: int, generator: np.random.Generator, *, common: bool
) -> Array:
    """Return draws of true variances, (trial, ...), given estimates of any shape.

    Parameters
    ----------
    estimate : ndarray
        NaN is unknown, and remains so.
    freedom : float
        Degrees of freedom of each estimate; infinite if it is exact.
    common : bool
        Whether the estimates are one, repeated; otherwise each has its own degrees of freedom, and their logarithms are
        shrunk towards the mean by the share of their variance that is not the variance of estimation, but by `LIMIT`
        standard deviations at most (Efron, Morris, J. Am. Stat. Assoc. 67 (1972) 130): one that differs from all others
        is not like them. Variance and mean of the logarithms are drawn as well.
    """
    if common:
        scale = freedom / generator.chisquare(freedom, trials) if np.isfinite(freedom) else np.ones(trials)
        return np.asarray(scale.reshape(-1, *(1,) * estimate.ndim) * estimate)
    known = np.isfinite(estimate)
    # ln(estimate / variance) = ln(chi2_v / v) has E = digamma(v / 2) - ln(v / 2), Var = trigamma(v / 2)
    excess = special.digamma(freedom / 2.0) - np.log(freedom / 2.0)
    logs = np.log(estimate[known]) - excess
    noise, n = float(special.polygamma(1, freedom / 2.0)), logs.size
    # the variance of the logarithms, and their mean, are drawn as well
    off = logs - logs.mean()
    width = float(off @ off) / generator.chisquare(max(n - 1, 1), (trials, 1))
    centre = logs.mean() + np.sqrt(width / n) * generator.standard_normal((trials, 1))
    limit = LIMIT * np.sqrt(noise)
    share = _true_share(width, np.asarray(noise)) if n > 1 else 1.0
    B = np.maximum(share, 1.0 - limit / np.maximum(np.abs(off), limit))
    drawn = np.full((trials, *estimate.shape), np.nan)
    error = np.log(generator.chisquare(freedom, (trials, logs.size)) / freedom) - excess
    drawn[:, known] = np.exp(centre + B * (logs - centre) - np.sqrt(B) * error)
    return drawn


def draw_components(
    estimate: Array, noise: Array, freedom: float | Array, trials: int, generator: np.random.Generator
) -> Array:
    """Return draws of components of variance, (trial, k), of which noise has been subtracted.

    Parameters
    ----------
    estimate, noise : ndarray, (k,)
        ``estimate + noise`` has been estimated with ``freedom`` degrees of freedom, ``noise`` is known.
    freedom : float or ndarray, (k,)
        0 for components that are stated: they are not drawn. Neither is one that does not differ significantly from 0;
        its distribution would be that of the noise.
    """
    known = np.broadcast_to(np.asarray(freedom, dtype=float), estimate.shape)
    degrees = np.where(known > 0, known, 1.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = (estimate + noise) / noise
    significant = (known > 0) & (special.chdtrc(degrees, degrees * ratio) < SIGNIFICANT)
    scale = degrees / generator.chisquare(degrees, (trials, estimate.size))
    return np.where(significant, np.maximum(scale * (estimate + noise) - noise, 0.0), estimate)


def _true_share(observed: Array, noise: Array) -> Array:
    """Return the share of an observed variance that is not noise."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(observed > noise, 1.0 - noise / observed, 0.0)
