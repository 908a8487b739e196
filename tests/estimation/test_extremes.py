"""Extreme values of noisy curves: intervals contain the true figures; cases with a known answer."""

import numpy as np
import pytest
from scipy import stats

from errormotion.estimation.extremes import (
    BIAS_UNCERTAINTY,
    by_true_values,
    expanded,
    of_noisy_values,
    range_from_reference,
)

SEEDS = 150
CURVES = {
    "at rest": np.zeros(40),
    "exponential": 20.0 * (1 - np.exp(-np.linspace(0, 3, 40))),
    "pointed": 20.0 * np.abs(np.linspace(-1, 1, 40)),
}


def ends(values: np.ndarray) -> np.ndarray:
    """Return the smallest and the largest value, (..., 2)."""
    return np.stack([values.min(axis=-1), values.max(axis=-1)], axis=-1)


@pytest.mark.parametrize("name", CURVES)
def test_intervals_contain_the_true_extremes(name: str) -> None:
    rng, true = np.random.default_rng(1), CURVES[name]
    shared = np.full((1, true.size), 0.3)
    held = np.zeros(2)
    for _ in range(SEEDS):
        values = true + rng.normal(size=true.size) + 0.3 * rng.normal()
        found = of_noisy_values(ends, values, np.ones(true.size), shared)
        held += np.abs(found.value - ends(true)) <= expanded(found.bias, found.u)
    assert (held >= stats.binom.ppf(1e-3 / 6, SEEDS, 0.95)).all()


@pytest.mark.parametrize("name", CURVES)
def test_intervals_contain_the_true_range_from_the_reference(name: str) -> None:
    rng, true = np.random.default_rng(2), CURVES[name] - CURVES[name][0]
    size, held = true.max() - true.min(), 0
    for _ in range(SEEDS):
        values = true + 0.5 * rng.normal(size=true.size)
        found = range_from_reference(values, np.full(true.size, 0.25), np.zeros((0, true.size)))
        held += abs(float(found.value) - size) <= float(expanded(found.bias, found.u))
    assert held >= stats.binom.ppf(1e-3 / 3, SEEDS, 0.95)


def test_the_bias_of_the_largest_of_equal_values_is_their_expectation() -> None:
    """The largest of n normal values: 2.16 standard deviations for 40 (Tippett 1925). Its estimate scatters by 0.5."""
    rng, n = np.random.default_rng(3), 40
    exact = stats.norm.ppf((np.arange(1, 100001) - 0.5) / 100000) @ np.diff(np.linspace(0, 1, 100001) ** n)
    bias = [
        float(of_noisy_values(lambda x: x.max(axis=-1), rng.normal(size=n), np.ones(n), np.zeros((0, n))).bias)
        for _ in range(200)
    ]
    assert np.mean(bias) == pytest.approx(exact, abs=4 * np.std(bias) / np.sqrt(200))


def test_a_mean_has_no_bias_and_the_uncertainty_of_a_mean() -> None:
    rng, n = np.random.default_rng(4), 50
    found = of_noisy_values(
        lambda x: np.stack([x.mean(axis=-1), x[..., 0]], axis=-1),
        rng.normal(size=n),
        np.ones(n),
        np.ones((1, n)),
        draws=4000,
    )
    assert found.bias == pytest.approx(0.0, abs=1e-12)  # pairs of opposite draws
    assert found.covariance is not None
    assert found.covariance == pytest.approx(np.array([[1.02, 1.02], [1.02, 2.0]]), abs=0.15)  # 4000 draws: 3 %
    assert np.sqrt(np.diagonal(found.covariance)) == pytest.approx(found.u)


def test_the_longer_side_of_a_skewed_figure_counts_if_asked() -> None:
    values, u, none = np.zeros(3), np.ones(3), np.zeros((0, 3))
    plain, skewed = (
        of_noisy_values(lambda x: np.exp(x).max(axis=-1), values, u, none, skewed=each) for each in (False, True)
    )
    assert skewed.u > plain.u
    assert skewed.bias == plain.bias


def test_figures_of_true_values_have_the_excess_over_their_median() -> None:
    true = np.column_stack([np.linspace(0, 2, 101), np.full(101, np.nan)])
    found = by_true_values(np.array([3.0, np.nan]), true)
    assert found.bias[0] == pytest.approx(2.0)
    assert found.u[0] == pytest.approx(np.hypot(true[:, 0].std(ddof=1), BIAS_UNCERTAINTY * 2.0))
    assert np.isnan(found.bias[1])
