"""What a plan promises is what identification states later."""

import copy
import dataclasses
import logging

import numpy as np
import pytest
from coded import raises
from scipy.spatial.transform import RigidTransform

from errormotion import datasets
from errormotion.errors import MethodError
from errormotion.methods.crossbeam_scan import CrossbeamScan, simulation
from errormotion.methods.crossbeam_scan.identification.profiler_pose import calibration
from errormotion.methods.crossbeam_scan.planning import registration_covariance
from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings
from errormotion.twin import VirtualMachine
from errormotion.twin.artefacts.pieces import freeform
from errormotion.twin.sensors.profiler import Disturbances, Profiler

PLACES = (-0.4, 0.0, 0.4)
WARM_UP = (1800.0, 7200.0)
LAYOUT = {"width": 20e-3, "points": 800}
EXACT = {"scale_uncertainty": 0.0, "expansion_uncertainty": 0.0, "mount_expansion_uncertainty": 0.0}
NOTHING = {"lever_uncertainty": (0.0, 0.0, 0.0)} | EXACT


@pytest.fixture(autouse=True)
def _quiet(caplog):
    caplog.set_level(logging.ERROR)


def plan(**settings):
    return CrossbeamScan().plan(CrossbeamScanSettings(**settings))


def uncertainty(ds):
    """Return the standard uncertainty, (..., 6)."""
    return np.sqrt(np.diagonal(ds["covariance"].values, axis1=-2, axis2=-1))


def waves(x, y):
    """The artefact that a plan assumes."""
    layout = CrossbeamScanSettings().layout
    kx, ky = (2 * np.pi / wave for wave in layout.wavelength)
    return layout.relief * (np.sin(kx * x + 0.4) + np.cos(ky * y - 0.7))


@pytest.fixture(scope="module")
def machine():
    """A gantry."""
    return VirtualMachine("gantry", seed=3)


@pytest.fixture(scope="module")
def pose(machine):
    """Its true pose and lever, as exact, as settings."""
    names = ("a", "b", "g", "dx", "dy", "dz")
    p = calibration.parameters(RigidTransform.from_matrix(machine.crossbeam.pose))
    exact = {"angle_uncertainty": 0.0, "place_uncertainty": 0.0}
    return {
        "profiler_pose": dict(zip(names, map(float, p), strict=True)) | exact,
        "lever": tuple(machine.crossbeam.lever),
        "lever_uncertainty": (0.0, 0.0, 0.0),
    }


@pytest.mark.parametrize(
    ("wrong", "strain"),
    [
        pytest.param(Disturbances.white(), "free", id="white noise"),
        pytest.param(Disturbances(speckle=0.0), "free", id="jitter from line to line"),
        pytest.param(Disturbances(speckle=0.0), "rigid", id="jitter, as a rigid picture"),
    ],
)
def test_plan_agrees_with_the_stated_uncertainty_of_the_identification(machine, pose, wrong, strain):
    motion = "rigid" if strain == "rigid" else "axis"
    raw = simulation.raw_scans(machine,
        [0.0, 7200.0], [0.0], seed=1, profiles=400, feed=70e-6, motion=motion,
        profiler=Profiler(800, 25e-6, disturbances=wrong), artefact=freeform(waves),
    )  # fmt: skip
    stated = uncertainty(CrossbeamScan().identify(raw, CrossbeamScanSettings(strain=strain, **EXACT)))[1, 0]
    layout = LAYOUT | {"jitter_z": wrong.jitter_z, "jitter_y": wrong.jitter_y}
    planned = plan(
        strain=strain, positions=(0.0,), warm_up=(7200.0,), scan_length=28e-3, height_noise=wrong.noise,
        layout=layout, **pose, **EXACT,
    )  # fmt: skip
    assert uncertainty(planned)[1, 0] == pytest.approx(stated, rel=0.3)


def test_a_plan_of_scans_is_a_valid_dataset_of_zeros():
    ds = plan(positions=PLACES, warm_up=WARM_UP, profiler_pose={"dz": -0.174})
    datasets.validate(ds)
    assert ds["time"].values.tolist() == [0, *WARM_UP]
    assert ds["y"].values.tolist() == list(PLACES)
    assert ds.attrs["component"] == "Y"
    assert not ds.em.twist().values.any()
    assert not uncertainty(ds)[0].any()  # cold
    assert np.all(uncertainty(ds)[1:] > 0)
    assert ds.em.budget()["group"].values.tolist() == [
        *("profiler pose", "lever", "cold scan", "scale of the profiler", "expansion of the mount"),
        *("expansion of the artefacts", "independent"),
    ]


def test_plan_without_positions_states_what_it_needs():
    with pytest.raises(MethodError, match="set positions, such as"):
        plan()


def test_guide_reduces_the_expected_uncertainty():
    free, guided = (uncertainty(plan(positions=PLACES, strain=strain, **NOTHING))[1:] for strain in ("free", "guided"))
    assert np.all(guided <= free * (1 + 1e-9))
    assert np.all(guided[..., 3] < 0.6 * free[..., 3])
    # a better guide promises more still, a rough one no more than none
    fine, rough = (
        uncertainty(plan(positions=PLACES, strain="guided", guide_uncertainty=u, **NOTHING))[1:] for u in (0.1e-6, 1e-3)
    )
    assert np.all(fine <= guided * (1 + 1e-9))
    assert rough == pytest.approx(free, rel=1e-3)


@pytest.mark.parametrize(
    "better",
    [
        {"line_pitch": 35e-6},
        {"height_noise": 0.25e-6},
        {"scan_length": 80e-3},
        {"layout": {"jitter_z": 0.0, "jitter_y": 0.0}},
        {"layout": {"points": 6400}},
        {"strain": "rigid"},
    ],
    ids=str,
)
def test_better_layout_reduces_the_expected_uncertainty(better):
    usual, good = (registration_covariance(CrossbeamScanSettings(**changes))[0] for changes in ({}, better))
    # in no direction worse, in some better
    known = np.diag(good)[:6] > 0
    values = np.linalg.eigvalsh((usual - good)[:6, :6][np.ix_(known, known)] * 1e12)
    assert values.max() > 0
    assert values.min() > -1e-6 * values.max()


def test_twice_the_noise_is_twice_the_uncertainty():
    still = {"jitter_z": 0.0, "jitter_y": 0.0}
    once, twice = (
        registration_covariance(
            CrossbeamScanSettings(layout=still, height_noise=u, scale_uncertainty=0, expansion_uncertainty=0)
        )[0]
        for u in (0.5e-6, 1e-6)
    )
    assert twice == pytest.approx(4 * once, rel=1e-6)


def test_plan_of_the_pose_agrees_with_the_stated_uncertainty_of_the_calibration(machine):
    # a plan takes the line of sight as parallel to the axis of the pocket
    true = calibration.parameters(RigidTransform.from_matrix(machine.crossbeam.pose)) * [0, 0, 1, 1, 1, 1]
    level = copy.copy(machine)
    level.crossbeam = dataclasses.replace(machine.crossbeam, pose=calibration.pose(*true).as_matrix())
    raw = simulation.raw_pocket(level, seed=1)
    stated = uncertainty(CrossbeamScan().identify(raw))[0]
    planned = plan(procedure="profiler_pose", profiler_pose={"dz": -0.174})
    datasets.validate(planned)
    assert planned["beam"].values.tolist() == ["profiler"]
    assert not planned.em.twist().values.any()
    ratio = uncertainty(planned)[0] / stated
    # the scatter of an edge is taken as one figure; along the feed, where lines cross the rim obliquely, it is more
    assert np.all((ratio > 0.5) & (ratio < 2))


def test_one_lift_does_not_determine_the_pose():
    with raises("scan.pocket.undetermined"):
        plan(procedure="profiler_pose", pocket_lifts=(0.166,), profiler_pose={"dz": -0.174})


def test_a_prior_of_the_angles_or_a_longer_lift_helps():
    def of(**changes):
        return uncertainty(plan(procedure="profiler_pose", profiler_pose={"dz": -0.174}, **changes))[0]

    usual = of()
    assert np.all(of(pocket_lifts=(0.160, 0.188)) <= usual * 1.001)
    assert np.all(of(angle_prior=1e-5) <= usual * 1.001)
    assert np.isfinite(of(pocket_lifts=(0.174,), angle_prior=1e-3)).all()
