"""Ridge regression against its normal equations, and the effective number of correlated residuals by simulation."""

import numpy as np
import pytest

from errormotion.estimation.ridge import (
    STRENGTHS,
    best_strength,
    covariance,
    effective_count,
    left_out_residuals,
    solve,
)


def test_coefficients_are_those_of_the_normal_equations() -> None:
    rng = np.random.default_rng(1)
    X, y, weight = rng.normal(size=(30, 3)), rng.normal(size=30), rng.uniform(0.5, 2.0, 30)
    weight[4], y[4] = 0.0, np.nan
    known = weight > 0
    XW = X[known].T * weight[known]
    for strength, found in zip(STRENGTHS, solve(X, y, weight, STRENGTHS), strict=True):
        normal = XW @ X[known] + strength * weight.sum() * np.eye(3)
        assert found == pytest.approx(np.linalg.solve(normal, XW @ y[known]), rel=1e-10)


def test_nothing_is_predicted_for_a_group_without_another() -> None:
    rng = np.random.default_rng(0)
    X, y, group = rng.standard_normal((8, 2)), rng.standard_normal(8), np.repeat([0, 1], 4)
    assert np.isfinite(left_out_residuals(X, y, np.ones(8), group)).all()
    assert np.isnan(left_out_residuals(X, y, np.repeat([1.0, 0.0], 4), group)).all()


def test_noise_is_regularised_and_a_linear_law_is_not() -> None:
    rng = np.random.default_rng(2)
    X, group = rng.standard_normal((60, 4)), np.repeat(np.arange(6), 10)
    weight = np.ones(60)
    assert best_strength(X, X @ np.ones(4) + 1e-3 * rng.standard_normal(60), weight, group)[0] <= 1e-5
    assert best_strength(X, rng.standard_normal(60), weight, group)[0] >= 0.1


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.8])
def test_the_covariance_of_a_correlated_series_is_that_of_its_effective_number(correlation: float) -> None:
    """The variance of a mean of AR(1) values; 400 series of 400: a variance is known to 7 %."""
    rng, n, count = np.random.default_rng(3), 400, 400
    noise = np.sqrt(1 - correlation**2) * rng.standard_normal((count, n))
    series = np.empty((count, n))
    series[:, 0] = rng.standard_normal(count)
    for k in range(1, n):
        series[:, k] = correlation * series[:, k - 1] + noise[:, k]
    X, weight, group = np.ones((n, 1)), np.ones(n), np.zeros(n, dtype=np.int64)
    effective = np.mean([effective_count(each, group) for each in series])
    assert effective == pytest.approx(n * (1 - correlation) / (1 + correlation), rel=0.05)
    stated = np.mean([covariance(X, weight, 0.0, float(np.mean(each**2)), each, group)[0, 0] for each in series])
    assert stated == pytest.approx(series.mean(axis=1).var(), rel=0.25)
