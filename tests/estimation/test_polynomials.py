"""Curves as Legendre polynomials: scaling, and the variance of the orders that are not fitted."""

import numpy as np
import pytest

from errormotion.estimation.evidence import averaged, posteriors
from errormotion.estimation.polynomials import HIGHEST, Interval, rest_of


def test_an_interval_is_scaled_to_its_ends():
    assert Interval(0.1, 0.5).scaled([0.1, 0.3, 0.5]) == pytest.approx([-1, 0, 1])
    assert Interval(np.array([0.0, -1.0]), np.array([2.0, 3.0])).scaled([2.0, -1.0]) == pytest.approx([1, -1])
    assert Interval(0.2, 0.2).scaled([0.2]) == pytest.approx([0.0])


def test_the_rest_is_the_variance_of_the_orders_above_the_fitted_ones():
    rng = np.random.default_rng(1)
    order, A = np.arange(1.0, 5.0), rng.normal(size=(30, 4))
    y = A @ (rng.normal(size=4) * order**-1.0) + 0.01 * rng.normal(size=30)
    found = averaged(
        posteriors(A.T @ A / 1e-4, A.T @ y / 1e-4, np.zeros(4, dtype=np.intp), order, exponents=(0.5, 1.0, 2.0))
    )
    rest = rest_of(found, 4)
    n = np.arange(5.0, HIGHEST + 1)
    assert rest.shape == (1, n.size)
    interval = Interval(-3.0, 1.0)
    # P_n(1) = 1, and the mean of P_n^2 is 1 / (2 n + 1)
    assert interval.rest(np.array([1.0]), rest[0])[0] == pytest.approx(rest[0].sum())
    x, w = np.polynomial.legendre.leggauss(200)
    assert w @ interval.rest(2 * x - 1, rest[0]) / 2 == pytest.approx((rest[0] / (2 * n + 1)).sum())
