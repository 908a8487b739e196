from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import pytest
from coded import raises
from scipy import stats

from errormotion.arrays import Array
from errormotion.estimation.blocks import Block, Noise
from errormotion.estimation.checks.correlated import (
    _deviance,
    autoregressive,
    correlated,
    effective_number,
    lag_one,
    with_trend,
)
from errormotion.estimation.components import components
from errormotion.estimation.fit import fit
from errormotion.estimation.problem import Problem
from errormotion.estimation.variance import expansion

T = TypeVar("T")


class Line(NamedTuple, Generic[T]):
    line: T


class Drift(NamedTuple, Generic[T]):
    knot: T
    offset: T


def line(y: Array, *, stated: bool = False, analytic: bool = False, sd: Array | None = None) -> Problem:
    n = len(y)
    x = np.linspace(-1, 1, n)

    def equation(y: Array, u: Line[Array], c: Any) -> Array:
        return np.asarray(y - u.line[:, 0] - u.line[:, 1] * x)

    def derivatives(y: Array, u: Line[Array], c: Any) -> Mapping[str, Array]:
        return {"line": -np.stack([np.ones(n), x], axis=1)[:, None]}

    block = Block(start=np.zeros((1, 2)), index=np.zeros(n, dtype=int), scale=1.0, group="line")
    return Problem(
        equation=equation, readings=y, unknowns=Line(block), derivatives=derivatives if analytic else None,
        noise=Noise(sd=np.ones(n) if sd is None else sd, stated=stated),
    )  # fmt: skip


def ar1(n: int, phi: float, rng: np.random.Generator) -> Array:
    e = rng.standard_normal(n)
    for k in range(1, n):
        e[k] = phi * e[k - 1] + np.sqrt(1 - phi**2) * e[k]
    return e


def covariance(order: Array, series: Array, sd: Array, phi: float) -> Array:
    apart = np.abs(order[:, None] - order) / np.median(np.diff(np.unique(order)))
    return np.where(series[:, None] == series, phi**apart, 0.0) * sd * sd[:, None]


@pytest.mark.parametrize("analytic", [True, False])
def test_the_fit_is_the_generalised_one_of_the_explicit_covariance(analytic: bool) -> None:
    """In any order of the readings, with two series, a missing reading and several sizes of noise."""
    rng = np.random.default_rng(0)
    n = 24
    order, series = rng.permutation(n).astype(float), rng.integers(0, 2, n)
    sd = rng.uniform(0.5, 2, n)
    y = rng.standard_normal(n)
    y[7] = np.nan
    problem = line(y, stated=True, analytic=analytic, sd=sd)
    found = fit(autoregressive(problem, order, 0.6, series))
    X = np.stack([np.ones(n), np.linspace(-1, 1, n)], axis=1)
    used = np.isfinite(y)
    unit = np.median(np.concatenate([np.diff(np.sort(order[used & (series == s)])) for s in range(2)]))
    V = np.where(series[:, None] == series, 0.6 ** (np.abs(order[:, None] - order) / unit), 0.0) * sd * sd[:, None]
    V, X, y = V[np.ix_(used, used)], X[used], y[used]
    C = np.linalg.inv(X.T @ np.linalg.solve(V, X))
    b = C @ X.T @ np.linalg.solve(V, y)
    assert found.unknowns.line[0] == pytest.approx(b, rel=1e-9)
    assert found.normal.covariance == pytest.approx(C, rel=1e-8)
    assert found.chi2 == pytest.approx((y - X @ b) @ np.linalg.solve(V, y - X @ b), rel=1e-8)
    assert found.freedom == n - 3


def test_the_likelihood_is_that_of_the_explicit_covariance() -> None:
    rng = np.random.default_rng(1)
    y, order = ar1(30, 0.5, rng), np.arange(30.0)
    X = np.stack([np.ones(30), np.linspace(-1, 1, 30)], axis=1)
    problem = line(y)
    found = fit(problem)

    def dense(phi: float) -> float:
        V = covariance(order, np.zeros(30), np.ones(30), phi)
        N = X.T @ np.linalg.solve(V, X)
        r = y - X @ np.linalg.solve(N, X.T @ np.linalg.solve(V, y))
        whole = np.linalg.slogdet(V)[1] + np.linalg.slogdet(N)[1]
        return float(whole + 28 * np.log(r @ np.linalg.solve(V, r)))

    mine = [_deviance(problem, found.linear.at, order, None, phi) for phi in (0.0, 0.3, 0.8)]
    assert np.diff(mine) == pytest.approx(np.diff([dense(phi) for phi in (0.0, 0.3, 0.8)]), rel=1e-7)


def test_a_drift_between_knots_keeps_its_elimination() -> None:
    """Weighted rows of an eliminated chain: the same as all unknowns in the border."""
    rng = np.random.default_rng(2)
    time = np.sort(rng.uniform(0, 7, 160))
    low = np.minimum(time.astype(int), 6)
    weight = np.stack([1 - (time - low), time - low], axis=1)
    channel = rng.integers(0, 3, 160)

    def equation(y: Array, u: Drift[Array], c: Any) -> Array:
        return np.asarray(y - u.knot[:, 0] - u.offset[:, 0])

    def made(group: str) -> Problem:
        unknowns = Drift(
            Block(start=np.zeros((8, 1)), index=low[:, None] + np.array([0, 1]), weight=weight, scale=1.0, group=group),
            Block(start=np.zeros((3, 1)), index=channel, scale=1.0, free=np.arange(3) > 0, group="offsets"),
        )
        return Problem(equation=equation, readings=y, unknowns=unknowns, noise=Noise(sd=np.ones(160)))

    y = ar1(160, 0.5, rng)
    parts, whole = (fit(autoregressive(made(group), time, 0.5)) for group in ("", "knots"))
    assert parts.linear.numbering.local == 0
    assert whole.linear.numbering.local is None
    assert parts.unknowns.knot == pytest.approx(whole.unknowns.knot, abs=1e-8)
    assert parts.unknowns.offset == pytest.approx(whole.unknowns.offset, abs=1e-8)
    J = np.zeros((160, 10))
    J[np.arange(160), low], J[np.arange(160), low + 1] = weight.T
    J[channel > 0, 7 + channel[channel > 0]] = 1
    gap = np.median(np.diff(time))
    V = 0.5 ** (np.abs(time[:, None] - time) / gap)
    N = J.T @ np.linalg.solve(V, J)
    expected = np.linalg.solve(N, J.T @ np.linalg.solve(V, y))
    assert whole.unknowns.knot[:, 0] == pytest.approx(expected[:8], rel=1e-6, abs=1e-8)


def covered(n: int, phi: float, seeds: int, *, white: bool = False) -> int:
    """Return how often a mean is covered, with AR(1) noise estimated, or with white noise assumed."""
    rng = np.random.default_rng(n)
    a, b = np.zeros((0, 1, 1)), np.array([[1.0], [0.0]])
    inside = 0
    for _ in range(seeds):
        found = fit(line(ar1(n, phi, rng)))
        if white:
            its, freedom = found, np.array([found.freedom])
        else:
            more = correlated(found, np.arange(float(n)))
            its, freedom = more.fit, more.freedom_of(a, b)
        u = np.sqrt(its.normal.covariance[0, 0] * its.chi2 / its.freedom) * expansion(freedom)[0]
        inside += abs(its.unknowns.line[0, 0]) <= 1.96 * u
    return inside


@pytest.mark.slow
def test_white_noise_stays_covered() -> None:
    assert stats.binom.cdf(covered(25, 0.0, 100), 100, 0.95) > 0.01


@pytest.mark.slow
def test_correlated_noise_is_covered_at_90_percent_and_not_without() -> None:
    assert stats.binom.cdf(covered(25, 0.5, 100), 100, 0.90) > 0.01
    assert stats.binom.cdf(covered(25, 0.5, 100, white=True), 100, 0.90) < 0.01


def test_the_correlation_is_estimated_and_drawn_to_0_for_few_readings() -> None:
    rng = np.random.default_rng(4)
    many = [correlated(fit(line(ar1(400, 0.6, rng))), np.arange(400.0)) for _ in range(10)]
    assert np.mean([each.phi for each in many]) == pytest.approx(0.6, abs=4 * 0.04 / np.sqrt(10))
    assert many[0].u_phi == pytest.approx(np.sqrt((1 - 0.36) / 400), rel=0.2)
    few = [correlated(fit(line(ar1(6, 0.6, rng))), np.arange(6.0)).phi for _ in range(20)]
    assert np.mean(few) < 0.4


def test_the_effective_number_is_the_information_on_a_mean() -> None:
    V = 0.7 ** np.abs(np.arange(12)[:, None] - np.arange(12))
    expected = np.ones(12) @ np.linalg.solve(V, np.ones(12))
    assert effective_number(12, 0.7) == pytest.approx(expected)
    assert effective_number(12, 0.0) == 12
    found = fit(line(ar1(60, 0.5, np.random.default_rng(5))))
    its = correlated(found, np.arange(60.0))
    assert its.independent == pytest.approx(effective_number(60, its.phi), rel=1e-9)


def test_lag_one_is_the_correlation_of_neighbours() -> None:
    rng = np.random.default_rng(6)
    for phi in (0.0, 0.7):
        y = ar1(2000, phi, rng)
        shuffled = rng.permutation(2000)
        found = fit(line(y[shuffled]))
        assert lag_one(found, shuffled.astype(float)) == pytest.approx(phi, abs=0.1)


def runs(count: int, targets: int, drift: float, rng: np.random.Generator) -> Problem:
    """Return readings of targets in runs with a random offset each, and a drift over the runs."""
    j, i = (each.ravel() for each in np.meshgrid(np.arange(count), np.arange(targets), indexing="ij"))
    time = j * targets + i
    y = rng.standard_normal(j.size) + 0.5 * rng.standard_normal(count)[j] + drift * (time / time.max() - 0.5)

    def equation(y: Array, u: Drift[Array], c: Any) -> Array:
        return np.asarray(y - u.knot[:, 0] - u.offset[:, 0])

    unknowns = Drift(
        Block(start=np.zeros((targets, 1)), index=i, scale=1.0),
        Block(start=np.zeros((count, 1)), index=j, scale=1.0, component=("offset",)),
    )
    return Problem(
        equation=equation, readings=y, unknowns=unknowns, noise=Noise(sd=np.ones(y.size), stated=False)
    )  # fmt: skip


def test_a_trend_that_is_always_estimated_covers_the_difference_of_targets() -> None:
    """The last target is read later than the first in each run: by 1/5 of the drift over the test."""
    rng = np.random.default_rng(7)
    inside = {True: 0, False: 0}
    a = np.zeros((9, 1, 1))
    a[0], a[-1] = -1, 1
    for _ in range(60):
        problem = runs(5, 9, 20.0, rng)
        time = np.arange(45.0)
        for trend in (True, False):
            its = components(with_trend(problem, time) if trend else problem)
            b = np.zeros((its.fit.linear.numbering.size, 1))
            u = np.sqrt(np.vdot(a, its.fit.normal.solve(a, b)[0])) * expansion(its.freedom_of(a, b))[0]
            value = its.fit.unknowns.knot[-1, 0] - its.fit.unknowns.knot[0, 0]
            inside[trend] += abs(value) <= 1.96 * u
    assert stats.binom.cdf(inside[True], 60, 0.95) > 0.01
    assert stats.binom.cdf(inside[False], 60, 0.90) < 0.01


def test_each_series_may_have_its_trend() -> None:
    y = np.concatenate([np.linspace(0, 1, 20), np.linspace(3, 1, 20)])

    def equation(y: Array, u: Line[Array], c: Any) -> Array:
        return np.asarray(y - u.line[:, 0])

    series = np.repeat([0, 1], 20)
    problem = Problem(
        equation=equation, readings=y, unknowns=Line(Block(start=np.zeros((2, 1)), index=series, scale=1.0)),
        noise=Noise(sd=np.ones(40)),
    )  # fmt: skip
    found = fit(with_trend(problem, np.tile(np.arange(20.0), 2), series))
    assert found.unknowns.trend[:, 0] == pytest.approx([1.0, -2.0])
    assert found.chi2 == pytest.approx(0, abs=1e-20)
    with raises("estimation.trend.one_instant"):
        with_trend(problem, np.zeros(40))


def test_simultaneous_readings_of_one_series_are_refused() -> None:
    problem = line(np.zeros(6))
    with raises("estimation.series.order"):
        autoregressive(problem, np.array([0.0, 1, 1, 2, 3, 4]), 0.5)
