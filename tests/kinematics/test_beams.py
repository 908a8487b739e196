"""Beams against their nominal ones, and how surfaces lie to them."""

import numpy as np
import pytest
from coded import raises
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from errormotion.kinematics.beams import (
    across,
    beam_errors,
    inclination_rotation,
    rotation_between,
    tilt,
    tilt_vector,
    turned,
)

U = np.array([0.3, -0.2, -0.9])
U /= np.linalg.norm(U)
T = np.array([0.1, 0.95, -0.2])
T /= np.linalg.norm(T)

angles = st.floats(-3.0, 3.0)
vectors = st.tuples(angles, angles, angles).map(np.array)


def surface(alpha, beta):
    """Normal of a surface from the definition: -u tilted by alpha towards the azimuth beta in the plane across u."""
    e1 = np.cross(T, U)
    e1 /= np.linalg.norm(e1)
    e2 = T - U * (U @ T)
    e2 /= np.linalg.norm(e2)
    return -U * np.cos(alpha) + (e1 * np.cos(beta) + e2 * np.sin(beta)) * np.sin(alpha)


@given(vectors)
def test_across_completes_a_direction_to_a_right_handed_frame(vector):
    u = Rotation.from_rotvec(vector).apply([0, 0, 1.0])
    frame = np.stack([u, *across(u)])
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(frame) > 0


@given(st.floats(0.01, 1.5), st.floats(0, 6.28))
def test_tilt_vector_is_inverted_to_inclination_and_rotation(alpha, beta):
    q = tilt(U, T, surface(alpha, beta))
    np.testing.assert_allclose(q, tilt_vector(alpha, beta), atol=1e-12 / np.cos(alpha) ** 2)
    found = inclination_rotation(q)
    assert found[0] == pytest.approx(alpha, abs=1e-9)
    assert np.cos(found[1] - beta) == pytest.approx(1, abs=1e-9)


def test_tilt_of_many_surfaces_is_nan_on_their_back():
    normals = np.stack([surface(0.3, 0.1), surface(0.3, 2.0), -surface(0.3, 0.1)])
    q = tilt(U, T, normals)
    np.testing.assert_allclose(q[:2], tilt_vector(0.3, [0.1, 2.0]), atol=1e-12)
    assert np.isnan(q[2]).all()


def test_tilt_does_not_depend_on_the_orientation_of_the_sensor():
    # Deflection is no third freedom: beam, triangulation plane and surface turned as one leave q as it is.
    normal, R = surface(0.4, 1.1), Rotation.from_rotvec([0.4, -1.2, 0.3])
    np.testing.assert_allclose(tilt(R.apply(U), R.apply(T), R.apply(normal)), tilt(U, T, normal), atol=1e-12)


def test_negative_inclination_is_half_a_turn():
    np.testing.assert_allclose(tilt_vector(-0.3, 0.2), tilt_vector(0.3, 0.2 + np.pi), atol=1e-15)


@pytest.mark.parametrize("q", [(0.0, 0.0), (1.0, -0.0), (1.0, -1e-18)])
def test_rotation_is_below_a_whole_turn(q):
    assert 0 <= inclination_rotation(np.array(q))[1] < 2 * np.pi


def test_triangulation_normal_along_the_beam_is_refused():
    with raises("beam.normal.along_beam"):
        tilt(U, -U, surface(0.1, 0.0))


@given(vectors)
def test_rotation_between_is_the_smallest_rotation(vector):
    u0 = np.array([0, 0.6, 0.8])
    u = Rotation.from_rotvec(vector).apply(u0)
    R = Rotation.from_rotvec(rotation_between(u0, u))
    np.testing.assert_allclose(R.apply(u0), u, atol=1e-9)
    assert R.magnitude() == pytest.approx(np.arctan2(np.linalg.norm(np.cross(u0, u)), u0 @ u), abs=1e-9)


def test_opposite_directions_have_no_smallest_rotation():
    assert np.isnan(rotation_between([0, 0, 1.0], [0, 0, -1.0])).all()


@pytest.mark.parametrize("angle", [0.0, 1e-4, 9.9e-4, 1.1e-3, 0.2, 1.2])
def test_covariance_of_errors_follows_the_derivative(angle):
    u0 = np.array([0.48, -0.6, 0.64])
    u = Rotation.from_rotvec(angle * across(u0)[0]).apply(u0)
    spread = np.array([2e-6, 3e-6])
    moved = [turned(u, spread * e) for e in np.concatenate([np.eye(2), -np.eye(2)])]
    factor = np.array(
        [(rotation_between(u0, a) - rotation_between(u0, b)) / 2 for a, b in zip(moved[:2], moved[2:], strict=True)]
    )
    C = np.zeros((1, 6, 6))
    C[0, 3:, 3:] = across(u).T @ np.diag(spread**2) @ across(u)
    origin = np.zeros((1, 3))
    errors, covariance = beam_errors(origin, u0[None], origin, u[None], C)
    np.testing.assert_allclose(errors[0, 3:], rotation_between(u0, u))
    np.testing.assert_allclose(covariance[0, 3:, 3:], factor.T @ factor, atol=1e-6 * spread[0] ** 2)


def test_unknown_origin_and_rotation_about_the_beam_are_nan():
    origin, nominal = np.array([[np.nan] * 3, [0.1, 0, 0]]), np.array([[0, 0, -1.0], [0, 0, -1.0]])
    C = np.broadcast_to(np.eye(6) * 1e-12, (2, 6, 6))
    errors, covariance = beam_errors(np.zeros((2, 3)), nominal, origin, nominal, C)
    assert np.isnan(errors).tolist() == [[True] * 3 + [False, False, True], [False] * 5 + [True]]
    assert (np.isnan(np.diagonal(covariance, axis1=1, axis2=2)) == np.isnan(errors)).all()


def test_beam_that_points_away_is_refused():
    with raises("beam.direction.opposite"):
        beam_errors(np.zeros((1, 3)), [[0, 0, 1.0]], np.zeros((1, 3)), [[0, 0, -1.0]], np.zeros((1, 6, 6)))
