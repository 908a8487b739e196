"""The tracker beside the virtual machine: what it reads, and the truth less the motion that distances do not see."""

import numpy as np
import pytest

from errormotion import datasets
from errormotion.errors import BenchError
from errormotion.twin import VirtualMachine
from errormotion.twin.multilateration_rawdata import NOISE, REFLECTOR


@pytest.fixture(scope="module")
def machine():
    return VirtualMachine("cframe", seed=2)


def test_readings_are_distances_less_the_dead_path(machine):
    q, U, L = machine.target_grid(), machine.tracker_places(), np.array([0.1, 0.0, 0.2, 0.3])
    raw = machine.raw_multilateration(q, U, seed=1, dead_path=L)
    datasets.validate(raw)
    distance = np.linalg.norm(machine.reflector_places(q) - U[:, None], axis=2)
    left = raw["displacement"].values - (distance - L[:, None])
    # 400 readings: their scatter to 3.5 %.
    assert left.std() == pytest.approx(NOISE, rel=0.15)
    assert abs(left.mean()) < 4 * NOISE / 20


def test_one_seed_gives_one_dataset(machine):
    assert machine.raw_multilateration(seed=1).identical(machine.raw_multilateration(seed=1))
    assert not machine.raw_multilateration(seed=1).identical(machine.raw_multilateration(seed=2))


def test_the_reflector_is_where_the_volume_error_takes_it(machine):
    q = np.array([(0.1, -0.1, 0.2)])
    moved = machine.volumetric_truth(q).em.at(REFLECTOR)
    found = machine.reflector_places(q)[0] - q[0] - REFLECTOR
    np.testing.assert_allclose(found, [float(moved[name].item()) for name in ("EX", "EY", "EZ")], atol=1e-18)


def test_the_truth_has_no_motion_of_the_whole(machine):
    q = machine.target_grid((4, 3, 3))
    truth = machine.truth_multilateration(q)
    error = np.stack([truth[name].values for name in ("EX", "EY", "EZ")], axis=-1)
    assert np.abs(error.mean(axis=0)).max() < 1e-18
    assert np.abs(np.cross(q - q.mean(axis=0), error).mean(axis=0)).max() < 1e-17
    assert error.std() > 1e-6


def test_broken_beams_and_drift_are_as_asked(machine):
    still, broken = (machine.raw_multilateration(seed=3, missing=share) for share in (0.0, 0.3))
    assert not np.isnan(still["displacement"]).any()
    assert float(np.isnan(broken["displacement"]).mean()) == pytest.approx(0.3, abs=0.1)
    drifting = machine.raw_multilateration(seed=3, drift=np.array([(1e-7, 0, 0, 0)] + [(0, 0, 0, 0)] * 3))
    time = still["reading_time"].values[0]
    difference = (drifting["displacement"] - still["displacement"]).values
    np.testing.assert_allclose(difference[0], 1e-7 * (time - time.mean()), atol=1e-12)
    assert not difference[1:].any()


def test_targets_out_of_the_travel_are_refused(machine):
    with pytest.raises(BenchError, match=r"Axis Z travels from 0 to 0\.46 m"):
        machine.raw_multilateration([[0.0, 0.0, 0.5]], seed=1)
