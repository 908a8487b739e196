"""Spikes and trends of values in their order: found where they are, and rarely where they are not."""

import numpy as np
import pytest
from scipy.stats import linregress

from errormotion.estimation.checks.series import FALSE_ALARM, SIGNIFICANT, spikes, trend

T = np.arange(200.0)
CURVE = 20e-6 * (1 - np.exp(-T / 60))


def test_single_values_that_stand_out_are_found() -> None:
    rng = np.random.default_rng(1)
    y = CURVE + 5e-9 * rng.standard_normal(T.size)
    y[[0, 30, 31, 90, 140]] += [0, np.nan, 0, 60e-9, -80e-9]
    assert np.flatnonzero(spikes(y)).tolist() == [90, 140]


def test_a_step_and_a_turn_are_no_spikes() -> None:
    y = CURVE + 5e-9 * np.random.default_rng(2).standard_normal(T.size)
    y[100:] += 3e-6
    assert not spikes(y).any()
    assert not spikes(np.abs(T - 100.3) * 1e-7 + 5e-9 * np.random.default_rng(3).standard_normal(T.size)).any()


def test_valid_values_have_hardly_any_spikes() -> None:
    found = [spikes(np.random.default_rng(seed).standard_normal(200)).any() for seed in range(2000)]
    assert np.mean(found) < 3 * FALSE_ALARM


@pytest.mark.parametrize("noise", [0.02, 0.3])
def test_the_next_mark_of_a_coarse_scale_is_no_spike(noise: float) -> None:
    found = [
        spikes(np.rint(CURVE * 1e5 + noise * np.random.default_rng(seed).standard_normal(T.size)) * 1e-6).any()
        for seed in range(200)
    ]
    assert np.mean(found) < 0.02


def test_a_trend_is_that_of_the_regression() -> None:
    y = 0.3 * np.arange(8.0) + np.random.default_rng(4).standard_normal(8)
    expected = linregress(np.arange(8.0), y)
    found = trend(y)
    assert found is not None
    assert found.range == pytest.approx(7 * expected.slope)
    assert found.u == pytest.approx(7 * expected.stderr)
    assert found.probability == pytest.approx(expected.pvalue)


def test_trends_are_significant_as_often_as_stated() -> None:
    found = [trend(np.random.default_rng(seed).standard_normal(5)) for seed in range(4000)]
    share = np.mean([each is not None and each.significant for each in found])
    assert abs(share - SIGNIFICANT) < 4 * np.sqrt(SIGNIFICANT / 4000)
    assert trend(np.array([1.0, 2.0, np.nan, 3.0])) is None


def test_a_value_beside_a_missing_one_is_not_compared_across_it() -> None:
    """A change during an interruption would look like a spike of the last value before it."""
    y = 5e-9 * np.random.default_rng(5).standard_normal(T.size)
    y[100] = np.nan
    y[101:] += 3e-6
    y[99] += 1.5e-6
    assert not spikes(y)[[99, 101]].any()
