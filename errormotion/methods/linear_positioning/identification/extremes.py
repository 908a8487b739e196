"""Figures that are extreme values: their mean excess by scatter, and their standard uncertainty.

The largest of noisy means, and the largest of standard deviations that are estimated from a few runs, are too large on
average. The true figure is that of the true means and standard deviations, the limit for an infinite number of runs.
Its distribution given the readings is found by simulation (JCGM 101). In each trial

* variances are drawn from their scaled inverse chi-square distributions;
* the mean curve and the reversal curve are drawn as a line plus a remainder that is shrunk by the share of noise in it
  (`errormotion.estimation.extremes.true_curves`), as are the logarithms of variances that differ from target to target;
* drift from run to run shifts and inclines both curves, and each source of the budget is drawn once.

The figure of the standard exceeds the median of the trials by the ``bias``. The bias depends on the assumption of how
similar the targets are. Half of it is therefore added to the standard deviation of the trials as its standard
uncertainty (root sum of squares). The mean reversal error is not an extreme value and has no bias.
``docs/validation.md`` shows the share of intervals that contain the true figure, for several kinds of axes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from errormotion.arrays import Array
from errormotion.estimation.extremes import SEED, Extremes, by_true_values
from errormotion.estimation.extremes.true_curves import draw_components, draw_curves, draw_variances
from errormotion.methods.linear_positioning.identification import standard
from errormotion.methods.linear_positioning.identification.scatter import Scatter
from errormotion.methods.linear_positioning.identification.standard import Statistics


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


def figures(
    x: Array,
    z: Array,
    spread: Scatter,
    shared: Array,
    target_u: float,
    reversal_u: Array | None = None,
    *,
    straight: bool,
    trials: int,
) -> Extremes:
    """Return the figures of readings in the order of ``standard.FIGURES`` with their bias and uncertainty; m or rad.

    Parameters
    ----------
    x : ndarray, (approach, run, target)
        Corrected deviations.
    z : ndarray, (target,)
        Position, scaled to -1 ... 1.
    spread : Scatter
    shared : ndarray, (source, target)
        Effect of one standard uncertainty of each source that approaches and runs share, without drift.
    target_u : float
        Standard uncertainty that is independent from target to target.
    reversal_u : ndarray, (target,), optional
        Standard uncertainty of the reversal by a trend, one source; 0 by default.
    straight : bool
        Whether the freedom is a straightness, of which a line is removed.
    trials : int
        0: bias and uncertainty are not determined (NaN).
    """
    reversal_u = np.zeros(z.size) if reversal_u is None else reversal_u
    observed = standard.statistics(x)
    value = _evaluate(observed, z, straight)
    if not trials:
        return Extremes(value, *np.full((2, value.size), np.nan))
    true = _trials(x, z, observed, spread, shared, target_u, reversal_u, trials)
    distribution = by_true_values(value, _evaluate(true, z, straight))
    mean = standard.FIGURES.index("B_mean")  # not an extreme value: unbiased
    if not np.isfinite(value[mean]):
        return distribution
    others = np.arange(value.size) != mean
    of_mean = np.hypot(_mean_reversal_u(x, z, spread), reversal_u.mean())
    return replace(
        distribution, bias=np.where(others, distribution.bias, 0.0), u=np.where(others, distribution.u, of_mean)
    )


def _mean_reversal_u(x: Array, z: Array, spread: Scatter) -> float:
    n = np.isfinite(x).sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        own = (spread.own_stated / n).sum(axis=0)
    known = np.isfinite(own)
    inclined = z[known].mean() ** 2  # 0 if no target is missing
    drift = 4.0 * (spread.run_stated[2] + spread.run_stated[3] * inclined) / n.max()
    return float(np.sqrt(own[known].sum() / known.sum() ** 2 + drift))


def _evaluate(statistics: Statistics, z: Array, straight: bool) -> Array:
    return standard.figures(straightened(statistics, z) if straight else statistics)


def _trials(
    x: Array,
    z: Array,
    observed: Statistics,
    spread: Scatter,
    shared: Array,
    target_u: float,
    reversal_u: Array,
    trials: int,
) -> Statistics:
    """Return draws of the true means and standard deviations, (trial, approach, target)."""
    generator = np.random.default_rng(SEED)
    draw = generator.standard_normal
    m = z.size
    n = np.isfinite(x).sum(axis=1)
    measured = n.any(axis=1)
    both = bool(measured.all())
    own = np.full((trials, 2, m), np.nan)
    for approach in np.flatnonzero(measured):
        own[:, approach] = draw_variances(
            spread.own[approach], spread.own_freedom, trials, generator, common=spread.pooled
        )
    common, opposite = (
        draw_components(spread.run[two], spread.noise[two], spread.freedom[two], trials, generator)  # (trial, 2)
        for two in (slice(2), slice(2, 4))
    )
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
        draw_curves(curve, noise, drift / runs, z, about_zero=k > 0, generator=generator)
        for k, (curve, drift) in enumerate(zip(curves, (common, opposite), strict=False))
    ]
    of_sources = draw((trials, len(shared))) @ shared + target_u * draw((trials, m))
    drawn[0] += of_sources
    if both and reversal_u.any():
        drawn[1] += draw((trials, 1)) * reversal_u / 2.0
    mean = np.full((trials, 2, m), np.nan)
    if both:
        mean[:, 0], mean[:, 1] = drawn[0] + drawn[1], drawn[0] - drawn[1]
        single = (n > 0) & ~(n > 0).all(axis=0)  # targets that were reached by this approach only
        for approach in np.flatnonzero(single.any(axis=1)):
            of_runs = (common + opposite) / runs
            alone = draw_curves(
                observed.mean[approach], of_mean[:, approach], of_runs, z, about_zero=False, generator=generator
            )
            mean[:, approach, single[approach]] = (alone + of_sources)[:, single[approach]]
    else:
        mean[:, int(measured.argmax())] = drawn[0]
    total = own + ((common + opposite) @ np.stack([np.ones_like(z), z**2]))[:, None, :]
    return Statistics(mean, np.sqrt(total))
