"""The bar's axis from four distances, and its errors against a reference."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from errormotion.methods.spindle_drift.identification.bar import errors_of, fit_axis, states

R = 5e-3
LEVELS = np.array([0.01, 0.05])


@pytest.fixture
def beams():
    """Return the beams of a frame set up by hand: 0.1 mm and 5 mrad off."""
    rng = np.random.default_rng(0)
    near = R + 1e-3
    origin = np.array([[near, 0, 0.01], [near, 0, 0.05], [0, near, 0.01], [0, near, 0.05], [0, 0, -1e-3]])
    direction = np.array([[-1.0, 0, 0], [-1, 0, 0], [0, -1, 0], [0, -1, 0], [0, 0, 1]])
    direction = direction + rng.normal(0, 5e-3, (5, 3))
    return origin + rng.normal(0, 1e-4, (5, 3)), direction / np.linalg.norm(direction, axis=1, keepdims=True)


def gaps(q, distance, origin, direction):
    A, B = np.array([q[0], q[1], LEVELS[0]]), np.array([q[2], q[3], LEVELS[1]])
    a = (B - A) / np.linalg.norm(B - A)
    S = origin[:4] + direction[:4] * distance[:4, None]
    return np.linalg.norm(np.cross(S - A, a), axis=1) - R


def test_fit_puts_the_surface_through_every_point(beams):
    distance = 1e-3 + np.random.default_rng(1).normal(0, 5e-5, (5, 300))
    q = fit_axis(distance, *beams, R, LEVELS)
    worst = max(np.abs(gaps(q[t], distance[:, t], *beams)).max() for t in range(300))
    assert worst < 1e-12 * R


def test_fit_agrees_with_scipy_to_a_picometre(beams):
    distance = 1e-3 + np.random.default_rng(2).normal(0, 2e-5, (5, 20))
    q = fit_axis(distance, *beams, R, LEVELS)
    for t in range(20):
        peer = least_squares(
            gaps, np.zeros(4), args=(distance[:, t], *beams), x_scale=1e-3, xtol=1e-15, ftol=1e-15, gtol=1e-15
        )
        np.testing.assert_allclose(q[t], peer.x, rtol=0, atol=1e-12)


def test_unknown_readings_give_unknown_axes_and_affect_no_others(beams):
    distance = np.full((5, 6), 1e-3)
    distance[1, 2] = np.nan
    distance[:4, 4] = 0.9  # no bar there
    q = fit_axis(distance, *beams, R, LEVELS)
    assert np.isnan(q[2]).all()
    assert np.isfinite(q[[0, 1, 3, 5]]).all()
    np.testing.assert_allclose(q[5], q[0], rtol=0, atol=1e-15)


def test_parallel_beams_give_no_axis(beams):
    origin, direction = beams
    direction = direction.copy()
    direction[2:4] = direction[:2]
    assert np.isnan(fit_axis(np.full((5, 2), 1e-3), origin, direction, R, LEVELS)).all()


def test_errors_are_the_motion_of_the_bar(beams):
    """A bar turned about a point and displaced: the rotation across its axis, and the displacement of the point."""
    origin, direction = beams
    reference = states(np.full((5, 1), 1e-3), origin, direction, R, LEVELS)
    point, w, shift = np.array([0.01, -0.02, 0.03]), np.array([3e-4, -2e-4, 0.0]), np.array([5e-6, -3e-6, 9e-6])
    a0 = np.array([*reference[0, 3:], 1.0]) / np.linalg.norm([*reference[0, 3:], 1.0])
    w -= a0 * (w @ a0)  # across the axis
    a = np.cross(w, a0) + a0 * np.sqrt(1.0 - w @ w)
    E = reference[0, :3] + shift - np.cross(w, point - reference[0, :3])
    moved = np.array([[*E, *(a[:2] / a[2])]])
    np.testing.assert_allclose(errors_of(moved, reference, point)[0], [*shift, *w[:2]], rtol=0, atol=1e-15)
    # A rotation about the axis displaces the point along a circle about it.
    turned = errors_of(reference, reference, point, 1e-4)[0]
    np.testing.assert_allclose(turned[:3], 1e-4 * np.cross(a0, point - reference[0, :3]), rtol=0, atol=1e-18)


def test_an_origin_for_each_instant_is_that_of_a_displaced_frame(beams):
    origin, direction = beams
    shift = 1e-6 * np.random.default_rng(4).normal(size=(3, 5, 3))
    distance = np.full((5, 3), 1e-3)
    together = states(distance, origin + shift, direction, R, LEVELS)
    for k in range(3):
        alone = states(distance[:, :1], origin + shift[k], direction, R, LEVELS)
        np.testing.assert_allclose(together[k], alone[0], rtol=0, atol=1e-14)
