"""Planted faults: what the result says about each."""

import numpy as np
import pytest
import xarray as xr
from coded import raises
from scipy.spatial.transform import Rotation

from errormotion.errors import MethodError
from errormotion.kinematics.iso import DOF
from errormotion.methods.r_test import RTest, RTestSettings

METHOD, SETTINGS, FOUR = RTest(), RTestSettings(), RTestSettings(spheres=4)


def simulated(seed: int = 0) -> tuple[xr.Dataset, xr.Dataset]:
    return METHOD.simulate(SETTINGS, seed)


def scores(errors: xr.Dataset, truth: xr.Dataset) -> np.ndarray:
    """Return all deviations from the truth in standard uncertainties: error motions, then location errors."""
    off = np.stack([(errors[name] - truth[name]).values for name in DOF], axis=1)
    u = np.sqrt(np.diagonal(errors["covariance"].values, axis1=1, axis2=2))
    line = (errors["location_error"] - truth["location_error"]).values
    v = np.sqrt(np.diag(errors["location_covariance"].values))
    return np.concatenate([(off / u).ravel(), line / v])


def moved(raw: xr.Dataset, sphere: int, first: int, shift: np.ndarray) -> xr.Dataset:
    """Return readings of a sphere that has moved on the table before an angle."""
    raw = raw.copy(deep=True)
    turn = Rotation.from_rotvec(-raw["angle"].values[first:, None] * [0.0, 0.0, 1.0])
    raw["displacement"][first:, sphere] += turn.apply(shift) @ raw["sensor_direction"].values.T
    return raw


def test_valid_readings_have_no_note() -> None:
    for seed in range(4):
        raw, _ = simulated(seed)
        assert METHOD.identify(raw).attrs["notes"] == [""]
        unstated = METHOD.identify(raw.drop_vars("displacement_noise")).attrs["notes"]
        assert unstated == ["The noise of the displacements is not stated, and estimated with 101 degrees of freedom."]


SHIFT = np.array([0.6, -0.64, 0.48])


@pytest.mark.parametrize(("sphere", "first", "size"), [(1, 14, 20e-6), (0, 30, 3e-6)])
def test_a_sphere_of_four_that_moved_is_named_and_excluded(sphere: int, first: int, size: float) -> None:
    raw, truth = METHOD.simulate(FOUR, 0)
    errors = METHOD.identify(moved(raw, sphere, first, size * SHIFT))
    assert f"sphere {sphere + 1} has moved on the table before {10 * first} deg" in errors.attrs["notes"][0]
    assert np.abs(scores(errors, truth)).max() < 4.5
    assert np.square(scores(errors, truth)).mean() < 1.5


@pytest.mark.parametrize("size", [20e-6, 2e-6])
def test_a_sphere_of_three_that_moved_is_refused(size: float) -> None:
    """The other two do not determine the errors."""
    raw, _ = simulated()
    with raises("readings.contradict"):
        METHOD.identify(moved(raw, 1, 14, size * SHIFT))


def test_a_wrong_gain_is_named_and_estimated() -> None:
    raw, truth = simulated()
    raw["displacement"][..., 1] *= 1.1
    errors = METHOD.identify(raw)
    assert "the gain of sensor 2 is not the stated one" in errors.attrs["notes"][0]
    assert np.abs(scores(errors, truth)).max() < 4.5


def test_the_wrong_sense_of_rotation_is_refused() -> None:
    raw, _ = simulated()
    wrong = raw.isel(angle=slice(None, None, -1))
    wrong = wrong.assign_coords(angle=("angle", -wrong["angle"].values, {"units": "rad"}))
    with raises("readings.sense.opposite"):
        METHOD.identify(wrong)
    with raises("readings.sense.opposite"):
        METHOD.identify(wrong.drop_vars("displacement_noise"))


def test_one_wrong_angle_is_found() -> None:
    """2 deg displace a sphere that is 40 um off its place by 1.4 um."""
    raw, truth = simulated()
    angle = raw["angle"].values.copy()
    angle[11] += np.radians(2)
    errors = METHOD.identify(raw.assign_coords(angle=("angle", angle, {"units": "rad"})))
    assert any("110" in note or "112" in note for note in errors.attrs["notes"]), errors.attrs["notes"]
    others = np.r_[:11, 12:36]
    off = np.stack([(errors[name].values - truth[name].values)[others] for name in DOF], axis=1)
    u = np.sqrt(np.diagonal(errors["covariance"].values[others], axis1=1, axis2=2))
    assert np.abs(off / u).max() < 4.5


def test_an_index_that_is_shifted_at_all_angles_is_not_found() -> None:
    """The tilts are turned with it: 3.5 % of them. The method states that it cannot see this."""
    raw, truth = simulated()
    shifted = raw.assign_coords(angle=("angle", raw["angle"].values + np.radians(2), {"units": "rad"}))
    errors = METHOD.identify(shifted)
    assert errors.attrs["notes"] == [""]
    assert any("shifted by the same amount" in text for text in METHOD.info.cannot_see)
    line, true = errors["location_error"].values[2:], truth["location_error"].values[2:]
    assert np.linalg.norm(line - true) == pytest.approx(np.radians(2) * np.linalg.norm(true), rel=0.6)


def test_correlated_noise_of_neighbouring_angles_is_noted_or_refused() -> None:
    seen = 0
    for seed in range(4):
        raw = simulated(seed)[0].drop_vars("displacement_noise").transpose("angle", ...)
        e = np.random.default_rng(seed).standard_normal(raw["displacement"].shape)
        white = METHOD.identify(raw.assign(displacement=raw["displacement"] + 0.3e-6 * e))
        assert not any("correlated" in note for note in white.em.notes)
        for k in range(1, len(e)):
            e[k] = 0.8 * e[k - 1] + 0.6 * e[k]
        try:
            found = METHOD.identify(raw.assign(displacement=raw["displacement"] + 0.3e-6 * e))
        except MethodError as error:  # a slow wave may look like a sphere that moves
            seen += "has moved on the table" in str(error)
        else:
            seen += any("neighbouring displacements is correlated" in note for note in found.em.notes)
    assert seen == 4
