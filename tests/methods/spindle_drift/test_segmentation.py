"""A stepped record is cut into its steps without knowing when the machine moved."""

import numpy as np
import pytest
from coded import raises

from errormotion.methods.spindle_drift.identification.segmentation import segment_steps

R, STEPS, RATE = 5e-3, 101, 1500.0
PLACES = np.linspace(-1e-3, 1e-3, STEPS)


def record(seed, *, dwell=1.0, rate=RATE, steps=STEPS):
    """Return a record, what each step should read, and where the first rest begins."""
    rng = np.random.default_rng(seed)
    places = np.linspace(-1e-3, 1e-3, steps)
    travel, lead, approach, off = rng.uniform([0.02, 1.0, 0.1, -2e-4], [0.25, 8.0, 0.5, 2e-4])
    knots = [(0.0, 0.0), (lead, 0.0), (lead + approach, places[0])]
    t = lead + approach
    for i, place in enumerate(places):
        knots.append((t + dwell, place))
        t += dwell
        if i + 1 < steps:
            knots.append((t + travel, places[i + 1]))
            t += travel
    knots += [(t + approach, 0.0), (t + approach + 3.0, 0.0)]
    times, where = np.array(knots).T
    clock = np.arange(0, times[-1], 1 / rate)
    x = np.interp(clock, times, where) - off
    distance = 1e-3 + R - np.sqrt(R * R - x * x) + rng.normal(0, 0.3e-6, clock.size)
    distance[rng.random(clock.size) < 1e-3] = np.nan
    return distance, 1e-3 + R - np.sqrt(R * R - (places - off) ** 2), lead + approach, dwell + travel


@pytest.mark.parametrize("seed", range(8))
def test_every_step_is_found_whatever_the_machine_takes_to_move(seed):
    distance, expected, start, period = record(seed)
    steps = segment_steps(distance, RATE, STEPS, 1.0)
    # 0.3 um over 450 samples is 14 nm; the largest of 101 lies within five of it.
    np.testing.assert_allclose(steps.mean, expected, rtol=0, atol=5 * 14.2e-9)
    assert abs(steps.start - start) < 0.3
    assert abs(steps.period - period) < 0.005


def test_other_rates_and_rests_are_segmented():
    distance, expected, *_ = record(1, dwell=0.5, rate=20e3, steps=41)
    np.testing.assert_allclose(segment_steps(distance, 20e3, 41, 0.5, 0.2).mean, expected, rtol=0, atol=5 * 4.8e-9)


def test_step_without_readings_is_unknown():
    distance, *_, start, period = record(2)
    lost = slice(int((start + 20 * period) * RATE), int((start + 21 * period) * RATE))
    distance[lost] = np.nan
    mean = segment_steps(distance, RATE, STEPS, 1.0).mean
    assert np.isnan(mean[20])
    assert np.isfinite(np.delete(mean, 20)).all()


def test_a_record_without_a_scan_is_refused():
    noise = 1e-3 + np.random.default_rng(0).normal(0, 0.3e-6, int(130 * RATE))
    with raises("detection.no_moves"):
        segment_steps(noise, RATE, STEPS, 1.0)


def test_a_cut_off_record_is_refused():
    distance, *_ = record(3)
    with raises("detection.record.too_short"):
        segment_steps(distance[: distance.size // 2], RATE, STEPS, 1.0)


def test_wrong_number_of_steps_is_detected():
    distance, *_ = record(4)
    with raises("detection.steps.count"):
        segment_steps(distance, RATE, 51, 1.0)


def test_a_mean_longer_than_half_a_rest_is_refused():
    with raises("detection.average.too_long"):
        segment_steps(np.zeros(1000), RATE, STEPS, 1.0, 0.6)
