"""Points that do not determine a shape: every refusal is a FitError that names what is undetermined."""

import numpy as np
import pytest
from coded import raises

from errormotion.errors import FitError
from errormotion.kinematics.fits import fit_circle, fit_cone, fit_cylinder, fit_line, fit_plane, fit_sphere

RNG = np.random.default_rng(6)
PLACE = np.array([0.1, 0.2, 0.3])
LINE = np.outer(np.linspace(-1, 1, 9), [0.3, 0.5, -0.2]) + PLACE
PLANE = RNG.uniform(-1, 1, (12, 2)) @ RNG.normal(size=(2, 3)) + PLACE
ANGLE = np.linspace(0, 2 * np.pi, 12, endpoint=False)
RING = np.column_stack([np.cos(ANGLE), np.sin(ANGLE), 0 * ANGLE])
TWO_LINES = np.concatenate([np.column_stack([c * np.ones(6), 0 * np.ones(6), np.linspace(0, 3, 6)]) for c in (-1, 1)])


@pytest.mark.parametrize(
    ("fit", "points", "message"),
    [
        (fit_line, [(0.0, 0.0)], "at least 2 points; found 1"),
        (fit_line, [(1.0, 2.0)] * 5, "all 5 are one point"),
        (fit_line, [(1, 0), (0, 1), (-1, 0), (0, -1)], "do not determine one line"),
        (fit_plane, LINE, "on one line, which leaves the plane undetermined"),
        (fit_plane, [(0, 0, 0), (1, 0, 0)], "at least 3 points; found 2"),
        (fit_circle, LINE[:, :2], r"on one line, which leaves the circle undetermined \(centre, radius\)"),
        (fit_circle, LINE, "on one line"),
        (fit_circle, [(0, 0), (1, 1), (1, 1), (0, 0)], "Only 2 of the 4 points are distinct"),
        (fit_sphere, PLANE, r"in one plane, which leaves the sphere undetermined \(centre, radius\)"),
        (fit_sphere, RING, "in one plane"),
        (fit_cylinder, PLANE, "in one plane, which leaves the cylinder undetermined"),
        (fit_cylinder, RING, "in one plane"),
        (fit_cylinder, TWO_LINES, "in one plane"),
        (fit_cylinder, LINE, "on one line"),
        (fit_cone, RING + PLACE, "in one plane, which leaves the cone undetermined"),
        (lambda p: fit_cylinder(p, 1.0), RING, "cylinder undetermined: .*direction"),
        (lambda p: fit_cylinder(p, 1.0), LINE, "on one line"),
        (lambda p: fit_cylinder(p, 1.0), LINE[:3], "at least 4 points; found 3"),
    ],
)
def test_points_that_leave_a_freedom_undetermined_are_refused(fit, points, message):
    with pytest.raises(FitError, match=message):
        fit(points)


@pytest.mark.parametrize("fit", [fit_line, fit_plane, fit_circle, fit_sphere, fit_cylinder, fit_cone])
def test_invalid_points_are_refused(fit):
    broken = RNG.normal(size=(20, 3))
    broken[[3, 7]] = np.nan
    with raises("shape.points.not_finite"):
        fit(broken)
    with raises("shape.points.shape"):
        fit(np.zeros(20))
    with raises("shape.points.shape"):
        fit(np.zeros((3, 20)))
    with raises("shape.points.form"):
        fit([("a", "b", "c")])
    with pytest.raises(FitError, match=r"at least \d points; found 0"):
        fit(np.zeros((0, 3)))


def test_noise_that_hides_the_radius_is_refused():
    # Sagitta 1 um on a chord of 100 mm, noise 10 um: a circle of any radius fits as well.
    x = np.linspace(-0.05, 0.05, 20)
    y = x**2 * 4e-4 + 1e-5 * np.random.default_rng(3).normal(size=20)
    with raises("shape.hidden_by_noise"):
        fit_circle(np.column_stack([x, y]))


def test_three_lines_determine_a_cylinder():
    lines = [np.column_stack([np.full(5, np.cos(a)), np.full(5, np.sin(a)), np.linspace(0, 3, 5)]) for a in (0, 2, 4)]
    cylinder = fit_cylinder(np.concatenate(lines))
    assert cylinder.radius == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(
    ("options", "code"),
    [
        ({"sigma": 0.0}, "shape.sigma.not_positive"),
        ({"sigma": float("nan")}, "shape.sigma.not_positive"),
        ({"weights": [1.0, 1.0]}, "shape.weights.form"),
        ({"weights": [0.0] + [1.0] * 11}, "shape.weights.form"),
    ],
)
def test_options_are_checked(options, code):
    with raises(code):
        fit_circle(RING[:, :2], **options)


def test_radius_and_direction_of_a_cylinder_are_checked():
    with raises("shape.radius.not_positive"):
        fit_cylinder(PLANE, -1.0)
    with raises("shape.direction.form"):
        fit_cylinder(PLANE, direction=[0, 0, 0])
