"""Figures that are extreme values: their mean excess by scatter, and their standard uncertainty.

The largest of noisy means, and the largest of standard deviations that are estimated from a few runs, are too large on
average. The true figure is that of the true means and standard deviations, the limit for an infinite number of runs.
Its distribution given the readings is found by simulation (JCGM 101). In each trial

* variances are drawn from their scaled inverse chi-square distributions;
* the mean curve is a line plus a remainder r. The observed remainder contains noise of variance s^2, so the variance
  t^2 of the true one is that of the observed remainder less s^2, and the true remainder of a target has the mean
  ``B r_i`` and the variance ``B s^2`` with ``B = t^2 / (t^2 + s^2)`` (Efron, Morris, J. Am. Stat. Assoc. 68 (1973)
  117). The reversal curve, and the logarithms of variances that differ from target to target, are treated in the same
  way;
* drift from run to run shifts and inclines both curves, and each source of the budget is drawn once.

The figure of the standard exceeds the median of the trials by the ``bias``. The bias depends on the assumption of how
similar the targets are. Half of it is therefore added to the standard deviation of the trials as its standard
uncertainty (root sum of squares). The mean reversal error is not an extreme value and has no bias.
``docs/validation.md`` shows the share of intervals that contain the true figure, for several kinds of axes.
"""

from __future__ import annotations

import numpy as np
from scipy import special

from errormotion.arrays import Array
from errormotion.datasets.results.extremes import BIAS_UNCERTAINTY, SEED, Extremes
from errormotion.methods.linear_positioning.identification import standard
from errormotion.methods.linear_positioning.identification.scatter import Scatter
from errormotion.methods.linear_positioning.identification.standard import Statistics

SIGNIFICANT = 0.01
"""Probability below which a variance of the drift is significantly different from 0."""


def straightened(statistics: Statistics, z: Array) -> Statistics:
    """Return means (..., approach, target) minus the least-squares line of the mean bidirectional deviation."""
    both = np.isfinite(statistics.mean).any(axis=-1).all()
    middle = statistics.bidirectional if both else _measured_approach(statistics.mean)
    known = np.isfinite(middle).reshape(-1, z.size)[0]
    Z = np.stack([np.ones_like(z), z], axis=1)
    line = (middle[..., known] @ np.linalg.pinv(Z[known]).T) @ Z.T
    return Statistics(statistics.mean - line[..., None, :], statistics.s)


def _measured_approach(mean: Array) -> Array:
    return np.asarray(np.where(np.isfinite(mean[..., 0, :]), mean[..., 0, :], mean[..., 1, :]))


def figures(x: Array, spread: Scatter, shared: Array, target_u: float, *, straight: bool, trials: int) -> Extremes:
    """Return the figures of readings in the order of ``standard.FIGURES`` with their bias and uncertainty; m or rad.

    Parameters
    ----------
    x : ndarray, (approach, run, target)
        Corrected deviations.
    spread : Scatter
    shared : ndarray, (source, target)
        Effect of one standard uncertainty of each source that approaches and runs share, without drift.
    target_u : float
        Standard uncertainty that is independent from target to target.
    straight : bool
        Whether the freedom is a straightness, of which a line is removed.
    trials : int
        0: bias and uncertainty are not determined (NaN).
    """
    observed = standard.statistics(x)
    value = _evaluate(observed, spread.z, straight)
    if not trials:
        return Extremes(value, *np.full((2, value.size), np.nan))
    true = _evaluate(_trials(x, observed, spread, shared, target_u, trials), spread.z, straight)
    bias = value - np.median(true, axis=0)
    u = np.hypot(true.std(axis=0, ddof=1), BIAS_UNCERTAINTY * bias)
    mean = standard.FIGURES.index("B_mean")  # not an extreme value: unbiased
    if np.isfinite(value[mean]):
        bias[mean], u[mean] = 0.0, _mean_reversal_u(x, spread)
    return Extremes(value, bias, u)


def _mean_reversal_u(x: Array, spread: Scatter) -> float:
    n = np.isfinite(x).sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        own = (spread.own_factor * spread.own / n).sum(axis=0)
    known = np.isfinite(own)
    inclined = spread.z[known].mean() ** 2  # 0 if no target is missing
    drift = 4.0 * (spread.opposite_mean[0] + spread.opposite_mean[1] * inclined) / n.max()
    return float(np.sqrt(own[known].sum() / known.sum() ** 2 + drift))


def _evaluate(statistics: Statistics, z: Array, straight: bool) -> Array:
    return standard.figures(straightened(statistics, z) if straight else statistics)


def _trials(x: Array, observed: Statistics, spread: Scatter, shared: Array, target_u: float, trials: int) -> Statistics:
    """Return draws of the true means and standard deviations, (trial, approach, target)."""
    generator = np.random.default_rng(SEED)
    draw = generator.standard_normal
    z, m = spread.z, spread.z.size
    n = np.isfinite(x).sum(axis=1)
    measured = n.any(axis=1)
    both = bool(measured.all())
    own = _own(spread, trials, generator)  # (trial, approach, target)
    common, opposite = _drifts(spread, trials, generator)  # (trial, 2)
    with np.errstate(invalid="ignore", divide="ignore"):
        of_mean = own / n
    if both:
        curves = [observed.bidirectional, observed.reversal / 2.0]
        noise = of_mean.sum(axis=1) / 4.0
    else:
        curves = [_measured_approach(observed.mean)]
        noise = of_mean[:, int(measured.argmax())]
    runs = max(int(n.max()), 1)
    drawn = [
        _curve(curve, noise, drift / runs, z, about_zero=k > 0, generator=generator)
        for k, (curve, drift) in enumerate(zip(curves, (common, opposite), strict=False))
    ]
    of_sources = draw((trials, len(shared))) @ shared + target_u * draw((trials, m))
    drawn[0] += of_sources
    mean = np.full((trials, 2, m), np.nan)
    if both:
        mean[:, 0], mean[:, 1] = drawn[0] + drawn[1], drawn[0] - drawn[1]
        single = (n > 0) & ~(n > 0).all(axis=0)  # targets that were reached by this approach only
        for approach in np.flatnonzero(single.any(axis=1)):
            of_runs = (common + opposite) / runs
            alone = _curve(
                observed.mean[approach], of_mean[:, approach], of_runs, z, about_zero=False, generator=generator
            )
            mean[:, approach, single[approach]] = (alone + of_sources)[:, single[approach]]
    else:
        mean[:, int(measured.argmax())] = drawn[0]
    total = own + ((common + opposite) @ np.stack([np.ones_like(z), z**2]))[:, None, :]
    return Statistics(mean, np.sqrt(total))


def _own(spread: Scatter, trials: int, generator: np.random.Generator) -> Array:
    """Return draws of the variances of one reading, (trial, approach, target)."""
    known = np.isfinite(spread.own)
    freedom = 2.0 * spread.own_factor / (spread.own_factor - 1.0) if spread.own_factor > 1.0 else np.inf
    if spread.pooled:
        scale = freedom / generator.chisquare(freedom, trials) if np.isfinite(freedom) else np.ones(trials)
        return np.asarray(scale[:, None, None] * spread.own)
    logs = np.log(spread.own[known]) - special.digamma(freedom / 2.0) + np.log(freedom / 2.0)
    noise = float(special.polygamma(1, freedom / 2.0))
    centre, width = logs.mean(), logs.var(ddof=1)
    B = max(0.0, 1.0 - noise / width) if width > 0 else 0.0
    drawn = np.full((trials, *spread.own.shape), np.nan)
    shrunk = centre + B * (logs - centre)
    drawn[:, known] = np.exp(shrunk + np.sqrt(B * noise) * generator.standard_normal((trials, logs.size)))
    return drawn


def _drifts(spread: Scatter, trials: int, generator: np.random.Generator) -> tuple[Array, Array]:
    """Return draws of the variances of offset and slope of a run, common and opposite, each (trial, 2).

    A variance that does not differ significantly from 0 is not drawn: its distribution would be that of the noise.
    """
    drawn = []
    for variance in (spread.common, spread.opposite):
        variances = np.tile(variance, (trials, 1))
        if spread.freedom > 0:
            with np.errstate(invalid="ignore", divide="ignore"):
                ratio = (variance + spread.noise) / spread.noise
            significant = special.chdtrc(spread.freedom, spread.freedom * ratio) < SIGNIFICANT
            scale = spread.freedom / generator.chisquare(spread.freedom, (trials, 2))
            with_noise = np.maximum(scale * (variance + spread.noise) - spread.noise, 0.0)
            variances = np.where(significant, with_noise, variances)
        drawn.append(variances)
    return drawn[0], drawn[1]


def _curve(
    curve: Array, noise: Array, drift: Array, z: Array, *, about_zero: bool, generator: np.random.Generator
) -> Array:
    """Return draws of the true curve (trial, target), given an observed one.

    ``noise`` (trial, target) is the variance that is independent from target to target, ``drift`` (trial, 2) that of
    offset and slope. Offset and slope of a curve ``about_zero``, such as a reversal, are shrunk towards 0 like the
    remainder, with one degree of freedom each.
    """
    known = np.isfinite(curve)
    m, trials = int(known.sum()), len(noise)
    if m < 2:  # no line
        out = np.full((trials, z.size), np.nan)
        spread = np.sqrt(noise[:, known] + drift[:, :1])
        out[:, known] = curve[known] + spread * generator.standard_normal((trials, m))
        return out
    Z = np.stack([np.ones(m), z[known]], axis=1)
    normal = np.linalg.inv(Z.T @ Z)
    coefficient = normal @ Z.T @ curve[known]
    rest = curve[known] - Z @ coefficient
    variance = noise[:, known]
    typical = variance.mean(axis=1)
    of_line = typical[:, None] * np.diagonal(normal) + drift
    B = _share(coefficient**2 / generator.chisquare(1.0, (trials, 2)), of_line)
    if not about_zero:
        B[:] = 1.0
    line = B * coefficient + np.sqrt(B * of_line) * generator.standard_normal((trials, 2))
    B = _share(float(rest @ rest) / generator.chisquare(max(m - 2, 1), trials), typical)[:, None]
    remainder = B * rest + np.sqrt(B * variance) * generator.standard_normal((trials, m))
    out = np.full((trials, z.size), np.nan)
    out[:, known] = line @ Z.T + remainder
    return out


def _share(observed: Array, noise: Array) -> Array:
    """Return the share of an observed variance that is not noise."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(observed > noise, 1.0 - noise / observed, 0.0)
