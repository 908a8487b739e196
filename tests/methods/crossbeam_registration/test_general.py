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


def sphere(rng, points=POINTS):
    v = rng.normal(size=(points, 3))
    return RADIUS * v / np.linalg.norm(v, axis=1, keepdims=True)


def pebble(rng, points=POINTS):
    """A closed surface with bumps: whatever the direction, two points lie behind one another."""
    v = sphere(rng, points) / RADIUS
    radius = RADIUS * (1 + 0.15 * np.sin(6 * v[:, 0]) + 0.1 * np.cos(4 * v[:, 1] + 3 * v[:, 2]))
    return radius[:, None] * v * [1.0, 1.3, 0.8]


def square(rng, points, half=4e-3):
    return rng.uniform(-half, half, (2, points))


def waves(rng, points):
    x, y = square(rng, points)
    return np.column_stack([x, y, 1e-3 * np.sin(600 * x + 100 * y) + 1e-3 * np.cos(500 * y - 80 * x)])


def plane(rng, points):
    x, y = square(rng, points)
    return np.column_stack([x, y, 0.2 * x])


def ridges(rng, points):
    x, y = square(rng, points)
    return np.column_stack([x, y, 0.5e-3 * np.sin(1500 * x)])


def cap(rng, points):
    x, y = square(rng, points, 2e-3)
    return np.column_stack([x, y, np.sqrt(25e-6 - x**2 - y**2)])


def cylinder(rng, points):
    angle, y = rng.uniform(0, 2 * np.pi, points), rng.uniform(-4e-3, 4e-3, points)
    return np.column_stack([RADIUS * np.cos(angle), y, RADIUS * np.sin(angle)])


def cone(rng, points):
    angle, height = rng.uniform(0, 2 * np.pi, points), rng.uniform(1e-3, 5e-3, points)
    return np.column_stack([height * np.cos(angle), height * np.sin(angle), height])


def pair(shape, seed, points=POINTS, noise=NOISE):
    rng = np.random.default_rng(seed)
    both = shape(rng, points), poses.displaced(TWIST).inv().apply(shape(rng, points))
    return [cloud + rng.normal(0, noise, cloud.shape) for cloud in both]


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


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.2e-6, 10e-6])
@pytest.mark.parametrize("points", [600, 4000])
@pytest.mark.parametrize("shape", [pebble, waves])
def test_the_covariance_holds_at_any_density(shape, points, noise):
    squares = []
    for seed in range(8):
        found = register_clouds(*pair(shape, seed, points, noise), point=np.zeros(3))
        error = found.twist - TWIST
        squares.append(error @ np.linalg.solve(found.covariance, error) / 6)
    # The mean of 8 values of chi2(6) / 6 scatters by sqrt(2 / 6 / 8) = 0.2; three of it.
    assert np.mean(squares) < 1.6


@pytest.mark.parametrize(
    ("shape", "loose"),
    [
        (plane, "EX, EY, EC"),
        (cap, "EX, EY, EC"),
        (sphere, "EA, EB, EC"),
        (cylinder, "EY, EB"),
        (ridges, "EY"),
        (cone, "EC"),
    ],
    ids=lambda value: value if isinstance(value, str) else value.__name__,
)
@pytest.mark.parametrize("points", [600, 4000])
@pytest.mark.parametrize("noise", [0.2e-6, 2e-6])
def test_freedoms_that_a_shape_leaves_undetermined_are_named_at_any_density(shape, loose, points, noise):
    for seed in range(3):
        with pytest.raises(MethodError, match=f"undetermined: {loose} "):
            register_clouds(*pair(shape, seed, points, noise))


@pytest.mark.parametrize("shape", [pebble, waves, plane, sphere, cylinder])
@pytest.mark.parametrize("points", [100, 200, 300, 400, 600])
def test_few_points_give_a_result_that_holds_or_are_refused(shape, points):
    for seed in range(6):
        try:
            found = register_clouds(*pair(shape, seed, points), point=np.zeros(3))
        except MethodError as refusal:
            said = str(refusal)
        else:
            # chi2(6) exceeds 33 once in 100 000
            error = found.twist - TWIST
            assert error @ np.linalg.solve(found.covariance, error) < 33
            assert shape in (pebble, waves)
            continue
        assert "undetermined" in said or "within 0.3 mm" in said
        assert points < 400 or shape not in (pebble, waves)
