"""Smooth curves over position and time: the truth lies in their bands."""

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import RigidTransform

from errormotion.methods.crossbeam_scan.identification import chain
from errormotion.methods.crossbeam_scan.identification.chain import Rig
from errormotion.methods.crossbeam_scan.identification.curves import MOMENTS, curves
from errormotion.methods.crossbeam_scan.identification.profiler_pose import calibration
from errormotion.methods.crossbeam_scan.planning import registration_covariance
from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings
from errormotion.twin import VirtualMachine

PLACES = np.linspace(-0.7, 0.7, 8)
TIMES = 60.0 * np.array([0, 7, 15, 30, 45, 60, 90, 120, 150, 180])
EXACT = {"scale_uncertainty": 0.0, "expansion_uncertainty": 0.0}
POSE_COVARIANCE = np.diag([1e-3, 1e-3, 1e-3, 1e-5, 1e-5, 1e-5]) ** 2
LEVER_UNCERTAINTY = np.full(3, 1e-3)
SHARE = 0.5
SEEDS = range(8)


def campaign(seed, places=PLACES):
    """Return registrations of the twin with the noise that a plan expects, seen by a rig off by its uncertainty."""
    crossbeam, rng = VirtualMachine("gantry", seed=seed).crossbeam, np.random.default_rng(seed)
    pose = RigidTransform.from_matrix(crossbeam.pose)
    W, A = chain.from_maps(pose)[:6], chain.carriage_adjoint(pose, crossbeam.lever)
    C = W @ registration_covariance(CrossbeamScanSettings(**EXACT))[0] @ W.T
    shape = len(TIMES), len(places)
    cold, own = rng.multivariate_normal(np.zeros(6), C, (2, *shape))
    twist = crossbeam.twist(TIMES[:, None], places) @ np.linalg.inv(A).T
    twist = twist + np.sqrt(SHARE) * cold[:1] + np.sqrt(1 - SHARE) * own
    known = np.tile(C, (*shape, 1, 1))
    twist[0], known[0] = 0.0, 0.0
    p = calibration.parameters(pose) + rng.multivariate_normal(np.zeros(6), POSE_COVARIANCE)
    rig = Rig(
        calibration.pose(*p), crossbeam.lever + rng.normal(0, LEVER_UNCERTAINTY), POSE_COVARIANCE, LEVER_UNCERTAINTY
    )
    return crossbeam, twist, known, rig


def drawn(twist, covariance, rig, places=PLACES):
    """Return the curves' values: name to array."""
    extras = curves(twist, covariance, SHARE * covariance, rig, places, TIMES)
    return {name: np.asarray(value[1]) for name, value in extras.items()}


@pytest.fixture(scope="module")
def runs():
    """A handful of campaigns: crossbeam and curves."""
    return [(crossbeam, drawn(*rest)) for crossbeam, *rest in map(campaign, SEEDS)]


def test_truth_lies_in_the_bands_over_position(runs):
    inside = []
    for crossbeam, curve in runs:
        truth = crossbeam.twist(TIMES[1:, None], curve["place"])
        inside.append(np.abs(curve["smooth_position"][1:] - truth) <= 2 * curve["smooth_position_u"][1:])
    assert_about_95_percent(np.array(inside))


def test_truth_lies_in_the_bands_over_time(runs):
    inside = []
    for crossbeam, curve in runs:
        truth = crossbeam.twist(curve["moment"][1:, None], PLACES)
        inside.append(np.abs(curve["smooth_time"][1:] - truth) <= 2 * curve["smooth_time_u"][1:])
    assert_about_95_percent(np.array(inside))


def assert_about_95_percent(inside):
    # Neighbours on a curve share their noise, cycles the cold scan and places the rig: of all these points there are
    # about as many independent ones as campaigns by freedoms by curves of two or three parameters.
    independent = len(SEEDS) * 6 * 4
    low, high = stats.binom.interval(0.998, independent, 0.9545)
    assert low / independent <= inside.mean() <= min(high / independent, 1.0)
    for freedom in np.moveaxis(inside, -1, 0):
        assert freedom.mean() > 0.8


def test_curves_are_more_certain_than_the_points():
    _, twist, covariance, rig = campaign(0)
    _, points = chain.carriage_errors(twist, covariance, rig)
    u = np.sqrt(np.diagonal(points[-1], axis1=-2, axis2=-1))  # (artefact, dof)
    curve = drawn(twist, covariance, rig)
    inner = np.abs(curve["place"]) < 0.5
    assert np.all(curve["smooth_position_u"][-1, inner].mean(axis=0) < u.mean(axis=0))


def test_cold_cycle_is_zero_without_uncertainty(runs):
    for _, curve in runs:
        for name in ("smooth_position", "smooth_position_u"):
            assert not curve[name][0].any()
        assert curve["moment"][0] == 0
        assert not curve["smooth_time"][0].any()
        # before the warm-up all is 0 by definition, the cold scan's noise included
        assert np.all(curve["smooth_time_u"][0] <= curve["smooth_time_u"][1])


def test_curves_have_no_gaps_where_they_are_determined(runs):
    for _, curve in runs:
        assert all(np.isfinite(values).all() for values in curve.values())
        assert curve["smooth_position"].shape == (len(TIMES), curve["place"].size, 6)
        assert curve["smooth_time"].shape == (MOMENTS, len(PLACES), 6)
        assert (curve["place"][0], curve["place"][-1]) == (PLACES[0], PLACES[-1])
        assert curve["moment"][-1] == TIMES[-1]


def test_one_artefact_has_curves_over_time():
    crossbeam, *rest = campaign(1, PLACES[3:4])
    curve = drawn(*rest, places=PLACES[3:4])
    truth = crossbeam.twist(curve["moment"][:, None], PLACES[3:4])
    assert curve["smooth_time"].shape == (MOMENTS, 1, 6)
    assert np.all(np.abs(curve["smooth_time"] - truth) <= 4 * curve["smooth_time_u"] + 1e-12)
    assert curve["smooth_position"].shape == (len(TIMES), 1, 6)
    assert curve["place"].tolist() == [PLACES[3]]


def test_missing_points_are_excluded():
    crossbeam, twist, covariance, rig = campaign(2)
    gone = np.zeros((len(TIMES), len(PLACES)), dtype=bool)
    gone[4:, 2], gone[3, 5] = True, True
    twist[gone], covariance[gone] = np.nan, np.nan
    curve = drawn(twist, covariance, rig)
    truth = crossbeam.twist(TIMES[:, None], curve["place"])
    assert np.isfinite(curve["smooth_position"]).all()
    assert np.all(np.abs(curve["smooth_position"] - truth) <= 5 * curve["smooth_position_u"] + 1e-12)
    # the artefact is seen at first: its curve goes on, and is less and less certain
    u = curve["smooth_time_u"][:, 2, 0]
    known = np.isfinite(u)
    assert known[curve["moment"] <= TIMES[3]].all()
    assert np.all(u[known & (curve["moment"] > TIMES[6])] > u[np.searchsorted(curve["moment"], TIMES[2])])
    truth = crossbeam.twist(curve["moment"][:, None], PLACES)
    miss = np.abs(curve["smooth_time"] - truth)
    others = np.arange(len(PLACES)) != 2
    assert np.all(miss[:, others] <= 5 * curve["smooth_time_u"][:, others] + 1e-12)


def test_artefact_without_scans_is_unknown_only_over_time():
    crossbeam, twist, covariance, rig = campaign(3)
    twist[:, 4], covariance[:, 4] = np.nan, np.nan
    curve = drawn(twist, covariance, rig)
    assert np.isnan(curve["smooth_time"][1:, 4]).all()
    assert np.isfinite(np.delete(curve["smooth_time"], 4, axis=1)).all()
    truth = crossbeam.twist(TIMES[:, None], curve["place"])
    assert np.all(np.abs(curve["smooth_position"] - truth) <= 5 * curve["smooth_position_u"] + 1e-12)
