"""The worked examples of JCGM 101:2008, clause 9, and of the GUM, H.1, through the same code as the methods."""

import numpy as np
import pytest
from scipy import stats

from errormotion.montecarlo import intervals
from errormotion.montecarlo.adaptive import numerical_tolerance, propagate
from errormotion.montecarlo.validation import NOT_VALIDATED, VALIDATED, validate_linear


def _block(model, *inputs):
    """Return a block function of a model of scalar inputs, each ``draw(generator, size)``."""

    def block(sequence, size):
        generator = np.random.default_rng(sequence)
        return np.asarray(model(*(draw(generator, size) for draw in inputs)), dtype=float)[:, None]

    return block


def normal(mean, u):
    return lambda generator, size: generator.normal(mean, u, size)


def rectangular(low, high):
    return lambda generator, size: generator.uniform(low, high, size)


def student(mean, u, degrees):
    return lambda generator, size: mean + u * generator.standard_t(degrees, size)


def arcsine(low, high):
    return lambda generator, size: (low + high) / 2 + (high - low) / 2 * np.sin(generator.uniform(0, 2 * np.pi, size))


def curvilinear_trapezoid(low, high, uncertain):
    """A rectangle whose half width is known to within ``uncertain``: JCGM 101, 6.4.3.4."""

    def draw(generator, size):
        first = low - uncertain + 2 * uncertain * generator.uniform(size=size)
        return first + (low + high - 2 * first) * generator.uniform(size=size)

    return draw


def _sum(*terms):
    return sum(terms)


def _check(found, uncertainty, interval, error, short=False):
    """The published figures hold within ``error``: half a unit of their last digit, and the spread of both runs."""
    assert found.uncertainty[0] == pytest.approx(uncertainty, abs=error)
    np.testing.assert_allclose((found.shortest if short else found.symmetric)[:, 0], interval, atol=error)


@pytest.mark.parametrize(
    ("u", "digits", "tolerance"),
    [(0.35, 2, 0.005), (0.00011, 1, 0.00005), (32.0, 2, 0.5), (9.96, 2, 0.5), (0.0754, 1, 0.005), (0.0, 2, 0.0)],
)
def test_numerical_tolerance_is_half_a_unit_of_the_last_meaningful_digit(u, digits, tolerance):
    assert numerical_tolerance(u, digits) == pytest.approx(tolerance)


def test_additive_model_of_four_normal_quantities():
    """9.2.2, table 2: u 2.00, [-3.92, 3.92], validated."""
    block = _block(_sum, *[normal(0, 1)] * 4)
    found = propagate(block, digits=2, most=3_000_000)
    assert found.stable.all()
    _check(found, 2.0, (-3.92, 3.92), 0.05)  # the tolerance to which the procedure found it stable
    assert validate_linear(np.zeros(1), np.full(1, 2.0), propagate(block, trials=1_000_000)).verdict[0] == VALIDATED


def test_additive_model_of_four_rectangular_quantities():
    """9.2.3, table 3: u 2.00, [-3.88, 3.88], validated with two digits: the ends differ by 0.04 of 0.05."""
    block = _block(_sum, *[rectangular(-(3**0.5), 3**0.5)] * 4)
    found = propagate(block, digits=2, most=3_000_000)
    _check(found, 2.0, (-3.88, 3.88), 0.05)
    found = propagate(block, trials=4_000_000)  # the margin to the tolerance is a quarter of it
    _check(found, 2.0, (-3.88, 3.88), 0.01)
    result = validate_linear(np.zeros(1), np.full(1, 2.0), found)
    np.testing.assert_allclose([result.low[0], result.high[0]], 0.04, atol=0.01)
    assert result.verdict[0] == VALIDATED


def test_additive_model_with_one_large_rectangular_quantity():
    """9.2.4, table 4: u 10.1, [-17.0, 17.0] where the linear interval is [-19.9, 19.9]: not validated."""
    large = rectangular(-10 * 3**0.5, 10 * 3**0.5)
    found = propagate(_block(_sum, *[rectangular(-(3**0.5), 3**0.5)] * 3, large), digits=3, most=1_000_000)
    _check(found, 10.1, (-17.0, 17.0), 0.06)
    result = validate_linear(np.zeros(1), np.full(1, np.sqrt(103.0)), found)
    np.testing.assert_allclose([result.low[0], result.high[0]], 2.8, atol=0.12)
    assert result.verdict[0] == NOT_VALIDATED


def _mass(reference, difference, air, weight, standard):
    return (reference + difference) * (1 + (air - 1.2) * (1 / weight - 1 / standard)) - 100_000.0


_MASS = (
    normal(100_000.0, 0.050),
    normal(1.234, 0.020),
    rectangular(1.10, 1.30),
    rectangular(7e3, 9e3),
    rectangular(7.95e3, 8.05e3),
)


def test_mass_calibration():
    """9.3, table 6: 1.2341 mg, u 0.0754 mg, shortest interval [1.0834, 1.3825] mg; first order is not validated."""
    found = propagate(_block(_mass, *_MASS), digits=2, most=2_000_000)
    assert found.stable.all()
    assert found.mean[0] == pytest.approx(1.2341, abs=3e-4)
    assert found.uncertainty[0] == pytest.approx(0.0754, abs=3e-4)
    # The density is symmetric, so that the shortest interval of a sample lies where chance puts it; not so its length.
    np.testing.assert_allclose(found.shortest[:, 0], (1.0834, 1.3825), atol=4e-3)
    assert np.diff(found.shortest[:, 0])[0] == pytest.approx(1.3825 - 1.0834, abs=1e-3)
    one_digit = propagate(_block(_mass, *_MASS), trials=found.trials, digits=1)
    first = validate_linear(np.array([1.2340]), np.array([0.0539]), one_digit)
    np.testing.assert_allclose([first.low[0], first.high[0]], 0.044, atol=2e-3)  # 0.0451 and 0.0430 in the table
    assert first.verdict[0] == NOT_VALIDATED
    second = validate_linear(np.array([1.2340]), np.array([0.0750]), one_digit)
    assert second.verdict[0] == VALIDATED


def _loss(x1, x2):
    return x1**2 + x2**2


@pytest.mark.parametrize(
    ("x1", "mean", "uncertainty", "interval"),
    [
        (0.0, 50e-6, 50e-6, (0.0, 150e-6)),
        (0.010, 150e-6, 112e-6, (0.0, 367e-6)),
        (0.050, 2551e-6, 502e-6, (1590e-6, 3543e-6)),
    ],
)
def test_comparison_loss(x1, mean, uncertainty, interval):
    """9.4, table 8: without correlation, x2 = 0; the intervals are the shortest ones."""
    found = propagate(_block(_loss, normal(x1, 0.005), normal(0.0, 0.005)), trials=1_000_000)
    assert found.mean[0] == pytest.approx(mean, abs=2e-6)
    assert found.uncertainty[0] == pytest.approx(uncertainty, abs=1e-6)
    # The shortest interval is flat about its minimum: its place is known to about 0.03 u with 1e6 trials.
    np.testing.assert_allclose(found.shortest[:, 0], interval, atol=max(0.03 * uncertainty, 1e-6))


def test_comparison_loss_of_zero_has_no_linear_uncertainty():
    found = propagate(_block(_loss, normal(0.0, 0.005), normal(0.0, 0.005)), trials=100_000)
    assert validate_linear(np.zeros(1), np.zeros(1), found).verdict[0] == NOT_VALIDATED


def _gauge(standard, difference, random, systematic, expansion, temperature, cycle, expansions, temperatures):
    """Deviation from nominal length, nm: JCGM 101, 9.5.2.3."""
    along = temperature + cycle
    change = expansions * along + expansion * temperatures
    return standard * (1 - change) + difference + random + systematic - 50_000_000.0


_GAUGE = (
    student(50_000_623.0, 25.0, 18),
    student(215.0, 6.0, 24),
    student(0.0, 4.0, 5),
    student(0.0, 7.0, 8),
    rectangular(9.5e-6, 13.5e-6),
    normal(-0.1, 0.2),
    arcsine(-0.5, 0.5),
    curvilinear_trapezoid(-1.0e-6, 1.0e-6, 0.1e-6),
    curvilinear_trapezoid(-0.050, 0.050, 0.025),
)


def test_gauge_block_calibration():
    """9.5, table 11: 838 nm, u 36 nm, [745, 932] nm with 99 %; the linear method gave 32 nm, [745, 931] nm."""
    found = propagate(_block(_gauge, *_GAUGE), probability=0.99, digits=2, most=2_000_000)
    assert found.mean[0] == pytest.approx(838.0, abs=0.6)
    _check(found, 36.0, (745.0, 932.0), 1.5)
    factor = float(stats.t.ppf(0.995, 16))  # GUM, H.1.6: 16 effective degrees of freedom, U = 93 nm
    assert factor * 31.7 == pytest.approx(93.0, abs=0.6)
    assert validate_linear(np.array([838.0]), np.array([31.7]), found, factor=factor).low[0] < 2.0


def test_end_gauge_of_the_gum():
    """GUM, H.1: u = 32 nm to first order, which a sample of normal inputs of the same uncertainties confirms."""
    inputs = (
        normal(50_000_623.0, 25.0),
        normal(215.0, 5.8),
        normal(0.0, 3.9),
        normal(0.0, 6.7),
        rectangular(9.5e-6, 13.5e-6),
        normal(-0.1, 0.2),
        arcsine(-0.5, 0.5),
        rectangular(-1.0e-6, 1.0e-6),
        rectangular(-0.050, 0.050),
    )
    found = propagate(_block(_gauge, *inputs), trials=1_000_000)
    # H.1.7: with the second-order terms of the products, 34 nm instead of 32 nm
    assert found.uncertainty[0] == pytest.approx(34.0, abs=0.5)
    assert found.mean[0] == pytest.approx(838.0, abs=0.5)


def test_another_package_returns_the_same_gauge_block_result():
    """MetroloPy, linear and by Monte Carlo, on 9.5: u 32 nm and 36 nm, 99 % interval."""
    metrolopy = pytest.importorskip("metrolopy", reason="the package MetroloPy, another implementation, is missing")
    given = metrolopy.gummy
    length = _gauge(
        *(given(metrolopy.TDist(*each)) for each in ((50_000_623.0, 25.0, 18), (215.0, 6.0, 24))),
        *(given(metrolopy.TDist(*each)) for each in ((0.0, 4.0, 5), (0.0, 7.0, 8))),
        given(metrolopy.UniformDist(lower_limit=9.5e-6, upper_limit=13.5e-6)),
        given(metrolopy.NormalDist(-0.1, 0.2)),
        given(metrolopy.ArcSinDist(center=0.0, half_width=0.5)),
        given(metrolopy.CurvlinearTrapDist(center=0.0, half_width=1e-6, limit_half_range=0.1e-6)),
        given(metrolopy.CurvlinearTrapDist(center=0.0, half_width=0.050, limit_half_range=0.025)),
    )
    metrolopy.Distribution.set_seed(3)
    length.sim(n=400_000)
    theirs = np.sort(np.asarray(length.simdata, dtype=float))[:, None]
    ours = propagate(_block(_gauge, *_GAUGE), probability=0.99, trials=400_000)
    error = np.hypot(ours.standard_error[:, 0], np.array(intervals.standard_errors(theirs, 0.99))[:, 0])
    assert length.u == pytest.approx(32.0, abs=0.5)
    # 36 nm is known to 36 / sqrt(2 n) = 0.04 nm on either side, more for the tails of Student's distribution
    assert ours.uncertainty[0] == pytest.approx(theirs.std(), abs=0.4)
    ends = np.array(intervals.symmetric(theirs, 0.99))[:, 0]
    np.testing.assert_array_less(np.abs(ours.symmetric[:, 0] - ends), 4 * error)


def test_bounds_of_an_end_hold_as_often_as_stated():
    """Of 4000 samples of 300, both quantiles lie within their bounds except for the stated fraction."""
    samples = np.sort(np.random.default_rng(2).exponential(size=(300, 4000)), axis=0)
    alarm = 0.05
    for bounds, q in zip(intervals.confidence(samples, 0.95, alarm), (0.025, 0.975), strict=True):
        missed = int(((bounds[0] > -np.log(1 - q)) | (bounds[1] < -np.log(1 - q))).sum())
        # at most the stated share, and not much less: the binomial distribution is discrete
        assert stats.binom.ppf(1e-4, 4000, alarm / 3) < missed < stats.binom.ppf(1 - 1e-4, 4000, alarm)


def test_a_linear_model_is_never_rejected_by_few_trials():
    """Two hundred normally distributed quantities by 100 trials each: none may be 'not validated'."""
    for seed in range(20):
        found = propagate(
            lambda sequence, n: np.random.default_rng(sequence).normal(size=(n, 200)), trials=100, seed=seed
        )
        assert (validate_linear(np.zeros(200), np.ones(200), found).verdict != NOT_VALIDATED).all()
