import numpy as np
import pytest
from coded import raises

from errormotion.kinematics.fits import fit_circle, fit_cone, fit_cylinder, fit_line, fit_plane, fit_sphere

# A check bar of 50 mm (+/- 2 um) measured in three ways, mm: Lu et al., table 2.
TOUCH_PROBE = [
    (3.537, 7.167), (1.539, 6.920), (-0.432, 6.513), (-2.365, 5.949), (-4.246, 5.231), (-6.063, 4.364),
    (-7.805, 3.354), (-9.459, 2.207), (-11.016, 0.930), (-12.465, -0.468), (-9.375, -37.768), (-7.715, -38.909),
    (-5.969, -39.912), (-4.149, -40.771), (-2.265, -41.481), (-0.330, -42.037), (1.644, -42.436), (3.643, -42.674),
    (5.655, -42.751), (7.667, -42.666),
]  # fmt: skip
LASER_AT_ZERO = [
    (159.892, -90.0757), (157.834, -92.1039), (156.213, -94.1168), (154.881, -96.1332), (153.850, -98.0827),
    (153.023, -100.019), (152.366, -102.026), (151.895, -104.003), (151.576, -105.988), (151.490, -107.039),
    (151.420, -109.01), (151.514, -111.085), (151.788, -113.099), (152.215, -115.098), (152.800, -117.029),
    (153.598, -119.048), (154.592, -121.023), (155.847, -123.042), (157.408, -125.064), (159.315, -127.065),
]  # fmt: skip
LASER_0_DEG = [  # raw, compensated, y
    (-4.273, -4.338, 81.414), (-1.878, -1.901, 79.413), (0.007, 0.007, 77.414), (1.527, 1.544, 75.413),
    (2.772, 2.797, 73.413), (3.776, 3.802, 71.411), (4.561, 4.590, 69.419), (5.177, 5.199, 67.418),
    (5.58, 5.465, 65.418), (5.833, 5.839, 63.411), (5.944, 5.946, 61.412), (5.887, 5.884, 59.415),
    (5.651, 5.640, 57.412), (5.26, 5.244, 55.416), (4.687, 4.667, 53.415), (3.931, 3.914, 51.414),
    (2.969, 2.949, 49.417), (1.784, 1.769, 47.417), (0.294, 0.291, 45.413), (-1.536, -1.513, 43.417),
]  # fmt: skip
LASER_90_DEG = [
    (-2.345, -2.322, -90.242), (-0.356, -0.354, -92.239), (1.253, 1.246, -94.244), (2.537, 2.527, -96.234),
    (3.590, 3.579, -98.237), (4.427, 4.415, -100.235), (5.064, 5.055, -102.230), (5.517, 5.510, -104.233),
    (5.830, 5.807, -106.234), (5.947, 5.949, -108.230), (5.929, 5.924, -110.236), (5.716, 5.706, -112.238),
    (5.364, 5.352, -114.243), (4.837, 4.818, -116.229), (4.134, 4.113, -118.229), (3.212, 3.190, -120.238),
    (2.065, 2.049, -122.239), (0.665, 0.658, -124.235), (-1.070, -1.133, -126.236), (-3.242, -3.283, -128.230),
]  # fmt: skip

TURN = np.linalg.qr(np.random.default_rng(12).normal(size=(3, 3)))[0]
FITS = {
    "line": fit_line,
    "plane": fit_plane,
    "circle": fit_circle,
    "circle in space": fit_circle,
    "sphere": fit_sphere,
    "cylinder": fit_cylinder,
    "cylinder of known radius": lambda points, **k: fit_cylinder(points, 0.025, **k),
    "cone": fit_cone,
}


def noisy(shape, n, rng, noise=1e-6):
    a, h, e = rng.uniform(0, 2 * np.pi, n), rng.uniform(-0.05, 0.05, n), noise * rng.normal(size=n)
    ring = np.column_stack([np.cos(a), np.sin(a)])
    if shape == "circle":
        return (0.025 + e)[:, None] * ring
    if shape == "line":
        p = np.column_stack([e, noise * rng.normal(size=n), h])
    elif shape == "plane":
        p = np.column_stack([h, rng.uniform(-0.05, 0.05, n), e])
    elif shape == "circle in space":
        p = np.column_stack([(0.025 + e)[:, None] * ring, noise * rng.normal(size=n)])
    elif shape == "sphere":
        v = rng.normal(size=(n, 3))
        p = (0.025 + e)[:, None] * v / np.linalg.norm(v, axis=1, keepdims=True)
    elif shape == "cone":
        p = np.column_stack([(0.04 + 0.3 * h + e)[:, None] * ring, h])
    else:
        p = np.column_stack([(0.025 + e)[:, None] * ring, h])
    return p @ TURN


def test_fit_to_touches_of_the_check_bar():
    circle = fit_circle(TOUCH_PROBE)
    np.testing.assert_allclose([*circle.centre, circle.radius], [5.6026, -17.7493, 25.0018], atol=5e-5)
    assert circle.rms == pytest.approx(0.19e-3, abs=0.005e-3)


def test_fit_to_laser_points_at_zero_on_the_check_bar():
    circle = fit_circle(LASER_AT_ZERO)
    np.testing.assert_allclose([*circle.centre, circle.radius], [176.4197, -108.8329, 25.0009], atol=6e-5)
    assert circle.rms == pytest.approx(3.4e-3, abs=0.05e-3)


@pytest.mark.parametrize(
    ("table", "column", "radius", "rms"),
    [(LASER_0_DEG, 0, 25.0122, 7.1e-3), (LASER_90_DEG, 0, 25.0142, 5.2e-3), (LASER_90_DEG, 1, 25.0022, 9e-3)],
)
def test_laser_scans_of_the_check_bar(table, column, radius, rms):
    points = np.array(table)[:, [column, 2]]
    circle = fit_circle(points, robust=True)
    assert circle.left_out == ()
    assert circle.radius == pytest.approx(radius, abs=5e-5)
    assert circle.rms == pytest.approx(rms, abs=0.06e-3)


def test_misprint_in_the_published_table_is_detected():
    points = np.array(LASER_0_DEG)[:, [1, 2]]
    circle = fit_circle(points, robust=True)
    assert circle.left_out == (8,)
    assert circle.radius == pytest.approx(24.961, abs=5e-4)
    assert circle.rms == pytest.approx(14e-3, abs=0.5e-3)
    assert abs(circle.residuals[8]) > 0.1  # it is judged, not forgotten
    np.testing.assert_allclose(circle.parameters, fit_circle(np.delete(points, 8, axis=0)).parameters, rtol=1e-12)


@pytest.mark.parametrize("shape", list(FITS))
def test_outliers_are_listed_and_have_no_effect(shape):
    """30 % of the points off by 0.1 mm to millimetres, noise 1 um."""
    rng = np.random.default_rng(4)
    points = noisy(shape, 40, rng)
    wrong = rng.choice(40, 12, replace=False)
    away = rng.normal(size=(12, points.shape[1]))
    points[wrong] += away / np.linalg.norm(away, axis=1, keepdims=True) * rng.choice([2e-4, 5e-3], size=(12, 1))
    robust = FITS[shape](points, robust=True)
    named, rest = set(robust.left_out), np.setdiff1d(np.arange(40), wrong)
    assert named <= set(wrong.tolist())
    # A point that was moved along the shape is right again: what stays in must be within the noise.
    assert np.abs(np.delete(robust.residuals, list(named))).max() < 5e-6
    assert len(named) >= 8
    # The shape lies where the right points alone put it, within the uncertainty of a fit to 28 points.
    clean = FITS[shape](points[rest])
    np.testing.assert_allclose(robust.residuals[rest], clean.residuals, atol=2e-6)


@pytest.mark.parametrize(("shape", "fits"), [("circle", 150), ("plane", 40), ("line", 40), ("cylinder", 12)])
def test_clean_points_are_rarely_excluded(shape, fits):
    rng = np.random.default_rng(20)
    accused = sum(bool(FITS[shape](noisy(shape, 16, rng), robust=True).left_out) for _ in range(fits))
    # One fit in a hundred; the binomial's 1e-3 point at 150 fits of probability 0.01 is 6.
    assert accused <= 6 * fits / 150 + 1


@pytest.mark.parametrize("shape", list(FITS))
def test_exact_points_are_not_excluded_for_their_rounding(shape):
    exact = noisy(shape, 20, np.random.default_rng(1), noise=0.0) + 10.0
    assert FITS[shape](exact, robust=True).left_out == ()


def test_same_points_give_the_same_result():
    points = noisy("circle", 20, np.random.default_rng(2))
    points[3] += 1e-3
    first, second = fit_circle(points, robust=True), fit_circle(points, robust=True)
    assert first.left_out == second.left_out == (3,)
    np.testing.assert_array_equal(first.parameters, second.parameters)


def test_deviations_within_known_noise_are_accepted():
    points = noisy("circle", 20, np.random.default_rng(2))
    points[3] *= 1 + 8e-6 / 0.025
    assert fit_circle(points, robust=True).left_out == (3,)
    assert fit_circle(points, robust=True, sigma=5e-6).left_out == ()


def test_robust_fit_needs_points_to_spare():
    with raises("shape.points.too_few"):
        fit_circle([(1, 0), (0, 1), (-1, 0), (0, -1), (0.7, 0.7)], robust=True)


def test_coincident_points_are_refused():
    with raises("shape.points.not_distinct"):
        fit_line(np.repeat([[1.0, 2.0], [3.0, 4.0]], [8, 2], axis=0), robust=True)
