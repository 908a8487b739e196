"""Simulated scans: valid, seeded, and moved exactly by the true errors."""

import numpy as np
import pytest
from coded import raises

from errormotion.datasets import validate
from errormotion.kinematics.poses import displaced
from errormotion.methods.crossbeam_scan import CrossbeamScan, simulation
from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings
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
    with raises("simulation.machine.no_crossbeam"):
        simulation.truth_axis(VirtualMachine("cframe"), [0], [0])
    with raises("simulation.scan.outside_travel"):
        simulation.raw_scans(gantry, [0], [0.89], seed=1, profiler=PERFECT, **SMALL)
    with raises("simulation.scan.motion"):
        simulation.raw_scans(gantry, [0], [0.0], seed=1, motion="stiff")
    with raises("simulation.scan.size"):
        simulation.raw_scans(gantry, [0], [0.0], seed=1, profiles=1)


class _Ones:
    """Draws of one standard uncertainty."""

    def normal(self, size=None):
        return np.ones(() if size is None else size)


@pytest.mark.parametrize(
    ("strain", "group", "sign"),
    [
        ("scale", "scale of the profiler", -1),
        ("expansion", "expansion of the artefacts", -1),
        ("mount_expansion", "expansion of the mount", 1),
    ],
)
def test_strained_scans_have_the_effect_that_the_result_states(strain, group, sign):
    """A strain is the one that takes the warm picture to the cold one: of a larger picture it is negative."""
    machine = VirtualMachine("gantry", seed=3)
    profiler = Profiler(800, 25e-6, disturbances=Disturbances(noise=10e-9, jitter_y=0, jitter_z=0, speckle=0))
    raw = simulation.raw_scans(machine, [0, 7200], [0.1], seed=1, profiles=400, profiler=profiler, motion="rigid")
    nothing = {"scale_uncertainty": 0.0, "expansion_uncertainty": 0.0, "mount_expansion_uncertainty": 0.0}
    options = {"strain": "rigid", "artefact_height": 0.1}
    name = f"{strain}_uncertainty"
    strained = simulation.strained(raw, CrossbeamScanSettings(**options, **nothing | {name: 100e-6}), _Ones())
    # so small an uncertainty that the registration takes the strain as 0
    before, after = (
        CrossbeamScan().identify(each, CrossbeamScanSettings(**options, **nothing | {name: 1e-9}))
        for each in (raw, strained)
    )
    F = before["influence"].transpose("source", "time", "position", "dof").values[:, 1, 0]
    change = (after.em.twist().values - before.em.twist().values)[1, 0]
    stated = -sign * 100e-6 / 1e-9 * F[before["source_group"].values == group].sum(axis=0)
    for part in (slice(0, 3), slice(3, 6)):
        assert change[part] == pytest.approx(stated[part], abs=0.03 * np.abs(stated[part]).max() + 1e-8)
    assert np.abs(stated[:3]).max() > 5e-6
