"""Readings that are rounded, or whose noise is correlated: intervals still hold the truth, and a note says why."""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest
import xarray as xr
from coded import raises

from errormotion.datasets import provenance
from errormotion.measurement import Block, Noise, Observed, Places, Problem
from errormotion.measurement.identification import dataset, solve
from tests.measurement.test_model import Drift, DriftSettings
from tests.measurement.test_solution import POSITION, SLOPE, N, observed

METHOD = Drift()
STEP = 1e-6


def rounded(seed: int, noise: float, step: float, *, stated: bool) -> tuple[xr.Dataset, xr.Dataset, DriftSettings]:
    settings = DriftSettings(times=12, repeats=5, noise=noise, gain=0.002)
    raw, truth = METHOD.simulate(settings, seed)
    values = raw["reading"].values + np.random.default_rng(seed).uniform(0, 10 * STEP)
    if step:
        values = np.round(values / step) * step
    raw["reading"] = raw["reading"].copy(data=values)
    return (raw if stated else raw.drop_vars("reading_noise")), truth, settings


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize(("noise", "noted"), [(0.05e-6, True), (0.2e-6, True), (1e-6, False)])
def test_rounding_is_part_of_the_uncertainty_where_the_noise_is_smaller(
    noise: float, noted: bool, stated: bool
) -> None:
    inside, notes, seeds = [], 0, 60
    for seed in range(seeds):
        raw, truth, settings = rounded(seed, noise, STEP, stated=stated)
        errors = METHOD.identify(raw, settings)
        off = (errors["EZ"] - truth["EZ"]).values[1:]
        inside.append(np.abs(off) <= 1.96 * np.sqrt(errors["covariance"].values[1:, 2, 2]))
        notes += any("multiples of 1 um" in note for note in errors.em.notes)
    assert np.mean(inside) > 0.93
    assert notes >= 0.9 * seeds if noted else notes == 0


def test_unrounded_readings_have_no_step_and_small_steps_change_nothing() -> None:
    fine, _, settings = rounded(1, 0.5e-6, 1e-9, stated=True)
    plain, _, _ = rounded(1, 0.5e-6, 0.0, stated=True)
    one, other = METHOD.identify(fine, settings), METHOD.identify(plain, settings)
    assert one["covariance"].values == pytest.approx(other["covariance"].values, rel=1e-3, nan_ok=True)
    assert one.em.notes == other.em.notes


def test_readings_without_scatter_and_without_a_step_are_refused() -> None:
    raw, _, settings = rounded(1, 0.01e-6, STEP, stated=False)
    raw["reading"] = raw["reading"] * 0 + 3e-6
    with raises("readings.noise.unknown"):
        METHOD.identify(raw, settings)


def test_the_next_mark_of_the_scale_is_no_outlier() -> None:
    """One of five repeats is rounded up: against four without scatter it would be one."""
    raw, _, settings = rounded(1, 0.01e-6, STEP, stated=False)
    raw["reading"][3, 2] += STEP
    errors = METHOD.identify(raw, settings)
    assert not errors["left_out"].values.any()
    raw["reading"][3, 2] += 30 * STEP
    assert np.argwhere(METHOD.identify(raw, settings)["left_out"].values).tolist() == [[3, 2]]


def along(seed: int, phi: float, noise: float = 0.5e-6) -> np.ndarray:
    rng = np.random.default_rng(seed)
    e = rng.standard_normal(N)
    for k in range(1, N):
        e[k] = phi * e[k - 1] + np.sqrt(1 - phi**2) * e[k]
    return np.asarray(rng.normal(0, SLOPE) * POSITION + noise * e)


@pytest.mark.parametrize(("phi", "least"), [(0.0, 0.92), (0.8, 0.88)])
def test_correlated_noise_along_an_order_is_part_of_the_uncertainty(phi: float, least: float) -> None:
    inside, blind, notes, seeds = 0, 0, 0, 60
    for seed in range(seeds):
        model = observed(along(seed, phi), 0.5e-6)
        white, solved = solve(model), solve(replace(model, order=POSITION))
        for which in (white, solved):
            u = np.sqrt(which.relative.errors.covariance[0, 0, 0])
            held = abs(which.relative.errors.value[0, 0]) <= 1.96 * u
            inside, blind = (inside + held, blind) if which is solved else (inside, blind + held)
        notes += any("correlated" in note for note in solved.observed.notes)
    assert inside / seeds > least
    if phi:
        assert blind / seeds < 0.75
        assert notes > 0.8 * seeds
    else:
        assert notes <= 0.05 * seeds


def test_a_correlation_over_most_of_the_test_doubts_an_estimated_noise() -> None:
    strong = solve(replace(observed(along(3, 0.97), None), order=POSITION))
    assert any("may be too small" in note for note in strong.observed.doubts)
    assert not any(solve(replace(observed(along(3, 0.0), None), order=POSITION)).observed.doubts)


def test_a_noise_that_is_stated_wrongly_is_no_correlation() -> None:
    """Noise of a third and of three times the stated size, 60 series each; the note has a probability of 1 %."""
    for stated in (0.5e-6 / 3, 1.5e-6):
        found = [solve(replace(observed(along(seed, 0.0), stated), order=POSITION)) for seed in range(60)]
        assert sum(any("correlated" in note for note in each.observed.notes) for each in found) <= 4


def test_expected_readings_show_no_correlation() -> None:
    exact = solve(replace(observed(np.zeros(N), 0.5e-6), order=POSITION))
    assert exact.observed.correlation == 0.0
    assert exact.relative.errors.own == pytest.approx(solve(observed(np.zeros(N), 0.5e-6)).relative.errors.own)


def test_doubts_are_those_of_the_result() -> None:
    raw, _, settings = rounded(1, 1e-6, 0.0, stated=True)
    raw["reading_noise"] = raw["reading_noise"] / 5
    errors = METHOD.identify(raw, settings)
    assert not errors.em.doubts  # the uncertainties are increased
    model = METHOD.observe(raw, settings)
    unchanged = solve(replace(model, noise_increases=False, robust=False))
    result = dataset(METHOD, unchanged, raw, METHOD.info, provenance.make(settings, raw, None, steps=["test"]))
    assert any("the stated noise is used" in note for note in result.em.doubts)


class Levels(NamedTuple):
    level: Any


def curve(further: float, seed: int) -> tuple[Observed, np.ndarray]:
    """Return three readings for the three errors of each of 60 instants of a warm-up, and the true errors."""
    n, noise, rng = 60, 3e-9, np.random.default_rng(seed)
    time = 30.0 * np.arange(n)
    true = (1 - np.exp(-time / 600.0))[:, None] * np.array([1e-6, 3e-6, 20e-6])
    e = rng.standard_normal((n, 3))
    for k in range(1, n):
        e[k] = 0.8 * e[k - 1] + 0.6 * e[k]
    index = np.arange(n)
    problem = Problem(
        equation=lambda y, x, _: y - x.level,
        readings=true + noise * (rng.standard_normal((n, 3)) + further * e),
        unknowns=Levels(Block(start=np.zeros((n, 3)), index=index, scale=1.0, group="level")),
        noise=Noise(sd=np.full((n, 3), noise)),
    )
    model = Observed(
        problem=problem,
        places=Places(lambda x, _: x.level, n, rows={"level": index}),
        freedoms=("EX", "EY", "EZ"),
        dims=("time",),
        coords={"time": ("time", time, {"units": "s"})},
        component="tool",
        functional_point=(0, 0, 0),
        reference="none",
        order=time,
        robust=False,
    )
    return model, true


def test_noise_of_readings_that_nothing_checks_is_found_by_their_order() -> None:
    inside, doubted, false = [], 0, 0
    for seed in range(20):
        model, true = curve(2.0, seed)
        solved = solve(model)
        errors = solved.relative.errors
        u = np.sqrt(np.diagonal(errors.covariance, axis1=1, axis2=2))
        inside.append(np.abs(errors.value - true) <= 1.96 * u)
        doubted += any("alike for about" in each for each in solved.observed.doubts)
        false += any("alike for about" in each for each in solve(curve(0.0, seed)[0]).observed.doubts)
    assert np.mean(inside) > 0.9
    assert doubted >= 18
    assert false <= 3
