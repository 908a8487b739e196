"""Detection of steps and outliers in a series with a trend, with a stated rate of false alarms.

Candidates are a step between any two neighbouring times with ``MIN_SIDE`` values on either side, and an outlier at any
single run. Runs may be alike over a time T (`errormotion.estimation.between_runs`), and a slow variation looks like a
step: T is estimated with and without the candidate. With its contribution g to the weighted sum of squares r in the
metric of the covariance V of each T, orthogonal to the present model, the statistic is

    max over T, candidates of (log L(T, r - g)) - max over T of (log L(T, r)),    log L = -log|V| / 2 - n log(r) / 2,

with the prior of T. g counts relative to the mean of two scales, which for T = 0 are the residuals and the moving
ranges without those that the candidate itself changes: undetected steps increase the residuals, but hardly the ranges.
The largest statistic of each kind is compared with its distribution without steps and outliers, from simulated normal
series with the same times and the covariance of each T, as often as it is likely: the probability of any false alarm is
``FALSE_STEPS + FALSE_DEPARTURES``. A significant candidate is added to the model, the
positions of the earlier ones are optimised again, and the search is repeated with the distribution for the new model
until no candidate is significant.

A weakly significant step may be a chance result, which would falsify the trend. The interval of the trend therefore
covers the intervals with and without the steps and outliers whose p is above ``CERTAIN``.

The interval of the time of a step contains all positions whose log likelihood is within 7.35 / 2 of the best: the 95 %
quantile of the larger of two independent exponential variables (Eo and Morley, Quantitative Economics 6 (2015) 463).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular

from errormotion.arrays import Array
from errormotion.estimation.between_runs import (
    RunFit,
    alike,
    by_moving_ranges,
    correlation,
    difference_variance,
    fit_runs,
    paule_mandel,
)
from errormotion.record.series import Series

FALSE_STEPS = 0.035
"""Probability that a step is detected in a series without steps."""
FALSE_DEPARTURES = 0.01
"""Probability that an outlier is detected in a series without outliers."""
MIN_SIDE = 3
"""Smallest number of values on either side of a step."""
CERTAIN = 0.001
"""Largest p at which a step is regarded as certain for the interval of the trend."""
MAX_FOUND = 20
"""Largest number of steps and outliers."""
SIMULATIONS = 1999
LIKELIHOOD_DROP = 7.35
"""Twice the decrease of the log likelihood at the ends of the 95 % interval of the position of a step."""
TINY = np.finfo(float).tiny
MIN_ORTHOGONAL = 1e-6
"""Smallest fraction of the square of a candidate that is orthogonal to the model."""


@dataclass(frozen=True)
class Candidate:
    """A change at value number ``index``: a step before it, or an outlier."""

    index: int
    single: bool = False
    p: float = np.nan

    def column(self, n: int) -> Array:
        """Return the column of the design matrix, (n,)."""
        k = np.arange(n)
        return (k == self.index).astype(float) if self.single else (k >= self.index).astype(float)


@dataclass(frozen=True)
class Step:
    """A step between the values ``index - 1`` and ``index``; its interval is after ``first`` and up to ``last``."""

    index: int
    first: int
    last: int
    size: float
    half_width: float
    p: float


@dataclass(frozen=True)
class Model:
    """Trend, steps and outliers of a series.

    Attributes
    ----------
    fit : RunFit or None
        The first two parameters are the value at the first run and the trend per year; None for too few values.
    steps : tuple of Step
        Steps in chronological order.
    departing : tuple of int
        Indices of outliers.
    trend : tuple of float
        Change per year, with the limits of its interval.
    """

    fit: RunFit | None
    steps: tuple[Step, ...] = ()
    departing: tuple[int, ...] = ()
    trend: tuple[float, float, float] = (np.nan, np.nan, np.nan)


def model_of(series: Series) -> Model:
    """Return trend, steps and outliers of a series."""
    base = _base(series)
    if base.shape[1] < 2:
        return Model(None)
    chosen = _search(series, base)
    X = _design(base, chosen)
    result = fit_runs(X, series.value, series.covariance, series.time)
    if result is None:
        return Model(None)
    V = series.covariance + result.tau**2 * correlation(series.time, series.size, result.duration)
    steps, departing = list[Step](), list[int]()
    for number, candidate in enumerate(chosen):
        if candidate.single:
            departing.append(candidate.index)
            continue
        column = base.shape[1] + number
        first, last = _interval(series, base, chosen, number, V)
        size, half_width = float(result.parameters[column]), float(result.half_width[column])
        steps.append(Step(candidate.index, first, last, size, half_width, candidate.p))
    trend = _trend(series, base, chosen, result)
    return Model(result, tuple(sorted(steps, key=lambda step: step.index)), tuple(sorted(departing)), trend)


def _trend(series: Series, base: Array, chosen: list[Candidate], result: RunFit) -> tuple[float, float, float]:
    """Return the trend with its interval, which covers that of the model without uncertain candidates."""
    fits = [result]
    certain = [candidate for candidate in chosen if candidate.p <= CERTAIN]
    if len(certain) < len(chosen) and (
        without := fit_runs(_design(base, certain), series.value, series.covariance, series.time)
    ):
        fits.append(without)
    low = min(float(each.parameters[1] - each.half_width[1]) for each in fits)
    high = max(float(each.parameters[1] + each.half_width[1]) for each in fits)
    return float(result.parameters[1]), low, high


def _base(series: Series) -> Array:
    """Return the columns of a constant and a trend; with fewer than three times, of the constant only."""
    t = series.years
    if np.unique(t).size < 3:
        return np.ones((series.size, 1))
    return np.column_stack([np.ones_like(t), t])


def _design(base: Array, chosen: list[Candidate]) -> Array:
    return np.column_stack([base, *(candidate.column(len(base)) for candidate in chosen)])


def _search(series: Series, base: Array) -> list[Candidate]:
    chosen: list[Candidate] = []
    noise = np.random.default_rng(20260301).normal(size=(SIMULATIONS, series.size))
    while len(chosen) < MAX_FOUND:
        X = _design(base, chosen)
        candidates = _candidates(series, chosen)
        if not candidates or series.size - X.shape[1] < 2:
            break
        best = _Trial(series, X, candidates).significant(noise)
        if best is None:
            break
        chosen = _repositioned(series, base, [*chosen, best])
    return chosen


def _candidates(series: Series, chosen: list[Candidate], single: bool | None = None) -> list[Candidate]:
    """Return the candidates for a model; ``single`` restricts them to outliers (True) or steps (False)."""
    n, t = series.size, series.time
    steps = [candidate.index for candidate in chosen if not candidate.single]
    taken = {candidate.index for candidate in chosen if candidate.single}
    made = []
    if single is not True:
        made += [
            Candidate(k)
            for k in range(MIN_SIDE, n - MIN_SIDE + 1)
            if t[k] > t[k - 1] and all(abs(k - other) >= MIN_SIDE for other in steps)
        ]
    if single is not False:
        made += [Candidate(k, single=True) for k in range(n) if k not in taken]
    return made


def _repositioned(series: Series, base: Array, chosen: list[Candidate]) -> list[Candidate]:
    """Return candidates at their best positions, each optimised with the others fixed, in at most five passes."""
    for _ in range(5):
        before = list(chosen)
        for number, candidate in enumerate(chosen):
            others = chosen[:number] + chosen[number + 1 :]
            candidates = _candidates(series, others, candidate.single)
            trial = _Trial(series, _design(base, others), candidates) if candidates else None
            if trial is not None and trial.candidates:
                chosen[number] = replace(trial.best(), p=candidate.p)
        if chosen == before:
            break
    return chosen


class _Trial:
    """Candidates for a model in the metrics of several covariances, and their statistics.

    ``V``, if it is given, is the covariance; otherwise it is one for each time over which runs may be alike.
    """

    def __init__(self, series: Series, X: Array, candidates: list[Candidate], V: Array | None = None) -> None:
        y, V0, n = series.value, series.covariance, series.size
        columns = np.column_stack([c.column(n) for c in candidates])
        metrics = [] if V is None else [(V, 0.0)]
        if V is None:
            residual = y - X @ np.linalg.lstsq(X, y, rcond=None)[0]
            for T, prior in alike(series.time, n):
                R = correlation(series.time, n, T)
                # ranges hardly show what is alike in neighbours
                tau = paule_mandel(X, y, V0, R) if T else by_moving_ranges(residual, V0)
                if tau > 0 or not T:  # without a variation between runs there is nothing that is alike
                    metrics.append((V0 + tau**2 * R, prior))
        self._metrics = [_Metric(X, columns, each, prior) for each, prior in metrics]
        kept = np.all([metric.orthogonal for metric in self._metrics], axis=0)
        self.candidates = [c for c, keep in zip(candidates, kept, strict=True) if keep]
        for metric in self._metrics:
            metric.keep(kept)
        self._index = np.array([c.index for c in self.candidates], dtype=int)
        self._single = np.array([c.single for c in self.candidates])
        self._y = y

    def squares(self) -> Array:
        """Return twice the increase of the log likelihood by each candidate in the first metric, (candidates,)."""
        return self._metrics[0].squares(self._y)

    def best(self) -> Candidate:
        """Return the candidate with the largest likelihood."""
        return self.candidates[int(np.argmax(self._statistics(self._y[None])[0]))]

    def significant(self, noise: Array) -> Candidate | None:
        """Return the significant candidate with the largest likelihood, or None."""
        own, null = self._statistics(self._y[None])[0], self._statistics(self._simulated(noise))
        best, largest = None, -np.inf
        for single, rate in ((False, FALSE_STEPS), (True, FALSE_DEPARTURES)):
            kind = np.flatnonzero(self._single == single)
            if not kind.size:
                continue
            p = float((1 + np.sum(null[:, kind].max(axis=1) >= own[kind].max())) / (1 + len(null)))
            first = kind[np.argmax(own[kind])]
            if p <= rate and own[first] > largest:
                best, largest = replace(self.candidates[first], p=p), float(own[first])
        return best

    def _simulated(self, noise: Array) -> Array:
        """Return series without candidates from white noise (m, n), with each metric as often as it is likely."""
        logs = np.array([float(metric.log_likelihood(self._y[None])[0]) for metric in self._metrics])
        share = np.cumsum(np.exp(logs - logs.max()))
        which = np.searchsorted(share / share[-1], (np.arange(len(noise)) + 0.5) / len(noise))
        return np.concatenate([noise[which == k] @ metric.L.T for k, metric in enumerate(self._metrics)])

    def _statistics(self, values: Array) -> Array:
        """Return the statistics of the candidates for each row of values (m, n)."""
        with_them = np.full((len(values), len(self.candidates)), -np.inf)
        without = np.full(len(values), -np.inf)
        for metric in self._metrics:
            log = metric.log_likelihood(values)
            without = np.maximum(without, log)
            with_them = np.maximum(with_them, log[:, None] + metric.gains(values, self._index, self._single))
        decrease: Array = with_them - without[:, None]
        return decrease


class _Metric:
    """A covariance V of the values, and the directions of candidates in whitened coordinates."""

    def __init__(self, X: Array, columns: Array, V: Array, prior: float) -> None:
        self.L: Array = np.asarray(np.linalg.cholesky(V), dtype=float)
        self._inverse = solve_triangular(self.L, np.eye(len(V)), lower=True)
        self._Q, _ = np.linalg.qr(self._inverse @ X)
        Z = self._inverse @ columns
        size = (Z**2).sum(axis=0)
        Z = Z - self._Q @ (self._Q.T @ Z)
        rest = (Z**2).sum(axis=0)
        self.orthogonal = rest > MIN_ORTHOGONAL * size
        self._G = Z / np.sqrt(np.where(self.orthogonal, rest, 1.0))
        self._v = difference_variance(V)
        self._constant = prior - float(np.log(np.diag(self.L)).sum())

    def keep(self, kept: Array) -> None:
        """Keep some of the candidates."""
        self._G = self._G[:, kept]

    def squares(self, y: Array) -> Array:
        """Return the contributions of the candidates to the sum of squares of values (n,)."""
        squares: Array = (self._inverse @ y @ self._G) ** 2
        return squares

    def _rest(self, values: Array) -> tuple[Array, Array]:
        """Return whitened values (m, n), and their residuals."""
        white: Array = values @ self._inverse.T
        rest: Array = white - (white @ self._Q) @ self._Q.T
        return white, rest

    def log_likelihood(self, values: Array) -> Array:
        """Return the log likelihood of each row of values (m, n) without a candidate, the scale being eliminated."""
        square = (self._rest(values)[1] ** 2).sum(axis=1)
        return np.asarray(self._constant - 0.5 * values.shape[1] * np.log(np.maximum(square, TINY)), dtype=float)

    def gains(self, values: Array, index: Array, single: Array) -> Array:
        """Return the increase of the log likelihood of each row (m, n) by each candidate."""
        white, rest = self._rest(values)
        d = np.abs(np.diff(rest @ self.L.T, axis=1)) / np.sqrt(np.maximum(self._v, TINY))
        # Ranges that a candidate changes: the one before its value, and of an outlier also the one after it.
        around = np.pad(d, ((0, 0), (1, 1)))
        own = around[:, index] + np.where(single, around[:, index + 1], 0.0)
        ends = (index == 0) | (index == d.shape[1])
        count = d.shape[1] - 1 - (single & ~ends)
        scale = (d.sum(axis=1, keepdims=True) - own) / count
        gain = (white @ self._G) ** 2
        freedom = white.shape[1] - self._Q.shape[1] - 1
        square = ((rest**2).sum(axis=1, keepdims=True) - gain) / freedom
        ratio = 0.5 * gain * (1 / np.maximum(np.pi / 4 * scale**2, 1e-12) + 1 / np.maximum(square, 1e-12))
        gains: Array = 0.5 * values.shape[1] * np.log1p(ratio / freedom)
        return gains


def _interval(series: Series, base: Array, chosen: list[Candidate], number: int, V: Array) -> tuple[int, int]:
    """Return the last value before the interval of a step, and the last value within it."""
    others = chosen[:number] + chosen[number + 1 :]
    trial = _Trial(series, _design(base, others), _candidates(series, others, single=False), V)
    if not trial.candidates:
        return chosen[number].index - 1, chosen[number].index
    gain = trial.squares()
    inside = [c.index for c, each in zip(trial.candidates, gain, strict=True) if each >= gain.max() - LIKELIHOOD_DROP]
    return min(inside) - 1, max(inside)
