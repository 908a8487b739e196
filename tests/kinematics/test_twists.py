import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import RigidTransform, Rotation

from errormotion.kinematics import poses, twists
from errormotion.kinematics.iso import DOF, iso_names, location_names

metres = st.floats(-5.0, 5.0)
points = arrays(float, 3, elements=metres)
small_twists = arrays(float, 6, elements=st.floats(-1e-3, 1e-3))
rotation_vectors = arrays(float, 3, elements=st.floats(-3.0, 3.0))
# A sum of ten products of numbers up to 5 m and 1e-3 rad rounds by some 1e-17; five steps of it stay below 1e-15.
ROUNDING = 1e-15


@given(points, points)
def test_cross_matrix_is_the_cross_product(v, w):
    np.testing.assert_allclose(twists.cross_matrix(v) @ w, np.cross(v, w), atol=1e-14)


def test_cross_matrix_accepts_stacks():
    v = np.arange(24.0).reshape(2, 4, 3)
    assert twists.cross_matrix(v).shape == (2, 4, 3, 3)
    np.testing.assert_array_equal(twists.cross_matrix(v)[1, 2], twists.cross_matrix(v[1, 2]))


def test_a_yaw_moves_a_point_ahead_sideways():
    yaw = np.array([0, 0, 0, 0, 0, 10e-6])
    np.testing.assert_allclose(twists.move(yaw, [2.0, 0, 0]), [0, 20e-6, 0, 0, 0, 10e-6], atol=1e-20)


@given(small_twists, points)
def test_moving_there_and_back_changes_nothing(twist, shift):
    back = twists.move(twists.move(twist, shift), -shift)
    np.testing.assert_allclose(back, twist, atol=ROUNDING)


@given(small_twists, rotation_vectors, points)
def test_frame_there_and_back_changes_nothing(twist, vector, shift):
    pose = RigidTransform.from_components(shift, Rotation.from_rotvec(vector))
    back = twists.to_frame(twists.to_frame(twist, pose), pose.inv())
    np.testing.assert_allclose(back, twist, atol=ROUNDING)


@given(rotation_vectors, points, rotation_vectors, points)
def test_adjoints_compose(first, shift, second, then):
    Q1, Q2 = Rotation.from_rotvec(first), Rotation.from_rotvec(second)
    one_by_one = twists.adjoint(Q2, then) @ twists.adjoint(Q1, shift)
    at_once = twists.adjoint(Q2 * Q1, shift + Q1.inv().apply(then))
    np.testing.assert_allclose(one_by_one, at_once, atol=5e-14)


@settings(max_examples=40)
@given(small_twists, points, rotation_vectors, st.integers(0, 2**32 - 1))
def test_covariance_there_and_back_changes_nothing(twist, shift, vector, seed):
    half = np.random.default_rng(seed).normal(size=(6, 6)) * 1e-6
    covariance = half @ half.T
    A = twists.adjoint(Rotation.from_rotvec(vector), shift)
    back = twists.transform_covariance(twists.transform_covariance(covariance, A), np.linalg.inv(A))
    np.testing.assert_allclose(back, covariance, atol=1e-12 * 25 * np.trace(covariance))


def test_covariance_is_that_of_the_moved_draws():
    rng = np.random.default_rng(5)
    half = rng.normal(size=(6, 6))
    draws = rng.normal(size=(1000, 6)) @ half.T
    A = twists.adjoint(Rotation.from_euler("xyz", [0.2, -0.4, 1.0]), [0.3, -2.0, 0.7])
    moved = twists.transform(draws, A)
    np.testing.assert_allclose(np.cov(moved.T), twists.transform_covariance(np.cov(draws.T), A), rtol=1e-10)


def test_stacked_matrices_act_element_by_element():
    rng = np.random.default_rng(1)
    twist, shift = rng.normal(size=(4, 6)), rng.normal(size=(4, 3))
    moved = twists.move(twist, shift)
    covariance = np.broadcast_to(np.eye(6), (4, 6, 6))
    spread = twists.transform_covariance(covariance, twists.adjoint(shift=shift))
    for i in range(4):
        np.testing.assert_allclose(moved[i], twists.move(twist[i], shift[i]), rtol=1e-13)
        A = twists.adjoint(shift=shift[i])
        np.testing.assert_allclose(spread[i], A @ A.T, rtol=1e-13)


def test_unknown_freedom_affects_only_dependent_freedoms():
    no_roll_about_z = np.array([1e-6, 2e-6, 3e-6, 4e-6, 5e-6, np.nan])
    along_z = twists.move(no_roll_about_z, [0, 0, 0.1])
    np.testing.assert_allclose(along_z, [1.5e-6, 1.6e-6, 3e-6, 4e-6, 5e-6, np.nan])
    aside = twists.move(no_roll_about_z, [0.1, 0, 0])
    np.testing.assert_array_equal(np.isnan(aside), [False, True, False, False, False, True])


def test_unknown_freedom_is_one_freedom_after_a_quarter_turn():
    # cos 90 deg rounds to 6e-17; that is no dependence.
    pose = RigidTransform.from_rotation(Rotation.from_euler("x", 90, degrees=True))
    turned = twists.to_frame([1e-6, 2e-6, 3e-6, 4e-6, 5e-6, np.nan], pose)
    np.testing.assert_allclose(turned, [1e-6, -3e-6, 2e-6, 4e-6, np.nan, 5e-6])


def test_unknown_covariance_affects_only_dependent_elements():
    covariance = np.eye(6)
    covariance[5, :] = covariance[:, 5] = np.nan
    along_z = twists.transform_covariance(covariance, twists.adjoint(shift=[0, 0, 0.1]))
    expected = np.zeros((6, 6), dtype=bool)
    expected[5, :] = expected[:, 5] = True
    np.testing.assert_array_equal(np.isnan(along_z), expected)
    assert along_z[0, 0] == pytest.approx(1.01)
    aside = np.isnan(twists.transform_covariance(covariance, twists.adjoint(shift=[0.1, 0, 0])))
    expected[1, :] = expected[:, 1] = True
    np.testing.assert_array_equal(aside, expected)


def test_arguments_are_left_alone():
    twist, A = np.array([1, 2, 3, 4, 5, np.nan]), twists.adjoint(shift=[1.0, 2.0, 3.0])
    before = twist.copy(), A.copy()
    twists.transform(twist, A)
    np.testing.assert_array_equal(twist, before[0])
    np.testing.assert_array_equal(A, before[1])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: twists.move(np.zeros(5), np.zeros(3)), r"twist of shape \(..., 6\), found \(5,\)"),
        (lambda: twists.cross_matrix(np.zeros(2)), r"vector of shape \(..., 3\)"),
        (lambda: twists.transform(np.zeros(6), np.eye(3)), r"matrix of shape \(..., 6, 6\)"),
        (lambda: twists.transform_covariance(np.zeros(6), np.eye(6)), r"covariance of shape \(..., 6, 6\)"),
        (lambda: twists.adjoint(np.eye(4)), r"rotation of shape \(..., 3, 3\)"),
        (lambda: twists.adjoint(np.diag([1.0, 1.0, -1.0])), "proper rotation"),
    ],
)
def test_wrong_shapes_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@given(arrays(float, 6, elements=st.floats(-1.0, 1.0)))
def test_log_undoes_exp(twist):
    np.testing.assert_allclose(poses.log(poses.exp(twist)), twist, atol=1e-13)


@given(arrays(float, 6, elements=st.floats(-1.0, 1.0)), points)
def test_displacement_undoes_displaced(twist, point):
    np.testing.assert_allclose(poses.displacement(poses.displaced(twist, point), point), twist, atol=1e-13)


@given(arrays(float, 6, elements=st.floats(-1.0, 1.0)), rotation_vectors, points)
def test_adjoint_of_a_pose_is_the_conjugation_by_it(twist, vector, shift):
    pose = RigidTransform.from_components(shift, Rotation.from_rotvec(vector))
    conjugated = pose * poses.exp(twist) * pose.inv()
    expected = poses.exp(poses.adjoint_of(pose) @ twist)
    np.testing.assert_allclose(conjugated.as_matrix(), expected.as_matrix(), atol=1e-12)


@given(small_twists, points, points)
def test_moving_a_twist_is_the_first_order_of_the_exact_displacement(twist, point, shift):
    # What is left out is of second order: angle squared times lever, at most 3 * 1e-6 * 9 m.
    exact = poses.displacement(poses.displaced(twist, point), point + shift)
    np.testing.assert_allclose(twists.move(twist, shift), exact, atol=2e-5)
    tiny = 1e-4 * twist
    exact = poses.displacement(poses.displaced(tiny, point), point + shift)
    np.testing.assert_allclose(twists.move(tiny, shift), exact, atol=2e-13)


def test_iso_names():
    assert list(iso_names("X").values()) == ["EXX", "EYX", "EZX", "EAX", "EBX", "ECX"]
    assert list(iso_names("spindle").values()) == ["EXC", "EYC", "EZC", "EAC", "EBC", "ECC"]
    assert iso_names("spindle", spindle_axis="B")["EX"] == "EXB"
    assert tuple(iso_names("Y")) == DOF
    assert iso_names("tool") == {dof: dof for dof in DOF}
    with pytest.raises(ValueError, match=r"expected one of X, Y.*found 'Q'"):
        iso_names("Q")


def test_location_names():
    machine = ("X", "Y", "Z")
    assert location_names("X", machine) == {}
    assert location_names("Y", machine) == {"EC": "EC0Y"}
    assert location_names("Z", machine) == {"EA": "EA0Z", "EB": "EB0Z"}
    assert location_names("Z", ("X", "Z")) == {"EB": "EB0Z"}
    assert list(location_names("C", machine).values()) == ["EX0C", "EY0C", "EA0C", "EB0C"]
    assert list(location_names("W", machine).values()) == ["EA0W", "EB0W"]


def test_twists_need_no_scipy():
    code = (
        "import sys, errormotion.kinematics.twists, errormotion.kinematics.iso, errormotion.kinematics as k;"
        "k.twists.move([0]*6, [0]*3); sys.exit('scipy' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
