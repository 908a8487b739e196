from __future__ import annotations

from dataclasses import replace
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import pytest
from coded import raises
from scipy import stats

from errormotion.arrays import Array
from errormotion.errors import FitError
from errormotion.estimation.additions import with_linear
from errormotion.estimation.blocks import Block, Noise
from errormotion.estimation.checks.candidates import Candidate, steps
from errormotion.estimation.checks.effects import Numbers, information, solved
from errormotion.estimation.checks.exclusions import FALSE_ALARM, Cleaned, cleaned, doubts, notes
from errormotion.estimation.checks.suspects import Sequence
from errormotion.estimation.fit import Fit, fit
from errormotion.estimation.problem import Problem

T = TypeVar("T")


class Line(NamedTuple, Generic[T]):
    line: T


class Levels(NamedTuple, Generic[T]):
    level: T
    offset: T


def design(n: int) -> Array:
    x = np.linspace(-1, 1, n)
    return np.stack([np.ones(n), x, x**2], axis=1)


def curve(y: Array, *, stated: bool = True, noise: float = 1.0) -> Problem:
    X = design(len(y))

    def equation(y: Array, u: Line[Array], c: Any) -> Array:
        return np.asarray(y - np.einsum("nk,nk->n", X, u.line))

    block = Block(start=np.zeros((1, 3)), index=np.zeros(len(y), dtype=int), scale=1.0)
    return Problem(
        equation=equation, readings=y, unknowns=Line(block), noise=Noise(sd=np.full(len(y), noise), stated=stated)
    )


def vectors(y: Array, root: Array) -> Problem:
    """Return readings (n, 3) of one mean with correlated noise."""

    def equation(y: Array, u: Line[Array], c: Any) -> Array:
        return np.asarray(y - u.line)

    block = Block(start=np.zeros((1, 3)), index=np.zeros(len(y), dtype=int), scale=1.0)
    return Problem(equation=equation, readings=y, unknowns=Line(block), noise=Noise(root=root))


def levels(cycles: int, balls: int, y: Array) -> Problem:
    """Return readings (cycle, ball) of a level of each cycle plus an offset of each ball but the first."""
    c, b = (each.ravel() for each in np.meshgrid(np.arange(cycles), np.arange(balls), indexing="ij"))

    def equation(y: Array, u: Levels[Array], _: Any) -> Array:
        return np.asarray(y - u.level[:, 0] - u.offset[:, 0])

    unknowns = Levels(
        Block(start=np.zeros((cycles, 1)), index=c, scale=1.0),
        Block(start=np.zeros((balls, 1)), index=b, scale=1.0, free=np.arange(balls) > 0, group="balls"),
    )
    return Problem(equation=equation, readings=y.ravel(), unknowns=unknowns, noise=Noise(sd=np.ones(y.size)))


def names(found: Cleaned) -> list[str]:
    return [each.words for each in found.made]


def test_the_gain_is_the_decrease_of_the_sum_of_squares() -> None:
    rng = np.random.default_rng(0)
    problem = levels(30, 4, rng.standard_normal((30, 4)))
    found = fit(problem)
    D = rng.standard_normal((120, 1, 2))
    u, N = information(found, D)
    X = np.zeros((120, 33))
    X[np.arange(120), problem.unknowns.level.index] = 1
    free = problem.unknowns.offset.index > 0
    X[free, 29 + problem.unknowns.offset.index[free]] = 1
    M = np.eye(120) - X @ np.linalg.pinv(X)
    assert pytest.approx(D[:, 0].T @ M @ D[:, 0], rel=1e-8) == N
    assert u == pytest.approx(D[:, 0].T @ M @ problem.readings, rel=1e-8)
    with_both = fit(with_linear(problem, "more", D))
    assert found.chi2 - with_both.chi2 == pytest.approx(u @ np.linalg.solve(N, u), rel=1e-8)
    assert with_both.unknowns.more[0] == pytest.approx(np.linalg.solve(N, u), rel=1e-8)


def test_the_gain_of_a_number_is_that_of_the_fit_without_it() -> None:
    rng = np.random.default_rng(1)
    root = rng.standard_normal((7, 3, 3)) * 0.4 + np.eye(3)
    problem = vectors(np.einsum("nij,nj->ni", root, rng.standard_normal((7, 3))), root)
    found = fit(problem)
    numbers, readings = Numbers(found, whole=False), Numbers(found, whole=True)
    for i, j in ((0, 0), (3, 2), (6, 1)):
        wrong = np.zeros((7, 3), dtype=bool)
        wrong[i, j] = True
        assert found.chi2 - fit(problem.without(wrong)).chi2 == pytest.approx(numbers.gain[i, j], rel=1e-8)
        assert found.chi2 - fit(problem.without(wrong.any(axis=1))).chi2 == pytest.approx(readings.gain[i, 0], rel=1e-8)


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("n", [6, 20, 80])
def test_the_rate_of_false_alarms_is_that_of_bonferroni(stated: bool, n: int) -> None:
    """On the same data as the rule of a single outlier in closed form, of which more than one makes few alarms."""
    rng = np.random.default_rng(n)
    X = design(n)
    H = X @ np.linalg.pinv(X)
    alarms, expected = 0, 0
    for _ in range(100):
        y = rng.standard_normal(n)
        it = cleaned(curve(y, stated=stated), false_alarm=0.05)
        alarms += bool(it.made or it.undecided)
        r = y - H @ y
        w2, f = r**2 / (1 - np.diag(H)), n - 3
        p = stats.chi2.sf(w2, 1) if stated else stats.f.sf(w2 / ((r @ r - w2) / (f - 1)), 1, f - 1)
        expected += bool(p.min() < 0.05 / n)
    assert expected <= alarms <= expected + 2


@pytest.mark.parametrize(("stated", "noise"), [(True, 1.0), (False, 100.0)])
def test_outliers_are_found_and_no_others(stated: bool, noise: float) -> None:
    """12 standard deviations, beyond the quantile of a F-test with the noise from the other readings."""
    rng = np.random.default_rng(2)
    for _ in range(20):
        y = rng.standard_normal(40)
        wrong = rng.choice(40, 3, replace=False)
        y[wrong] += np.array([12, -12, 15])
        found = cleaned(curve(y, stated=stated, noise=noise))
        assert sorted(np.flatnonzero(found.excluded)) == sorted(wrong)
        assert all(each.probability < FALSE_ALARM for each in found.made)
        sizes = {each.words: each.size[0] for each in found.made}
        assert sizes[f"reading {wrong[2] + 1}"] == pytest.approx(15, abs=6)


def test_a_noise_that_is_stated_too_small_makes_no_outliers() -> None:
    rng = np.random.default_rng(3)
    found = [cleaned(curve(rng.standard_normal(60), noise=0.4)) for _ in range(100)]
    assert sum(bool(each.made) for each in found) <= 2


def test_a_reading_that_is_excluded_for_another_one_returns() -> None:
    """Two outliers at one end pull the curve: a valid reading between them may appear as the worst."""
    rng = np.random.default_rng(4)
    for _ in range(30):
        y = rng.standard_normal(25)
        y[[0, 2]] += 25
        assert sorted(np.flatnonzero(cleaned(curve(y)).excluded)) == [0, 2]


def test_a_number_or_a_whole_reading_is_excluded() -> None:
    rng = np.random.default_rng(5)
    root = np.broadcast_to(np.array([[1, 0, 0], [0.9, 0.4, 0], [0.9, 0.1, 0.4]]), (12, 3, 3))
    y = np.einsum("nij,nj->ni", root, rng.standard_normal((12, 3)))
    y[4, 1] += 5.0  # 12 standard deviations for the others given, 5 of its own
    found = cleaned(vectors(y, root))
    assert names(found) == ["number 2 of reading 5"]
    assert found.excluded.sum() == 1
    y[4] += np.array([9.0, -3, 0])
    found = cleaned(vectors(y, root), whole=True)
    assert names(found) == ["reading 5"]
    assert found.excluded[4].all()
    assert found.excluded.sum() == 3
    assert found.made[0].size == pytest.approx(y[4] - y[np.arange(12) != 4].mean(axis=0), abs=1e-6)


def test_a_reading_that_nothing_checks_is_reported() -> None:
    """Ball 3 is probed once: its offset takes up any error."""
    y = np.random.default_rng(6).standard_normal((10, 4))
    y[1:, 3] = np.nan
    found = cleaned(levels(10, 4, y))
    assert found.unchecked.sum() == 1
    assert found.unchecked[3, 0]


def test_a_contradiction_without_a_culprit_is_reported_and_not_excluded() -> None:
    """Two readings of a level differ: either may be wrong, and without both it is undetermined."""
    y = np.array([[0.0, 0.3], [0.2, -0.1], [0.4, 20.0], [0.1, 0.2]])
    problem = levels(4, 2, y)
    found = cleaned(problem.without(np.zeros(8, dtype=bool)))
    assert not found.made
    assert len(found.undecided) == 1
    assert {found.undecided[0].words, *found.undecided[0].rivals} == {"reading 5", "reading 6"}
    assert list(np.flatnonzero(found.undecided[0].readings)) == [4, 5]
    assert not found.excluded.any()


def test_rivals_are_excluded_together_where_the_others_determine_all() -> None:
    """A parabola through 5 points: an error of the second one is nearly one of the first, and 3 points remain."""
    y = np.zeros(5)
    y[1] = 6.0
    problem = curve(y)
    gain = Numbers(fit(problem), whole=False).gain[:, 0]
    assert gain[1] - 6 < gain[0] < gain[1]
    found = cleaned(problem)
    assert [(each.words, each.rivals) for each in found.made] == [("reading 2", ("reading 1",))]
    assert list(np.flatnonzero(found.excluded)) == [0, 1]
    y[1] = 60.0  # now the odds are clear
    assert [(each.words, each.rivals) for each in cleaned(curve(y)).made] == [("reading 2", ())]


def moved(y: Array, *, exclude: bool) -> Cleaned:
    cycles, balls = y.shape
    c, b = (each.ravel() for each in np.meshgrid(np.arange(cycles), np.arange(balls), indexing="ij"))
    search = steps(
        c.astype(float), b, np.ones((y.size, 1)), lambda i, t: f"ball {i + 1} before cycle {t + 1:g}", exclude=exclude
    )
    return cleaned(levels(cycles, balls, y), suspects=search)


@pytest.mark.parametrize("exclude", [True, False])
def test_a_ball_that_moved_is_found_with_its_cycle(exclude: bool) -> None:
    rng = np.random.default_rng(8)
    y = rng.standard_normal((60, 5)) + np.cumsum(rng.standard_normal(60))[:, None]
    y[37:, 2] += 6.0
    y[11, 4] += 12.0
    found = moved(y, exclude=exclude)
    assert sorted(names(found)) == ["ball 3 before cycle 38", "reading 60"]
    assert found.made[0].size[0] == pytest.approx(6, abs=1.5)
    assert notes(found)[0].endswith("not used.")
    if exclude:
        assert found.excluded.sum() == 60 - 37 + 1
    else:
        assert found.fit.unknowns.added_1[0, 0] == pytest.approx(6, abs=1.5)


def test_the_instant_of_a_step_is_the_best_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the gain has several maxima: a ball that moved, and was put back for the most part."""
    rng = np.random.default_rng(21)
    c, b = (each.ravel() for each in np.meshgrid(np.arange(200), np.arange(3), indexing="ij"))
    search = steps(c.astype(float), b, np.ones((c.size, 1)), lambda i, t: f"{i} {t:g}")
    for _ in range(20):
        y = rng.standard_normal((200, 3)) + np.cumsum(rng.standard_normal(200))[:, None]
        first, last = np.sort(rng.choice(np.arange(1, 200), 2, replace=False))
        y[first:, 1] += 4.0
        y[last:, 1] -= 3.0 * rng.uniform(0.8, 1.2)
        found = fit(levels(200, 3, y))
        fast = search(found)
        with monkeypatch.context() as every:
            every.setattr("errormotion.estimation.checks.candidates.CUTS", 1000)
            best = search(found)
        for one, other in zip(fast, best, strict=True):
            gains = [
                float(solved(*information(found, each.design[:, None, :] if each.design.ndim == 2 else each.design))[1])
                for each in (one, other)
            ]
            assert gains[0] > 0.99 * gains[1]


@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("stated", [False, True])
def test_the_chances_of_several_numbers_are_those_of_each_given_the_others(whole: bool, stated: bool) -> None:
    """At once by one inverse, and one after the other; also all numbers, without which nothing is determined."""
    rng = np.random.default_rng(22)
    y = rng.standard_normal((30, 3))
    y[[3, 7, 11, 20]] += 10.0
    problem = vectors(y, np.tile(np.eye(3) + 0.3, (30, 1, 1)))
    found = fit(replace(problem, noise=replace(problem.noise, stated=stated)))
    sequence = Sequence(found, Numbers(found, whole), 0.0, np.log(1e-5))
    chosen = [j for j, _ in sequence.order]
    assert len(chosen) > 3
    each = [sequence._given(j, [i for i in chosen if i != j]).chance for j in chosen]
    assert sequence._chances(chosen) == pytest.approx(each, rel=1e-6)
    every = list(range(len(sequence.where)))
    if not whole:
        assert sequence._chances(every) == pytest.approx(
            [sequence._given(j, [i for i in every if i != j]).chance for j in every], rel=1e-6
        )


def test_a_single_outlier_is_not_a_move() -> None:
    rng = np.random.default_rng(9)
    for cycle in (0, 20, 59):
        y = rng.standard_normal((60, 5))
        y[cycle, 3] += 15.0
        assert names(moved(y, exclude=True)) == [f"reading {5 * cycle + 4}"]


def test_balls_at_rest_do_not_move() -> None:
    rng = np.random.default_rng(10)
    alarms = 0
    for _ in range(100):
        y = rng.standard_normal((30, 4))
        c, b = (each.ravel() for each in np.meshgrid(np.arange(30), np.arange(4), indexing="ij"))
        search = steps(c.astype(float), b, np.ones((y.size, 1)), lambda i, t: f"{i} {t}")
        alarms += bool(cleaned(levels(30, 4, y), suspects=search, false_alarm=0.05).made)
    assert stats.binom.sf(alarms - 1, 100, 0.05) > 1e-3


def test_a_candidate_whose_exclusion_leaves_an_unknown_undetermined_is_reported() -> None:
    rng = np.random.default_rng(11)
    y = rng.standard_normal((10, 4))
    y[:, 1] += np.linspace(0, 60, 10)
    c = np.repeat(np.arange(10), 4)

    def suspects(_: Fit) -> list[Candidate]:
        drift = np.where(np.tile(np.arange(4), 10) == 1, c, 0.0)[:, None]
        return [Candidate(words="ball 2 creeps", design=drift, excluded=np.tile(np.arange(4), 10) == 1)]

    found = cleaned(levels(10, 4, y), suspects=suspects)
    assert [each.words for each in found.undecided] == ["ball 2 creeps"]


def test_an_endless_search_ends_with_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("errormotion.estimation.checks.exclusions.MAX_PASSES", 1)
    y = np.random.default_rng(12).standard_normal(30)
    y[5] += 50
    with raises("estimation.outliers.too_many"):
        cleaned(curve(y))


class Network(NamedTuple, Generic[T]):
    target: T


@pytest.mark.parametrize("stations", [3, 4, 5])
def test_the_wrong_distance_of_a_target_is_found_from_five_stations_on(stations: int) -> None:
    """In a plane: 3 distances contradict, 4 show in most places which one is wrong, 5 do in all."""
    rng = np.random.default_rng(13)
    angle = 2 * np.pi * np.arange(stations) / stations
    station = 3 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    target = rng.uniform(-1, 1, (60, 2))
    t, s = (each.ravel() for each in np.meshgrid(np.arange(60), np.arange(stations), indexing="ij"))
    y = np.linalg.norm(target[t] - station[s], axis=1) + 1e-3 * rng.standard_normal(t.size)
    y[17 * stations + 1] += 0.05

    def equation(y: Array, u: Network[Array], c: Any) -> Array:
        return np.asarray(y - np.linalg.norm(u.target - station[s], axis=1))

    problem = Problem(
        equation=equation, readings=y, unknowns=Network(Block(start=target, index=t, scale=1.0)),
        noise=Noise(sd=np.full(t.size, 1e-3)),
    )  # fmt: skip
    found = cleaned(problem)
    wrong = 17 * stations + 1
    if stations == 3:
        assert not found.made
        assert list(np.flatnonzero(found.undecided[0].readings)) == [51, 52, 53]
    else:
        assert list(np.flatnonzero(found.excluded)) == [wrong]


def test_valid_data_have_no_note_and_others_one_sentence() -> None:
    y = np.random.default_rng(14).standard_normal(20)
    assert notes(cleaned(curve(y))) == []
    y[7] += 20
    assert notes(cleaned(curve(y)), "distances") == [
        "Some distances contradict the others (reading 8); 1 of them is not used."
    ]
    steady = np.random.default_rng(15).standard_normal((20, 4))
    steady[9:, 1] += 8
    assert notes(moved(steady, exclude=False)) == [
        "Some readings contradict the others (ball 2 before cycle 10); their effect is estimated."
    ]
    pair = np.array([[0.0, 0.3], [0.2, -0.1], [0.4, 20.0], [0.1, 0.2]])
    undecided = cleaned(levels(4, 2, pair))
    text = doubts(undecided)
    assert len(text) == 1
    assert notes(undecided) == []
    assert text[0].startswith("One of reading 5, reading 6 is wrong") or "reading 6, reading 5" in text[0]


def test_unknowns_without_readings_are_left_out_where_the_structure_says_so() -> None:
    """All readings of a level are wrong together: without them nothing determines it."""
    rng = np.random.default_rng(5)
    y = rng.standard_normal((6, 4))
    y[3] += [0.0, 30.0, -30.0, 15.0]
    whole = np.zeros(y.shape, dtype=bool)
    whole[3] = True

    def suspects(found: Fit) -> list[Candidate]:
        design = np.where(whole.ravel()[:, None], np.tile(np.eye(4), (6, 1)), 0.0)
        return [Candidate(words="cycle 3", design=design, excluded=whole.ravel(), trials=6)]

    def structure(problem: Problem) -> Problem:
        level = problem.unknowns.level
        free = np.bincount(level.index[np.isfinite(problem.readings)], minlength=6) > 0
        return replace(problem, unknowns=problem.unknowns._replace(level=replace(level, free=free)))

    with pytest.raises(FitError, match="level 4"):
        cleaned(levels(6, 4, y), suspects=suspects)
    found = cleaned(levels(6, 4, y), suspects=suspects, structure=structure)
    assert names(found) == ["cycle 3"]
    assert np.flatnonzero(~found.fit.problem.unknowns.level.free).tolist() == [3]
    assert found.fit.freedom == 20 - 5 - 3


def test_two_steps_at_once_are_no_outliers() -> None:
    """Each reading of a step has a large gain given the others, but alone a smaller one than the step."""
    rng = np.random.default_rng(8)
    y = rng.standard_normal((12, 6))
    y[3:, 2] += 12.0
    y[7:, 4] += 12.0
    problem = levels(12, 6, y)
    cycle, ball = np.divmod(np.arange(y.size), 6)
    search = steps(cycle.astype(float), ball, np.ones((y.size, 1)), lambda i, t: f"{i} from {t:g}")
    assert sorted(names(cleaned(problem, suspects=search))) == ["2 from 3", "4 from 7"]
