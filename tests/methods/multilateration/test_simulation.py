"""Tracker of the virtual machine: its readings, and the true errors without the undetermined rigid motion."""

import numpy as np
import pytest
from coded import raises
from scipy.stats import chi2

from errormotion import datasets
from errormotion.methods.multilateration import Multilateration, MultilaterationSettings, simulation
from errormotion.methods.multilateration.simulation import NOISE, REFLECTOR
from errormotion.twin import VirtualMachine


@pytest.fixture(scope="module")
def machine():
    return VirtualMachine("cframe", seed=2)


def test_readings_are_distances_minus_the_dead_path(machine):
    q, U, L = simulation.target_grid(machine), simulation.stations(machine), np.array([0.1, 0.0, 0.2, 0.3])
    raw = simulation.raw(machine, q, U, seed=1, dead_path=L)
    datasets.validate(raw)
    distance = np.linalg.norm(simulation.reflector_positions(machine, q) - U[:, None], axis=2)
    left = raw["displacement"].values - (distance - L[:, None])
    # 400 readings: their scatter to 3.5 %.
    assert left.std() == pytest.approx(NOISE, rel=0.15)
    assert abs(left.mean()) < 4 * NOISE / 20


def test_a_seed_is_reproducible(machine):
    assert simulation.raw(machine, seed=1).identical(simulation.raw(machine, seed=1))
    assert not simulation.raw(machine, seed=1).identical(simulation.raw(machine, seed=2))


def test_the_reflector_is_displaced_by_the_volumetric_error(machine):
    q = np.array([(0.1, -0.1, 0.2)])
    moved = machine.volumetric_truth(q).em.at(REFLECTOR)
    found = simulation.reflector_positions(machine, q)[0] - q[0] - REFLECTOR
    np.testing.assert_allclose(found, [float(moved[name].item()) for name in ("EX", "EY", "EZ")], atol=1e-18)


def test_the_true_errors_have_no_rigid_motion(machine):
    q = simulation.target_grid(machine, (4, 3, 3))
    truth = simulation.true_errors(machine, q)
    error = np.stack([truth[name].values for name in ("EX", "EY", "EZ")], axis=-1)
    assert np.abs(error.mean(axis=0)).max() < 1e-18
    assert np.abs(np.cross(q - q.mean(axis=0), error).mean(axis=0)).max() < 1e-17
    assert error.std() > 1e-6


def test_broken_beams_and_drift_are_as_stated(machine):
    still, broken = (simulation.raw(machine, seed=3, missing=share) for share in (0.0, 0.3))
    assert not np.isnan(still["displacement"]).any()
    assert float(np.isnan(broken["displacement"]).mean()) == pytest.approx(0.3, abs=0.1)
    drifting = simulation.raw(machine, seed=3, drift=np.array([(1e-7, 0, 0, 0)] + [(0, 0, 0, 0)] * 3))
    time = still["reading_time"].values[0]
    difference = (drifting["displacement"] - still["displacement"]).values
    np.testing.assert_allclose(difference[0], 1e-7 * (time - time.mean()), atol=1e-12)
    assert not difference[1:].any()


def test_targets_out_of_the_travel_are_refused(machine):
    with raises("simulation.targets.outside_travel"):
        simulation.raw(machine, [[0.0, 0.0, 0.5]], seed=1)


def test_the_layout_of_the_settings_is_simulated_with_its_true_errors():
    settings = MultilaterationSettings(layout={"count": (4, 4, 3), "reflector": ("20 mm", "0 mm", "-80 mm")})
    raw, truth = Multilateration.simulate(settings, 4)
    datasets.validate(raw)
    assert raw["displacement"].shape == (4, 48)
    np.testing.assert_array_equal(raw["reflector"].values[0], settings.layout.reflector)
    errors = Multilateration().identify(raw, settings)
    for name in ("EX", "EY", "EZ"):
        u = np.sqrt(errors["covariance"].sel(dof=name, dof_=name).values)
        assert np.abs(errors[name].values - truth[name].values).max() < 5 * u.max()


def test_simulated_data_contain_all_sources_that_the_result_states():
    """The size of the volume along X: 40 independent draws of expansion, air and tracker, far above the noise."""
    settings = MultilaterationSettings(
        scale_uncertainty=3e-6,
        air={"temperature_uncertainty": 2.0},
        expansion={"coefficient": 11.5e-6, "temperature": 24.0, "temperature_uncertainty": 0.5},
        parametric=False,
    )
    square, groups = [], {}
    for seed in range(40):
        raw, truth = Multilateration().simulate(settings, seed)
        found = Multilateration().identify(raw, settings)
        x = found["x"].values - found["x"].values.mean()
        F = found["influence"].values[..., 0]
        own = found["covariance"].values[:, 0, 0] - (F**2).sum(axis=0)
        off = x @ (found["EX"].values - truth["EX"].values)
        square.append(off**2 / (np.sum((F @ x) ** 2) + x**2 @ own))
        for group, effect in zip(found["source_group"].values, np.abs(F @ x), strict=True):
            groups[group] = max(groups.get(group, 0.0), effect)
    assert min(groups[name] for name in ("refraction", "scale of the tracker", "scales")) > groups["stations"]
    assert 1e-3 < chi2.cdf(np.sum(square), 40) < 1 - 1e-3
