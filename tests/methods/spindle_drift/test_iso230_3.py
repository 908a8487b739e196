"""ISO 230-3 values: ranges, differences, time constant, slope, and what is known of them."""

import numpy as np
import pytest
from scipy import signal, stats

from errormotion.errors import MethodError
from errormotion.methods.spindle_drift.identification.iso230_3 import MEASURES, QUANTITIES, evaluate, quantities

U = 1e-8


def drift(t, tau=1500.0):
    """Return error twists: Z rises by 20 um and settles, the bar tilts, and X turns back halfway."""
    errors = np.full((t.size, 6), np.nan)
    errors[:, 0] = 3e-6 * np.sin(np.pi * t / t[-1])
    errors[:, 1] = -2e-6 * t / t[-1]
    errors[:, 2] = 20e-6 * -np.expm1(-t / tau)
    errors[:, 3] = 100e-6 * -np.expm1(-t / tau)
    errors[:, 4] = -50e-6 * -np.expm1(-t / tau)
    return errors


def results(t, errors=None, reference_u=3 * U, only=QUANTITIES, **options):
    """Return the values of a record; those of other quantities than ``only`` are unknown."""
    errors = drift(t) if errors is None else errors
    independent = np.tile(np.diag([U**2] * 6), (t.size, 1, 1))
    influence = np.zeros((1, t.size, 6))
    influence[0, 1:] = reference_u  # the reference: one draw in all values but the first
    series = quantities(errors, independent, influence, np.array([0.01, 0.05]), np.zeros(3))
    series.value[[name not in only for name in QUANTITIES]] = np.nan
    settings = {
        "temperature": None,
        "sensors": (),
        "spindle_speed": None,
        "running_end": None,
        "sensor": None,
        "average": 30.0,
        "reference": np.array([0]),
    }
    return evaluate(series, t, **(settings | options))


def value(found, quantity, measure, table="value"):
    return getattr(found, table)[QUANTITIES.index(quantity), MEASURES.index(measure)]


def test_ranges_and_differences_are_reported_apart():
    t = np.arange(0, 7200.5, 0.5)
    found = results(t)
    assert value(found, "X1", "range_total") == pytest.approx(
        3e-6 + abs(value(found, "B", "difference_total")) * 0.0, abs=1e-6
    )
    # Means of half a minute of a curve that rises by 13 nm/s at first: 0.2 um at the start, 5 nm at the end.
    assert value(found, "Z", "range_60min") == pytest.approx(20e-6 * -np.expm1(-3600 / 1500), abs=0.22e-6)
    assert value(found, "Z", "difference_60min") == pytest.approx(20e-6 * -np.expm1(-3600 / 1500), abs=0.02e-6)
    assert value(found, "Z", "difference_total") == pytest.approx(20e-6 * -np.expm1(-7200 / 1500), abs=0.002e-6)
    turned = drift(t)[:, 0] + drift(t)[:, 4] * 0.01
    assert value(found, "X1", "range_total") == pytest.approx(np.ptp(turned), rel=0.02)
    assert value(found, "X1", "difference_total") == pytest.approx(turned[-1] - turned[0], abs=0.022e-6)  # 1.3 nm/s
    assert abs(value(found, "X1", "difference_total")) < 0.3 * value(found, "X1", "range_total")


def test_levels_follow_from_displacement_and_tilt():
    t = np.arange(0, 4000.0, 10.0)
    found = results(t)
    errors = drift(t)
    np.testing.assert_allclose(found.series.value[1], errors[:, 0] + 0.05 * errors[:, 4], atol=1e-18)
    np.testing.assert_allclose(found.series.value[2], errors[:, 1] - 0.01 * errors[:, 3], atol=1e-18)


def test_only_a_difference_from_the_start_contains_the_uncertainty_of_the_reference():
    t = np.arange(0, 4000.0, 10.0)
    found = results(t)
    # The end of a line through three instants of 10 s in half a minute, and the reference that they share.
    of_end = np.linalg.pinv(np.column_stack([np.ones(3), [-2.0, -1.0, 0.0]]))[0]
    u = value(found, "Z", "difference_60min", "uncertainty")
    assert u == pytest.approx(U * np.sqrt(of_end @ of_end + 9), rel=1e-9)
    change = found.series.weighted(4, np.array([100, 50]), np.array([1.0, -1.0]))
    assert change[1] == pytest.approx(U * np.sqrt(2), rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("size", [0.0, 0.02, 1.0], ids=["at rest", "nearly at rest", "moving"])
def test_ranges_lie_within_their_uncertainty_at_rest_and_moving(size):
    t = np.arange(0, 4000.0, 10.0)
    fine = np.arange(0, t[-1] + 0.5, 1.0)
    seeds = 200
    truth = {}
    for name, (height, freedom) in {"X1": (0.01, 0), "Z": (0.0, 2), "A": (0.0, 3)}.items():
        values = size * drift(fine)[:, freedom] + height * size * drift(fine)[:, 4] * (freedom == 0)
        truth[name] = np.ptp(values[fine <= 3600.0])
    held = dict.fromkeys(truth, 0)
    for seed in range(seeds):
        draw = np.random.default_rng(seed).standard_normal
        errors = size * drift(t) + U * draw((t.size, 6))
        errors[1:] -= 3 * U * draw()  # the reference
        errors[0] = 0.0
        found = results(t, errors, only=truth)
        for name, range_ in truth.items():
            held[name] += abs(value(found, name, "range_60min") - range_) <= 2 * value(
                found, name, "range_60min", "uncertainty"
            )
    assert min(held.values()) >= stats.binom.ppf(1e-3, seeds, 0.95), held


@pytest.mark.slow
def test_means_and_slopes_of_noise_that_is_alike_lie_within_their_uncertainty():
    t = np.arange(0, 4000.0, 10.0)
    phi, size, seeds = 0.9, 2 * U, 40  # alike for 95 s, beside the independent noise U
    effect = size * np.tile(np.eye(5)[:, None], (1, t.size, 1))
    none = np.zeros((1, t.size, 6))
    independent = np.tile((U**2 + size**2) * np.eye(6), (t.size, 1, 1))
    warmth = np.stack([20.0 + 1e-3 * t])
    options = {"temperature": warmth, "sensors": ("front",), "spindle_speed": None, "running_end": None, "sensor": None}
    held = {measure: [] for measure in ("range_60min", "difference_60min", "end_slope", "per_kelvin")}
    true = results(t, temperature=warmth, sensors=("front",))
    for seed in range(seeds):
        draw = np.random.default_rng(seed).standard_normal
        e = signal.lfilter([1.0], [1.0, -phi], np.sqrt(1 - phi**2) * draw((t.size + 500, 5)), axis=0)[500:]
        errors = drift(t)
        errors[:, :5] += size * e + U * draw((t.size, 5))
        series = quantities(
            errors, independent, none, np.array([0.01, 0.05]), np.zeros(3), (effect, t, -10.0 / np.log(phi))
        )
        found = evaluate(series, t, average=30.0, reference=np.array([0]), **options)
        for measure, inside in held.items():
            for quantity in ("Z", "A", "B"):  # independent of one another
                off = value(found, quantity, measure) - value(true, quantity, measure)
                inside.append(abs(off) <= 2 * value(found, quantity, measure, "uncertainty"))
    for measure, inside in held.items():
        assert np.sum(inside) >= stats.binom.ppf(1e-3, len(inside), 0.95), (measure, np.mean(inside))


def test_the_bias_of_a_range_at_rest_is_its_value():
    t = np.arange(0, 4000.0, 0.5)
    errors = np.zeros((t.size, 6))
    ratio = []
    for seed in range(20):
        errors[1:, 2] = np.random.default_rng(seed).normal(0, U, t.size - 1)
        found = results(t, errors, reference_u=0.0, only=("Z",))
        ratio.append(value(found, "Z", "range_60min", "bias") / value(found, "Z", "range_60min"))
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.25)


def test_the_value_at_the_end_does_not_lag_behind_the_drift():
    t = np.arange(0.25, 4000.0, 0.5)
    errors = np.zeros((t.size, 6))
    errors[:, 2] = 10e-6 * t / 3600.0
    found = results(t, errors, mean=0.5)
    for measure in ("range_60min", "difference_60min"):
        assert value(found, "Z", measure) == pytest.approx(10e-6, abs=1e-12)


@pytest.mark.parametrize("end", [3661.0, 3663.0])  # within a mean of 4 s, before and after its middle
def test_a_mean_across_the_end_of_running_is_left_out(end):
    t = np.arange(2.0, 4400.0, 4.0)
    errors = drift(t)
    errors[t + 2.0 > end, 2] += 27e-6 * np.clip((t[t + 2.0 > end] + 2.0 - end) / 4.0, 0.0, 1.0)
    found = results(t, errors, running_end=end, mean=4.0)
    smooth = 20e-6 * -np.expm1(-end / 1500)
    for measure in ("range_running", "difference_running"):
        assert value(found, "Z", measure) == pytest.approx(smooth, abs=0.03e-6)


@pytest.mark.parametrize("at", [4011.0, 4009.0])  # within a mean of 4 s, after and before its middle
@pytest.mark.parametrize("mean", [0.0, 4.0])
def test_no_mean_of_a_range_contains_a_switched_compensation(mean, at):
    t = np.arange(2.0, 4400.0, mean or 1.0)
    errors = np.zeros((t.size, 6))
    after = np.clip((t - at) / mean + 0.5, 0.0, 1.0) if mean else t > at
    errors[:, 2] = 10e-6 * t / 4000.0 - 30e-6 * after
    found = results(t, errors, mean=mean, changes=[at])
    peak, low = 10e-6 * at / 4000.0, 10e-6 * (at + 1) / 4000.0 - 30e-6
    # The drift, 2.5 nm/s, between the switch and the middles of half a minute, and in the mean that is left out.
    assert value(found, "Z", "range_total") == pytest.approx(peak - low, abs=2 * (15 + mean) * 2.5e-9)


def test_noise_widens_a_range_less_than_its_uncertainty():
    t = np.arange(0, 7200.0, 0.5)
    errors = drift(t)
    errors[:, 2] += np.random.default_rng(0).normal(0, 0.1e-6, t.size)
    # Of 7200 single values the largest lies 3.7 sigma out, on either side; of means of 60 half a sigma at most.
    assert value(results(t, errors), "Z", "range_60min") == pytest.approx(
        value(results(t), "Z", "range_60min"), abs=0.05e-6
    )


def test_spindle_that_turns_backwards_is_running():
    t = np.arange(0, 4000.0, 10.0)
    speed = np.where(t < 3000, -15000.0, 0.0)
    found = results(t, spindle_speed=speed)
    assert found.test == "rotating spindle"
    assert value(found, "Z", "difference_running") == pytest.approx(20e-6 * -np.expm1(-2990 / 1500), abs=0.05e-6)


def test_all_quantities_are_those_on_the_axis_wherever_the_errors_are_stated():
    t = np.arange(0, 4000.0, 10.0)
    errors = drift(t)
    point = np.array([0.1, 0.05, -0.05])
    there = errors.copy()
    there[:, :3] += np.cross(np.nan_to_num(errors[:, 3:]), point)
    none = np.zeros((t.size, 6, 6)), np.zeros((1, t.size, 6))
    here = quantities(errors, *none, np.array([0.01, 0.05]), np.zeros(3))
    moved = quantities(there, *none, np.array([0.01, 0.05]) - point[2], -point)
    np.testing.assert_allclose(moved.value, here.value, atol=1e-18)


def test_an_hour_that_was_not_measured_is_unknown():
    found = results(np.arange(0, 1800.0, 1.0))
    assert np.isnan(value(found, "Z", "range_60min"))
    assert np.isfinite(value(found, "Z", "range_total"))


def test_running_ends_where_the_speed_goes_to_zero():
    t = np.arange(0, 7200.0, 1.0)
    speed = np.where(t < 5000, 15000.0, 0.0)
    found = results(t, spindle_speed=speed)
    assert found.test == "rotating spindle"
    assert value(found, "Z", "difference_running") == pytest.approx(20e-6 * -np.expm1(-4999 / 1500), abs=0.01e-6)
    assert value(found, "Z", "range_total") > value(found, "Z", "range_running")


def test_a_spindle_that_stands_still_makes_it_an_etve_test():
    t = np.arange(0, 4000.0, 10.0)
    assert results(t, spindle_speed=np.zeros(t.size)).test.startswith("ETVE")


@pytest.mark.parametrize("tau", [300.0, 1500.0, 3000.0])
def test_time_constant_is_found_or_unknown(tau):
    t = np.arange(0, 7200.0, 1.0)
    noise = np.random.default_rng(0).normal(0, 1e-8, (t.size, 6))
    found = results(t, drift(t, tau) + noise)
    assert value(found, "Z", "time_constant") == pytest.approx(tau, rel=0.01)
    assert np.isnan(value(found, "Y1", "time_constant")) or value(found, "Y1", "time_constant") < 7200
    straight = drift(t)
    straight[:, 2] = 1e-9 * t
    assert np.isnan(value(results(t, straight), "Z", "time_constant"))


def test_end_slope_and_change_per_kelvin_with_their_uncertainty():
    t = np.arange(0, 7200.0, 1.0)
    errors = drift(t)
    errors[:, 2] = 2e-9 * t
    warmth = np.stack([np.full(t.size, 20.0), 20.0 + 1e-3 * t])
    found = results(t, errors, temperature=warmth, sensors=("ambient", "front"))
    assert found.sensor == "front"
    assert value(found, "Z", "end_slope") == pytest.approx(2e-9, rel=1e-9)
    assert value(found, "Z", "per_kelvin") == pytest.approx(2e-6, rel=1e-9)
    # A slope over 601 s of 1 s samples with white noise: U / sqrt(sum of (t - mean)^2); the shared part drops out.
    assert value(found, "Z", "end_slope", "uncertainty") == pytest.approx(
        U / np.sqrt(601 * (601**2 - 1) / 12), rel=0.01
    )


def test_unknown_thermometer_is_reported():
    with pytest.raises(MethodError, match=r"iso_temperature = 'oil'.*front"):
        results(np.arange(0, 100.0), temperature=np.ones((1, 100)), sensors=("front",), sensor="oil")


def test_unknown_instants_are_skipped():
    t = np.arange(0, 4000.0, 1.0)
    errors = drift(t)
    errors[100:700] = np.nan
    assert value(results(t, errors), "Z", "range_60min") == pytest.approx(
        value(results(t), "Z", "range_60min"), rel=1e-12
    )
