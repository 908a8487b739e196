"""The chain: errors of the carriage from the motion of the profiler's frame, against the virtual machine and itself."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from errormotion.datasets import build_errors, provenance, validate
from errormotion.errors import MethodError
from errormotion.kinematics.poses import displaced, displacement, log
from errormotion.methods.crossbeam_scan import simulation
from errormotion.methods.crossbeam_scan.identification import chain
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
    found = chain.carriage_errors(motions(truth, H, lever), np.zeros((3, 2, 6, 6)), H, lever)
    # second order: 2.2 m times (30 urad)^2
    assert found.values[..., :3] == pytest.approx(truth[..., :3], abs=2e-9)
    assert found.values[..., 3:] == pytest.approx(truth[..., 3:], abs=1e-9)
    assert not found.values[0].any()


def test_sign_and_direction_are_those_of_the_scans(gantry, H, lever):
    scans = {"seed": 1, "profiles": 40, "feed": 1e-3, "profiler": PERFECT, "motion": "rigid"}
    raw = simulation.raw_scans(gantry, [0, T], [Y], **scans)
    truth = simulation.truth_axis(gantry, [T], [Y]).em.twist().values[0, 0]
    assert np.abs(registered(gantry, raw, 0)).max() < 1e-9
    found = chain.carriage_errors(registered(gantry, raw, 1), np.zeros((6, 6)), H, lever)
    # float32 and second order
    assert found.values == pytest.approx(truth, abs=2e-9)


def missed(machine, by_line):
    """Return what the chain misses of the true motion (6,), m and rad."""
    H, lever = RigidTransform.from_matrix(machine.crossbeam.pose), machine.crossbeam.lever
    raw = simulation.raw_scans(machine, [0, T], [Y], seed=1, profiles=40, feed=1e-3, profiler=PERFECT)
    found = chain.carriage_errors(registered(machine, raw, 1, by_line), np.zeros((6, 6)), H, lever)
    return found.values - simulation.truth_axis(machine, [T], [Y]).em.twist().values[0, 0]


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
        again, right = (chain.carriage_errors(M, np.zeros((50, 6, 6)), pose, lever).values for pose in (wrong, H))
        effect = calibration_effect(right, H, lever, change)
        # next order: the change, 0.01 rad, once more
        assert np.abs(again - right - effect).max(axis=0) / np.abs(effect).max(axis=0) == pytest.approx(0, abs=0.05)


@pytest.mark.parametrize("by_line", [False, True])
def test_assembly_with_a_wrong_pose_has_no_larger_effect_than_the_chain(gantry, H, lever, by_line):
    # 10 mrad against errors of 33 um and 10 urad: products of the two, some of them on the lever of 2.2 m
    raw = simulation.raw_scans(gantry, [0, T], [Y], seed=1, profiles=40, feed=1e-3, profiler=PERFECT, motion="rigid")
    right = chain.carriage_errors(registered(gantry, raw, 1, by_line), np.zeros((6, 6)), H, lever).values
    for change in 0.01 * np.eye(3, 6):
        wrong = calibration.pose(*(calibration.parameters(H) + change))
        motion = registered(gantry, raw, 1, by_line, wrong)
        again = chain.carriage_errors(motion, np.zeros((6, 6)), wrong, lever).values
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


def test_influence_is_the_effect_of_one_standard_uncertainty(H, lever):
    errors = np.array([3e-6, 40e-6, -8e-6, -20e-6, 15e-6, 5e-6])
    M = motions(errors, H, lever)
    size = [1e-3, 2e-3, 3e-3, 1e-5, 2e-5, 3e-5]
    found = chain.carriage_errors(M, np.zeros((6, 6)), H, lever, pose_covariance=np.diag(size) ** 2)
    one_by_one = [calibration_effect(found.values, H, lever, step) for step in np.diag(size)]
    assert found.covariance == pytest.approx(np.einsum("si,sj", one_by_one, one_by_one), rel=1e-9, abs=1e-24)
    assert np.einsum("si,sj", found.influence, found.influence) == pytest.approx(found.covariance)


def test_lever_is_a_separate_source(H, lever):
    errors = np.array([0, 0, 0, 20e-6, 10e-6, -5e-6])
    M = motions(errors, H, lever)
    found = chain.carriage_errors(M, np.zeros((6, 6)), H, lever, lever_uncertainty=(2e-3, 0, 2e-3))
    again = chain.carriage_errors(M, np.zeros((6, 6)), H, lever + np.array([2e-3, 0, 0])).values - found.values
    assert found.influence[found.sources.index("lever x")] == pytest.approx(again, abs=1e-13)
    assert not found.influence[found.sources.index("lever y")].any()


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
        found = chain.carriage_errors(seen, C, pose, lever, pose_covariance=COVARIANCE)
        miss = found.values - truth
        squares.append(np.mean([m @ np.linalg.solve(c, m) for m, c in zip(miss, found.covariance, strict=True)]))
    # 300 draws of 12 numbers: 6 +/- 0.14
    assert np.mean(squares) == pytest.approx(6, abs=0.5)


def test_results_make_a_valid_error_dataset_with_a_gap(gantry, H, lever):
    truth = simulation.truth_axis(gantry, [0, T], [-0.5, Y]).em.twist().values
    M = motions(truth, H, lever)
    M[1, 0] = np.nan
    C = np.tile(np.diag([50e-9] * 3 + [0.5e-6] * 3) ** 2, (2, 2, 1, 1))
    found = chain.carriage_errors(M, C, H, lever, pose_covariance=COVARIANCE, lever_uncertainty=(1e-3, 0, 1e-3))
    assert np.isnan(found.values[1, 0]).all()
    assert np.isfinite(np.delete(found.values.reshape(4, 6), 2, axis=0)).all()
    ds = build_errors(
        found.values,
        found.covariance,
        dims=("time", "position"),
        coords={"time": [0.0, T], "y": ("position", [-0.5, Y], {"units": "m"})},
        component="Y",
        machine="Gantry 4000",
        frame="carriage",
        functional_point=np.zeros(3),
        reference="cold scan",
        method="crossbeam_scan",
        method_version="1",
        provenance=provenance.make({}, None, None),
        influence=found.influence,
        sources=found.sources,
        source_groups=found.source_groups,
    )
    validate(ds)


def test_feed_is_along_the_machine(H):
    assert H.rotation.apply(chain.feed_direction(H)) == pytest.approx([0, 1, 0], abs=1e-15)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"motion": np.zeros(5)}, r"motions \(\.\.\., 6\)"),
        ({"covariance": np.zeros((2, 6, 6))}, "found"),
        ({"pose_covariance": np.zeros((3, 3))}, "symmetric"),
        ({"pose_covariance": -np.eye(6)}, "symmetric"),
    ],
)
def test_wrong_shapes_are_refused(H, lever, changes, message):
    given = {"motion": np.zeros(6), "covariance": np.zeros((6, 6)), "profiler_pose": H, "lever": lever} | changes
    with pytest.raises(MethodError, match=message):
        chain.carriage_errors(**given)
