"""Solution of a model: noise as an unknown beside priors, and outliers with suspects."""

from dataclasses import replace
from typing import Generic, NamedTuple, TypeVar

import numpy as np
import pytest
import xarray as xr
from coded import raises
from scipy import stats
from scipy.optimize import minimize_scalar

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.estimation.blocks import Block, Constant, Noise
from errormotion.estimation.checks.candidates import steps
from errormotion.estimation.checks.exclusions import FALSE_ALARM
from errormotion.estimation.checks.reliability import POWER, reliability
from errormotion.estimation.fit import fit
from errormotion.estimation.problem import Problem
from errormotion.estimation.sources import Places
from errormotion.measurement import Observed
from errormotion.measurement.identification import of_readings, solve
from errormotion.measurement.noise import estimated_noise

T = TypeVar("T")
N = 40
POSITION = np.linspace(0.0, 1.0, N)
SLOPE = 3e-6
"""Standard uncertainty of the slope, which the readings improve."""


class Unknowns(NamedTuple, Generic[T]):
    level: T


class Known(NamedTuple, Generic[T]):
    slope: T


def problem(y: Array, noise: float | None) -> Problem:
    """Return readings of a level, with a slope that has a prior."""
    zero = np.zeros(N, dtype=int)
    return Problem(
        equation=lambda y, x, c: y - x.level[:, 0] - c.slope[:, 0] * POSITION,
        readings=y,
        unknowns=Unknowns(Block(start=np.zeros((1, 1)), index=zero, scale=1.0, group="level")),
        constants=Known(
            Constant(value=np.zeros((1, 1)), factor=np.full((1, 1, 1), SLOPE), index=zero, scale=1.0, group="slope",
                     adjust=True)
        ),
        noise=Noise(sd=np.full(N, noise or 1.0), stated=noise is not None),
    )  # fmt: skip


def observed(y: Array, noise: float | None) -> Observed:
    return Observed(
        problem=problem(y, noise),
        places=Places(lambda x, _: x.level, 1),
        freedoms=("EX",),
        dims=(),
        coords={},
        component="tool",
        functional_point=(0, 0, 0),
        reference="none",
    )


def readings(seed: int, noise: float = 0.5e-6) -> Array:
    rng = np.random.default_rng(seed)
    return np.asarray(rng.normal(0, SLOPE) * POSITION + rng.normal(0, noise, N))


def restricted(y: Array, noise: float) -> float:
    """Return -2 log of the restricted likelihood, from the dense covariance of the readings."""
    V = noise**2 * np.eye(N) + SLOPE**2 * np.outer(POSITION, POSITION)
    W, X = np.linalg.inv(V), np.ones((N, 1))
    P = W - W @ X @ np.linalg.inv(X.T @ W @ X) @ X.T @ W
    return float(np.linalg.slogdet(V)[1] + np.linalg.slogdet(X.T @ W @ X)[1] + y @ P @ y)


@pytest.mark.parametrize("start", [None, 5e-6, 0.02e-6])
def test_the_noise_beside_a_prior_maximises_the_restricted_likelihood(start: float | None) -> None:
    y = readings(1)
    _, factor, freedom = estimated_noise(fit(problem(y, start)))
    best = minimize_scalar(lambda s: restricted(y, np.exp(s)), bounds=(np.log(1e-8), np.log(1e-4)), method="bounded",
                           options={"xatol": 1e-10})  # fmt: skip
    assert np.sqrt(factor) * (start or 1.0) == pytest.approx(np.exp(best.x), rel=1e-5)
    assert N - 2 < freedom < N - 1


def test_an_increased_noise_does_not_increase_the_uncertainty_of_a_prior() -> None:
    """The noise is three times the stated one; the slope, whose uncertainty is much larger, keeps its own."""
    y = readings(2, noise=1.5e-6)
    solved = solve(observed(y, 0.5e-6))
    assert solved.scatter.ratio > 2
    assert "scatter" in solved.scatter.note
    v = (0.5e-6) ** 2 * solved.scatter.factor
    V = v * np.eye(N) + SLOPE**2 * np.outer(POSITION, POSITION)
    X = np.ones((N, 1))
    student = 1.03  # of some 38 degrees of freedom
    u = float(np.sqrt(solved.relative.errors.covariance[0, 0, 0]))
    expected = float(np.sqrt(np.linalg.inv(X.T @ np.linalg.inv(V) @ X)[0, 0]))
    assert expected <= u <= student * expected * 1.01
    slope = [source for source in solved.relative.errors.sources if source.group == "slope"]
    assert slope or solved.relative.errors.own.any()


@pytest.mark.parametrize("prior", [True, False])
def test_the_smallest_error_that_is_found_is_that_of_the_noise_that_was_found(prior: bool) -> None:
    """A noise that is estimated beside a prior is in the fit already, and must not be counted twice."""
    given = observed(readings(2, noise=1.5e-6), 0.5e-6)
    if not prior:
        unknowns = given.problem.unknowns
        free = [replace(block, prior=None) for block in unknowns]
        constants = [replace(c, adjust=False) for c in given.problem.constants]
        its = given.problem.constants
        problem = replace(
            given.problem, unknowns=type(unknowns)(*free), constants=type(its)(*constants) if constants else its
        )
        given = replace(given, problem=problem)
    solved = solve(given)
    assert solved.scatter.ratio > 2
    sd = np.asarray(solved.fit.problem.noise.sd)[0] * np.sqrt(solved.fit_factor)
    assert sd == pytest.approx(0.5e-6 * np.sqrt(solved.scatter.factor), rel=1e-9)
    found = reliability(solved.fit, factor=solved.fit_factor)
    assert np.nanmin(found.smallest) > 4 * 1.1e-6  # four standard deviations at least, of about 1.5 um
    assert np.nanmin(found.smallest) < 8 * 1.9e-6


def test_intervals_with_an_unknown_noise_are_covered() -> None:
    inside = 0
    for seed in range(300):
        solved = solve(observed(readings(seed), None))
        u = np.sqrt(solved.relative.errors.covariance[0, 0, 0])
        inside += abs(solved.relative.errors.value[0, 0]) <= 1.96 * u
    assert abs(inside / 300 - 0.95) < 3.3 * np.sqrt(0.95 * 0.05 / 300)


def test_an_outlier_and_a_step_are_named_and_repaired() -> None:
    y = readings(3)
    y[7] += 20e-6
    y[25:] += 8e-6
    find = steps(np.arange(N, dtype=float), np.zeros(N, dtype=int), -np.ones((N, 1)),
                 lambda _, cut: f"the level has changed at {cut:.0f}", exclude=False)  # fmt: skip
    one = replace(observed(y, 0.5e-6), suspects=find, name=lambda at: f"reading {at[0] + 1}")
    solved = solve(one)
    notes = " ".join(solved.observed.notes)
    assert "reading 8" in notes
    assert "the level has changed at 25" in notes
    assert "1 of them is not used" in notes
    assert abs(solved.relative.errors.value[0, 0]) < 4 * np.sqrt(solved.relative.errors.covariance[0, 0, 0])
    assert solved.observed.robust is False


def test_an_unknown_noise_without_redundancy_is_refused() -> None:
    y = np.full(N, np.nan)
    y[3] = 1e-6
    with raises("estimation.no_redundancy"):
        solve(observed(y, None))


def test_readings_that_scatter_more_than_the_stated_noise_doubt_an_uncertainty_that_does_not_follow() -> None:
    y = readings(2, noise=1.5e-6)
    follows, fixed = solve(observed(y, 0.5e-6)), solve(replace(observed(y, 0.5e-6), noise_increases=False))
    assert not follows.scatter.doubtful
    assert fixed.scatter.doubtful
    assert not solve(observed(readings(2), 0.5e-6)).scatter.doubtful


class Circle(NamedTuple, Generic[T]):
    circle: T


def test_touches_with_one_residual_each_have_the_reliability_of_a_dense_calculation() -> None:
    """Touches (x, y) of a circle: an error along the normal changes the residual, and centre and radius."""
    rng = np.random.default_rng(8)
    angle, sd, radius = np.array([0.0, 0.5, 1.2, 2.0, 2.2, 4.0, 5.5]), 1e-6, 0.02
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    y = radius * unit + sd * rng.standard_normal(unit.shape)

    def equation(y: Array, x: Circle[Array], c: object) -> Array:
        return np.asarray(np.linalg.norm(y - x.circle[:, :2], axis=1) - x.circle[:, 2])

    start = np.array([[1e-6, 0.0, radius]])
    block = Block(start=start, index=np.zeros(angle.size, dtype=int), scale=radius, group="circle")
    given = Observed(
        problem=Problem(
            equation=equation, readings=y, reading_scale=radius, unknowns=Circle(block), noise=Noise(sd=np.full(7, sd))
        ),
        places=Places(lambda x, _: x.circle, 1),
        freedoms=("EX", "EY", "EZ"),
        dims=(),
        coords={},
        component="tool",
        functional_point=(0, 0, 0),
        reference="",
        recorded=("touch", ("point", "direction")),
        noise_increases=False,
    )
    raw = xr.Dataset({"touch": (("point", "direction"), y, {"units": "m"})})
    found = of_readings(solve(given), raw)
    assert {array.dims for array in found.values()} == {("point",)}
    J = -np.column_stack([unit, np.ones(7)]) / sd
    C = np.linalg.inv(J.T @ J)
    r = 1 - np.einsum("ni,ij,nj->n", J, C, J)
    delta = stats.norm.isf(FALSE_ALARM / 2 / 7) + stats.norm.ppf(POWER)
    smallest = sd * delta / np.sqrt(r)
    assert found["redundancy"].values == pytest.approx(r, rel=1e-3)  # the normals are those of the noisy touches
    assert found["smallest_error"].values == pytest.approx(smallest, rel=1e-3)
    # what each error does to centre and radius, in any direction
    change = C @ J.T * (smallest / sd)
    largest = np.sqrt(np.einsum("in,ij,jn->n", change, np.linalg.inv(C), change))
    assert found["smallest_error_effect"].values == pytest.approx(largest, rel=1e-3)
    assert np.abs(found["residual"].values).max() < 5 * sd
    assert not found["left_out"].values.any()


def test_a_stated_noise_with_few_degrees_of_freedom_is_combined_with_the_residuals() -> None:
    y = readings(4)
    vague = observed(y, 0.4e-6)
    vague = replace(vague, problem=replace(vague.problem, noise=replace(vague.problem.noise, freedom=10.0)))
    solved = solve(vague)
    found = fit(problem(y, 0.4e-6))
    Q, f = found.chi2, found.freedom
    # GUM H.3.6: independent estimates of one variance are weighted by their degrees of freedom.
    assert solved.scatter.factor == pytest.approx((10 + Q) / (10 + f), rel=1e-9)
    assert solved.scatter.freedom == 10 + f


def test_a_noise_with_few_degrees_of_freedom_makes_no_outliers() -> None:
    """Stated at half of the truth, a certain noise makes an outlier of one reading in many data sets."""
    found = []
    for freedom in (np.inf, 8.0):
        out = 0
        for seed in range(60):
            one = observed(readings(seed, 0.8e-6), 0.5e-6)
            noise = replace(one.problem.noise, freedom=freedom)
            solved = solve(replace(one, problem=replace(one.problem, noise=noise)))
            out += bool(solved.cleaned is not None and solved.cleaned.made)
        found.append(out)
    assert found[1] <= 1
    assert found[0] >= found[1]


def test_the_reason_of_undetermined_unknowns_is_that_of_the_model() -> None:
    y = readings(5)
    one = observed(y, 0.5e-6)
    with pytest.raises(MethodError, match="do not determine level"):
        solve(replace(one, problem=replace(one.problem, equation=lambda y, x, c: y + 0.0 * x.level[:, 0])))
    lost = replace(one.problem, equation=lambda y, x, c: y + 0.0 * x.level[:, 0])
    with pytest.raises(MethodError, match=r"Nothing is seen of it\."):
        solve(replace(one, problem=lost, undetermined=lambda _: "nothing is seen of it"))
