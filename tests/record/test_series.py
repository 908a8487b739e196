"""Trend, steps and control limits of a series: coverage, false alarms and power against a known truth."""

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import norm

from errormotion.estimation.between_runs import by_moving_ranges, fit_runs
from errormotion.record.control import chart
from errormotion.record.series import YEAR, Series
from errormotion.record.steps import Model, model_of

SLOPE = 2e-6
"""True trend, m per year."""


def series(
    rng: np.random.Generator,
    count: int,
    tau: float,
    size: float = 0.0,
    after: int = 0,
    shared: float = 0.0,
    slope: float = SLOPE,
) -> Series:
    """Return three years of values with u of 0.5 um to 1.5 um; a step of ``size`` u before value ``after``."""
    t = np.sort(rng.uniform(0, 3 * YEAR, count))
    u = rng.uniform(0.5e-6, 1.5e-6, count)
    y = 5e-6 + slope * t / YEAR + u * rng.normal(size=count) + tau * rng.normal(size=count)
    y += size * np.sqrt(np.mean(u**2) + tau**2) * (np.arange(count) >= after) + shared * rng.normal()
    F = np.full((1, count), shared)
    return Series(t, y, np.sqrt(u**2 + shared**2), F, ["bar"] if shared else [])


def alike(rng: np.random.Generator, count: int, tau: float, days: float, size: float = 0.0) -> Series:
    """Return three years of values whose deviations from the trend are alike for some days; a step in the middle."""
    values = series(rng, count, 0.0)
    R = np.exp(-np.abs(np.subtract.outer(values.time, values.time)) / (86400 * days)) + 1e-9 * np.eye(count)
    y = values.value + tau * np.linalg.cholesky(R) @ rng.normal(size=count)
    y += size * np.sqrt(np.mean(values.u**2) + tau**2) * (np.arange(count) >= count // 2)
    return Series(values.time, y, values.u)


def bound(rate: float, count: int) -> float:
    """Return three standard deviations of a counted rate."""
    return 3 * float(np.sqrt(rate * (1 - rate) / count))


@pytest.mark.parametrize("tau", [0.0, 2e-6])
def test_false_alarms_and_coverage_without_a_step(tau: float) -> None:
    rng, count = np.random.default_rng(1), 100
    found = [model_of(series(rng, 16, tau)) for _ in range(count)]
    assert np.mean([bool(each.steps) for each in found]) <= 0.05 + bound(0.05, count)
    assert np.mean([bool(each.departing) for each in found]) <= 0.02 + bound(0.02, count)
    covered = np.mean([each.trend[1] <= SLOPE <= each.trend[2] for each in found])
    assert covered >= 0.95 - bound(0.95, count)


def test_a_step_of_four_standard_deviations_is_found_where_it_is_with_its_size() -> None:
    rng, count, n = np.random.default_rng(2), 60, 36
    hits, within, covered = 0, 0, 0
    for _ in range(count):
        values = series(rng, n, 1e-6, size=4.0, after=20)
        steps = model_of(values).steps
        hits += bool(steps)
        for step in steps[:1]:
            within += step.first < 20 <= step.last
            true = 4 * np.sqrt(np.mean(values.u**2) + 1e-12)
            covered += abs(step.size - true) <= step.half_width
    assert hits >= (0.9 - bound(0.9, count)) * count
    assert within >= (0.95 - bound(0.95, hits)) * hits
    assert covered >= (0.9 - bound(0.9, hits)) * hits


@pytest.mark.parametrize(("count", "days"), [(24, 60.0), (24, 180.0), (40, 60.0)])
def test_runs_that_are_alike_make_no_steps_and_no_trend(count: int, days: float) -> None:
    rng, tries = np.random.default_rng(6), 40
    found = [model_of(alike(rng, count, 3e-6, days)) for _ in range(tries)]
    # with independent runs: steps in half of them and more, trends covered in two thirds and fewer
    assert np.mean([bool(each.steps) for each in found]) <= 0.05 + bound(0.05, tries)
    covered = np.mean([each.trend[1] <= SLOPE <= each.trend[2] for each in found])
    assert covered >= 0.9 - bound(0.9, tries)
    assert np.median([0.0 if each.fit is None else each.fit.duration for each in found]) > 0


def test_a_step_of_six_standard_deviations_is_found_among_runs_that_are_alike() -> None:
    rng, tries = np.random.default_rng(7), 20
    found = [model_of(alike(rng, 36, 1e-6, 30.0, size=6.0)) for _ in range(tries)]
    assert np.mean([any(abs(step.index - 18) <= 1 for step in each.steps) for each in found]) >= 0.8


def test_several_steps_are_detected_and_a_single_departure_is_not() -> None:
    rng = np.random.default_rng(3)
    found = []
    for _ in range(20):
        values = series(rng, 45, 0.5e-6)
        y = values.value + 12e-6 * (np.arange(45) >= 15) - 12e-6 * (np.arange(45) >= 30)
        y[22] += 20e-6
        found.append(model_of(Series(values.time, y, values.u)))
    counts = [(len(each.steps), each.departing) for each in found]
    assert np.mean([count == (2, (22,)) for count in counts]) >= 0.75  # exactly: some have a false one beside
    assert all({step.index for step in each.steps} & {14, 15, 16} for each in found)


def test_a_step_between_equal_times_is_not_sought() -> None:
    t = np.repeat([0.0, 1.0, 2.0], 4) * YEAR
    y = np.where(np.arange(12) >= 6, 50e-6, 0.0)
    steps = model_of(Series(t, y + 1e-7 * np.arange(12) % 3, np.full(12, 1e-6))).steps
    assert all(step.index in (4, 8) for step in steps)


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_no_step_is_reported_for_few_values(count: int) -> None:
    values = series(np.random.default_rng(4), count, 0.0)
    found = model_of(values)
    assert found.steps == ()
    assert (found.fit is None) == (count <= 2)
    assert np.isfinite(chart(values, found).upper).all()


@pytest.mark.parametrize("kind", ["constant", "alternating", "huge", "one time", "tiny", "mixed", "all shared"])
@pytest.mark.parametrize("count", [3, 7, 12])
def test_any_series_is_evaluated(count: int, kind: str) -> None:
    rng = np.random.default_rng(2)
    t, u, y = np.sort(rng.uniform(0, YEAR, count)), np.full(count, 1e-6), 1e-6 * rng.normal(size=count)
    F, identities = np.zeros((0, count)), list[str]()
    if kind == "constant":
        y[:] = 5e-6
    elif kind == "alternating":
        y = 1e-6 * (np.arange(count) % 2)
    elif kind == "huge":
        y *= 1e9
    elif kind == "one time":
        t[:] = t[0]
    elif kind == "tiny":
        u[:] = 1e-15
    elif kind == "mixed":
        u = 10.0 ** rng.uniform(-12, -3, count)
    else:
        F, identities = u[None].copy(), ["bar"]
    values = Series(t, y, u, F, identities)
    found = model_of(values)
    limits = chart(values, found)
    assert (limits.upper >= limits.lower).all()
    assert (found.fit is None) == (kind == "one time")
    assert all(step.first < step.index <= step.last for step in found.steps)
    assert kind != "constant" or found.steps == ()


def test_a_shared_source_shifts_the_constant_and_not_the_trend() -> None:
    values = series(np.random.default_rng(5), 20, 0.0, shared=50e-6)
    alone = Series(values.time, values.value, np.sqrt(values.u**2 - 50e-6**2))
    X = np.column_stack([np.ones(20), values.years])
    shared, without = (fit_runs(X, each.value, each.covariance) for each in (values, alone))
    assert shared is not None
    assert without is not None
    assert shared.parameters[1] == pytest.approx(without.parameters[1], rel=1e-6)
    assert shared.half_width[1] == pytest.approx(without.half_width[1], rel=1e-6)
    assert shared.half_width[0] > 40 * without.half_width[0]
    limits, same = (chart(each, Model(None)) for each in (values, alone))
    assert limits.upper - limits.lower == pytest.approx(same.upper - same.lower, rel=1e-6)


def test_values_in_control_are_outside_of_their_limits_as_often_as_three_sigma_state() -> None:
    rng, count, n = np.random.default_rng(8), 200, 100
    outside = ranges = 0
    for _ in range(count):
        values = series(rng, n, 1e-6, slope=0.0)
        limits = chart(values, Model(None))
        outside += limits.outside(values.value).sum()
        ranges += (limits.moving_range > limits.range_limit).sum()
    stated = 2 * norm.sf(3)
    # tau is estimated: with 60 degrees of freedom three sigma are exceeded 1.4 times as often
    assert stated / 2 <= outside / (count * n) <= 2.5 * stated
    assert ranges / (count * (n - 1)) == pytest.approx(2 * norm.sf(2.606), abs=0.003)


@pytest.mark.parametrize("n", [20, 60])
def test_runs_that_are_alike_are_outside_of_their_limits_as_often_as_three_sigma_state(n: int) -> None:
    outside, count, phi = 0, 100, 0.5
    widths: dict[float, list[float]] = {0.0: [], phi: []}
    for seed in range(count):
        rng = np.random.default_rng([seed, n])
        white = rng.normal(size=n + 100)
        for each, widened in widths.items():
            y = 1e-6 * lfilter([1.0], [1.0, -each], np.sqrt(1 - each**2) * white)[100:]
            values = Series(np.arange(n) * YEAR / 12, y + 0.3e-6 * rng.normal(size=n), np.full(n, 0.3e-6))
            limits = chart(values, Model(None))
            tau = by_moving_ranges(values.value, values.covariance)
            widened.append((limits.upper - limits.centre)[0] / np.sqrt(9 * (tau**2 + 0.3e-6**2) * (1 - 1 / n)))
            outside += limits.outside(values.value).sum() if each == phi else 0
    # by the moving ranges alone 2.5 %; those of 20 runs determine a standard deviation to a fifth
    assert outside / (count * n) < 0.01
    assert np.median(widths[0.0]) == pytest.approx(1.0, abs=1e-6)
    assert np.mean(widths[0.0]) < 1.05
    assert np.mean(widths[phi]) > 1.1


def test_limits_follow_the_uncertainty_of_each_run_and_restart_after_a_step() -> None:
    rng, n = np.random.default_rng(9), 40
    u = np.where(np.arange(n) % 2, 3e-6, 0.5e-6)
    y = u * rng.normal(size=n) + 100e-6 * (np.arange(n) >= 20)
    values = Series(np.arange(n) * YEAR / 12, y, u)
    found = model_of(values)
    assert [step.index for step in found.steps] == [20]
    limits = chart(values, found)
    width = limits.upper - limits.centre
    assert (width[1::2] > 1.5 * width[::2]).all()
    assert np.unique(limits.centre).size == 2
    assert limits.centre[[0, -1]] == pytest.approx([0.0, 100e-6], abs=1e-6)
    assert np.isnan(limits.moving_range[19])
