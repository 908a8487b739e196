import numpy as np
import pytest
from coded import raises
from scipy import stats

from errormotion.estimation.variance import MIN_POWER, TAIL, Verdict, expansion, power, variance_factor

SEEDS = 20_000


@pytest.mark.parametrize("freedom", [1, 10, 100])
def test_a_nominal_noise_has_a_note_in_at_most_5_percent(freedom: int) -> None:
    """The rate of alarms is twice the probability of a tail; 3 standard deviations of the number of seeds."""
    chi2 = np.random.default_rng(freedom).chisquare(freedom, SEEDS)
    alarms = [variance_factor(float(c), freedom).verdict in (Verdict.MORE, Verdict.LESS) for c in chi2]
    assert np.mean(alarms) == pytest.approx(2 * TAIL, abs=3 * np.sqrt(2 * TAIL / SEEDS))
    assert 2 * TAIL <= 0.05


@pytest.mark.parametrize("freedom", [10, 30, 100])
def test_the_power_is_that_of_a_noise_of_half_or_twice_the_truth(freedom: int) -> None:
    chi2 = np.random.default_rng(freedom).chisquare(freedom, SEEDS)
    for ratio, verdict in ((2.0, Verdict.MORE), (0.5, Verdict.LESS)):
        found = [variance_factor(float(c), freedom).verdict is verdict for c in ratio**2 * chi2[:5000]]
        expected = power(freedom, ratio)
        assert np.mean(found) == pytest.approx(expected, abs=4 * np.sqrt(expected * (1 - expected) / 5000) + 1e-3)
    assert power(freedom, 2.0) == pytest.approx(stats.chi2.sf(stats.chi2.isf(TAIL, freedom) / 4, freedom))


@pytest.mark.parametrize("freedom", range(40))
def test_every_noise_of_half_the_truth_has_a_note_with_90_percent(freedom: int) -> None:
    """Either the data have the power to contradict, or the note says that they have not."""
    silent = variance_factor(float(max(freedom, 0)), freedom).note == ""
    assert silent == (power(freedom, 2.0) >= MIN_POWER)
    if freedom < 1:
        assert "No redundancy" in variance_factor(0.0, freedom).note


def test_readings_that_scatter_more_increase_the_uncertainty_if_asked() -> None:
    raised = variance_factor(400.0, 100, what="the touches", cause="Check the balls.")
    assert raised.factor == 4.0
    assert raised.freedom == 100
    assert raised.note == (
        "The touches scatter 2 times as much as stated, with 100 degrees of freedom; the uncertainties are increased "
        "accordingly. Check the balls."
    )
    kept = variance_factor(400.0, 100, increase=False)
    assert (kept.factor, kept.freedom, kept.verdict) == (1.0, np.inf, Verdict.MORE)
    less = variance_factor(25.0, 100)
    assert (less.factor, less.verdict) == (1.0, Verdict.LESS)
    assert "only 0.5 times" in less.note


def test_an_unknown_noise_is_estimated_with_its_degrees_of_freedom() -> None:
    found = variance_factor(12.0, 3, stated=False, what="a touch", size=lambda k: f"{k * 0.5:.3g} um")
    assert (found.factor, found.freedom) == (4.0, 3)
    assert found.note == "The noise of a touch is not stated: 1 um from the residuals, with 3 degrees of freedom."
    with raises("estimation.noise.unknown"):
        variance_factor(0.0, 0, stated=False)


def test_a_factor_with_priors_is_refused() -> None:
    for stated in (True, False):
        with raises("estimation.noise.not_unknown"):
            variance_factor(10.0, 10, stated=stated, priors=True)
    assert variance_factor(30.0, 30, priors=True, increase=False).note == ""
    found = variance_factor(90.0, 30, priors=True, estimate=lambda: (3.2, 25.0))
    assert (found.factor, found.freedom) == (3.2, 25.0)


def test_a_stated_variance_with_few_degrees_of_freedom_is_combined_with_the_residuals() -> None:
    """Both are chi-squares of one variance: the sum of squares over the sum of the degrees."""
    found = variance_factor(30.0, 20, stated_freedom=10)
    assert found.factor == pytest.approx(40 / 30)
    assert found.freedom == 30
    rng = np.random.default_rng(0)
    stated, chi2 = rng.chisquare(10, 5000) / 10, rng.chisquare(20, 5000)
    alarms = [
        variance_factor(float(c / s), 20, stated_freedom=10).verdict in (Verdict.MORE, Verdict.LESS)
        for c, s in zip(chi2, stated, strict=True)
    ]
    assert np.mean(alarms) == pytest.approx(2 * TAIL, abs=4 * np.sqrt(2 * TAIL / 5000))
    assert power(20, 2.0, stated_freedom=10) == pytest.approx(
        stats.f.sf(stats.f.isf(TAIL, 20, 10) / 4, 20, 10), rel=1e-9
    )


def test_the_expansion_is_that_of_student() -> None:
    assert expansion(np.array([4.0, np.inf])) == pytest.approx([stats.t.ppf(0.975, 4) / stats.norm.ppf(0.975), 1.0])


@pytest.mark.parametrize(("freedom", "ratio"), [(4, 1.0), (8, 1.0), (12, 0.5), (20, 2.0), (40, 2.0)])
def test_a_mean_is_covered_or_has_a_note(freedom: int, ratio: float) -> None:
    """Of values whose noise is ``ratio`` times the stated one."""
    rng = np.random.default_rng(freedom)
    y = ratio * rng.standard_normal((4000, freedom + 1))
    covered = []
    for row in y:
        found = variance_factor(float(np.sum((row - row.mean()) ** 2)), freedom)
        u = np.sqrt(found.factor / row.size) * float(expansion(found.freedom))
        covered.append(found.verdict is Verdict.UNCHECKED or abs(row.mean()) <= 1.96 * u)
    assert np.mean(covered) >= 0.95 - 3 * np.sqrt(0.05 * 0.95 / 4000)
