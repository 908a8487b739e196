"""Artefacts under the line profiler: rays meet surfaces where geometry says, and each disturbance does what it is."""

import numpy as np
import pytest
from coded import raises
from scipy.special import ndtr

from errormotion.kinematics.poses import displaced
from errormotion.twin.artefacts import pieces as artefacts
from errormotion.twin.sensors.profiler import Disturbances, Profiler

SHAPES = {
    "free form": artefacts.swept(),
    "plane": artefacts.plane(),
    "sphere": artefacts.sphere(),
    "pocket": artefacts.circular_pocket(),
}
TILTED = [1e-4, -2e-4, 3e-4, 0.011, -0.007, 0.02]
UM = 1e-6


def lines(n=60, feed=0.5e-3, twist=TILTED):
    """Poses of a profiler, tilted and shifted, that goes along y."""
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, 1, 3] = (np.arange(n) - (n - 1) / 2) * feed
    return poses @ displaced(twist).as_matrix()


def seen(profiler, heights, poses):
    """Points (line, point, 3) of a scan in the frame of the artefact."""
    x = np.broadcast_to(profiler.x, heights.shape)
    points = np.stack([x, np.zeros_like(x), heights, np.ones_like(x)], axis=-1)
    return np.einsum("nij,npj->npi", poses, points)[..., :3]


def test_points_stand_as_in_the_head():
    x = Profiler().x
    assert x.size == 3200
    assert x[1600] == 0
    assert x[0] == pytest.approx(-1600 * 12.5e-6)


@pytest.mark.parametrize("name", ["free form", "plane", "sphere"])
def test_every_point_of_a_perfect_scan_lies_on_the_surface(name):
    profiler, poses = Profiler(400, 100 * UM, disturbances=Disturbances.none()), lines()
    heights = profiler.scan(SHAPES[name], poses)
    points = seen(profiler, heights, poses)
    there = SHAPES[name].height(points[..., 0], points[..., 1])
    assert np.isfinite(heights).mean() > 0.8
    # rounding of levers of some centimetres, and of the last step of the iteration
    assert np.nanmax(np.abs(points[..., 2] - there)) < 1e-14
    assert np.array_equal(np.isnan(heights), np.isnan(there)) or name == "sphere"


def test_free_form_is_the_function_it_was_made_from():
    def wave(x, y):
        return 3e-3 * np.sin(2 * np.pi * x / 20e-3) + 0.1 * x * y

    x, y = np.random.default_rng(1).uniform(-0.02, 0.02, (2, 500))
    # 3e-19 m^4 times the fourth derivative, 3 mm (2 pi / 20 mm)^4
    assert artefacts.freeform(wave).height(x, y) == pytest.approx(wave(x, y), abs=1.2e-11)


def test_swept_surface_is_not_too_steep_for_readings():
    artefact = SHAPES["free form"]
    x, y = np.meshgrid(np.linspace(-0.022, 0.022, 400), np.linspace(-0.03, 0.03, 400), indexing="ij")
    slopes = np.gradient(artefact.height(x, y), x[:, 0], y[0])
    assert np.hypot(*slopes).max() < 1.0


def test_no_readings_beside_the_artefact():
    assert np.isnan(SHAPES["plane"].height([0.0221, 0.0], [0.0, -0.0301])).all()
    profiler = Profiler(3200, disturbances=Disturbances.none())
    heights = profiler.scan(artefacts.plane((10e-3, 30e-3)), lines(twist=[0] * 6))
    assert np.array_equal(np.isfinite(heights[0]), np.abs(profiler.x) <= 10e-3)


def test_pocket_has_its_rim_where_the_spot_is_half_in():
    profiler = Profiler(disturbances=Disturbances.none())
    artefact = artefacts.circular_pocket(10e-3, 4e-3, spot=12e-6)
    heights = profiler.scan(artefact, lines(3, 1e-9, [0] * 6))[1]
    assert heights == pytest.approx(-4e-3 * ndtr((10e-3 - np.abs(profiler.x)) / 12e-6), abs=1e-12)


def test_tilted_ray_reaches_the_floor_of_the_pocket_farther_on():
    profiler, tilt = Profiler(disturbances=Disturbances.none()), 0.01
    poses = lines(3, 1e-9, [0, 0, 0, 0, tilt, 0])
    points = seen(profiler, profiler.scan(SHAPES["pocket"], poses), poses)[1]
    floor = np.abs(points[:, 0]) < 12e-3
    assert points[floor, 2] == pytest.approx(-5e-3, abs=1e-12)


def test_unphysical_artefacts_are_refused():
    with raises("virtual.artefact.length"):
        artefacts.circular_pocket(-1)
    with raises("virtual.surface.heights"), np.errstate(invalid="ignore"):
        artefacts.freeform(lambda x, y: np.sqrt(x))
    with raises("virtual.poses.shape"):
        Profiler().scan(SHAPES["plane"], np.eye(4))


def errors_of(**wrong):
    """Return (line, point) of what a disturbance alone does to a scan of a plane, and the scan's places."""
    profiler = Profiler(1600, 25 * UM, disturbances=Disturbances(**(vars(Disturbances.none()) | wrong)))
    heights = profiler.scan(artefacts.plane(), lines(twist=[0] * 6), key=(7,))
    return heights, profiler


def test_key_determines_the_numbers():
    profiler, poses = Profiler(400, 100 * UM, disturbances=Disturbances(blobs=2)), lines()
    one, same, other = (profiler.scan(SHAPES["free form"], poses, key=key) for key in ((3,), (3,), (4,)))
    assert np.array_equal(one, same, equal_nan=True)
    assert not np.array_equal(one, other, equal_nan=True)


def test_noise_is_white_and_of_the_stated_size():
    noise, _ = errors_of(noise=0.5 * UM)
    assert noise.std() == pytest.approx(0.5 * UM, rel=5 / np.sqrt(2 * noise.size))
    for shifted in (noise[1:] * noise[:-1], noise[:, 1:] * noise[:, :-1]):
        assert abs(shifted.mean()) < 5 * noise.var() / np.sqrt(noise.size)


def test_jitter_in_z_is_one_shift_per_line():
    heights, _ = errors_of(jitter_z=0.5 * UM)
    assert np.ptp(heights, axis=1).max() == 0
    assert heights[:, 0].std() == pytest.approx(0.5 * UM, rel=4 / np.sqrt(2 * 60))


def test_jitter_in_y_shows_as_slope_times_shift():
    ramp = artefacts.freeform(lambda x, y: 0.1 * y)
    wrong = Disturbances(**(vars(Disturbances.none()) | {"jitter_y": 2 * UM}))
    poses = lines(twist=[0] * 6)
    heights = Profiler(400, 100 * UM, disturbances=wrong).scan(ramp, poses, key=(7,))
    shift = heights[:, 0] / 0.1 - poses[:, 1, 3]
    assert shift.std() == pytest.approx(2 * UM, rel=4 / np.sqrt(2 * 60))
    assert np.ptp(heights, axis=1).max() < 1e-15


def test_speckle_is_correlated_over_its_points_and_not_between_lines():
    heights, _ = errors_of(speckle=0.4 * UM, speckle_points=3.0)
    assert heights.std() == pytest.approx(0.4 * UM, rel=0.03)
    for apart in (1, 3, 6):
        correlation = np.mean(heights[:, apart:] * heights[:, :-apart]) / heights.var()
        assert correlation == pytest.approx(np.exp(-apart / 3), abs=0.03)
    assert abs(np.mean(heights[1:] * heights[:-1])) < 0.03 * heights.var()


def test_too_steep_points_have_no_reading():
    wrong = Disturbances(**(vars(Disturbances.none()) | {"steepest": 0.5}))
    profiler, radius = Profiler(3200, disturbances=wrong), 25e-3
    heights = profiler.scan(artefacts.sphere(radius), lines(3, 1e-9, [0] * 6))[1]
    # slope 0.5 on a sphere lies at r sin(atan(0.5))
    reach = np.abs(profiler.x[np.isfinite(heights)]).max()
    assert reach == pytest.approx(radius * np.sin(np.arctan(0.5)), abs=profiler.pitch)


def test_stray_light_is_limited_to_the_edges():
    wrong = Disturbances(**(vars(Disturbances.none()) | {"edge_lift": 30 * UM, "edge_reach": 150 * UM}))
    profiler = Profiler(disturbances=wrong)
    heights = profiler.scan(artefacts.plane((15e-3, 30e-3)), lines(20, 0.5e-3, [0] * 6))
    inside = np.abs(profiler.x) < 15e-3 - 151 * UM
    assert np.ptp(heights[:, inside]) == 0
    last = np.flatnonzero(np.isfinite(heights[0]))[[0, -1]]
    assert heights[:, last].mean() == pytest.approx(30 * UM, rel=0.3)


def test_outliers_and_losses_are_as_frequent_as_stated():
    heights, _ = errors_of(outliers=0.01, outlier_spread=0.5e-3, missing=0.02)
    n = heights.size
    assert np.isnan(heights).mean() == pytest.approx(0.02, abs=5 * np.sqrt(0.02 / n))
    assert np.mean(np.abs(heights) > 0) == pytest.approx(0.01, abs=5 * np.sqrt(0.01 / n))
    assert np.nanstd(heights[heights != 0]) == pytest.approx(0.5e-3, rel=0.15)


def test_blobs_are_gaps_of_their_size():
    heights, _ = errors_of(blobs=1, blob_radius=2e-3)
    area = np.isnan(heights).sum() * 25 * UM * 0.5e-3
    assert 0 < area < 1.05 * np.pi * 3e-3**2


def test_out_of_range_is_no_reading():
    profiler = Profiler(100, 100 * UM, low=-1e-3, high=1e-3, disturbances=Disturbances.none())
    assert np.isnan(profiler.scan(SHAPES["plane"], lines(3, twist=[0, 0, 1.1e-3, 0, 0, 0]))).all()
    assert np.isfinite(profiler.scan(SHAPES["plane"], lines(3, twist=[0, 0, 0.9e-3, 0, 0, 0]))).all()
