"""Reference circles of polar plots, against a general solver of linear programmes and by hand."""

import numpy as np
import pytest
from scipy.optimize import linprog

from errormotion.methods.spindle_error_motion.circles import CIRCLES, centre_of, range_about

TAU = 2 * np.pi
ANGLE = (np.arange(90) + 0.5) * TAU / 90


def by_a_general_solver(v, circle):
    """Return the range (MZC), or the largest value about the centre (MCC), or minus the smallest one (MIC)."""
    c, s, one = np.cos(ANGLE), np.sin(ANGLE), np.ones(ANGLE.size)
    if circle == "MZC":  # smallest hi - lo, with lo <= v - a c - b s <= hi
        A = np.concatenate([np.stack([-one, 0 * one, -c, -s], 1), np.stack([0 * one, one, c, s], 1)])
        return linprog([1, -1, 0, 0], A_ub=A, b_ub=np.concatenate([-v, v]), bounds=(None, None)).fun
    sign = 1 if circle == "MCC" else -1
    return linprog([1, 0, 0], A_ub=-np.stack([one, c, s], 1), b_ub=-sign * v, bounds=(None, None)).fun


@pytest.mark.parametrize("circle", CIRCLES)
def test_circles_are_those_of_a_general_solver(circle):
    """Their radii; two touching points that face each other leave the centre of MCC and MIC free across them."""
    generator = np.random.default_rng(3)
    k = np.arange(1, 9)
    v = generator.standard_normal((20, 8)) @ np.cos(np.multiply.outer(k, ANGLE) + k[:, None])
    v += 0.1 * generator.standard_normal(v.shape)
    rest = v - centre_of(v, ANGLE, circle) @ np.stack([np.cos(ANGLE), np.sin(ANGLE)])
    found = {"MZC": np.ptp(rest, axis=1), "MCC": rest.max(axis=1), "MIC": -rest.min(axis=1)}[circle]
    np.testing.assert_allclose(found, [by_a_general_solver(each, circle) for each in v], rtol=1e-6)


@pytest.mark.parametrize("circle", CIRCLES)
def test_an_eccentric_circle_has_its_centre_and_no_range(circle):
    v = 3.0 + 2.0 * np.cos(ANGLE) - 1.0 * np.sin(ANGLE)
    np.testing.assert_allclose(centre_of(v[None], ANGLE, circle), [[2.0, -1.0]], atol=1e-9)
    assert range_about(v, ANGLE, circle) == pytest.approx(0.0, abs=1e-9)


def test_the_minimum_zone_is_the_smallest():
    v = np.random.default_rng(5).standard_normal((50, ANGLE.size))
    zone, inscribed, circumscribed = (range_about(v, ANGLE, circle) for circle in CIRCLES)
    assert (zone <= inscribed + 1e-9).all()
    assert (zone <= circumscribed + 1e-9).all()
