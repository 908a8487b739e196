"""Variance between runs: three estimates of it against the truth, and limits in which the fit is a known one."""

import numpy as np
import pytest
from scipy import stats

from errormotion.estimation.between_runs import COVERAGE, by_moving_ranges, fit_runs, variance_between


def series(rng: np.random.Generator, count: int, tau: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the design matrix of a line, values with a variance between runs, and the stated covariance."""
    t, u = np.sort(rng.uniform(0, 3, count)), rng.uniform(0.5e-6, 1.5e-6, count)
    y = 5e-6 + 2e-6 * t + u * rng.normal(size=count) + tau * rng.normal(size=count)
    return np.column_stack([np.ones(count), t]), y, np.diag(u**2)


@pytest.mark.parametrize("tau", [0.0, 1e-6, 4e-6])
def test_both_estimates_of_the_reproducibility_are_near_the_truth(tau: float) -> None:
    n = 400
    X, y, V = series(np.random.default_rng(6), n, tau)
    found = fit_runs(X, y, V)
    assert found is not None
    spread = np.sqrt(np.diag(V).mean() + tau**2)
    for estimate in (found.tau, by_moving_ranges(y, V)):
        # variance of an estimated variance: 2 / n, about 1.6 times as much from ranges
        assert abs(estimate**2 - tau**2) <= 4 * spread**2 * np.sqrt(2 * 1.65 / n)


def test_the_trend_is_that_of_ordinary_least_squares_for_equal_uncertainties() -> None:
    rng, n = np.random.default_rng(7), 12
    y = rng.normal(0, 5e-6, n)
    X = np.column_stack([np.ones(n), np.arange(n) / 4])
    found = fit_runs(X, y, np.eye(n) * 1e-14)
    assert found is not None
    expected, (square,), *_ = np.linalg.lstsq(X, y, rcond=None)
    assert found.parameters == pytest.approx(expected, rel=1e-9)
    assert found.covariance == pytest.approx(np.linalg.inv(X.T @ X) * square / (n - 2), rel=1e-4)


def test_quantile_and_probability_are_those_of_student_and_chi_square() -> None:
    X, y, V = series(np.random.default_rng(8), 12, 1e-6)
    found = fit_runs(X, y, V)
    assert found is not None
    quantile = found.half_width / np.sqrt(np.diag(found.covariance))
    assert quantile == pytest.approx(stats.t.ppf(0.5 + COVERAGE / 2, 10))
    assert found.p == pytest.approx(stats.chi2.cdf(found.chi2, 10))


def test_there_is_no_fit_without_degrees_of_freedom_or_for_dependent_columns() -> None:
    V = np.eye(3)
    assert fit_runs(np.eye(3)[:, :2], np.arange(3.0), V) is not None
    assert fit_runs(np.eye(3), np.arange(3.0), V) is None
    assert fit_runs(np.ones((3, 2)), np.arange(3.0), V) is None


def test_the_robust_mean_estimates_the_spread_between_datasets() -> None:
    rng, shape = np.random.default_rng(7), (12, 9, 4)
    scale = np.array([1e-6, 2e-6, 5e-6, 1e-5])
    variance = (rng.uniform(0.5, 2.0, shape) * scale) ** 2
    between, none = [], []
    for _ in range(30):
        y = rng.normal(size=shape) * np.sqrt(variance)
        none.append(variance_between(y, variance)[2])
        between.append(variance_between(y + rng.normal(size=shape) * 20 * scale, variance)[2])
    # 12 datasets of 9 points, 30 times: the estimate of a standard deviation has a standard deviation of 1.3 %
    np.testing.assert_allclose(np.mean(between, axis=0), 20 * scale, rtol=0.05)
    assert (np.array(none) < 2 * scale).all()


def test_a_value_that_is_unknown_to_all_datasets_stays_unknown() -> None:
    y = np.array([[[1.0, np.nan]], [[3.0, np.nan]]])
    value, u, _ = variance_between(y, np.ones_like(y))
    assert value.tolist()[0][0] == pytest.approx(2.0)
    assert np.isnan(value[0, 1])
    assert np.isnan(u[0, 1])
