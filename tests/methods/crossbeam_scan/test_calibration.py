"""Pose of the profiler: the published figures, edges below the point pitch, and the truth within what is stated."""

import copy
import dataclasses

import numpy as np
import pytest
from coded import raises
from scipy.spatial.transform import RigidTransform

from errormotion.datasets import load, save, validate
from errormotion.errors import MethodError
from errormotion.methods.crossbeam_scan import simulation
from errormotion.methods.crossbeam_scan.identification.profiler_pose import calibration, edges
from errormotion.methods.crossbeam_scan.identification.profiler_pose.calibration import Pocket, calibrate
from errormotion.twin.sensors.profiler import Disturbances, Profiler

RADIUS = 12.496e-3
POCKET = Pocket(RADIUS)
PITCH = 12.5e-6


@pytest.fixture
def truth(gantry):
    """The true pose of the twin's profiler: (a, b, g, dx, dy, dz)."""
    return calibration.parameters(RigidTransform.from_matrix(gantry.crossbeam.pose))


def test_published_parameters_give_the_published_matrix():
    # Zhao et al., section 4.2 and eq. (11); the spindle was lifted by 178.152 mm
    H = calibration.pose(0.0029, -0.0013, -0.0091, 2.771e-3, -0.876e-3, 4.219e-3 - 178.152e-3).as_matrix()
    published = [
        [0.9999579, 0.0090741, -0.001301],
        [-0.009074, 0.9999546, -0.002897],
        [0.0012751, 0.0028967, 0.9999949],
    ]
    # angles are printed to 1e-4 rad, so to half of that
    assert H[:3, :3] == pytest.approx(np.array(published), abs=5e-5)
    assert H[:3, 3] * 1e3 == pytest.approx([2.7710384, -0.876047, -173.9324], abs=1e-3)


def test_parameters_are_the_inverse_of_the_pose():
    p = [0.02, -0.03, 0.4, 1e-3, -2e-3, -0.17]
    assert calibration.parameters(calibration.pose(*p)) == pytest.approx(p, abs=1e-15)


def radii(scan, truth):
    """Radii of the edges (line, 2), in the tool frame by the true pose, and |cos| of the places."""
    x, height, stage = scan
    _, rim = edges.pocket(x, height[0])
    places = np.stack([rim.x, np.zeros_like(rim.x), rim.z], axis=-1)
    P = calibration.pose(*truth).apply(places.reshape(-1, 3)).reshape(places.shape) + stage[0][rim.line, None]
    R = np.hypot(P[..., 0], P[..., 1])
    return R, np.abs(P[..., 0] / R).min(axis=1)


def leaning(machine, a, b):
    """Return a machine whose profiler has other angles a and b, and its pose."""
    true = calibration.parameters(RigidTransform.from_matrix(machine.crossbeam.pose))
    true[:2] = a, b
    changed = copy.copy(machine)
    changed.crossbeam = dataclasses.replace(machine.crossbeam, pose=calibration.pose(*true).as_matrix())
    return changed, true


def test_edges_are_found_to_a_thousandth_of_the_pitch_under_white_noise(scan_pocket, gantry):
    level, truth = leaning(gantry, 0.0, 0.0)
    R, cos = radii(scan_pocket(1, Disturbances.white(), machine=level), truth)
    across = R[cos > 0.5]
    assert len(across) > 50
    assert np.std(across[:, 1] - across[:, 0]) < 1e-3 * PITCH
    assert across.mean() == pytest.approx(RADIUS, abs=1e-3 * PITCH)


def test_edges_are_found_below_the_pitch_with_a_third_of_their_points_lost(scan_pocket, truth):
    R, cos = radii(scan_pocket(1), truth)
    # the difference of both radii holds no jitter of the line
    assert np.std(R[cos > 0.5][:, 1] - R[cos > 0.5][:, 0]) / np.sqrt(2) < PITCH / 4


def test_tilt_of_a_plane_and_its_uncertainty():
    # 80 lines of 3000 points as in section 4.2
    rng = np.random.default_rng(1)
    x = (np.arange(3000) - 1500) * PITCH
    misses = []
    for _ in range(20):
        z = 0.0013 * x + rng.normal(0, 0.5e-6, (80, 1)) + rng.normal(0, 0.5e-6, (80, 3000))
        z[rng.uniform(size=z.shape) < 0.002] += 1e-3
        z[rng.uniform(size=z.shape) < 0.01] = np.nan
        seen = edges.tilt(x, z)
        misses.append((seen.slope - 0.0013) / seen.uncertainty)
    # white noise over 240 000 points: 0.5 um / (10.8 mm sqrt(240 000)) = 94 nrad
    assert seen.uncertainty == pytest.approx(94e-9, rel=0.3)
    assert np.sqrt(np.mean(np.square(misses))) == pytest.approx(1, abs=0.5)


def test_perfect_scans_give_the_pose(scan_pocket, truth):
    found = calibrate(*scan_pocket(1, Disturbances.none()), POCKET)
    # the spot of 12 um bends the half-way line inwards by spot^2 / 2 r = 6 nm, and by 30 nm where a line is oblique
    assert found.values[:3] == pytest.approx(truth[:3], abs=1e-6)
    assert found.values[3:] == pytest.approx(truth[3:], abs=3e-8)
    assert found.matrix == pytest.approx(calibration.pose(*truth).as_matrix(), abs=1e-6)


@pytest.mark.slow
def test_truth_lies_within_the_stated_uncertainty(scan_pocket, truth):
    misses, squares = [], []
    for seed in range(28):
        found = calibrate(*scan_pocket(seed, points=1600), POCKET)
        miss = found.values - truth
        misses.append(miss / np.sqrt(np.diag(found.covariance)))
        squares.append(miss @ np.linalg.solve(found.covariance, miss))
    # 168 numbers, some of them correlated: 95 % within 1.96 sigma, and a mean square of 1 +/- 0.11 (one sigma)
    assert np.mean(np.abs(misses) < 1.96) > 0.9
    assert np.mean(squares) / 6 == pytest.approx(1, abs=0.3)
    assert np.abs(np.mean(misses, axis=0)).max() < 3.5 / np.sqrt(28)


def test_uncertainty_is_as_small_as_the_sensor_allows(scan_pocket):
    size = np.sqrt(np.diag(calibrate(*scan_pocket(1), POCKET).covariance))
    assert (size[:3] < [5e-5, 1e-6, 5e-5]).all()
    # which share of the wall an edge contains is not known from elsewhere, and moves the middle along the profile
    assert (size[3:] < [1e-6, 0.5e-6, 0.5e-6]).all()


def test_uncertainty_of_the_centre_is_propagated(scan_pocket):
    scan = scan_pocket(1)
    plain = calibrate(*scan, POCKET).covariance
    more = calibrate(*scan, Pocket(RADIUS, centre_uncertainty=(3e-6, 4e-6, 5e-6))).covariance
    assert np.diag(more - plain)[3:] == pytest.approx(np.square([3e-6, 4e-6, 5e-6]))


def test_position_of_the_pocket_shifts_the_pose(scan_pocket):
    scan, centre = scan_pocket(1), np.array([1e-3, -2e-3, 3e-3])
    plain, moved = calibrate(*scan, POCKET), calibrate(*scan, Pocket(RADIUS, centre=centre))
    assert moved.values[3:] - plain.values[3:] == pytest.approx(centre, abs=1e-9)


def test_one_height_does_not_determine_the_angle_a(scan_pocket, truth):
    scan = scan_pocket(1, lifts=(0.174,))
    with raises("scan.pocket.undetermined"):
        calibrate(*scan, POCKET)
    found = calibrate(*scan, POCKET, angle_prior=5e-3)
    size = np.sqrt(np.diag(found.covariance))
    assert size[0] == pytest.approx(5e-3, rel=0.01)
    assert (np.abs(found.values - truth) < 4 * size).all()


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda x, z, s: (x, z[:, :, :-1], s), "scan.pocket.shape"),
        (lambda x, z, s: (x, np.where(z < 0, np.nan, z) * 0, s), "scan.pocket.not_round"),
        (lambda x, z, s: (x, z * 1e-3, s), "scan.pocket.not_round"),
        (lambda x, z, s: (x, z[:, :6], s[:, :6]), "scan.pocket.not_round"),
        (lambda x, z, s: (x, z, s + np.linspace(0, 1e-3, s.shape[1])[:, None]), "scan.pocket.heights"),
    ],
)
def test_invalid_scans_of_a_pocket_are_refused(scan_pocket, change, code):
    with raises(code):
        calibrate(*change(*scan_pocket(1, Disturbances.white(), lines=40)), POCKET)


def test_lines_that_all_cross_the_rim_obliquely_are_counted(scan_pocket, monkeypatch):
    monkeypatch.setattr(calibration, "OBLIQUE", 1.0)
    with pytest.raises(MethodError, match="Ten lines across the pocket must fit one circle; 0 do"):
        calibrate(*scan_pocket(1, Disturbances.white(), lines=40), POCKET)


def test_raw_dataset_and_its_arrays_give_the_same_result(gantry, truth, tmp_path):
    raw = simulation.raw_pocket(gantry, seed=1, profiles=80, feed=350e-6)
    save(raw, tmp_path / "pocket.nc")
    stored = load(tmp_path / "pocket.nc")
    validate(stored)
    found = calibration.calibrate_dataset(stored.transpose("point", ...))
    miss = (found.values - truth) / np.sqrt(np.diag(found.covariance))
    assert np.abs(miss).max() < 4
    more = raw.assign(pocket_centre_uncertainty=("direction", [1e-5] * 3, {"units": "m"}))
    wider = calibration.calibrate_dataset(more).covariance - found.covariance
    assert np.diag(wider)[3:] == pytest.approx(1e-10, rel=1e-3)


def test_scans_of_artefacts_are_refused_for_calibration(gantry):
    profiler = Profiler(80, 0.4e-3, disturbances=Disturbances.white())
    raw = simulation.raw_scans(gantry, [0], [0], seed=1, profiler=profiler, profiles=3, feed=1e-3)
    with raises("scan.pocket.missing"):
        calibration.calibrate_dataset(raw)


@pytest.mark.parametrize(("along_machine", "rank"), [(True, 5), (False, 4)])
def test_a_circle_shows_the_angle_g_only_because_the_feed_is_along_the_machine(along_machine, rank):
    # the rim in the profiler's frame, b = 0: unknown are g, dx, dy, dz and r
    angle = np.linspace(0, 2 * np.pi, 50, endpoint=False)
    X, Y = RADIUS * np.cos(angle), RADIUS * np.sin(angle)

    def miss(p):
        g, dx, dy, dz, r = p * [1e-3, 1e-6, 1e-6, 1e-6, 1e-6]
        H = calibration.pose(0, 0, g, dx, dy, dz)
        if along_machine:
            P = H.apply(np.stack([X, 0 * X, 0 * X], axis=-1)) + np.stack([0 * Y, Y, 0 * Y], axis=-1)
        else:  # eq. (7)
            P = H.apply(np.stack([X, Y, 0 * X], axis=-1))
        return np.concatenate([np.hypot(P[:, 0], P[:, 1]) - RADIUS - r, P[:, 2]]) * 1e6

    J = np.transpose([(miss(step) - miss(-step)) / 2 for step in np.eye(5)])
    assert np.linalg.matrix_rank(J, tol=1e-6) == rank


WALLS = {"seen": Disturbances(steepest=np.inf), "lost": Disturbances()}


@pytest.mark.slow
@pytest.mark.parametrize("walls", WALLS)
@pytest.mark.parametrize("lean", [3e-3, 10e-3])
def test_the_uncertainty_holds_where_a_tilted_line_of_sight_meets_the_wall(scan_pocket, gantry, lean, walls):
    squares = []
    for seed in range(10):
        azimuth = np.random.default_rng(seed).uniform(0, 2 * np.pi)
        machine, truth = leaning(gantry, lean * np.cos(azimuth), lean * np.sin(azimuth))
        found = calibrate(*scan_pocket(seed, WALLS[walls], lines=300, machine=machine), POCKET)
        squares.append((found.values - truth) ** 2 / np.diag(found.covariance))
        assert abs(found.values[2] - truth[2]) < 0.15e-3  # 0.1 to 0.5 mrad where walls are taken for edges
    # The mean of ten squares of normal numbers scatters by sqrt(2 / 10) = 0.45; three of it.
    assert np.all(np.mean(squares, axis=0) < 2.4)


def test_a_wall_on_one_side_does_not_turn_the_profiler(scan_pocket, gantry):
    machine, truth = leaning(gantry, 5e-3, 5e-3)  # to 45 deg, where the wall looks most like a shear
    found = calibrate(*scan_pocket(1, WALLS["seen"], lines=200, machine=machine), POCKET)
    assert abs(found.values[2] - truth[2]) < 4 * found.covariance[2, 2] ** 0.5 < 0.3e-3


def test_the_virtual_wall_is_seen_on_the_side_to_which_the_line_of_sight_leans(gantry):
    machine, truth = leaning(gantry, 0.0, 20e-3)  # 5 mm of depth: 0.1 mm of wall
    H = calibration.pose(*truth)
    raw = simulation.raw_pocket(
        machine, seed=0, lifts=(0.174,), profiler=Profiler(disturbances=Disturbances.none()), profiles=41
    )
    z, x = raw["height"].values[0, 20].astype(float), raw["x"].values
    place = H.apply(np.stack([x, 0 * x, z], axis=-1))
    between = (place[:, 2] + 0.174 < -0.2e-3) & (place[:, 2] + 0.174 > -4.8e-3)
    left, right = (int((between & (side * place[:, 0] > 0)).sum()) for side in (-1, 1))
    # With b the line of sight moves by tan(b) for each metre of height, outwards on the side of negative x; the spot
    # of 12 um spreads both edges.
    assert right <= 4
    assert left - right == pytest.approx(4.6e-3 * np.tan(20e-3) / 12.5e-6, abs=3)
