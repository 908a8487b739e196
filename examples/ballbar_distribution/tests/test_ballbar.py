"""The method passes the kit; its parameters, figures and their uncertainties are correct."""

import numpy as np
import pytest
from ballbar_test import circles, evaluation, extremes, simulation
from ballbar_test.conformance import subjects
from ballbar_test.method import Ballbar
from ballbar_test.path import PARAMETERS, basis, circle
from ballbar_test.simulation import Machine
from scipy import stats

from errormotion.errors import MethodError
from errormotion.testing import MethodConformance

SMALL = {"samples": 540, "places": 60}
SEEDS = 150
FALSE_ALARM = 1e-3


class TestBallbar(MethodConformance):
    subject = subjects()[0]


def silent(machine):
    """Return the result of a test without noise, bar errors, set-up error and gaps."""
    chosen = Ballbar.Settings(length_noise=1e-12, length_uncertainty=0.0)
    raw = simulation.measure(chosen, machine, Quiet())
    return Ballbar().identify(raw, chosen)


class Quiet:
    """A random generator that draws the mean."""

    def standard_normal(self, size=None):
        return np.zeros(size) if size is not None else 0.0

    def random(self, size=None):
        return np.full(size, 0.5)


R, V = 0.15, 1 / 60
ONE_ERROR = {
    "squareness": (Machine(squareness=40e-6), 40e-6, 40e-6 * R, 0.0),
    "scale_mismatch": (Machine(scale=(30e-6, -10e-6)), 40e-6, 40e-6 * R, 0.0),
    "servo_mismatch": (Machine(lag=(0.5e-3, 0.1e-3)), 0.4e-3, 0.4e-3 * V, 0.4e-3 * V),
    "backlash_1": (Machine(backlash=(4e-6, 0.0)), 4e-6, None, 4e-6),
    "backlash_2": (Machine(backlash=(0.0, 4e-6)), 4e-6, None, 4e-6),
    "bow_1": (Machine(bow=(3e-6, 0.0)), 3e-6, 1.5e-6, 0.0),
    "bow_2": (Machine(bow=(0.0, 3e-6)), 3e-6, 1.5e-6, 0.0),
    "spike_1": (Machine(spike=(5e-6, 0.0), spike_decay=np.radians(3)), 5e-6, None, None),
    "spike_2": (Machine(spike=(0.0, 5e-6), spike_decay=np.radians(3)), 5e-6, None, None),
}


@pytest.mark.parametrize("name", PARAMETERS)
def test_each_error_is_found_and_makes_the_deviation_of_its_formula(name):
    """G and H of one error agree with its formula within 1 %, for the average of a sector and the second order."""
    machine, size, g, h = ONE_ERROR[name]
    errors = silent(machine)
    found = dict(zip(PARAMETERS, errors["parameters"].values, strict=True))
    assert found.pop(name) == pytest.approx(size, rel=1e-3)
    lengths = {"squareness": R, "scale_mismatch": R, "servo_mismatch": V}
    assert max(abs(value) * lengths.get(other, 1.0) for other, value in found.items()) < 2e-9
    figures = dict(zip(extremes.NAMES, errors["figures"].values, strict=True))
    if g is not None:
        assert figures["G(CCW)"] == pytest.approx(g, rel=0.01)
    if h is not None:
        assert figures["H"] == pytest.approx(h, rel=0.01, abs=2e-9)


@pytest.fixture(scope="module")
def tests():
    """Return the errors of parameters and figures by their standard uncertainty, (seed, n) each."""
    settings = Ballbar.Settings(**SMALL)
    ratios = {"parameters": [], "figures": []}
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        machine = simulation.draw_machine(settings, rng)
        raw = simulation.measure(settings, machine, rng, missing=simulation.MISSING)
        found = evaluation.evaluate(circles.read(raw, []), settings, [])
        u = np.sqrt(np.diagonal(found.parameter_covariance))
        ratios["parameters"].append((found.parameters - machine.parameters) / u)
        true = extremes.evaluate(machine.path(settings))
        ratios["figures"].append((found.figures.value - true) / found.figures.u)
    return {name: np.array(values) for name, values in ratios.items()}


def test_intervals_of_the_parameters_hold_the_truth(tests):
    held = (np.abs(tests["parameters"]) <= 1.96).sum(axis=0)
    low, high = stats.binom.ppf([FALSE_ALARM / 20, 1 - FALSE_ALARM / 20], SEEDS, 0.95)
    assert dict(zip(PARAMETERS, (held >= low) & (held <= high), strict=True)) == dict.fromkeys(PARAMETERS, True)
    # Half of all squares, so that a covariance that is too large by a third is also detected.
    assert 0.8 < np.mean(tests["parameters"] ** 2) < 1.2


def test_intervals_of_the_figures_hold_the_truth(tests):
    """Extreme values are not normal variables; two standard uncertainties contain the truth in 95 % of tests."""
    held = (np.abs(tests["figures"]) <= 2).sum(axis=0)
    low = stats.binom.ppf(FALSE_ALARM / 7, SEEDS, 0.95)
    assert dict(zip(extremes.NAMES, held >= low, strict=True)) == dict.fromkeys(extremes.NAMES, True)
    assert (np.mean(tests["figures"] ** 2, axis=0) > 0.4).all()  # and the uncertainty is not much too large


@pytest.mark.parametrize("decay", [1.0, 3.0])
def test_a_spike_is_not_reduced_by_the_width_of_a_sector(decay):
    """G, H and F of the path itself: the mean over 2 degrees of a spike of 3 degrees is a quarter smaller."""
    settings = Ballbar.Settings()
    machine = Machine(spike=(6e-6, 4e-6), backlash=(1e-6, 1e-6), spike_decay=np.radians(decay))
    true = extremes.evaluate(machine.path(settings))
    held, seeds = np.zeros(len(true)), 40
    for seed in range(seeds):
        raw = simulation.measure(settings, machine, np.random.default_rng(seed))
        found = Ballbar().identify(raw, settings)
        u = np.sqrt(np.diagonal(found["figure_covariance"].values))
        held += np.abs(found["figures"].values - true) <= 2 * u
    low = stats.binom.ppf(FALSE_ALARM / 7, seeds, 0.95)
    assert dict(zip(extremes.NAMES, held >= low, strict=True)) == dict.fromkeys(extremes.NAMES, True)


@pytest.mark.parametrize(("path", "size"), [("flat", 0.0), ("ellipse", 20.0), ("spikes", 20.0)])
def test_noise_does_not_make_the_figures_larger(path, size):
    """The range of noisy values is too large by several standard deviations; the stated figure is not."""
    places, rng = 180, np.random.default_rng(5)
    angle = np.arange(places) * 2 * np.pi / places
    shape = {"flat": 0 * angle, "ellipse": np.cos(2 * angle) / 2, "spikes": (np.arange(places) % 45 == 0) * 1.0}[path]
    true = extremes.evaluate(np.array([size * shape] * 2))
    plain, stated, u = [], [], []
    for _ in range(40):
        noisy = size * shape + rng.standard_normal((2, places))
        found = extremes.figures(noisy, np.ones((2, places)), np.zeros((0, 2, places)))
        plain.append(extremes.evaluate(noisy) - true)
        stated.append(found.value - true)
        u.append(found.u)
    for name in ("G(CCW)", "G(CW)", "G(b)"):
        k = extremes.NAMES.index(name)
        assert np.mean(plain, axis=0)[k] > 3
        assert abs(np.mean(stated, axis=0)[k]) < 1
        assert np.mean(np.abs(np.array(stated)[:, k]) <= 2 * np.array(u)[:, k]) > 0.85


def test_the_plan_is_at_the_bound_of_cramer_and_rao():
    """Averaging by sectors costs 1 %, and 10 % for the spikes, which decay within two sectors.

    The bound is that of all readings for the parameters in addition to radius, offset and drift.
    """
    settings = Ballbar.Settings()
    planned = Ballbar().plan(settings)
    raw = simulation.measure(settings, Machine(), np.random.default_rng(0))
    angle = raw["angle"].values.ravel()
    sense = np.repeat([1.0, -1.0], angle.size // 2)
    drift = raw["reading_time"].values.reshape(-1, 1)
    path = basis(angle, sense, settings.nominal_radius, settings.feed, settings.spike_decay)
    design = np.hstack([path, circle(angle), drift])
    scale = np.linalg.norm(design, axis=0)
    bound = np.diagonal(np.linalg.inv((design / scale).T @ (design / scale)))[: len(PARAMETERS)]
    bound = settings.length_noise * np.sqrt(bound) / scale[: len(PARAMETERS)]
    ratio = np.sqrt(np.diagonal(planned["parameter_covariance"].values)) / bound
    assert (ratio > 0.999).all(), ratio
    assert (ratio < [1.1 if "spike" in name else 1.01 for name in PARAMETERS]).all(), ratio


def test_the_plan_is_the_covariance_of_the_result():
    settings = Ballbar.Settings(**SMALL)
    planned = Ballbar().plan(settings)
    found = Ballbar().identify(Ballbar.simulate(settings, 1)[0], settings)
    np.testing.assert_allclose(planned["noise_u"].values.mean(), found["noise_u"].values.mean(), rtol=0.02)
    np.testing.assert_allclose(
        np.sqrt(planned["deviation_variance"].values.mean()),
        np.sqrt(found["deviation_variance"].values.mean()),
        rtol=0.05,
    )


def test_a_path_beyond_the_model_enlarges_the_uncertainty_of_its_parameters():
    settings = Ballbar.Settings(**SMALL)
    raw, truth = Ballbar.simulate(settings, 2, machine=Machine(squareness=20e-6, lobes=1e-6))
    errors = Ballbar().identify(raw, settings)
    assert any("errors beyond the model" in note for note in errors.attrs["notes"])
    u = np.sqrt(np.diagonal(errors["parameter_covariance"].values))
    assert (np.abs(errors["parameters"].values - truth["parameters"].values) < 4 * u).all()
    assert float(errors["misfit"]) > 10


def test_more_scatter_than_stated_is_reported_and_used():
    settings = Ballbar.Settings(**SMALL, length_noise=1e-6)
    raw = Ballbar.simulate(settings, 3)[0]
    raw["length_noise"] = raw["length_noise"].copy(data=0.2e-6)
    errors = Ballbar().identify(raw, settings)
    assert float(errors["reading_noise"]) == pytest.approx(1e-6, rel=0.15)
    assert "Readings scatter by" in errors.attrs["notes"][0]


def test_one_circle_in_each_direction_leaves_the_drift_open():
    settings = Ballbar.Settings(**SMALL, runs=1)
    errors = Ballbar().identify(Ballbar.simulate(settings, 4)[0], settings)
    assert np.isnan(float(errors["drift"]))
    assert "A drift of the bar is not determined" in errors.attrs["notes"][0]


def test_arcs_are_refused():
    raw = Ballbar.simulate(Ballbar.Settings(**SMALL), 5)[0]
    raw["length"] = raw["length"].where(np.mod(raw["angle"], 2 * np.pi) < 4)
    with pytest.raises(MethodError, match=r"expected a full circle .* found one of 12\d degrees"):
        Ballbar().identify(raw, Ballbar.Settings(**SMALL))


def test_directions_and_axes_have_their_names():
    raw = Ballbar.simulate(Ballbar.Settings(**SMALL), 6)[0]
    with pytest.raises(MethodError, match="expected the labels CCW and CW; found left, right"):
        Ballbar().identify(raw.assign_coords(direction_of_travel=["left", "right"]))
    with pytest.raises(MethodError, match="in the order X Y, Y Z or Z X; found Y X"):
        Ballbar().identify(raw.assign_coords(axis=["Y", "X"]))
