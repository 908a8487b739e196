"""Draws of true curves and variances: the truth is one of them."""

import numpy as np
import pytest
from scipy import stats

from errormotion.estimation.extremes.true_curves import draw_components, draw_curves, draw_variances

TRIALS = 400
Z = np.linspace(-1, 1, 30)
LINE = np.tile([0.04, 0.01], (TRIALS, 1))


@pytest.mark.parametrize("rough", [0.0, 0.3, 3.0])
@pytest.mark.parametrize("about_zero", [False, True])
def test_the_true_curve_is_one_of_the_draws(rough: float, about_zero: bool) -> None:
    """Noise of 1 and an offset of 0.2 and a slope of 0.1 on average; a curve about zero has no line."""
    rng = np.random.default_rng(1)
    squares, covered, count = 0.0, 0, 150
    for _ in range(count):
        true = rough * rng.normal(size=Z.size) + (0.0 if about_zero else 5.0 + 3.0 * Z)
        seen = true + rng.normal(size=Z.size) + 0.2 * rng.normal() + 0.1 * rng.normal() * Z
        drawn = draw_curves(seen, np.ones((TRIALS, Z.size)), LINE, Z, about_zero=about_zero, generator=rng)
        squares += np.mean((drawn.mean(axis=0) - true) ** 2) / np.mean((seen - true) ** 2) / count
        low, high = np.quantile(drawn.mean(axis=1), (0.025, 0.975))
        covered += low <= true.mean() <= high
    assert squares < (0.5 if rough < 1 else 1.0)  # nearer to the truth than the readings are
    assert covered >= stats.binom.ppf(1e-3, count, 0.95)


def test_the_roughness_of_the_true_curve_is_one_of_those_of_the_draws() -> None:
    """The readings are too rough by their noise, their best estimates too smooth; the draws are neither."""
    rng, line = np.random.default_rng(2), np.zeros((TRIALS, 2))
    ranks = []
    for _ in range(200):
        true = rng.normal(size=Z.size)
        seen = true + rng.normal(size=Z.size)
        drawn = draw_curves(seen, np.ones((TRIALS, Z.size)), line, Z, about_zero=False, generator=rng)
        ranks.append(np.mean(np.var(drawn, axis=1) < np.var(true)))
    assert stats.kstest(ranks, "uniform").pvalue > 1e-3


def test_unknown_values_remain_unknown() -> None:
    seen = np.where(np.arange(Z.size) == 4, np.nan, Z)
    draws = draw_curves(seen, np.ones((TRIALS, Z.size)), LINE, Z, about_zero=False, generator=np.random.default_rng(3))
    assert np.isnan(draws[:, 4]).all()
    assert np.isfinite(np.delete(draws, 4, axis=1)).all()
    single = np.where(np.arange(Z.size) == 4, 2.0, np.nan)
    draws = draw_curves(
        single, np.ones((TRIALS, Z.size)), LINE, Z, about_zero=False, generator=np.random.default_rng(4)
    )
    assert draws[:, 4].std() == pytest.approx(np.sqrt(1.04), rel=0.15)  # 400 draws: 3.5 %


def test_a_true_common_variance_is_one_of_the_draws() -> None:
    rng, freedom = np.random.default_rng(5), 6.0
    ranks = []
    for _ in range(200):
        seen = np.full(3, 4.0 * rng.chisquare(freedom) / freedom)
        drawn = draw_variances(seen, freedom, TRIALS, rng, common=True)
        assert (np.ptp(drawn, axis=1) == 0).all()
        ranks.append((drawn[:, 0] < 4.0).mean())
    assert stats.kstest(ranks, "uniform").pvalue > 1e-3
    assert (draw_variances(np.full(3, 4.0), np.inf, TRIALS, rng, common=True) == 4.0).all()


def test_intervals_of_variances_that_differ_contain_them() -> None:
    """Standard deviations that differ by a factor of 1.5, 6 degrees of freedom each; 25 of them 100 times."""
    rng, freedom, n, count = np.random.default_rng(6), 6.0, 25, 100
    held = 0
    for _ in range(count):
        true = np.exp(2 * np.log(1.5) * rng.normal(size=n))
        seen = np.append(true * rng.chisquare(freedom, n) / freedom, np.nan)
        drawn = draw_variances(seen, freedom, TRIALS, rng, common=False)
        assert np.isnan(drawn[:, n]).all()
        low, high = np.quantile(drawn[:, :n], (0.025, 0.975), axis=0)
        held += int(((low <= true) & (true <= high)).sum())
    assert 0.9 <= held / (n * count) <= 0.98


@pytest.mark.parametrize("ratio", [1.0, 5.0, 50.0])
@pytest.mark.parametrize("freedom", [3.2, 9.0])
def test_intervals_contain_equal_variances_and_one_that_is_larger(ratio: float, freedom: float) -> None:
    """22 variances, of which one may be larger: 95 % of the intervals of the others contain them, most of its own do.

    One that is five times as large may as well be one of the others by chance, and is shifted towards them.
    """
    rng, n, count = np.random.default_rng(8), 22, 200
    others, largest = 0, 0
    true = np.ones(n)
    true[5] = ratio
    for _ in range(count):
        drawn = draw_variances(true * rng.chisquare(freedom, n) / freedom, freedom, TRIALS, rng, common=False)
        low, high = np.quantile(drawn, (0.025, 0.975), axis=0)
        inside = (low <= true) & (true <= high)
        largest += int(inside[5])
        others += int(inside.sum()) - int(inside[5])
    assert 0.94 <= others / (count * (n - 1)) <= 0.99
    assert largest >= stats.binom.ppf(1e-3, count, 0.8 if ratio == 5.0 else 0.92)


def test_components_are_drawn_if_they_are_significant() -> None:
    rng = np.random.default_rng(6)
    drawn = draw_components(np.array([9.0, 0.01]), np.array([1.0, 1.0]), 9.0, TRIALS, rng)
    assert np.ptp(drawn[:, 1]) == 0.0
    assert np.median(drawn[:, 0]) == pytest.approx(10.0 * 9 / stats.chi2.median(9) - 1.0, rel=0.15)  # 400 draws: 3 %
    assert (draw_components(np.array([9.0]), np.array([1.0]), 0.0, TRIALS, rng) == 9.0).all()
    some = draw_components(np.array([9.0, 9.0]), np.array([1.0, 1.0]), np.array([9.0, 0.0]), TRIALS, rng)
    assert np.ptp(some[:, 0]) > 1.0
    assert np.ptp(some[:, 1]) == 0.0
