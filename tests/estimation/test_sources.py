"""Errors at places with their sources, against dense propagation and Monte Carlo."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import pytest
from coded import raises

from errormotion.arrays import Array
from errormotion.errors import FitError
from errormotion.estimation.blocks import Block, Constant, Noise
from errormotion.estimation.datum import Datum, relative
from errormotion.estimation.fit import fit
from errormotion.estimation.problem import Problem
from errormotion.estimation.sources import Errors, Places, Source, errors_of

T = TypeVar("T")


class Unknowns(NamedTuple, Generic[T]):
    error: T
    offset: T


class Known(NamedTuple, Generic[T]):
    scale: T
    temperature: T


TARGETS, RUNS = 12, 4
POSITION = np.linspace(0.1, 1.2, TARGETS)
TARGET, RUN = (each.ravel() for each in np.meshgrid(np.arange(TARGETS), np.arange(RUNS), indexing="ij"))
SD = 1e-6
PRIOR = 3e-6


def equation(y: Array, x: Unknowns[Array], c: Known[Array]) -> Array:
    """Return reading minus prediction: errors, run offsets, and a scale that also heats up."""
    heat = 11e-6 * (c.temperature[:, 0] - 20.0)
    return np.asarray(y - x.error[:, 0] - x.offset[:, 0] - POSITION[TARGET] * (c.scale[:, 0] + heat))


def errors(x: Unknowns[Array], c: Known[Array]) -> Array:
    """Return the error at each target, with 1 more of the scale."""
    return np.asarray(x.error[:, 0] + 0.5 * POSITION * c.scale[:, 0])


def problem(y: Array, *, adjust: bool = False, scale: float = 1e-6) -> Problem:
    zero = np.zeros(TARGET.size, dtype=int)
    unknowns = Unknowns(
        Block(start=np.zeros((TARGETS, 1)), index=TARGET, scale=1.0),
        Block(start=np.zeros((RUNS, 1)), index=RUN, scale=1.0, prior=PRIOR, group="drift"),
    )
    constants = Known(
        Constant(
            value=np.array([[scale]]), factor=np.full((1, 1, 1), 2e-6), index=zero, scale=1.0, group="scale",
            identity=["certificate 17: scale"], adjust=adjust,
        ),
        Constant(value=np.array([[21.0]]), factor=np.full((1, 1, 1), 0.2), index=zero, scale=1.0, group="expansion"),
    )  # fmt: skip
    return Problem(
        equation=equation, readings=y, unknowns=unknowns, constants=constants, noise=Noise(sd=np.full(TARGET.size, SD))
    )


def dense() -> tuple[Array, Array]:
    """Return the estimator matrix of the errors for readings and priors, and the covariance."""
    A = np.zeros((TARGET.size + RUNS, TARGETS + RUNS))
    A[np.arange(TARGET.size), TARGET] = 1 / SD
    A[np.arange(TARGET.size), TARGETS + RUN] = 1 / SD
    A[TARGET.size + np.arange(RUNS), TARGETS + np.arange(RUNS)] = 1 / PRIOR
    C = np.linalg.inv(A.T @ A)
    return np.asarray((C @ A.T)[:TARGETS], dtype=float), np.asarray(C[:TARGETS, :TARGETS], dtype=float)


def whole(found: Errors) -> Array:
    """Return the covariance of all places (place, place) of one freedom."""
    F = found.influence[:, :, 0]
    return np.asarray(np.diag(found.own[:, 0, 0]) + F.T @ F)


def test_the_covariance_is_that_of_the_dense_propagation() -> None:
    found = errors_of(fit(problem(np.zeros(TARGET.size))), Places(errors, TARGETS))
    gain, C = dense()
    of_readings = gain[:, : TARGET.size] / SD
    scale = -of_readings @ (POSITION[TARGET] * 2e-6) + 0.5 * POSITION * 2e-6
    heat = -of_readings @ (POSITION[TARGET] * 11e-6 * 0.2)
    expected = C + np.outer(scale, scale) + np.outer(heat, heat)
    assert whole(found) == pytest.approx(expected, rel=1e-6)
    effects = {source.group: source.effect[:, 0] for source in found.sources}
    assert effects["scale"] == pytest.approx(scale, rel=1e-7)
    assert effects["expansion"] == pytest.approx(heat, rel=1e-7)
    assert [source.identity for source in found.sources if source.identity] == ["certificate 17: scale"]
    # the drift is the effect of the priors of the runs: cov(e, z) / sd
    drift = sum(np.square(s.effect[:, 0]) for s in found.sources if s.group == "drift")
    assert drift == pytest.approx(np.sum(np.square(gain[:, TARGET.size :]), axis=1), rel=1e-6)
    budget = found.budget()
    total = np.sum([np.square(part) for part in budget.values()], axis=0)
    assert total[:, 0] == pytest.approx(np.diag(expected), rel=1e-6)


def test_an_adjusted_constant_keeps_its_identity_and_its_part() -> None:
    """The readings of this test do not see the scale: adjusting it changes nothing."""
    y = np.zeros(TARGET.size)
    taken = errors_of(fit(problem(y)), Places(errors, TARGETS))
    adjusted = errors_of(fit(problem(y, adjust=True)), Places(errors, TARGETS))
    assert whole(adjusted) == pytest.approx(whole(taken), rel=1e-5)
    one, other = (next(s for s in each.sources if s.identity) for each in (taken, adjusted))
    assert one.effect == pytest.approx(other.effect, rel=1e-5)


def test_readings_that_see_a_constant_improve_it() -> None:
    """With a known target at the far end, the scale is measured."""
    sharp = problem(np.zeros(TARGET.size), adjust=True)
    block = replace(sharp.unknowns.error, prior=1e-9)
    better = replace(sharp, unknowns=sharp.unknowns._replace(error=block))
    u = [np.sqrt(errors_of(fit(each), Places(errors, TARGETS)).covariance[-1, 0, 0]) for each in (sharp, better)]
    assert u[1] < 0.7 * u[0]


def test_the_intervals_contain_the_truth() -> None:
    """Monte Carlo of readings, drift and constants: the spread of the errors is the stated one."""
    rng = np.random.default_rng(5)
    stated = errors_of(fit(problem(np.zeros(TARGET.size))), Places(errors, TARGETS))
    gain, _ = dense()
    misses = []
    for _ in range(4000):
        drift = PRIOR * rng.standard_normal(RUNS)
        scale = 1e-6 + 2e-6 * rng.standard_normal()
        temperature = 21.0 + 0.2 * rng.standard_normal()
        y = drift[RUN] + POSITION[TARGET] * (scale + 11e-6 * (temperature - 20.0)) + SD * rng.standard_normal(RUN.size)
        believed = y - POSITION[TARGET] * (1e-6 + 11e-6)
        found = gain[:, : TARGET.size] @ believed / SD + 0.5 * POSITION * 1e-6
        misses.append(found - 0.5 * POSITION * scale)
    spread = np.asarray(np.cov(np.array(misses).T), dtype=float)
    assert np.sqrt(np.diag(spread)) == pytest.approx(np.sqrt(stated.covariance[:, 0, 0]), rel=0.05)
    between = spread[0, -1] / np.sqrt(spread[0, 0] * spread[-1, -1])
    assert between == pytest.approx(
        whole(stated)[0, -1] / np.sqrt(whole(stated)[0, 0] * whole(stated)[-1, -1]), abs=0.05
    )


def test_a_variance_factor_scales_the_readings_only() -> None:
    found = fit(problem(np.zeros(TARGET.size)))
    one, four = (errors_of(found, Places(errors, TARGETS), factor=f) for f in (1.0, 4.0))
    assert four.own == pytest.approx(4 * one.own)
    for a, b in zip(one.sources, four.sources, strict=True):
        assert b.effect == pytest.approx(a.effect * (2.0 if a.group == "readings" else 1.0), rel=1e-9)


def test_places_without_rows_name_the_tables() -> None:
    with pytest.raises(FitError, match=r"all errors are NaN.*\(without: error, offset\)"):
        errors_of(fit(problem(np.zeros(TARGET.size))), Places(lambda x, c: x.error, 5))


def _line() -> Array:
    return np.stack([np.ones(TARGETS), POSITION], axis=1)[:, None, :]


def test_a_line_through_the_ends_is_exact() -> None:
    found = errors_of(fit(problem(np.zeros(TARGET.size))), Places(errors, TARGETS))
    weight = np.zeros((TARGETS, 1))
    weight[[0, -1]] = 1.0
    result = relative(found, Datum(_line(), weight, "ends"))
    t = (POSITION - POSITION[0]) / (POSITION[-1] - POSITION[0])
    M = np.eye(TARGETS)
    M[:, 0] -= 1 - t
    M[:, -1] -= t
    assert whole(result.errors) == pytest.approx(M @ whole(found) @ M.T, rel=1e-8, abs=1e-20)
    assert result.errors.covariance[[0, -1]] == pytest.approx(np.zeros((2, 1, 1)), abs=1e-20)


def test_what_a_datum_does_not_relate_stays_independent() -> None:
    """A straightness is relative to the line through its ends; the positioning at the same targets is not."""
    own = np.tile(np.diag([4.0, 9.0]), (5, 1, 1))
    columns = np.zeros((5, 2, 2))
    columns[:, 1] = np.stack([1.0 - np.linspace(0.0, 1.0, 5), np.linspace(0.0, 1.0, 5)], axis=1)
    weight = np.zeros((5, 2))
    weight[[0, 4], 1] = 1.0
    found = relative(Errors(np.ones((5, 2)), own, []), Datum(columns, weight, "ends")).errors
    assert found.own[:, 0, 0] == pytest.approx(np.full(5, 4.0))
    assert found.own[[0, 4], 1, 1] == pytest.approx(np.zeros(2))
    assert len(found.sources) == 2
    assert np.abs(found.influence[..., 0]).max() == 0.0
    assert found.covariance[2, 1, 1] == pytest.approx(9.0 * (1 + 0.5))


def test_a_datum_of_many_places_has_exact_totals() -> None:
    rng = np.random.default_rng(6)
    n = 200
    own = np.square(rng.uniform(0.5, 2.0, n))[:, None, None]
    before = Errors(rng.standard_normal((n, 1)), own, [Source("scale", "scale", rng.standard_normal((n, 1)))])
    A = np.stack([np.ones(n), np.linspace(-1, 1, n)], axis=1)
    result = relative(before, Datum(A[:, None, :], np.ones((n, 1)), "network", ["offset", "slope"]))
    M = np.eye(n) - A @ np.linalg.pinv(A)
    assert result.errors.value[:, 0] == pytest.approx(M @ before.value[:, 0])
    assert result.errors.covariance[:, 0, 0] == pytest.approx(np.diag(M @ whole(before) @ M.T), rel=1e-9)
    H = np.linalg.pinv(A)
    assert result.coefficient == pytest.approx(H @ before.value[:, 0])
    assert result.covariance == pytest.approx(H @ whole(before) @ H.T, rel=1e-9)
    assert result.influence.shape == (len(result.errors.sources), 2)
    assert result.influence.T @ result.influence == pytest.approx(result.covariance, rel=1e-9)


@pytest.mark.parametrize("n", [8, 20, 120, 400])
def test_the_noise_of_places_that_define_a_datum_is_noise_of_the_readings(n: int) -> None:
    """What a best fit absorbs of equal noise is 2 / n of its variance: the datum itself adds nothing."""
    A = np.stack([np.ones(n), np.sqrt(2) * np.cos(np.arange(n) * 2 * np.pi / n)], axis=1)
    before = Errors(np.zeros((n, 1)), np.full((n, 1, 1), 4.0), [])
    result = relative(before, Datum(A[:, None, :], np.ones((n, 1)), "axis average line"), noise="readings")
    parts = result.errors.budget()
    assert np.abs(parts.get("axis average line", np.zeros(1))).max() < 1e-6
    noise = np.square(parts[""]) + np.square(parts.get("readings", np.zeros((n, 1))))
    M = np.eye(n) - A @ np.linalg.pinv(A)
    assert noise[:, 0] == pytest.approx(4.0 * np.diag(M))
    if n < 40:  # a place has more than a tenth of the weight
        assert whole(result.errors) == pytest.approx(4.0 * M, abs=1e-9)
    else:
        assert "readings" not in parts
    assert result.covariance == pytest.approx(4.0 * np.eye(2) / n, abs=1e-12)


def test_a_place_that_defines_the_datum_alone_has_exactly_no_uncertainty() -> None:
    rng = np.random.default_rng(4)
    root = rng.standard_normal((6, 2, 2))
    before = Errors(np.zeros((6, 2)), root @ np.swapaxes(root, 1, 2), [])
    first = np.zeros((6, 2))
    first[0] = 1.0
    found = relative(before, Datum(np.tile(np.eye(2), (6, 1, 1)), first, "reference")).errors
    assert (found.covariance[0] == 0).all()
    assert found.covariance[1:] == pytest.approx(before.own[1:] + before.own[0])


@pytest.mark.parametrize("n", [20, 400])
def test_the_coefficients_of_a_datum_share_the_sources_of_the_errors(n: int) -> None:
    """Covariance of errors and coefficients: that of the sources, exactly where the places are sources of their own."""
    rng = np.random.default_rng(11)
    own = np.square(rng.uniform(0.5, 2.0, n))[:, None, None]
    scale = rng.standard_normal((n, 1))
    before = Errors(rng.standard_normal((n, 1)), own, [Source("scale", "scale", scale)])
    A = np.stack([np.ones(n), np.linspace(-1, 1, n)], axis=1)
    result = relative(before, Datum(A[:, None, :], np.ones((n, 1)), "line"))
    H = np.linalg.pinv(A)
    assert result.influence.T @ result.influence == pytest.approx(result.covariance, rel=1e-9)
    cross = np.einsum("spd,sg->pg", result.errors.influence, result.influence)
    exact = (np.eye(n) - A @ H) @ whole(before) @ H.T
    if n == 20:
        assert cross == pytest.approx(exact, abs=1e-12)
        M = np.eye(n) - A @ H
        assert whole(result.errors) == pytest.approx(M @ whole(before) @ M.T, abs=1e-12)


@pytest.mark.parametrize("n", [90, 400])
def test_a_column_beside_the_datum_is_adapted_and_stays(n: int) -> None:
    """The centre of an incomplete circle is that of the circle of the best radius, and the radius remains."""
    rng = np.random.default_rng(12)
    angle = np.linspace(0.3, 6.0, n)
    own = np.square(rng.uniform(0.5, 2.0, n))[:, None, None]
    before = Errors(5.0 + rng.standard_normal((n, 1)), own, [Source("length", "length", np.ones((n, 1)))])
    A, B = np.stack([np.cos(angle), np.sin(angle)], axis=1), np.ones((n, 1))
    datum = Datum(A[:, None, :], np.ones((n, 1)), "centre", ("x", "y"), beside=B[:, None, :])
    result = relative(before, datum)
    H = np.linalg.pinv(np.hstack([A, B]))[:2]
    M = np.eye(n) - A @ H
    assert result.coefficient == pytest.approx(H @ before.value[:, 0])
    assert result.errors.value[:, 0] == pytest.approx(M @ before.value[:, 0])
    assert result.errors.covariance[:, 0, 0] == pytest.approx(np.diag(M @ whole(before) @ M.T), rel=1e-9)
    assert result.errors.sources[0].effect == pytest.approx(np.ones((n, 1)))


def test_a_source_that_the_datum_removes_has_no_effect() -> None:
    n = 30
    A = np.stack([np.ones(n), np.linspace(-1, 1, n)], axis=1)
    offset = Source("offset", "offset", (A @ [0.3, -0.7])[:, None])
    result = relative(
        Errors(np.zeros((n, 1)), np.ones((n, 1, 1)), [offset]), Datum(A[:, None, :], np.ones((n, 1)), "l")
    )
    assert (result.errors.sources[0].effect == 0).all()
    assert result.influence[0] == pytest.approx([0.3, -0.7])


def test_an_unknown_value_defines_no_datum() -> None:
    before = Errors(np.array([[np.nan], [1.0], [2.0]]), np.ones((3, 1, 1)), [])
    reference = Datum(np.ones((3, 1, 1)), np.array([[1.0], [1.0], [0.0]]), "reference")
    result = relative(before, reference)
    assert result.errors.value[1:, 0] == pytest.approx([0.0, 1.0])
    assert np.isnan(result.errors.value[0, 0])
    with raises("estimation.datum.undetermined"):
        relative(before, replace(reference, weight=np.array([[1.0], [0.0], [0.0]])))


def test_one_place_has_no_shared_part() -> None:
    """A beam from planes: with a single place, what its readings share is independent."""
    rng = np.random.default_rng(7)
    X = rng.standard_normal((30, 3))

    class One(NamedTuple, Generic[T]):
        beam: T

    def line(y: Array, x: One[Array], c: Any) -> Array:
        return np.asarray(y - np.sum(X * x.beam, axis=1))

    block = Block(start=np.zeros((1, 3)), index=np.zeros(30, dtype=int), scale=1.0, group="beam")
    found = fit(Problem(equation=line, readings=np.zeros(30), unknowns=One(block), noise=Noise(sd=np.ones(30))))
    result = errors_of(found, Places(lambda x, c: x.beam, 1))
    assert result.sources == []
    assert result.own[0] == pytest.approx(np.linalg.inv(X.T @ X), rel=1e-9)


@pytest.mark.parametrize("order", ["by target", "mixed"])
def test_readings_in_the_order_of_their_targets_have_the_same_errors(order: str) -> None:
    """With one reading of each target, and offsets that all of them see: the sums of the ordered readings are short."""
    n, rng = 9, np.random.default_rng(2)
    slope = rng.normal(size=n)
    place = np.arange(n) if order == "by target" else rng.permutation(n)
    far = np.tile([0, 1], (n, 1))

    def residual(y: Array, x: Unknowns[Array], c: Known[Array]) -> Array:
        both = x.offset[:, 0] + slope[place][:, None] * x.offset[:, 1]
        return np.asarray(y - x.error * [1.0, 2.0] - both - slope[place][:, None] * c.scale - c.temperature)

    model = Problem(
        equation=residual,
        readings=rng.normal(0.0, SD, (n, 2)),
        unknowns=Unknowns(
            Block(start=np.zeros((n, 2)), index=place, scale=1.0),
            Block(start=np.zeros((2, 2)), index=far, scale=1.0, prior=PRIOR, group="drift"),
        ),
        constants=Known(
            Constant(
                value=np.ones((1, 2)), factor=1e-6 * np.eye(2)[None], index=np.zeros(n, int), scale=1.0, group="a"
            ),
            Constant(
                value=np.zeros((n, 2)), factor=1e-6 * rng.normal(size=(n, 2, 3)), index=place, scale=1.0, group="b"
            ),
        ),
        noise=Noise(sd=np.full((n, 2), SD)),
    )
    found = errors_of(fit(model), Places(lambda x, c: x.error, n, only=("error",)))
    # Two numbers determine the two unknowns of a place: what else changes the readings changes its errors.
    gain = np.array([-1.0, -0.5])
    effects = {group: np.array([s.effect for s in found.sources if s.group == group]) for group in ("a", "b", "drift")}
    of_a = gain * slope[:, None] * 1e-6 * np.eye(2)[:, None]
    assert effects["a"] == pytest.approx(of_a, abs=1e-9 * 1e-6)
    of_b = np.moveaxis(model.constants.temperature.factor, 2, 0) * gain
    assert effects["b"] == pytest.approx(of_b, abs=1e-8 * 1e-6)
    of_drift = np.stack([PRIOR * gain * w[:, None] * np.eye(2)[k] for w in (np.ones(n), slope) for k in range(2)])
    assert effects["drift"] == pytest.approx(of_drift, abs=1e-8 * PRIOR)
    assert found.own == pytest.approx(np.tile(np.diag(np.square(SD * gain)), (n, 1, 1)), abs=1e-8 * SD**2)


def test_derivatives_by_constants_may_be_given() -> None:
    called = []

    def derivatives(y: Array, x: Any, c: Any) -> dict[str, Array]:
        called.append(1)
        return {"temperature": np.full((y.size, 1, 1), -11e-6) * POSITION[TARGET][:, None, None]}

    plain = problem(np.zeros(TARGET.size))
    given = replace(plain, constant_derivatives=derivatives)
    by_differences, analytic = (errors_of(fit(each), Places(errors, TARGETS)) for each in (plain, given))
    assert called
    for one, other in zip(by_differences.sources, analytic.sources, strict=True):
        assert other.effect == pytest.approx(one.effect, rel=1e-6, abs=1e-15)


def test_a_source_that_no_reading_sees_acts_on_the_errors_only() -> None:
    unseen = problem(np.zeros(TARGET.size))
    blind = replace(unseen, equation=lambda y, x, _: y - x.error[:, 0] - x.offset[:, 0])
    found = errors_of(fit(blind), Places(errors, TARGETS))
    effect = next(source.effect[:, 0] for source in found.sources if source.group == "scale")
    assert effect == pytest.approx(0.5 * POSITION * 2e-6, rel=1e-7)
    expansion = next(source.effect for source in found.sources if source.group == "expansion")
    assert not expansion.any()


def test_a_table_that_the_errors_do_not_depend_on_is_named() -> None:
    found = fit(problem(np.zeros(TARGET.size)))
    places = Places(lambda x, c: x.error + 0.0 * np.nan_to_num(c.scale), TARGETS, only=("error",))
    maps = places.tables(found.problem, [*found.linear.at.tables, *found.problem.constant_tables(found.linear.at)])
    assert [each is None for each in maps] == [False, True, True, True]


def test_a_place_whose_unknowns_are_not_estimated_is_unknown_where_the_places_state_it() -> None:
    free = np.arange(TARGETS) != 3
    whole = problem(np.zeros(TARGET.size))
    one = replace(whole, unknowns=whole.unknowns._replace(error=replace(whole.unknowns.error, free=free)))
    places = Places(errors, TARGETS)
    assert np.isfinite(errors_of(fit(one), places).value).all()
    found = errors_of(fit(one), replace(places, estimated=True))
    assert np.flatnonzero(np.isnan(found.value[:, 0])).tolist() == [3]
    assert np.flatnonzero(np.isnan(found.own[:, 0, 0])).tolist() == [3]
