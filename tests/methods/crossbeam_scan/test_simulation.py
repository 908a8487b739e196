"""Simulated scans: valid, seeded, and moved exactly by the true errors."""

import numpy as np
import pytest

from errormotion.datasets import validate
from errormotion.errors import BenchError
from errormotion.kinematics.poses import displaced
from errormotion.methods.crossbeam_scan import simulation
from errormotion.twin import VirtualMachine
from errormotion.twin.artefacts.pieces import swept
from errormotion.twin.sensors.profiler import Disturbances, Profiler

POSITIONS = -0.7 + 0.2 * np.arange(8)
TIMES = 60.0 * np.array([0, 7, 15, 30, 45, 60, 90, 120, 150, 180])
PERFECT = Profiler(80, 0.4e-3, disturbances=Disturbances.none())
SMALL = {"profiles": 40, "feed": 1e-3}


@pytest.fixture
def gantry():
    """A gantry whose Y axis has been going to and fro since time 0."""
    return VirtualMachine("gantry", seed=3)


def test_truth_is_a_valid_error_dataset_and_zero_when_cold(gantry):
    truth = simulation.truth_axis(gantry, TIMES, POSITIONS)
    validate(truth)
    assert dict(truth.sizes) == {"time": 10, "position": 8, "dof": 6, "dof_": 6}
    assert truth.attrs["component"] == "Y"
    assert not truth.em.twist()[0].any()
    assert truth.em.iso_names() == {d: f"{d}Y" for d in ("EX", "EY", "EZ", "EA", "EB", "EC")}


def test_truth_has_the_size_of_a_real_crossbeam(gantry):
    # Zhao et al., section 4.4: positioning is largest and grows along Y and over time; angles thousandths of a degree
    end = simulation.truth_axis(gantry, TIMES, POSITIONS).isel(time=-1)
    assert 20e-6 < end.EY.max() < 80e-6
    assert (np.diff(end.EY) > 0).all()
    assert np.abs(end[["EX", "EZ"]].to_array()).max() < 25e-6
    assert 5e-6 < np.abs(end[["EA", "EB", "EC"]].to_array()).max() < 60e-6


def test_scans_are_a_valid_raw_dataset(gantry):
    raw = simulation.raw_scans(gantry, [0, 3600], POSITIONS[[0, 5]], seed=1, profiler=Profiler(80, 0.4e-3), **SMALL)
    validate(raw)
    assert raw.height.shape == (2, 2, 40, 80)
    assert raw.height.dtype == np.float32
    assert 0.9 < float(raw.height.notnull().mean()) < 1
    assert float(raw.height_noise) == 0.5e-6


def test_noise_seed_does_not_change_the_machine(gantry):
    one, same, other = (simulation.raw_scans(gantry, [0], [0.1], seed=s, profiler=PERFECT, **SMALL) for s in (1, 1, 2))
    assert one.identical(same)
    assert one.drop_vars(["height", "y"]).identical(other.drop_vars(["height", "y"]))
    shift = other.y.values - one.y.values  # the sampling phase
    assert np.ptp(shift) < 1e-15
    assert 0 < abs(shift).max() <= 1e-3


def in_cold_profiler(gantry, raw, cycle, position):
    """Points (profile, point, 3) of a scan in the profiler's frame as it stands over the middle of the scan."""
    direction = gantry.crossbeam.pose[1, :3]  # of Y, in the profiler's frame
    y = raw.y.values[cycle, position][:, None, None]
    points = np.stack(np.broadcast_arrays(raw.x.values, 0.0, raw.height.values[cycle, position]), axis=-1)
    return points.astype(float) + y * direction


def miss(gantry, raw, points, position, place):
    """Distances of points in the cold profiler's frame from the surface of the artefact, along z."""
    beam = gantry.crossbeam
    cold = beam.carriage(0.0, np.array([position]), position, "axis")
    pose = beam.lines(cold, beam.artefact_pose(gantry.seed, position))[0]
    there = points @ pose[:3, :3].T + pose[:3, 3]
    return there[..., 2] - place.height(there[..., 0], there[..., 1])


def test_scan_moved_by_the_truth_lies_on_the_cold_artefact(gantry):
    position = 0.3
    raw = simulation.raw_scans(gantry, [0, 7200], [position], seed=1, profiler=PERFECT, motion="rigid", **SMALL)
    beam, artefact = gantry.crossbeam, swept()
    cold = in_cold_profiler(gantry, raw, 0, 0)
    # float32 of heights of 4 mm: 0.25 nm
    assert np.nanmax(np.abs(miss(gantry, raw, cold, position, artefact))) < 0.5e-9
    warm = in_cold_profiler(gantry, raw, 1, 0)
    assert np.nanmax(np.abs(miss(gantry, raw, warm, position, artefact))) > 5e-6
    to_carriage = beam.pose.copy()
    to_carriage[:3, 3] += beam.lever
    E = displaced(beam.twist(7200.0, position)).as_matrix()
    M = np.linalg.inv(to_carriage) @ E @ to_carriage
    moved = warm @ M[:3, :3].T + M[:3, 3]
    assert np.nanmax(np.abs(miss(gantry, raw, moved, position, artefact))) < 0.5e-9


def test_true_motion_differs_from_a_rigid_one_by_the_strain_of_the_scan(gantry):
    def scan(motion):
        return simulation.raw_scans(gantry, [0, 7200], [0.3], seed=1, profiler=PERFECT, motion=motion, **SMALL)

    axis, rigid = scan("axis"), scan("rigid")
    difference = np.abs(axis.height - rigid.height).max(["artefact", "profile", "point"])
    assert float(difference[0]) == 0
    assert 0.05e-6 < float(difference[1]) < 3e-6


def test_invalid_arguments_are_refused(gantry):
    with pytest.raises(BenchError, match="'gantry' has a crossbeam; this one is 'cframe'"):
        simulation.truth_axis(VirtualMachine("cframe"), [0], [0])
    with pytest.raises(BenchError, match=r"travels from -0\.9 to 0\.9 m; the scans reach from"):
        simulation.raw_scans(gantry, [0], [0.89], seed=1, profiler=PERFECT, **SMALL)
    with pytest.raises(BenchError, match="'axis' or 'rigid'"):
        simulation.raw_scans(gantry, [0], [0.0], seed=1, motion="stiff")
    with pytest.raises(BenchError, match="two lines"):
        simulation.raw_scans(gantry, [0], [0.0], seed=1, profiles=1)
