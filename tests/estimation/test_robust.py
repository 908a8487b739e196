import numpy as np
import pytest
from scipy import stats

from errormotion.estimation.robust import NORMAL_MAD, scale_about_median, scale_about_zero


def test_the_factor_is_that_of_normal_values() -> None:
    assert pytest.approx(1 / stats.norm.ppf(0.75), rel=1e-4) == NORMAL_MAD


@pytest.mark.parametrize("share", [0.0, 0.2])
def test_outliers_hardly_affect_the_scale(share: float) -> None:
    """One fifth of outliers on one side moves the median by 0.3 standard deviations and the scale by a third."""
    rng = np.random.default_rng(1)
    values = 3.0 * rng.standard_normal((40, 250))
    values[:, : int(share * 250)] = 1e6
    assert scale_about_zero(values) == pytest.approx(3.0, rel=0.05 if share == 0 else 0.4)
    assert scale_about_median(values + 100.0) == pytest.approx(3.0, rel=0.05 if share == 0 else 0.4)


def test_the_scale_about_the_median_is_that_of_scipy() -> None:
    values = np.random.default_rng(2).standard_normal(101)
    expected = stats.median_abs_deviation(values) * NORMAL_MAD
    assert scale_about_median(values) == pytest.approx(expected, rel=1e-12)


def test_unknown_values_do_not_count() -> None:
    values = np.array([1.0, np.nan, -2.0, 3.0])
    assert scale_about_zero(values) == pytest.approx(2 * NORMAL_MAD)
    assert scale_about_median(values) == pytest.approx(2 * NORMAL_MAD)
    assert np.isnan(scale_about_zero(np.full(3, np.nan)))
    assert np.isnan(scale_about_median(np.zeros(0)))
