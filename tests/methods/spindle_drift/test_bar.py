"""The bar's axis from four distances, its end face, and their derivatives."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from errormotion.methods.spindle_drift.identification.bar import end_point, fit_axis, state_jacobian

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


def test_derivatives_are_those_of_finite_differences(beams):
    origin, direction = beams
    distance = 1e-3 + np.random.default_rng(3).normal(0, 2e-5, (5, 1))

    def state(p):
        d, rows, radius = p[:5].reshape(5, 1), p[5:35].reshape(5, 6), p[35]
        q = fit_axis(d, rows[:, :3], rows[:, 3:], radius, LEVELS)
        a, E = end_point(q, d[4], rows[4, :3], rows[4, 3:], LEVELS)
        return np.concatenate([a[0], E[0]])

    p = np.concatenate([distance[:, 0], np.hstack([origin, direction]).ravel(), [R]])
    h = 1e-7
    numeric = np.array([(state(p + e) - state(p - e)) / (2 * h) for e in np.eye(36) * h]).T
    q = fit_axis(distance, origin, direction, R, LEVELS)
    da, dE = state_jacobian(q, distance, origin, direction, LEVELS)
    # Central differences leave h^2 times the third derivative, about (1 / R)^2 relative.
    np.testing.assert_allclose(np.concatenate([da[0], dE[0]]), numeric, rtol=1e-7, atol=1e-7)
