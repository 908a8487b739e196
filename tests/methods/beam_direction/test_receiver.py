"""The side of the receiver: its definition, its statement, and what readings show of it."""

import numpy as np
import pytest
from coded import raises

from errormotion import datasets
from errormotion.datasets.calibrations.inclination import InclinationCalibration
from errormotion.errors import DatasetError, MethodError
from errormotion.kinematics.beams import tilt
from errormotion.methods.beam_direction import BeamDirection, BeamDirectionSettings, simulation
from errormotion.methods.beam_direction.identification.inclination.calibrate import (
    InclinationCalibrationSettings,
    calibrate,
)
from errormotion.twin import VirtualMachine
from errormotion.twin.sensors.point_sensor import RECEIVER

THREE = [np.radians(pair) for pair in ((25.0, 0.0), (35.5, 120.6), (35.5, 239.4))]
TWO = THREE[:2]
BOTH_SIDES = [np.radians(pair) for pair in ((10.0, 0.0), (45.0, 180.0), (35.5, 120.6))]
"""Turned to the receiver, away from it, and across."""
SETTINGS = np.radians(np.arange(-45, 46, 5.0)), np.radians(np.arange(0, 180, 15.0))


@pytest.fixture(scope="module")
def machine():
    return VirtualMachine("cframe", seed=3)


@pytest.fixture(scope="module")
def readings(machine):
    return simulation.raw_inclination(machine, *SETTINGS, seed=1)


@pytest.fixture(scope="module")
def calibration(readings, tmp_path_factory):
    return str(calibrate(readings).save(tmp_path_factory.mktemp("lab") / "sensor.nc"))


def identify(raw, calibration, **settings):
    return BeamDirection().identify(raw, BeamDirectionSettings(compensation=calibration, **settings))


def reversed_normal(raw):
    return raw.assign(triangulation_normal=-raw["triangulation_normal"])


def in_uncertainties(errors, machine):
    """Return the largest error of the beam's angles in standard uncertainties."""
    off = np.asarray(errors.em.twist() - simulation.truth_beam(machine).em.twist())[0, 3:]
    return np.max(np.abs(off) / np.sqrt(np.diag(errors["covariance"].values[0]))[3:])


@pytest.mark.parametrize("seed", range(5))
def test_the_virtual_receiver_is_on_the_stated_side(seed):
    sensor = VirtualMachine("cframe", seed=seed).point_sensor
    u, up = sensor.true_direction, sensor.triangulation_normal
    right = np.cross(u, up)  # of an observer who looks along the beam
    receiver = {"right": right, "left": -right}[RECEIVER]
    lean = np.radians(70.0)  # with 28 deg between beam and receiver, 98 deg or 42 deg
    seen = [sensor.slope(tilt(u, up, -np.cos(lean) * u + np.sin(lean) * side)) for side in (receiver, -receiver)]
    assert np.isfinite(seen).tolist() == [True, False]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("planes", [TWO, THREE])
def test_either_normal_with_its_side_of_the_receiver_gives_the_beam(machine, calibration, planes, seed):
    raw = simulation.raw(machine, planes, seed=seed)
    found = identify(raw, calibration)
    mirrored = identify(reversed_normal(raw).assign_attrs(receiver="left"), calibration)
    np.testing.assert_array_equal(found["beam_direction"], mirrored["beam_direction"])
    assert in_uncertainties(found, machine) < 4


@pytest.mark.parametrize("seed", range(3))
def test_planes_that_contradict_the_side_of_the_receiver_are_refused(machine, calibration, seed):
    raw = simulation.raw(machine, BOTH_SIDES, seed=seed)
    assert in_uncertainties(identify(raw, calibration), machine) < 4
    with raises("beam.receiver.contradicted"):
        identify(reversed_normal(raw), calibration)
    with raises("beam.receiver.contradicted"):
        identify(raw.assign_attrs(receiver="left"), calibration)


@pytest.mark.parametrize("planes", [TWO, THREE])
def test_planes_that_do_not_show_the_side_of_the_receiver_are_noted(machine, calibration, planes):
    raw = simulation.raw(machine, planes, seed=0)
    both = [identify(each, calibration) for each in (raw, raw.assign_attrs(receiver="left"))]
    assert in_uncertainties(both[0], machine) < 4 < in_uncertainties(both[1], machine)
    for errors in both:
        [note] = [note for note in errors.attrs["notes"] if "on which side of the laser" in note]
    turned = np.linalg.norm(np.subtract(*(each["beam_direction"].values[0] for each in both)))
    assert f"{np.degrees(turned) * 3600:.3g} arcsec" in note
    confirmed = identify(simulation.raw(machine, BOTH_SIDES, seed=0), calibration)
    assert not [note for note in confirmed.attrs["notes"] if "on which side" in note]


def test_a_check_bar_that_contradicts_the_side_of_the_receiver_is_refused(machine, calibration):
    sensor = machine.point_sensor
    bar = simulation.raw_check_bar(machine, seed=2).assign(
        nominal_direction=("direction", sensor.true_direction), nominal_origin=("direction", sensor.true_origin)
    )
    identify(bar, calibration)
    with pytest.raises(MethodError, match="check bar contradicts the stated side of the receiver"):
        identify(reversed_normal(bar), calibration)


def test_compensation_without_the_side_of_the_receiver_is_refused_by_name(machine, calibration):
    raw = simulation.raw(machine, THREE, seed=0)
    del raw.attrs["receiver"]
    with pytest.raises(MethodError, match=r"^receiver: expected 'right' or 'left'.*looks along the beam"):
        identify(raw, calibration)
    stated = identify(raw, calibration, receiver="right")
    assert in_uncertainties(stated, machine) < 4
    layout = {"triangulation_normal": (0.0, 1.0, 0.0)}
    method = BeamDirection()
    assert method.check(BeamDirectionSettings(compensation=calibration, receiver="left", layout=layout)) == {}
    assert set(method.check(BeamDirectionSettings(compensation=calibration))) == {
        "receiver",
        "layout.triangulation_normal",
    }


def test_rotations_of_a_calibration_without_their_zero_are_refused_by_name(readings):
    with raises("inclination.receiver.missing"):
        calibrate(readings.drop_vars("receiver_rotation"))
    with raises("inclination.receiver.form"):
        calibrate(readings, InclinationCalibrationSettings(receiver_rotation=np.pi / 2))


def test_rotations_may_be_counted_from_either_side(readings, calibration, tmp_path):
    turned = readings.assign(rotation=readings["rotation"] - np.pi, receiver_rotation=0.0)
    datasets.save(turned, tmp_path / "readings.nc")
    found, expected = calibrate(turned), InclinationCalibration.load(calibration)
    q = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2))
    np.testing.assert_allclose(found.slope(q)[0], expected.slope(q)[0], atol=1e-9)
    assert "counted from the direction away from the receiver" in found.dataset.attrs["notes"]


def test_a_calibration_that_does_not_state_its_rotation_0_is_refused(calibration):
    known = InclinationCalibration.load(calibration).dataset
    with pytest.raises(DatasetError, match=r"'rotation_zero': missing.*errormotion calibrate"):
        InclinationCalibration(known.drop_attrs().assign_attrs({k: v for k, v in known.attrs.items() if k[0] != "r"}))
    with pytest.raises(DatasetError, match="'rotation_zero': expected 'away from the receiver'; found 'any'"):
        InclinationCalibration(known.assign_attrs(rotation_zero="any"))
