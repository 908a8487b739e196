import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad

from errormotion.estimation.checks.probability import log_chi2_tail, log_f_tail

X = np.array([0.0, 0.3, 4.0, 50.0, 800.0, 1250.0])


@pytest.mark.parametrize("k", [1, 3, 6])
def test_tails_agree_with_those_of_scipy(k: int) -> None:
    assert log_chi2_tail(X, k) == pytest.approx(stats.chi2.logsf(X, k), rel=1e-9)
    for f in (3, 30, 300):
        assert log_f_tail(X, k, f) == pytest.approx(stats.f.logsf(X, k, f), rel=1e-9)


@pytest.mark.parametrize("k", [1, 3, 6])
def test_far_tails_agree_with_the_integral(k: int) -> None:
    """Relative error of the probability, where its ordinary value underflows."""
    for x in (2000.0, 1e4, 1e6):
        # Q = density(x) times the integral of density(x + 2 t) / density(x)
        within = quad(lambda t, x=x: 2 * (1 + 2 * t / x) ** (k / 2 - 1) * np.exp(-t), 0, np.inf)[0]
        expected = stats.chi2.logpdf(x, k) + np.log(within)
        assert log_chi2_tail(np.array(x), k) == pytest.approx(expected, abs=1e-5)
    f, x = 2000.0, 3000.0
    steps = np.linspace(0, 100, 100_001)
    density = np.exp(stats.f.logpdf(x + steps, k, f) - stats.f.logpdf(x, k, f))
    expected = stats.f.logpdf(x, k, f) + np.log(np.trapezoid(density, steps))
    assert stats.f.sf(x, k, f) < 1e-280
    assert log_f_tail(np.array(x), k, f) == pytest.approx(expected, abs=1e-2)


def test_the_two_parts_meet() -> None:
    """Where the ordinary value ends, the logarithm goes on without a step."""
    x = np.linspace(1270, 1310, 4001)
    for values in (log_chi2_tail(x, 3), log_f_tail(x, 3, 1e7)):
        step = np.diff(values)
        assert np.ptp(step) < 0.01 * np.abs(step).max()
