from __future__ import annotations

from dataclasses import replace
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import pytest
from coded import raises
from scipy import stats
from scipy.optimize import minimize

from errormotion.arrays import Array
from errormotion.estimation.blocks import Block, Constant, Noise
from errormotion.estimation.components import NOISE, components, noise_variance
from errormotion.estimation.fit import fit
from errormotion.estimation.problem import Problem
from errormotion.estimation.variance import expansion, variance_factor

T = TypeVar("T")


class Runs(NamedTuple, Generic[T]):
    mean: T
    run: T


class Mean(NamedTuple, Generic[T]):
    mean: T


class Scale(NamedTuple, Generic[T]):
    scale: T


def one_way(y: Array, *, sd: float = 1.0, stated: bool = False) -> Problem:
    """Return readings (run, repeat) of one mean with an offset of each run."""
    runs, repeats = y.shape

    def equation(y: Array, u: Runs[Array], c: Any) -> Array:
        return np.asarray(y - u.mean[:, 0] - u.run[:, 0])

    unknowns = Runs(
        Block(start=np.zeros((1, 1)), index=np.zeros(y.size, dtype=int), scale=1.0),
        Block(start=np.zeros((runs, 1)), index=np.repeat(np.arange(runs), repeats), scale=1.0, component=("offset",)),
    )
    return Problem(
        equation=equation, readings=y.ravel(), unknowns=unknowns, noise=Noise(sd=np.full(y.size, sd), stated=stated)
    )


def positioning(runs: int, targets: int, seed: int, *, sizes: Array, sd: float = 1e-6) -> tuple[Problem, Array, Array]:
    """Return readings of two approaches with offset and slope of each run, common and opposite; and X, Z."""
    rng = np.random.default_rng(seed)
    a, j, i = (each.ravel() for each in np.meshgrid(np.arange(2), np.arange(runs), np.arange(targets), indexing="ij"))
    z = np.linspace(-1, 1, targets)[i]
    sign = np.where(a == 0, 1.0, -1.0)
    effect = np.stack([np.ones_like(z), z, sign, sign * z], axis=1)

    def equation(y: Array, u: Runs[Array], c: Any) -> Array:
        return np.asarray(y - u.mean[:, 0] - np.einsum("nk,nk->n", effect, u.run))

    unknowns = Runs(
        Block(start=np.zeros((2 * targets, 1)), index=a * targets + i, scale=1.0),
        Block(
            start=np.zeros((runs, 4)), index=j, scale=1.0, component=("offset", "slope", "reversal", "opposite slope")
        ),
    )
    X = np.zeros((z.size, 2 * targets))
    X[np.arange(z.size), a * targets + i] = 1
    Z = np.zeros((z.size, runs, 4))
    Z[np.arange(z.size), j] = effect
    y = np.einsum("njk,jk->n", Z, sizes * rng.standard_normal((runs, 4))) + sd * rng.standard_normal(z.size)
    problem = Problem(
        equation=equation, readings=y, unknowns=unknowns, noise=Noise(sd=np.full(z.size, 1e-6), stated=False)
    )
    return problem, X, Z


def deviance(v: Array, y: Array, X: Array, Z: Array) -> float:
    """Return -log L with the explicit covariance; the last variance is that of the noise."""
    V = v[-1] * np.eye(len(y)) + np.einsum("njk,k,mjk->nm", Z, v[:-1], Z)
    L = np.linalg.cholesky(V)
    WX, Wy = np.linalg.solve(L, X), np.linalg.solve(L, y)
    r = Wy - WX @ np.linalg.lstsq(WX, Wy, rcond=None)[0]
    return float(np.log(np.diag(L)).sum() + 0.5 * np.linalg.slogdet(WX.T @ WX)[1] + 0.5 * r @ r)


def dense(y: Array, X: Array, Z: Array, start: Array) -> Array:
    """Return variances by scipy from the explicit covariance."""
    found = minimize(lambda log: deviance(np.exp(log), y, X, Z), np.log(start), method="BFGS", options={"gtol": 1e-7})
    return np.exp(found.x)


def test_a_balanced_design_has_the_analysis_of_variance() -> None:
    rng = np.random.default_rng(0)
    y = 3 + 2 * rng.standard_normal((6, 1)) + rng.standard_normal((6, 9))
    found = components(one_way(y))
    within = np.sum((y - y.mean(axis=1, keepdims=True)) ** 2) / (6 * 8)
    between = 9 * np.sum((y.mean(axis=1) - y.mean()) ** 2) / 5
    assert found.names == ("offset", NOISE)
    assert found.variance == pytest.approx([(between - within) / 9, within], rel=1e-7)
    # variances of mean squares: 2 E^2 / f
    assert found.freedom[1] == pytest.approx(48, rel=1e-6)
    assert found.covariance[0, 0] == pytest.approx((2 * between**2 / 5 + 2 * within**2 / 48) / 81, rel=1e-6)
    assert found.fit.unknowns.mean[0, 0] == pytest.approx(y.mean())
    # the mean has the variance of the mean square between the runs, with its degrees of freedom
    a = np.ones((1, 1, 1))
    q = found.fit.linear.numbering.size
    assert found.fit.normal.solve(a, np.zeros((q, 1)))[0][0, 0, 0] == pytest.approx(between / 54, rel=1e-6)
    assert found.freedom_of(a, np.zeros((q, 1)))[0] == pytest.approx(5, rel=1e-5)


def test_a_variance_may_be_zero() -> None:
    rng = np.random.default_rng(1)
    y = rng.standard_normal((6, 9))
    y += y.mean() - y.mean(axis=1, keepdims=True)
    found = components(one_way(y))
    assert found.variance[0] == 0
    assert found.freedom[0] == 0
    assert found.variance[1] == pytest.approx(np.sum((y - y.mean()) ** 2) / 53, rel=1e-6)
    assert np.abs(found.fit.unknowns.run).max() < 1e-6


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_four_components_agree_with_the_dense_likelihood(seed: int) -> None:
    sizes = np.array([3e-6, 1e-6, 0.5e-6, 0.3e-6])
    problem, X, Z = positioning(5, 7, seed, sizes=sizes)
    found = components(problem)
    noise = found.variance[-1] * 1e-12
    scaled = dense(problem.readings * 1e6, X, Z, np.array([9, 1, 0.3, 0.1, 1.0]))
    mine = np.append(found.variance[:-1] * 1e12, noise * 1e12)
    positive = mine > 1e-4
    assert positive.sum() >= 4
    assert mine[positive] == pytest.approx(scaled[positive], rel=1e-3)
    # the likelihood is not lower than that of the search by scipy
    assert deviance(mine, problem.readings * 1e6, X, Z) <= deviance(scaled, problem.readings * 1e6, X, Z) + 1e-8
    assert scaled[~positive] == pytest.approx(0, abs=1e-3)


def test_means_and_their_covariance_are_those_of_the_estimated_covariance() -> None:
    problem, X, Z = positioning(5, 41, 3, sizes=np.array([3e-6, 1e-6, 0.5e-6, 0.3e-6]))
    found = components(problem)
    v = found.variance
    V = v[-1] * 1e-12 * np.eye(len(X)) + np.einsum("njk,k,mjk->nm", Z, v[:-1], Z)
    C = np.linalg.inv(X.T @ np.linalg.solve(V, X))
    assert found.fit.unknowns.mean[:, 0] == pytest.approx(
        C @ X.T @ np.linalg.solve(V, problem.readings), abs=1e-5 * np.sqrt(C[0, 0])
    )
    normal = found.fit.normal
    whole = normal.own[:, 0, 0] + np.square(normal.shared[:, 0]).sum(axis=1)
    assert whole == pytest.approx(np.diag(C), rel=1e-5)


def test_the_degrees_of_freedom_follow_from_the_parts_of_a_variance() -> None:
    """Of the mean: the noise over all readings, and the variance of the offsets over the runs."""
    found = components(one_way(np.random.default_rng(0).standard_normal((6, 9)) + 2 * np.arange(6)[:, None]))
    parts = np.array([found.variance[0] / 6, found.variance[1] / 54])
    its = found.freedom_of(np.ones((1, 1, 1)), np.zeros((found.fit.linear.numbering.size, 1)))
    assert found.freedom_of_parts(parts, parts.sum()) == pytest.approx(its[0], rel=1e-5)
    # a part of known variance adds none
    assert found.freedom_of_parts(parts, 2 * parts.sum()) == pytest.approx(4 * its[0], rel=1e-5)


def test_a_problem_without_components_is_fitted_as_it_is() -> None:
    y = np.random.default_rng(8).standard_normal((4, 5))
    problem = one_way(y, stated=True)
    runs = problem.unknowns.run
    plain = Block(start=runs.start, index=runs.index, scale=1.0, prior=2.0)
    problem = Problem(
        equation=problem.equation, readings=problem.readings, noise=problem.noise,
        unknowns=Runs(problem.unknowns.mean, plain),
    )  # fmt: skip
    found = components(problem)
    assert found.names == ()
    assert found.fit.chi2 == pytest.approx(fit(problem).chi2)
    assert found.freedom_of(np.ones((1, 1, 1)), np.zeros((4, 1)))[0] > 1e6


def test_missing_readings_and_a_stated_noise() -> None:
    problem, X, Z = positioning(4, 7, 4, sizes=np.array([3e-6, 2e-6, 1e-6, 1e-6]))
    wrong = np.zeros(len(X), dtype=bool)
    wrong[[3, 17, 40]] = True
    found = components(problem.without(wrong))
    scaled = dense(problem.readings[~wrong] * 1e6, X[~wrong], Z[~wrong], np.array([9, 4, 1.0, 1, 1]))
    mine = np.append(found.variance[:-1] * 1e12, found.variance[-1])
    assert mine[mine > 1e-4] == pytest.approx(scaled[mine > 1e-4], rel=1e-4)
    stated = components(problem, noise=False)
    assert NOISE not in stated.names
    assert stated.fit.problem.noise is problem.noise


@pytest.mark.slow
def test_variances_are_covered_by_their_information() -> None:
    """Mean and standard deviation of the estimates over seeds, against the truth and the information."""
    found = [components(positioning(12, 9, seed, sizes=np.array([3e-6, 2e-6, 1e-6, 1e-6]))[0]) for seed in range(100)]
    variance = np.array([each.variance for each in found])
    truth = np.array([9e-12, 4e-12, 1e-12, 1e-12, 1.0])
    sd = np.sqrt(np.diagonal(np.mean([each.covariance for each in found], axis=0)))
    assert (np.abs(variance.mean(axis=0) - truth) < 4 * variance.std(axis=0) / 10).all()
    assert variance.std(axis=0) == pytest.approx(sd, rel=0.3)  # 100 seeds: 7 %, and the spread of the variance itself


@pytest.mark.slow
@pytest.mark.parametrize("size", [0.0, 0.3, 2.0])
def test_the_mean_of_few_runs_is_covered(size: float) -> None:
    """Five runs: Student's factor of the degrees of freedom of its variance, for offsets from none to large."""
    rng = np.random.default_rng(5)
    inside = []
    for _ in range(300):
        y = size * rng.standard_normal((5, 1)) + rng.standard_normal((5, 6))
        found = components(one_way(y))
        q = found.fit.linear.numbering.size
        a, b = np.ones((1, 1, 1)), np.zeros((q, 1))
        u = np.sqrt(found.fit.normal.solve(a, b)[0][0, 0, 0]) * expansion(found.freedom_of(a, b))[0]
        inside.append(abs(found.fit.unknowns.mean[0, 0]) <= 1.96 * u)
    # not fewer than 93 % beyond what 300 seeds allow
    assert stats.binom.cdf(sum(inside), 300, 0.93) > 0.01


def calibrated(y: Array, *, adjust: bool = True, scale_u: float = 1.0) -> Problem:
    """Return readings of a length by a scale that is adjusted: reading = length + 10 scale."""

    def equation(y: Array, u: Mean[Array], c: Scale[Array]) -> Array:
        return np.asarray(y - u.mean[:, 0] - 10 * c.scale[:, 0])

    zero = np.zeros(y.size, dtype=int)
    scale = Constant(
        value=np.zeros((1, 1)), factor=np.full((1, 1, 1), scale_u), index=zero, scale=1.0, adjust=adjust, group="scale"
    )
    return Problem(
        equation=equation, readings=y, unknowns=Mean(Block(start=np.zeros((1, 1)), index=zero, scale=1.0)),
        constants=Scale(scale), noise=Noise(sd=np.ones(y.size), stated=False),
    )  # fmt: skip


def test_an_unknown_noise_does_not_change_the_uncertainty_of_a_constant() -> None:
    """The readings scatter by 0.01 of the weights; the scale, of 1, makes the length uncertain by 10."""
    rng = np.random.default_rng(6)
    y = 0.01 * rng.standard_normal(20)
    found = fit(calibrated(y))
    factor, freedom = noise_variance(found)
    assert factor == pytest.approx(y.var(ddof=1), rel=1e-8)
    assert freedom == pytest.approx(19)
    with raises("estimation.noise.not_unknown"):
        variance_factor(found.chi2, found.freedom, stated=False, priors=True)
    scatter = variance_factor(
        found.chi2, found.freedom, stated=False, priors=True, estimate=lambda: noise_variance(found)
    )
    assert scatter.factor == pytest.approx(y.var(ddof=1), rel=1e-8)
    whole = components(calibrated(y)).fit
    a, b = np.ones((1, 1, 1)), np.zeros((1, 1))
    u = np.sqrt(whole.normal.solve(a, b)[0][0, 0, 0])
    assert u == pytest.approx(10, rel=1e-4)


def test_effects_that_are_not_separated_from_fixed_ones_are_refused() -> None:
    problem = one_way(np.random.default_rng(7).standard_normal((1, 1)))
    with raises("estimation.no_redundancy"):
        components(problem)


@pytest.mark.parametrize("seed", range(5))
def test_readings_without_any_noise_have_the_variances_of_their_effects(seed: int) -> None:
    """Neither the steps of the fit nor the variances follow the rounding of the readings."""
    problem, _, _ = positioning(4, 7, seed, sizes=np.array([3e-6, 2e-6, 1e-6, 1e-6]), sd=0.0)
    found = components(problem)
    of_run = problem.readings.reshape(2, 4, 7).mean(axis=(0, 2))  # half the sum of both approaches
    assert found.variance[0] == pytest.approx(np.var(of_run, ddof=1), rel=1e-3)
    assert found.variance[found.names.index(NOISE)] < 1e-7


def test_a_variance_that_the_readings_hardly_determine_does_not_prevent_convergence() -> None:
    """Changes far below the standard uncertainty of a variance end the iteration, however small the variance is."""
    rng, sd = np.random.default_rng(190), np.where(np.arange(11) < 5, 0.3e-6, 2e-6)
    problem, _, _ = positioning(5, 11, 90, sizes=np.array([0.3e-6, 0.0, 0.0, 0.0]), sd=0.0)
    y = problem.readings + rng.standard_normal(110) * np.tile(sd, 10)
    of_target = np.broadcast_to(y.reshape(2, 5, 11).std(axis=1, keepdims=True), (2, 5, 11)).ravel()
    found = components(replace(problem, readings=y, noise=Noise(sd=of_target, stated=False)))
    assert (found.variance >= 0).all()
