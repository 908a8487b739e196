"""Clouds that are no height map: how the sensor moved, what that is worth, and what is refused."""

import needed_open3d
import numpy as np
import pytest

from errormotion.errors import MethodError
from errormotion.kinematics import poses
from errormotion.methods.crossbeam_scan.identification.registration import register_clouds

TWIST = np.array([23e-6, -41e-6, 17e-6, 30e-6, -55e-6, 80e-6])
NOISE, RADIUS = 2e-6, 2e-3
POINTS = 9000


@pytest.fixture(autouse=True, scope="module")
def _open3d():
    needed_open3d.open3d()


def sphere(rng):
    v = rng.normal(size=(POINTS, 3))
    return RADIUS * v / np.linalg.norm(v, axis=1, keepdims=True)


def pebble(rng):
    """A closed surface with bumps: whatever the direction, two points lie behind one another."""
    v = sphere(rng) / RADIUS
    radius = RADIUS * (1 + 0.15 * np.sin(6 * v[:, 0]) + 0.1 * np.cos(4 * v[:, 1] + 3 * v[:, 2]))
    return radius[:, None] * v * [1.0, 1.3, 0.8]


def pair(shape, seed):
    rng = np.random.default_rng(seed)
    both = shape(rng), poses.displaced(TWIST).inv().apply(shape(rng))
    return [cloud + rng.normal(0, NOISE, cloud.shape) for cloud in both]


@pytest.mark.slow
def test_motion_of_a_cloud_that_is_no_height_map_and_what_it_is_worth():
    squares = []
    for seed in range(24):
        found = register_clouds(*pair(pebble, seed), point=np.zeros(3))
        error = found.twist - TWIST
        squares.append(error @ np.linalg.solve(found.covariance, error) / 6)
    # The mean of 24 values of chi2(6) / 6 scatters by sqrt(2 / 6 / 24) = 0.12; three of it.
    assert abs(np.mean(squares) - 1.0) < 0.36
    # Curvature between neighbours adds to the noise, by a sixth here.
    assert found.noise[0] == pytest.approx(NOISE, rel=0.3)
    assert found.backend == "open3d_plane"
    assert found.residual.size == 0


def test_the_result_holds_at_any_point():
    cold, warm = pair(pebble, 3)
    cold[5], warm[7:9] = np.nan, np.nan
    middle = register_clouds(cold, warm)
    there = register_clouds(cold, warm, point=[0.0, 0.1, 0.0])
    twist, covariance = middle.at(np.array([0.0, 0.1, 0.0]))
    np.testing.assert_allclose(there.twist, twist, rtol=1e-9)
    np.testing.assert_allclose(there.covariance, covariance, rtol=1e-9)
    assert (there.sigma[[0, 2]] > 10 * middle.sigma[[0, 2]]).all()


def test_a_ball_has_no_rotation():
    with pytest.raises(MethodError, match="undetermined: EA, EB, EC"):
        register_clouds(*pair(sphere, 0))
