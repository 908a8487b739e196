"""The chain: errors of the carriage from the motion of the profiler's frame, against the virtual machine and itself."""

from dataclasses import replace

import numpy as np
import pytest
from coded import raises
from scipy.spatial.transform import RigidTransform

from errormotion.kinematics.poses import displaced, displacement, log
from errormotion.methods.crossbeam_scan import simulation
from errormotion.methods.crossbeam_scan.identification import chain
from errormotion.methods.crossbeam_scan.identification.chain import Rig
from errormotion.methods.crossbeam_scan.identification.profiler_pose import calibration
from errormotion.twin import VirtualMachine
from errormotion.twin.artefacts.pieces import swept
from errormotion.twin.sensors.profiler import Disturbances, Profiler

T, Y = 7200.0, 0.3
PERFECT = Profiler(80, 0.4e-3, disturbances=Disturbances.none())
#: one mrad and 10 um of calibration
COVARIANCE = np.diag([1e-3, 1e-3, 1e-3, 1e-5, 1e-5, 1e-5]) ** 2


@pytest.fixture
def H(gantry):
    """The true pose of the profiler."""
    return RigidTransform.from_matrix(gantry.crossbeam.pose)


@pytest.fixture
def lever(gantry):
    """From the carriage to the tool frame."""
    return gantry.crossbeam.lever


def errors_of(motion, rig):
    """Return the errors of the carriage from motions of the profiler."""
    return chain.carriage_errors(motion, np.zeros((*np.shape(motion), 6)), rig)[0]


def motions(errors, H, lever):
    """Return the exact motions M of the profiler's frame under errors of the carriage, as twists (..., 6)."""
    SH = RigidTransform.from_translation(lever) * H
    flat = np.reshape(errors, (-1, 6))
    return np.reshape([displacement(SH.inv() * displaced(E) * SH) for E in flat], np.shape(errors))


def registered(gantry, raw, cycle, by_line=False, assumed=None):
    """Return M (6,) that best lays a scan onto the artefact as the cold profiler sees it: plain Gauss-Newton.

    By line, the motion is that of each line's frame, with a drift (3,) in proportion to the way along the feed. Both
    scans are put together by the true pose, or by an assumed one.
    """
    beam, artefact = gantry.crossbeam, swept()
    position = float(raw.position[0])
    place = beam.artefact_pose(gantry.seed, position)
    pose = beam.lines(beam.carriage(0.0, np.array([position]), position, "axis"), place)[0]
    true = chain.feed_direction(RigidTransform.from_matrix(beam.pose))
    along = true if assumed is None else chain.feed_direction(assumed)
    y, z = raw.y.values[cycle, 0][:, None, None], raw.height.values[cycle, 0].astype(float)
    seen = np.isfinite(z)
    points = np.stack(np.broadcast_arrays(raw.x.values, 0.0, z), axis=-1)[seen]
    way = np.broadcast_to(y, (*z.shape, 1))[seen]

    def miss(p):
        motion, drift = displaced(p[:6] * 1e-6), p[6:] * 1e-5
        moved = motion.apply(points) + way * (along + drift) if by_line else motion.apply(points + way * along)
        moved = moved + moved[:, 1:2] / along[1] * (true - along)  # the cold scan is off as well
        there = moved @ pose[:3, :3].T + pose[:3, 3]
        return (there[:, 2] - artefact.height(there[:, 0], there[:, 1])) * 1e6

    p = np.zeros(9 if by_line else 6)
    for _ in range(4):
        J = np.transpose([(miss(p + step) - miss(p - step)) / 2 for step in np.eye(p.size)])
        rows = np.isfinite(J).all(axis=1) & np.isfinite(miss(p))
        p = p - np.linalg.lstsq(J[rows], miss(p)[rows])[0]
    return p[:6] * 1e-6


def test_errors_of_the_carriage_follow_from_the_motion_of_the_profiler(gantry, H, lever):
    truth = simulation.truth_axis(gantry, [0, 600, T], [-0.5, Y]).em.twist().values
    found = errors_of(motions(truth, H, lever), Rig(H, lever))
    # second order: 2.2 m times (30 urad)^2
    assert found[..., :3] == pytest.approx(truth[..., :3], abs=2e-9)
    assert found[..., 3:] == pytest.approx(truth[..., 3:], abs=1e-9)
    assert not found[0].any()


def test_sign_and_direction_are_those_of_the_scans(gantry, H, lever):
    scans = {"seed": 1, "profiles": 40, "feed": 1e-3, "profiler": PERFECT, "motion": "rigid"}
    raw = simulation.raw_scans(gantry, [0, T], [Y], **scans)
    truth = simulation.truth_axis(gantry, [T], [Y]).em.twist().values[0, 0]
    assert np.abs(registered(gantry, raw, 0)).max() < 1e-9
    found = errors_of(registered(gantry, raw, 1), Rig(H, lever))
    # float32 and second order
    assert found == pytest.approx(truth, abs=2e-9)


def missed(machine, by_line):
    """Return what the chain misses of the true motion (6,), m and rad."""
    H, lever = RigidTransform.from_matrix(machine.crossbeam.pose), machine.crossbeam.lever
    raw = simulation.raw_scans(machine, [0, T], [Y], seed=1, profiles=40, feed=1e-3, profiler=PERFECT)
    found = errors_of(registered(machine, raw, 1, by_line), Rig(H, lever))
    return found - simulation.truth_axis(machine, [T], [Y]).em.twist().values[0, 0]


def test_rigid_registration_takes_strain_for_yaw(gantry):
    # roll changes along Y by some 5 urad/m: at 2.2 m below the carriage a shear of the scan by 12 urad
    rigid, by_line = (np.abs(missed(gantry, way)) for way in (False, True))
    assert 3e-6 < rigid[5] < 12e-6
    assert by_line[5] < 0.2e-6


@pytest.mark.parametrize(("freedom", "share"), [(3, 0.9), (5, 0.5)])
def test_rigid_registration_hardly_shows_a_rotation_of_the_carriage_alone(freedom, share):
    # every line stands as far off as its neighbour: there is no slope along the feed, where a rigid motion looks for it
    machine = VirtualMachine("gantry", seed=3)
    own = 10e-6 * np.eye(6)[freedom]
    machine.crossbeam = replace(machine.crossbeam, own=own, steady=0 * machine.crossbeam.steady)
    assert missed(machine, by_line=False)[freedom] < -share * 10e-6
    assert np.abs(missed(machine, by_line=True)[freedom]) < 0.1e-6


def test_pose_twists_are_the_derivatives_of_the_pose(H, lever):
    p, S = calibration.parameters(H), RigidTransform.from_translation(lever)
    for k, twist in enumerate(chain.pose_twists(H, lever)):
        step = 1e-6 * np.eye(6)[k]
        there, back = (S * calibration.pose(*(p + d)) for d in (step, -step))
        assert log(there * back.inv()) / 2e-6 == pytest.approx(twist, abs=1e-8)


def calibration_effect(errors, profiler_pose, lever, change):
    """Return the change of the errors of the carriage with the pose (a, b, g, dx, dy, dz), to first order (eq. 14)."""
    return chain.commutator(change @ chain.pose_twists(profiler_pose, lever), errors)


def test_effect_of_a_wrong_pose_equals_a_new_evaluation(H, lever):
    # errors and calibration errors of the size in section 5 of Zhao et al.
    rng = np.random.default_rng(1)
    errors = rng.normal(0, [1e-5] * 6, (50, 6))
    M = motions(errors, H, lever)
    for change in rng.normal(0, [0.01] * 3 + [1e-3] * 3, (5, 6)):
        wrong = calibration.pose(*(calibration.parameters(H) + change))
        again, right = (errors_of(M, Rig(pose, lever)) for pose in (wrong, H))
        effect = calibration_effect(right, H, lever, change)
        # next order: the change, 0.01 rad, once more
        assert np.abs(again - right - effect).max(axis=0) / np.abs(effect).max(axis=0) == pytest.approx(0, abs=0.05)


@pytest.mark.parametrize("by_line", [False, True])
def test_assembly_with_a_wrong_pose_has_no_larger_effect_than_the_chain(gantry, H, lever, by_line):
    # 10 mrad against errors of 33 um and 10 urad: products of the two, some of them on the lever of 2.2 m
    raw = simulation.raw_scans(gantry, [0, T], [Y], seed=1, profiles=40, feed=1e-3, profiler=PERFECT, motion="rigid")
    right = errors_of(registered(gantry, raw, 1, by_line), Rig(H, lever))
    for change in 0.01 * np.eye(3, 6):
        wrong = calibration.pose(*(calibration.parameters(H) + change))
        motion = registered(gantry, raw, 1, by_line, wrong)
        again = errors_of(motion, Rig(wrong, lever))
        assert np.abs(again - right)[:3].max() < 0.01 * 33e-6
        assert np.abs(again - right)[3:].max() < 0.01 * 12e-6


def test_effect_of_a_wrong_pose_has_the_published_size(H):
    # 0.01 rad and 1 mm against 1e-5 rad and 0.01 mm, at the tool frame: 1e-7 rad and 0.1 um
    rng = np.random.default_rng(1)
    signs = rng.choice([-1, 1], (400, 2, 6))
    tool = np.zeros(3), np.array([0.01] * 3 + [1e-3] * 3), np.array([1e-5] * 6)
    near = RigidTransform.from_components([0, 0, 0], H.rotation)
    effect = np.abs([calibration_effect(tool[2] * e, near, tool[0], tool[1] * c) for c, e in signs])
    assert 0.5e-7 < effect[:, 3:].mean() < 3e-7
    assert 0.05e-6 < effect[:, :3].mean() < 0.3e-6


def test_pose_and_lever_are_in_the_covariance(H, lever):
    errors = np.array([3e-6, 40e-6, -8e-6, -20e-6, 15e-6, 5e-6])
    M = motions(errors, H, lever)
    size = [1e-3, 2e-3, 3e-3, 1e-5, 2e-5, 3e-5]
    found, C = chain.carriage_errors(M, np.zeros((6, 6)), Rig(H, lever, np.diag(size) ** 2))
    one_by_one = [calibration_effect(found, H, lever, step) for step in np.diag(size)]
    assert pytest.approx(np.einsum("si,sj", one_by_one, one_by_one), rel=1e-9, abs=1e-24) == C
    u = np.array([2e-3, 0, 1e-3])
    _, C = chain.carriage_errors(M, np.zeros((6, 6)), Rig(H, lever, lever_uncertainty=u))
    one_by_one = [errors_of(M, Rig(H, lever + step)) - found for step in np.diag(u)]
    assert pytest.approx(np.einsum("si,sj", one_by_one, one_by_one), rel=1e-9, abs=1e-24) == C


def test_truth_lies_within_the_stated_covariance(gantry, H, lever):
    truth = simulation.truth_axis(gantry, [T], [-0.5, Y]).em.twist().values[0]
    M = motions(truth, H, lever)
    root = np.diag([50e-9] * 3 + [0.5e-6] * 3) @ np.array(np.eye(6) + 0.3)
    C = np.tile(root @ root.T, (2, 1, 1))
    rng = np.random.default_rng(1)
    squares = []
    for _ in range(300):
        pose = calibration.pose(*(calibration.parameters(H) + rng.multivariate_normal(np.zeros(6), COVARIANCE)))
        seen = M + rng.normal(size=(2, 6)) @ root.T
        found, total = chain.carriage_errors(seen, C, Rig(pose, lever, COVARIANCE))
        squares.append(np.mean([m @ np.linalg.solve(c, m) for m, c in zip(found - truth, total, strict=True)]))
    # 300 draws of 12 numbers: 6 +/- 0.14
    assert np.mean(squares) == pytest.approx(6, abs=0.5)


def test_feed_is_along_the_machine(H):
    assert H.rotation.apply(chain.feed_direction(H)) == pytest.approx([0, 1, 0], abs=1e-15)


@pytest.mark.parametrize("covariance", [np.zeros((3, 3)), -np.eye(6)])
def test_a_covariance_of_the_pose_that_is_none_is_refused(covariance):
    with raises("scan.pose.covariance"):
        chain.root(covariance)


def displacement_of_map(H, twist, g, Q):
    """Return how a point Q of the map moves, by the geometry of the lines: from the definition."""
    f = chain.feed_direction(H)
    x, s, z = Q

    def seen(point, along):  # the map's coordinates of a point of the profiler's frame
        way = along + point[1] / f[1]
        return np.array([point[0] - point[1] / f[1] * f[0], way, point[2] - point[1] / f[1] * f[2]])

    moved = np.array([x, 0, z]) + twist[:3] + np.cross(twist[3:], [x, 0, z]) + s * g
    return seen(moved, s) - Q


def test_maps_move_according_to_the_matrix():
    H = calibration.pose(0.02, -0.015, 0.03, 0.0, 0.0, 0.0)
    rng = np.random.default_rng(1)
    W = chain.from_maps(H)
    for o in rng.normal(0, 1e-5, (5, 9)):
        TQ, RQ, c = np.split(np.linalg.solve(W, o), 3)
        for Q in rng.uniform(-0.03, 0.03, (5, 3)) * [1, 1, 0.05]:
            there = displacement_of_map(H, o[:6], o[6:], Q)
            stated = TQ + np.cross(RQ, Q) + Q[1] * c
            # what no rotation describes: 0.03 rad of 1e-5 rad over 20 mm in x, of which nothing is left in z
            assert there == pytest.approx(stated, abs=0.04 * 3e-5 * 0.03)
            assert there[2] == pytest.approx(stated[2], abs=0.04 * 3e-5 * 1.5e-3 + 1e-13)


def test_a_square_profiler_changes_nothing_but_the_drift():
    W = chain.from_maps(RigidTransform.identity())
    assert W[:6] == pytest.approx(np.eye(6, 9))
    # a rigid picture: no displacement beside the rotation, so that g is what the rotation does along the feed
    assert (W @ [0, 0, 0, 1, 2, 3, 0, 0, 0])[6:] == pytest.approx([-3, 0, 1])
