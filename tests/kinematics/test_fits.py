from functools import partial

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from errormotion.kinematics.fits import fit_circle, fit_cone, fit_cylinder, fit_line, fit_plane, fit_sphere

TURN = Rotation.from_rotvec([0.4, -0.7, 1.1]).as_matrix()
PLACE = np.array([0.31, -0.12, 0.54])
FITS = {
    "line2": fit_line,
    "line3": fit_line,
    "plane": fit_plane,
    "circle2": fit_circle,
    "circle3": fit_circle,
    "sphere": fit_sphere,
    "cylinder": fit_cylinder,
    "cylinder of known radius": lambda points, robust=False, **k: fit_cylinder(points, 0.025, robust, **k),
    "cone": fit_cone,
}
SHAPES = list(FITS)


def points_on(shape, n=24, noise=0.0, seed=0):
    """Points on a shape the size of a check bar, turned and shifted, with noise across the shape; lengths in m."""
    rng = np.random.default_rng(seed)
    a, h = rng.uniform(0, 2 * np.pi, n), rng.uniform(-0.05, 0.05, n)
    e = noise * rng.normal(size=n)
    round_ = np.column_stack([np.cos(a), np.sin(a)])
    zero = np.zeros(n)
    if shape == "line2":
        return np.column_stack([0.8 * h - 0.6 * e, 0.6 * h + 0.8 * e]) + PLACE[:2]
    if shape == "circle2":
        return (0.025 + e)[:, None] * round_ + PLACE[:2]
    if shape == "line3":
        p = np.column_stack([e, noise * rng.normal(size=n), h])
    elif shape == "plane":
        p = np.column_stack([h, rng.uniform(-0.05, 0.05, n), e])
    elif shape == "circle3":
        p = np.column_stack([(0.025 + e)[:, None] * round_, noise * rng.normal(size=n)])
    elif shape == "sphere":
        v = rng.normal(size=(n, 3))
        p = (0.025 + e)[:, None] * v / np.linalg.norm(v, axis=1, keepdims=True)
    elif shape == "cone":
        slope, r = 0.3, 0.04 + np.tan(0.3) * h
        p = np.column_stack([(r + e * np.cos(slope))[:, None] * round_, h - e * np.sin(slope)])
    else:
        p = np.column_stack([(0.025 + e)[:, None] * round_, h + zero])
    return p @ TURN + PLACE


def distances(shape, theta, p):
    """Orthogonal distances by the textbook, for scipy to minimise; ``theta`` is the documented parameter vector."""
    if shape == "circle2":
        return np.hypot(*(p - theta[:2]).T) - theta[2]
    if shape == "sphere":
        return np.linalg.norm(p - theta[:3], axis=1) - theta[3]
    d = p.shape[1]
    c, u = theta[:d], theta[d : 2 * d] / np.linalg.norm(theta[d : 2 * d])
    h = (p - c) @ u
    rho = np.linalg.norm(p - c - h[:, None] * u, axis=1)
    if shape in ("line2", "line3"):
        return (p - c - h[:, None] * u).ravel()
    return {
        "plane": lambda: h,
        "circle3": lambda: np.concatenate([rho - theta[-1], h]),
        "cylinder": lambda: rho - theta[-1],
        "cylinder of known radius": lambda: rho - 0.025,
        "cone": lambda: (rho - theta[6]) * np.cos(theta[7]) - h * np.sin(theta[7]),
    }[shape]()


@pytest.mark.parametrize("shape", SHAPES)
def test_exact_points_leave_no_residual(shape):
    fitted = FITS[shape](points_on(shape))
    assert np.abs(fitted.residuals).max() < 1e-12 * 0.05


@pytest.mark.parametrize("shape", SHAPES)
def test_far_from_the_origin_only_the_rounding_of_the_points_is_left(shape):
    # The coordinates of points 1 km away are rounded to 1e-13 m.
    fitted = FITS[shape](points_on(shape) + 1000.0)
    assert np.abs(fitted.residuals).max() < 5e-13


@pytest.mark.parametrize("shape", SHAPES)
def test_scipy_finds_the_same_minimum(shape):
    points = 1000 * points_on(shape, noise=1e-4)  # mm, so that scipy's tolerances bite
    fitted = fit_cylinder(points, 25.0) if "known" in shape else FITS[shape](points)

    def misses(theta):
        scaled = theta * np.where([name.startswith(("direction", "normal", "half")) for name in names], 1.0, 1e-3)
        return 1000 * distances(shape, scaled, points / 1000)

    names = fitted.parameter_names
    off = fitted.parameters * (1 + 1e-4 * np.random.default_rng(3).normal(size=len(names)))
    found = least_squares(misses, off, xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale=np.maximum(np.abs(off), 0.1))
    # scipy stops when the sum of squares no longer shows a gain: at half of the digits in the parameters.
    assert fitted.sum_of_squares == pytest.approx(2 * found.cost, rel=1e-9)
    # It searches among sums that differ by the rounding of the distances, each by the last bit of a coordinate.
    rounding = np.finfo(float).eps * np.abs(points).max() * np.sqrt(len(points) / fitted.sum_of_squares)
    assert fitted.sum_of_squares <= 2 * found.cost * (1 + 2 * rounding)


def test_circle_of_gander_golub_and_strebel():
    points = [(1, 7), (2, 6), (5, 8), (7, 7), (9, 5), (3, 7)]
    circle = fit_circle(points)
    # The published digits end in the 8th decimal place and are true to about one unit of it.
    np.testing.assert_allclose(circle.centre, [4.73978242, 2.98353271], atol=2e-8)
    assert circle.radius == pytest.approx(4.71422603, abs=2e-8)
    assert circle.sum_of_squares == pytest.approx(1.22759908, abs=1e-8)


@pytest.mark.parametrize("shape", SHAPES)
def test_gradient_vanishes_at_the_fit(shape):
    points = points_on(shape, noise=2e-4)
    fitted = FITS[shape](points)
    # Steps that keep a direction's length: a direction changes only across itself.
    square = lambda theta: np.sum(distances(shape, theta, points) ** 2)  # noqa: E731
    for i in range(len(fitted.parameters)):
        step = np.zeros(len(fitted.parameters))
        step[i] = 1e-6
        slope = (square(fitted.parameters + step) - square(fitted.parameters - step)) / 2e-6
        curvature = 2 * len(points)
        assert abs(slope) < curvature * 1e-10


@pytest.mark.parametrize("shape", SHAPES)
def test_covariance_is_what_repeated_measurements_show(shape):
    noise, repeats = 1e-5, 30
    fit = FITS[shape]
    if shape.startswith("c") and not shape.startswith("circle"):
        fit = partial(fit, direction=TURN[2])  # no search: it is the same minimum
    exact = points_on(shape, seed=77)
    across = points_on(shape, noise=1e-5, seed=77) - exact
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    truth, rng, squares = fit(exact), np.random.default_rng(1), []
    for _ in range(repeats):
        isotropic = shape in ("line3", "circle3")
        measured = exact + noise * (rng.normal(size=exact.shape) if isotropic else rng.normal(size=(24, 1)) * across)
        fitted = fit(measured, sigma=noise)
        freedoms = 24 * (2 if isotropic else 1) - fitted.dof
        # Mahalanobis distance in the space of the freedoms: directions of length 1 and sliding points have no variance.
        values, vectors = np.linalg.eigh(fitted.covariance)
        off = vectors[:, -freedoms:].T @ (fitted.parameters - truth.parameters)
        squares.append(off**2 @ (1 / values[-freedoms:]))
    # Chi-square with that many freedoms: the mean of the repeats scatters by sqrt(2 freedoms / repeats); 2.5 sigma.
    assert np.mean(squares) == pytest.approx(freedoms, abs=2.5 * np.sqrt(2 * freedoms / repeats))


@pytest.mark.parametrize("shape", SHAPES)
def test_sigma_is_estimated_from_the_residuals(shape):
    noise, n = 1e-5, 400
    fitted = FITS[shape](points_on(shape, n=n, noise=noise))
    assert fitted.sigma == pytest.approx(noise, rel=4 / np.sqrt(2 * fitted.dof))
    given = FITS[shape](points_on(shape, n=n, noise=noise), sigma=2 * fitted.sigma)
    np.testing.assert_allclose(given.covariance, 4 * fitted.covariance, rtol=1e-9, atol=1e-25)


@pytest.mark.parametrize("shape", SHAPES)
def test_unit_of_length_does_not_matter(shape):
    metres = points_on(shape, noise=1e-5)
    in_metres = FITS[shape](metres)
    in_mm = fit_cylinder(1000 * metres, 25.0) if "known" in shape else FITS[shape](1000 * metres)
    np.testing.assert_allclose(in_mm.residuals, 1000 * in_metres.residuals, atol=1e-11)
    scale = np.sqrt(np.diag(in_mm.covariance) / np.maximum(np.diag(in_metres.covariance), 1e-300))
    assert np.all(np.isclose(scale, 1000, rtol=1e-6) | np.isclose(scale, 1, rtol=1e-6))


@pytest.mark.parametrize("shape", SHAPES)
def test_exact_fit_through_the_fewest_points_has_unknown_covariance(shape):
    fewest = {"line2": 2, "line3": 2, "plane": 3, "circle2": 3, "circle3": 3, "sphere": 4, "cylinder": 5, "cone": 6}
    points = points_on(shape, n=fewest.get(shape, 4), seed=4)
    fitted = FITS[shape](points)
    assert np.abs(fitted.residuals).max() < 1e-12
    assert fitted.dof == 0
    assert np.isnan(fitted.covariance).all()
    assert np.isfinite(FITS[shape](points, sigma=1e-8).covariance).all()


def test_parameters_have_their_names():
    cylinder = fit_cylinder(points_on("cylinder"))
    assert cylinder.parameter_names == (
        *("point_x", "point_y", "point_z"),
        *("direction_x", "direction_y", "direction_z"),
        "radius",
    )
    np.testing.assert_array_equal(cylinder.parameters, [*cylinder.point, *cylinder.direction, cylinder.radius])
    known = fit_cylinder(points_on("cylinder"), 0.025)
    assert "radius" not in known.parameter_names
    assert known.radius == 0.025
    assert fit_circle(points_on("circle2")).parameter_names == ("centre_x", "centre_y", "radius")
    assert set(cylinder.standard_uncertainty) == set(cylinder.parameter_names)


def test_true_shapes_are_recovered():
    axis = TURN[2] * np.sign(TURN[2][np.argmax(np.abs(TURN[2]))])
    np.testing.assert_allclose(fit_line(points_on("line3")).direction, axis, atol=1e-12)
    np.testing.assert_allclose(fit_plane(points_on("plane")).normal, axis, atol=1e-12)
    circle = fit_circle(points_on("circle3"))
    np.testing.assert_allclose([*circle.centre, *circle.normal, circle.radius], [*PLACE, *axis, 0.025], atol=1e-12)
    sphere = fit_sphere(points_on("sphere"))
    np.testing.assert_allclose([*sphere.centre, sphere.radius], [*PLACE, 0.025], atol=1e-13)
    cone = fit_cone(points_on("cone"))
    np.testing.assert_allclose(cone.direction, TURN[2], atol=1e-11)
    assert cone.half_angle == pytest.approx(0.3, abs=1e-11)
    np.testing.assert_allclose(cone.apex, PLACE - 0.04 / np.tan(0.3) * TURN[2], atol=1e-11)


def test_weights_are_repeated_points():
    points = points_on("circle2", noise=1e-4, n=8)
    twice = fit_circle(np.concatenate([points, points[:3]]))
    weighted = fit_circle(points, weights=[2, 2, 2, 1, 1, 1, 1, 1])
    np.testing.assert_allclose(weighted.parameters, twice.parameters, atol=1e-12)


def test_direction_selects_one_of_the_cylinders_through_four_points():
    # Two levels, sideways sensors in x on one and y on both: the ISO 230-3 frame around a bar of 10 mm.
    r = 0.005
    points = [(r, 0, 0.01), (0, r, 0.01), (r, 0, 0.05), (0, r, 0.05)]
    bar = fit_cylinder(points, r, direction=[0.01, 0.02, 1.0])
    np.testing.assert_allclose(bar.direction, [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(bar.residuals, 0, atol=1e-15)


def test_short_arc_is_fitted_without_bias():
    # 5 degrees of a circle of radius 1 m: a sagitta of 1 mm, noise of 0.1 um. An algebraic start alone is biased.
    a = np.radians(np.linspace(-2.5, 2.5, 50))
    rng = np.random.default_rng(8)
    z = []
    for _ in range(100):
        circle = fit_circle((1 + 1e-7 * rng.normal(size=(50, 1))) * np.column_stack([np.cos(a), np.sin(a)]), sigma=1e-7)
        z.append((circle.radius - 1) / circle.standard_uncertainty["radius"])
    assert abs(np.mean(z)) < 4 / np.sqrt(100)
    assert np.std(z) == pytest.approx(1, abs=4 / np.sqrt(200))


def test_arguments_are_left_alone():
    points = points_on("circle2", noise=1e-4)
    before = points.copy()
    fit_circle(points, robust=True)
    np.testing.assert_array_equal(points, before)
