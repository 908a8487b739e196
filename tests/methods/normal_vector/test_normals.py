"""The published construction, and what it costs."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from errormotion.kinematics.twists import cross_matrix
from errormotion.methods.normal_vector.identification import normals

BALLS = np.array([(1.0, -0.5, 0.1), (3.0, -0.6, 0.3), (2.0, 0.6, 0.15), (1.5, 0.1, 0.6)])
POINT = np.array([2.0, 0.0, 0.3])


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.5, 2.5])
def test_cayley_from_two_normals_gives_the_rotation_exactly(angle):
    rotation = angle * np.array([2.0, -1.0, 2.0]) / 3
    before = normals.plane_normals(BALLS)
    found = normals.cayley_rotation(before, Rotation.from_rotvec(rotation).apply(before))
    np.testing.assert_allclose(found, rotation, atol=1e-14, rtol=1e-9)


def test_singular_u_is_no_obstacle():
    u = np.array([0.3, -0.2, 0.1])
    U = cross_matrix(u)
    assert abs(np.linalg.det(U)) < 1e-15
    R = (np.eye(3) + U) @ np.linalg.inv(np.eye(3) - U)
    h = normals.plane_normals(BALLS)
    np.testing.assert_allclose(h @ R.T - h, np.cross(u, h @ R.T + h), atol=1e-15)  # H - h = U (H + h)
    axis = normals.cayley_rotation(h, h @ R.T)
    np.testing.assert_allclose(np.tan(np.linalg.norm(axis) / 2) * axis / np.linalg.norm(axis), u, rtol=1e-12)


def test_one_normal_leaves_the_turn_about_itself_open():
    H, h = normals.plane_normals(BALLS)[:1], normals.plane_normals(BALLS)[:1]
    assert np.linalg.matrix_rank(cross_matrix(H + h)[0]) == 2


def test_published_signs_make_no_rotation_where_ours_do():
    """Eq. (5) of the paper has +eps_x in row 2, column 3: that matrix is not antisymmetric and stretches."""
    x, y, z = 1e-4, 2e-4, -1e-4
    published = np.array([(1, -z, y), (z, 1, x), (-y, x, 1)])
    corrected = np.array([(1, -z, y), (z, 1, -x), (-y, x, 1)])
    exact = Rotation.from_rotvec([x, y, z]).as_matrix()
    assert np.abs(corrected - exact).max() < 1e-7  # second order
    assert np.abs(published - exact).max() > 1.9e-4  # twice the angle
    assert np.abs(corrected.T @ corrected - np.eye(3)).max() < 1e-7
    assert np.abs(published.T @ published - np.eye(3)).max() > 1.9e-4


def test_twist_of_a_rigid_motion_is_exact():
    error = np.array([2e-5, -3e-5, 5e-5, 6e-5, -8e-5, 4e-5])
    # What the machine sees: places p with p + E + (R - 1)(p - f) = b.
    R = Rotation.from_rotvec(error[3:])
    seen = R.inv().apply(BALLS - POINT - error[:3]) + POINT
    np.testing.assert_allclose(normals.twist(BALLS, seen, POINT), error, atol=1e-15)


def test_covariance_is_that_of_many_draws():
    rng = np.random.default_rng(5)
    noise = 0.2e-6
    cold, now = BALLS + noise * rng.normal(size=(2, 20000, 4, 3))
    found = normals.twist(cold[:4000], now[:4000], POINT)
    C = np.broadcast_to(noise**2 * np.eye(3), (4, 3, 3))
    stated = normals.covariance(C, C[None], POINT, BALLS)[0]
    # A standard deviation over 4000 draws is known to 1.1 %.
    np.testing.assert_allclose(found.std(axis=0), np.sqrt(np.diag(stated)), rtol=0.045)
