"""The structured solver against dense solutions, and against closed forms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import pytest
from coded import raises
from scipy.optimize import least_squares

from errormotion.arrays import Array
from errormotion.errors import FitError
from errormotion.estimation import problem as problems
from errormotion.estimation.blocks import Block, Constant, Noise
from errormotion.estimation.checks.correlated import autoregressive
from errormotion.estimation.fit import Fit, fit
from errormotion.estimation.problem import Problem, Unknown

T = TypeVar("T")


class Line(NamedTuple, Generic[T]):
    line: T


class Network(NamedTuple, Generic[T]):
    target: T
    station: T


class Drift(NamedTuple, Generic[T]):
    knot: T
    offset: T


class Scale(NamedTuple, Generic[T]):
    scale: T


def straight(x: Array, y: Array, **more: Any) -> Problem:
    def equation(y: Array, u: Line[Array], c: Any) -> Array:
        return np.asarray(y - u.line[:, 0] - u.line[:, 1] * x)

    block = Block(start=np.zeros((1, 2)), index=np.zeros(x.size, dtype=int), scale=1.0, group="line", **more)
    return Problem(equation=equation, readings=y, unknowns=Line(block), noise=Noise(sd=np.full(x.size, 0.1)))


def test_a_straight_line_has_the_closed_form() -> None:
    x = np.linspace(0, 1, 7)
    y = 2 + 3 * x + 0.1 * np.random.default_rng(0).standard_normal(7)
    X = np.stack([np.ones(7), x], axis=1)
    found = fit(straight(x, y))
    expected = np.linalg.lstsq(X, y, rcond=None)[0]
    assert found.unknowns.line[0] == pytest.approx(expected, rel=1e-12)
    assert found.normal.covariance == pytest.approx(0.01 * np.linalg.inv(X.T @ X), rel=1e-9)
    assert found.chi2 == pytest.approx(np.sum((y - X @ expected) ** 2) / 0.01)
    assert found.freedom == 5
    assert found.leverage[:, 0] == pytest.approx(np.diag(X @ np.linalg.inv(X.T @ X) @ X.T), rel=1e-9)


def test_a_missing_reading_is_not_used() -> None:
    x = np.linspace(0, 1, 7)
    y = 2 + 3 * x + 0.1 * np.random.default_rng(0).standard_normal(7)
    y[3] = np.nan
    one, other = fit(straight(x, y)), fit(straight(np.delete(x, 3), np.delete(y, 3)))
    assert one.unknowns.line == pytest.approx(other.unknowns.line, rel=1e-12)
    assert one.normal.covariance == pytest.approx(other.normal.covariance, rel=1e-12)
    assert one.freedom == other.freedom == 4
    assert np.isnan(one.residual[3])
    assert one.leverage[3] == 0


def test_a_prior_is_a_reading() -> None:
    x = np.linspace(0, 1, 7)
    y = 2 + 3 * x + 0.1 * np.random.default_rng(0).standard_normal(7)
    found = fit(straight(x, y, prior=np.array([np.inf, 0.05])))
    X = np.concatenate([np.stack([np.ones(7), x], axis=1) / 0.1, [[0.0, 1 / 0.05]]])
    right = np.append(y / 0.1, 0.0)
    expected = np.linalg.lstsq(X, right, rcond=None)[0]
    assert found.unknowns.line[0] == pytest.approx(expected, rel=1e-10)  # derivatives are accurate to 4e-11
    assert found.chi2 == pytest.approx(np.sum((right - X @ expected) ** 2))
    assert found.freedom == 6
    assert found.normal.covariance == pytest.approx(np.linalg.inv(X.T @ X), rel=1e-9)


def test_an_undetermined_unknown_is_named() -> None:
    with pytest.raises(FitError, match="the levels do not determine line 1"):
        fit(straight(np.full(7, 0.3), np.zeros(7)), what="the levels")


def trilateration(targets: int, *, group: str = "", seed: int = 0) -> tuple[Problem, Array, Array]:
    """Return distances of targets in a plane from four stations, three of which are known."""
    rng = np.random.default_rng(seed)
    target, station = rng.uniform(0, 1, (targets, 2)), np.array([[-1, -1], [2, -1], [2, 2], [-1, 2.0]])
    t, s = (each.ravel() for each in np.meshgrid(np.arange(targets), np.arange(4), indexing="ij"))

    def equation(y: Array, u: Network[Array], c: Any) -> Array:
        return np.asarray(y - np.linalg.norm(u.target - u.station, axis=1))

    sd = rng.uniform(1e-4, 2e-4, t.size)
    y = np.linalg.norm(target[t] - station[s], axis=1) + sd * rng.standard_normal(t.size)
    unknowns = Network(
        Block(start=target + 0.01, index=t, scale=1.0, group=group),
        Block(
            start=station + np.array([[0, 0], [0, 0], [0, 0], [0.01, -0.02]]),
            index=s,
            scale=1.0,
            free=np.arange(4) == 3,
            group="stations",
        ),
    )
    return Problem(equation=equation, readings=y, unknowns=unknowns, noise=Noise(sd=sd)), target, station


def dense(problem: Problem) -> tuple[Array, Array]:
    """Return all free unknowns and their covariance by scipy, from the residuals alone."""
    free = [block.freed for block in problem.unknowns]

    def tables(v: Array) -> list[Array]:
        out, at = [], 0
        for block, f in zip(problem.unknowns, free, strict=True):
            table = block.start.copy()
            table[f] = v[at : at + f.sum()]
            at += f.sum()
            out.append(table)
        return out

    def misses(v: Array) -> Array:
        r = problem.residuals(problems.Unknown(tables(v), []))
        return np.asarray((r[:, 0] / np.asarray(problem.noise.sd))[np.isfinite(r[:, 0])])

    start = np.concatenate([block.start[f] for block, f in zip(problem.unknowns, free, strict=True)])
    found = least_squares(misses, start, jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    jacobian = np.asarray(found.jac)
    return found.x, np.linalg.inv(jacobian.T @ jacobian)


@pytest.mark.parametrize("group", ["", "targets"])  # targets eliminated; all in the border
def test_a_network_has_the_dense_solution(group: str) -> None:
    targets = 40
    problem, _, _ = trilateration(targets, group=group)
    found = fit(problem)
    x, C = dense(problem)
    u = np.sqrt(np.diag(C))
    mine = np.concatenate([found.unknowns.target.ravel(), found.unknowns.station[3]])
    assert np.abs((mine - x) / u).max() < 1e-5
    eliminated = found.linear.numbering.local is not None
    assert eliminated == (not group)
    q = found.linear.numbering.size
    if eliminated:
        whole = found.normal.own + found.normal.shared @ np.swapaxes(found.normal.shared, 1, 2)
        of_targets = np.array([C[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(targets)])
        assert np.abs(whole / of_targets - 1).max() < 1e-6
        assert q == 2
    assert found.normal.covariance[-2:, -2:] == pytest.approx(C[-2:, -2:], rel=1e-6)
    # the sum of the leverages is the number of unknowns
    assert found.leverage.sum() == pytest.approx(2 * targets + 2, rel=1e-9)


def test_both_ways_of_elimination_agree() -> None:
    whole, parts = fit(trilateration(30, group="targets")[0]), fit(trilateration(30)[0])
    assert parts.linear.numbering.local == 0
    assert whole.linear.numbering.local is None
    assert parts.unknowns.target == pytest.approx(whole.unknowns.target, abs=1e-13)
    assert parts.leverage == pytest.approx(whole.leverage, abs=1e-9)
    assert parts.normal.covariance == pytest.approx(whole.normal.covariance[-2:, -2:], rel=1e-8)


def test_a_free_network_has_a_gauge() -> None:
    """A free network of stations and targets: distances do not see motions of the whole."""
    problem, _, station = trilateration(100)
    unknowns = problem.unknowns._replace(
        station=Block(start=station, index=problem.unknowns[1].index, scale=1.0, group="s")
    )
    turned = np.stack([-station[:, 1], station[:, 0]], axis=1)
    gauge = {"station": np.stack([np.tile([1.0, 0], (4, 1)), np.tile([0, 1.0], (4, 1)), turned])}
    free = Problem(
        equation=problem.equation, readings=problem.readings, unknowns=unknowns, noise=problem.noise, gauge=gauge
    )
    with pytest.raises(FitError, match="station 1, 2, 3, 4"):
        fit(Problem(equation=problem.equation, readings=problem.readings, unknowns=unknowns, noise=problem.noise))
    found = fit(free)
    assert found.freedom == 400 - 208 + 3
    # distances between the stations do not depend on the gauge: the minimum is that of three fixed coordinates
    fixed = np.zeros((4, 2), dtype=bool)
    fixed[0], fixed[1, 1] = True, True
    held = Block(start=station, index=problem.unknowns[1].index, scale=1.0, free=~fixed, group="s")
    other = fit(
        Problem(
            equation=problem.equation, readings=problem.readings, unknowns=unknowns._replace(station=held),
            noise=problem.noise,
        )
    )  # fmt: skip
    apart = [np.linalg.norm(each.unknowns.station[2] - each.unknowns.station[0]) for each in (found, other)]
    assert apart[0] == pytest.approx(apart[1], rel=1e-12)
    assert found.chi2 == pytest.approx(other.chi2, rel=1e-9)
    # and so are their variances
    away = found.unknowns.station[2] - found.unknowns.station[0]
    along = np.zeros((4, 2))
    along[2], along[0] = away / np.linalg.norm(away), -away / np.linalg.norm(away)
    free_u = along.ravel() @ found.normal.covariance @ along.ravel()
    held_u = along[~fixed] @ other.normal.covariance @ along[~fixed]
    assert free_u == pytest.approx(held_u, rel=1e-5)


def drifting(knots: int, *, group: str = "", seed: int = 0) -> Problem:
    """Return readings of a drift between knots (a parabola through three) plus an offset of each of 5 channels."""
    rng = np.random.default_rng(seed)
    time = np.sort(rng.uniform(0, knots - 1, 40 * knots))
    nearest = np.clip(np.rint(time).astype(int), 1, knots - 2)
    w = time - nearest
    weight = np.stack([w * (w - 1) / 2, 1 - w**2, w * (w + 1) / 2], axis=1)
    index = nearest[:, None] + np.array([-1, 0, 1])
    channel = rng.integers(0, 5, time.size)
    lever = rng.uniform(0.5, 1.5, time.size)

    def equation(y: Array, u: Drift[Array], c: Any) -> Array:
        return np.asarray(y - u.knot[:, 0] - lever * np.sin(u.knot[:, 1]) - u.offset[:, 0])

    y = np.cumsum(rng.standard_normal(knots))[nearest] / 10 + 0.05 * rng.standard_normal(time.size)
    free = np.arange(knots) > 0
    unknowns = Drift(
        Block(start=np.zeros((knots, 2)), index=index, weight=weight, scale=1.0, free=free, group=group),
        Block(start=np.zeros((5, 1)), index=channel, scale=1.0, group="offsets"),
    )
    return Problem(equation=equation, readings=y, unknowns=unknowns, noise=Noise(sd=np.full(time.size, 0.05)))


@pytest.mark.parametrize("knots", [8, 9])
def test_a_chain_has_the_dense_solution(knots: int) -> None:
    whole, parts = fit(drifting(knots, group="knots")), fit(drifting(knots))
    assert parts.linear.numbering.band == 2
    assert parts.unknowns.knot == pytest.approx(whole.unknowns.knot, abs=1e-9)
    assert parts.leverage == pytest.approx(whole.leverage, abs=1e-9)
    assert parts.leverage.sum() == pytest.approx(2 * (knots - 1) + 5, rel=1e-9)
    assert parts.normal.log_determinant == pytest.approx(whole.normal.log_determinant, rel=1e-9)
    assert whole.normal.log_determinant == pytest.approx(-np.linalg.slogdet(whole.normal.covariance)[1], rel=1e-9)
    C = whole.normal.covariance
    own = parts.normal.own + parts.normal.shared @ np.swapaxes(parts.normal.shared, 1, 2)
    for k in range(1, knots):
        at = slice(2 * (k - 1), 2 * k)
        assert own[k] == pytest.approx(C[at, at], rel=1e-7)
    assert parts.normal.covariance == pytest.approx(C[-5:, -5:], rel=1e-7)
    pair = parts.normal.local_covariance(np.array([3]), np.array([5]))[0]
    pair = pair + parts.normal.shared[3] @ parts.normal.shared[5].T
    assert pair == pytest.approx(C[4:6, 8:10], rel=1e-6, abs=1e-12)
    rng = np.random.default_rng(knots)
    a, b = rng.standard_normal((knots, 2, 4)), rng.standard_normal((5, 4))
    a[0] = 0.0  # not estimated
    whole_a = np.concatenate([a[1:].reshape(-1, 4), b])
    assert parts.normal.square(a, b) == pytest.approx(whole_a.T @ C @ whole_a, rel=1e-7)


def test_knots_that_no_reading_sees_are_named() -> None:
    problem = drifting(9)
    seen = problem.unknowns.knot.index[:, 1]
    with pytest.raises(FitError, match=r"the readings do not determine knot [5-8]"):
        fit(problem.without(seen >= 4))


@pytest.mark.parametrize("rate", [0.3, 0.01])
def test_a_refreshed_quantity_converges_to_a_millionth_of_the_uncertainty(rate: float) -> None:
    """The frozen quantity follows the unknown by a part of it: the steps decrease by this part, as a series does."""
    x = np.linspace(0, 1, 7)
    base = straight(x, 2 + 3 * x)
    frozen = [0.0]

    def equation(y: Array, u: Line[Array], c: Any) -> Array:
        return np.asarray(base.equation(y, u, c) + rate * frozen[0])

    def refresh(problem: Problem, u: Line[Array]) -> Problem:
        frozen[0] = float(u.line[0, 0])
        return problem

    found = fit(replace(base, equation=equation), refresh=refresh)
    u = np.sqrt(found.normal.covariance[0, 0])
    assert found.unknowns.line[0, 0] == pytest.approx(2 / (1 - rate), abs=1e-6 * u)


def test_a_vector_reading_with_correlated_noise_has_the_generalised_solution() -> None:
    rng = np.random.default_rng(3)
    root = rng.standard_normal((6, 4, 4)) * 0.1 + 0.2 * np.eye(4)
    X = rng.standard_normal((6, 4, 2))
    y = X @ [1.0, -2.0] + np.einsum("nij,nj->ni", root, rng.standard_normal((6, 4)))
    y[2, 1] = np.nan

    def equation(y: Array, u: Line[Array], c: Any) -> Array:
        return np.asarray(y - np.einsum("nij,nj->ni", X, u.line))

    block = Block(start=np.zeros((1, 2)), index=np.zeros(6, dtype=int), scale=1.0, group="line")
    found = fit(Problem(equation=equation, readings=y, unknowns=Line(block), noise=Noise(root=root)))
    known = np.isfinite(y).ravel()
    V = np.zeros((24, 24))
    for k in range(6):
        V[4 * k : 4 * k + 4, 4 * k : 4 * k + 4] = root[k] @ root[k].T
    V, A, b = V[np.ix_(known, known)], X.reshape(24, 2)[known], y.ravel()[known]
    C = np.linalg.inv(A.T @ np.linalg.solve(V, A))
    assert found.unknowns.line[0] == pytest.approx(C @ A.T @ np.linalg.solve(V, b), rel=1e-10)
    assert found.normal.covariance == pytest.approx(C, rel=1e-8)
    assert found.freedom == 21
    J = found.linear.local[:, :, 0] if found.linear.local.shape[2] else found.linear.border
    hat = np.einsum("nik,kl,njl->nij", J, C, J)
    assert found.hat == pytest.approx(hat, abs=1e-9)
    assert found.leverage.sum() == pytest.approx(2)


def test_the_noise_of_a_condition_is_that_of_its_readings() -> None:
    """A circle through points: the residual is a distance, the noise that of the coordinates along it."""
    rng = np.random.default_rng(4)
    angle = np.linspace(0, 2, 30)
    points = np.stack([np.cos(angle), np.sin(angle)], axis=1) * 0.02
    sd = np.broadcast_to(np.array([1e-6, 3e-6]), points.shape)
    y = points + sd * rng.standard_normal(points.shape)

    def equation(y: Array, u: Line[Array], c: Any) -> Array:
        return np.asarray(np.linalg.norm(y - u.line[:, :2], axis=1) - u.line[:, 2])

    block = Block(start=np.array([[0.0, 0, 0.02]]), index=np.zeros(30, dtype=int), scale=0.02, group="circle")
    found = fit(
        Problem(equation=equation, readings=y, unknowns=Line(block), noise=Noise(sd=sd), reading_scale=0.02)
    )  # fmt: skip
    c, s = np.cos(angle), np.sin(angle)
    J = np.stack([c, s, np.ones_like(c)], axis=1)
    w = 1 / ((c * 1e-6) ** 2 + (s * 3e-6) ** 2)
    assert found.normal.covariance == pytest.approx(np.linalg.inv((J.T * w) @ J), rel=1e-3)


def test_an_adjusted_constant_is_an_unknown_with_its_prior() -> None:
    x = np.linspace(1, 2, 9)
    y = 5.0 * 1.002 * x + 1e-3 * np.random.default_rng(1).standard_normal(9)

    def equation(y: Array, u: Line[Array], c: Scale[Array]) -> Array:
        return np.asarray(y - u.line[:, 0] - 5.0 * c.scale[:, 0] * x)

    zero = np.zeros(9, dtype=int)

    def made(adjust: bool) -> Fit:
        scale = Constant(value=np.ones((1, 1)), factor=np.full((1, 1, 1), 1e-3), index=zero, scale=1.0, adjust=adjust)
        block = Block(start=np.zeros((1, 1)), index=zero, scale=1.0, group="line")
        return fit(
            Problem(
                equation=equation, readings=y, unknowns=Line(block), constants=Scale(scale),
                noise=Noise(sd=np.full(9, 1e-3)),
            )
        )  # fmt: skip

    found = made(True)
    A = np.concatenate([np.stack([np.ones(9), 5e-3 * x], axis=1) / 1e-3, [[0, 1]]])
    expected = np.linalg.lstsq(A, np.append((y - 5 * x) / 1e-3, 0), rcond=None)[0]
    assert found.unknowns.line[0, 0] == pytest.approx(expected[0], rel=1e-9)
    assert found.constants.scale[0, 0] == pytest.approx(1 + 1e-3 * expected[1], rel=1e-12)
    assert found.normal.covariance == pytest.approx(np.linalg.inv(A.T @ A), rel=1e-8)
    assert made(False).constants.scale[0, 0] == 1.0


def test_exact_readings_converge() -> None:
    x = np.linspace(0, 1, 7)
    problem = straight(x, 2 + 3 * x)
    loose = Problem(
        equation=problem.equation, readings=problem.readings, unknowns=problem.unknowns,
        noise=Noise(sd=np.ones(7), stated=False),
    )  # fmt: skip
    assert fit(loose).unknowns.line[0] == pytest.approx([2, 3], abs=1e-14)


def test_a_fit_that_starts_at_its_solution_has_the_same_solution() -> None:
    problem, _, _ = trilateration(30)
    found = fit(problem)
    again = fit(problem, start=found.linear.at)
    assert again.unknowns.target == pytest.approx(found.unknowns.target, abs=1e-13)
    assert again.chi2 == pytest.approx(found.chi2, rel=1e-12)


def test_a_prior_of_zero_is_refused() -> None:
    with raises("estimation.prior.not_positive"):
        straight(np.linspace(0, 1, 7), np.zeros(7), prior=np.array([1.0, 0.0]))


def test_derivatives_by_the_readings_may_be_given() -> None:
    x = np.linspace(0, 1, 7)
    y = 2 + 3 * x + 0.1 * np.random.default_rng(0).standard_normal(7)
    plain = straight(x, y)
    evaluations = []

    def equation(*at: Any) -> Array:
        evaluations.append(1)
        return plain.equation(*at)

    def derivatives(y: Array, u: Line[Array], c: Any) -> dict[str, Array]:
        J = -np.stack([np.ones(7), x], axis=1)[:, None]
        return {"line": J, problems.READINGS: np.full((7, 1, 1), 2.0)}

    given = fit(replace(plain, equation=equation, derivatives=derivatives))
    expected = fit(plain)
    assert given.unknowns.line == pytest.approx(expected.unknowns.line)
    assert given.chi2 == pytest.approx(expected.chi2 / 4)  # twice the noise
    assert len(evaluations) <= 8  # no differences


def test_derivatives_by_constants_and_readings_may_be_given() -> None:
    """A line through 1 with an uncertain scale of its readings; also where noise is correlated along it."""
    x = np.linspace(0, 1, 7)
    y = 1.02 * (1 + 3 * x) + 0.1 * np.random.default_rng(0).standard_normal(7)
    line, index = straight(x, y, free=np.array([[False, True]])), np.zeros(7, dtype=int)
    line = replace(line, unknowns=Line(replace(line.unknowns.line, start=np.array([[1.0, 0.0]]))))
    gain = Constant(value=np.ones((1, 1)), factor=np.full((1, 1, 1), 0.05), index=index, scale=1.0, adjust=True)

    def equation(y: Array, u: Line[Array], c: Scale[Array]) -> Array:
        return np.asarray(y - c.scale[:, 0] * (u.line[:, 0] + u.line[:, 1] * x))

    def derivatives(y: Array, u: Line[Array], c: Scale[Array]) -> dict[str, Array]:
        J = np.stack([np.ones(7), x], axis=1)
        by_gain = -np.sum(J * u.line, axis=1)[:, None, None]
        return {"line": -c.scale[:, :, None] * J[:, None], "scale": by_gain, problems.READINGS: np.ones((7, 1, 1))}

    plain = replace(line, equation=equation, constants=Scale(gain))
    given = replace(plain, derivatives=derivatives)
    pairs = [(plain, given), (autoregressive(plain, x, 0.5), autoregressive(given, x, 0.5))]
    for expected, found in ([fit(each) for each in pair] for pair in pairs):
        assert found.constants.scale == pytest.approx(expected.constants.scale, rel=1e-9)
        assert found.normal.covariance == pytest.approx(expected.normal.covariance, rel=1e-8)
        assert expected.constants.scale != pytest.approx(1.0, abs=1e-3)


def test_rounding_of_large_readings_does_not_halve_the_steps() -> None:
    """At 4 m and a noise of 0.25 um the sum of squares is known to 1e-6; its derivatives are known far better."""
    x = np.linspace(0, 1, 600)
    y = 4 + 1e-5 * x + 0.25e-6 * np.random.default_rng(0).standard_normal(600)
    noisy = replace(straight(x, y), noise=Noise(sd=np.full(600, 0.25e-6)))
    steps: list[float] = []
    found = fit(noisy, refresh=lambda problem, u: steps.append(u.line[0, 0]) or problem)
    line = np.polynomial.polynomial.polyfit(x, y, 1)
    assert found.unknowns.line[0] == pytest.approx(line, abs=1e-12)
    assert len(steps) <= 4


def test_rounding_of_large_unknowns_is_not_iterated() -> None:
    """Ten thousand points at 1 m with a noise of 1 pm: what rounding promises to decrease is not 0 in any step."""
    rng, n = np.random.default_rng(3), 10_000
    true = 0.7 + rng.normal(0.0, 1e-3, (n, 2))

    def equation(y: Array, u: Line[Array], c: Any) -> Array:
        away = u.line - y[:, :1] * [0.6, 0.8]
        return np.asarray(np.stack([np.hypot(away[:, 0], away[:, 1]), away[:, 0] + away[:, 1] ** 2], axis=1) - y[:, 1:])

    y = np.zeros((n, 3))
    block = Block(start=true + 1e-4, index=np.arange(n), scale=1.0)
    made = Problem(equation=equation, readings=y, unknowns=Line(block), noise=Noise(sd=np.full((n, 3), 1e-12)))
    exact = equation(y, Line(true), ())
    found = fit(replace(made, readings=np.column_stack([np.zeros(n), exact])))
    assert np.abs(found.unknowns.line - true).max() < 1e-14


def test_a_table_of_which_all_readings_see_the_same_rows_is_not_copied() -> None:
    table = np.arange(6.0).reshape(3, 2)
    one = Block(start=table, index=np.ones(4, dtype=int), scale=1.0)
    two = Block(start=table, index=np.tile([2, 0], (4, 1)), scale=1.0)
    apart = Block(start=table, index=np.array([0, 1, 1, 1]), scale=1.0)
    assert one.common
    assert two.common
    assert not apart.common
    assert one.rows(table) == pytest.approx(np.tile(table[1], (4, 1)))
    assert two.rows(table) == pytest.approx(np.tile(table[[2, 0]], (4, 1, 1)))
    assert one.rows(table).strides[0] == 0


def test_a_linear_problem_has_its_derivatives_computed_once() -> None:
    """The solution is that of the iteration, from any start, and nothing is linearised again."""
    x = np.linspace(0, 1, 7)
    y = 2 + 3 * x + 0.1 * np.random.default_rng(0).standard_normal(7)
    plain = straight(x, y, prior=np.array([np.inf, 0.05]))
    calls = []

    def derivatives(_y: Array, rows: Any, _c: Any) -> Mapping[str, Array]:
        calls.append(1)
        return {"line": -np.stack([np.ones(7), x], axis=1)[:, None, :], problems.READINGS: np.ones((7, 1, 1))}

    once = replace(plain, derivatives=derivatives, linear=True)
    far = fit(once, start=Unknown([np.full((1, 2), 1e3)], []))
    assert len(calls) == 1
    assert far.unknowns.line == pytest.approx(fit(plain).unknowns.line, rel=1e-10)
    assert far.residual == pytest.approx(fit(plain).residual, abs=1e-9)
    assert far.normal.covariance == pytest.approx(fit(plain).normal.covariance, rel=1e-9)


def test_unknowns_that_differ_along_the_gauge_are_settled_after_each_step() -> None:
    """Differences of three levels do not determine their mean, which is settled at 5."""
    index = np.array([[0, 1], [1, 2], [0, 2]])

    def equation(y: Array, u: Line[Array], c: Any) -> Array:
        return np.asarray(y - (u.line[:, 1, 0] - u.line[:, 0, 0]))

    problem = Problem(
        equation=equation,
        readings=np.array([1.0, 2.0, 3.0]),
        unknowns=Line(Block(start=np.zeros((3, 1)), index=index, scale=1.0, group="level")),
        noise=Noise(sd=np.ones(3)),
        gauge={"line": np.ones((1, 3, 1))},
        settled=lambda _, x: x._replace(line=x.line - x.line.mean() + 5.0),
    )
    assert fit(problem).unknowns.line.ravel() == pytest.approx([5 - 4 / 3, 5 - 1 / 3, 5 + 5 / 3])
