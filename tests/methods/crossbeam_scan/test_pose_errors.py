"""The pose of the profiler as an error dataset."""

import numpy as np
import pytest
from coded import raises
from scipy.spatial.transform import RigidTransform

from errormotion import datasets
from errormotion.kinematics.poses import displacement
from errormotion.methods.crossbeam_scan import CrossbeamScan, simulation
from errormotion.methods.crossbeam_scan.identification.profiler_pose import calibration
from errormotion.methods.crossbeam_scan.identification.profiler_pose.pose_errors import stated_covariance, stated_pose
from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings, PoseSettings
from errormotion.twin import VirtualMachine
from errormotion.twin.sensors.profiler import Profiler

NOMINAL = RigidTransform.from_translation([0.0, 0.0, -0.17])
SETTINGS = CrossbeamScanSettings(profiler_pose=PoseSettings(dz=-0.17))
SEEDS = range(8)


def identify(raw, settings=SETTINGS):
    return CrossbeamScan().identify(raw, settings)


@pytest.fixture(scope="module")
def raws():
    """Scans of the pocket on a few machines, with those."""
    machines = [VirtualMachine("gantry", seed=seed) for seed in SEEDS]
    profiler = Profiler(800, 50e-6)
    return [(machine, simulation.raw_pocket(machine, seed=machine.seed, profiler=profiler)) for machine in machines]


@pytest.fixture(scope="module")
def found(raws):
    """The pose on each."""
    return [identify(raw) for _, raw in raws]


def test_truth_lies_within_the_stated_uncertainty(raws, found):
    squares = []
    for (machine, _), ds in zip(raws, found, strict=True):
        true = RigidTransform.from_matrix(machine.crossbeam.pose)
        miss = ds.em.twist().values[0] - displacement(true * NOMINAL.inv(), NOMINAL.translation)
        unit = np.array([1e-6] * 3 + [1e-5] * 3)
        C = ds["covariance"].values[0] / np.outer(unit, unit)
        squares.append((miss / unit) @ np.linalg.solve(C, miss / unit) / 6)
    # eight machines by six freedoms: 1 +- 0.2
    assert 0.4 < np.mean(squares) < 1.7


def test_pose_and_covariance_are_those_of_the_calibration(raws, found):
    for (_, raw), ds in zip(raws[:2], found, strict=False):
        known = calibration.calibrate_dataset(raw)
        np.testing.assert_array_equal(ds["profiler_pose"].values, known.matrix)
        np.testing.assert_array_equal(ds["pose_covariance"].values, known.covariance)
        assert float(ds["pocket_radius_found"]) == known.radius
        assert ds.attrs["lines_used"] == known.lines


def test_errors_transform_the_nominal_pose_to_the_found_one(found):
    ds = found[0]
    H = RigidTransform.from_matrix(ds["profiler_pose"].values)
    assert ds["nominal_pose"].values == pytest.approx(NOMINAL.as_matrix())
    np.testing.assert_array_equal(ds.attrs["functional_point"], NOMINAL.translation)
    off = ds.em.twist().values[0]
    # small: some millimetres and milliradians; the next order is their product
    assert off[:3] == pytest.approx(H.translation - NOMINAL.translation, abs=1e-4)
    assert off[3:] == pytest.approx(H.rotation.as_rotvec(), abs=1e-4)
    assert np.abs(off[:3]).max() > 1e-4


def test_covariance_is_that_of_small_changes_of_the_parameters(found):
    ds = found[0]
    p = calibration.parameters(RigidTransform.from_matrix(ds["profiler_pose"].values))
    rng = np.random.default_rng(1)
    draws = rng.multivariate_normal(np.zeros(6), ds["pose_covariance"].values, 4000)
    twists = displacement(calibration.pose(*(p + draws).T) * NOMINAL.inv(), NOMINAL.translation)
    u = np.sqrt(np.diag(ds["covariance"].values[0]))
    # 4000 draws: a standard deviation to 1.1 %, a correlation to 0.016
    sampled = np.cov(twists.T) / np.outer(u, u)
    assert sampled == pytest.approx(ds["covariance"].values[0] / np.outer(u, u), abs=0.08)


def test_default_nominal_pose_has_no_angles_and_rounded_position(raws):
    ds = identify(raws[0][1], CrossbeamScanSettings())
    assert ds["nominal_pose"].values[:3, :3] == pytest.approx(np.eye(3))
    place = ds["nominal_pose"].values[:3, 3] / 0.01
    assert place == pytest.approx(np.round(place), abs=1e-9)
    assert ds["profiler_pose"].values == pytest.approx(identify(raws[0][1])["profiler_pose"].values)


def test_dataset_is_valid_and_survives_a_round_trip(found, tmp_path):
    datasets.validate(found[0])
    assert found[0].attrs["component"] == "beam"
    assert found[0]["beam"].values.tolist() == ["profiler"]
    datasets.save(found[0], tmp_path / "pose.nc")
    again = datasets.load(tmp_path / "pose.nc")
    datasets.validate(again)
    np.testing.assert_array_equal(again["pose_covariance"].values, found[0]["pose_covariance"].values)


def test_found_pose_is_used_for_scans(raws, found):
    machine, _ = raws[0]
    raw = simulation.raw_scans(
        machine, [0.0, 7200.0], [0.0], seed=1, profiles=200, pose=found[0]["profiler_pose"].values
    )
    raw["pose_covariance"] = found[0]["pose_covariance"]
    ds = identify(raw)
    covariance = found[0]["pose_covariance"].values
    assert ds["pose_u"].values == pytest.approx(np.sqrt(np.diag(covariance)))
    assert ds["pose_u"]["pose_parameter"].values.tolist() == ["a", "b", "g", "dx", "dy", "dz"]
    miss = ds.em.twist().values[1, 0] - simulation.truth_axis(machine, [7200.0], [0.0]).em.twist().values[0, 0]
    assert np.all(np.abs(miss) < 4 * np.sqrt(np.diag(ds["covariance"].values[1, 0])))


def test_settings_give_a_pose_and_its_covariance():
    pose = PoseSettings(a=0.01, b=-0.02, g=0.03, dx=0.001, dy=0.002, dz=-0.17, angle_uncertainty=1e-3)
    assert calibration.parameters(stated_pose(pose)) == pytest.approx([0.01, -0.02, 0.03, 0.001, 0.002, -0.17])
    assert np.sqrt(np.diag(stated_covariance(pose))) == pytest.approx([1e-3] * 3 + [5e-3] * 3)


def test_one_lift_is_refused_unless_angles_are_known(raws):
    alone = raws[0][1].isel(scan=[0])
    with raises("scan.pocket.undetermined"):
        identify(alone)
    known = identify(alone, SETTINGS.model_copy(update={"angle_prior": 5e-3}))
    assert np.sqrt(known["pose_covariance"].values[0, 0]) == pytest.approx(5e-3, rel=0.05)
