"""Repeated visits to positions: drift of a set-up, repeatability, and missing data."""

import numpy as np
import pytest

from errormotion.methods.multilateration.drift import estimate_drift, positions

NOISE = 0.5e-6
TARGETS, RETURNS = 30, 12


def a_record(seed, rate, repeatability=0.0, stations=2):
    """Return displacement, time, position, directions and noise of set-ups that end with returns."""
    rng = np.random.default_rng(seed)
    target = rng.uniform(-0.2, 0.2, (TARGETS, 3))
    nominal = np.concatenate([target, target[:RETURNS]])
    station = np.array([(0.5, 0.1, 0.0), (-0.4, 0.5, 0.2)])[:stations]
    v = nominal - station[:, None]
    distance = np.linalg.norm(v, axis=2)
    e = v / distance[:, :, None]
    time = 10.0 * np.arange(len(nominal)) + 1000.0 * np.arange(stations)[:, None]
    since = time - time.mean(axis=1, keepdims=True)
    true = since * (rate[:, :1] + np.einsum("jta,ja->jt", e, rate[:, 1:]))
    noise = np.full(distance.shape, NOISE)
    moved = repeatability * rng.normal(size=(stations, len(nominal), 3))
    d = distance + true + np.einsum("jta,jta->jt", e, moved) + NOISE * rng.normal(size=distance.shape)
    return d, time, positions(nominal), e, noise, true


def test_targets_at_one_position_have_the_same_number():
    nominal = np.array([(0.1, 0.2, 0.3), (0.0, 0.0, 0.0), (0.1, 0.2, 0.3)])
    number = positions(nominal)
    assert number[0] == number[2] != number[1]


def test_drift_of_the_dead_path_is_estimated_and_subtracted():
    rate = np.array([(2e-8, 0, 0, 0), (0, 0, 0, 0)])  # 8 um in 400 s
    d, time, place, e, noise, true = a_record(1, rate)
    notes = []
    drift = estimate_drift(d, time, place, e, noise, ["A", "B"], notes)
    # Returns lie 300 s apart: 12 differences of 0.7 um leave 0.7e-9 m/s.
    assert abs(drift.rate[0, 0] - 2e-8) < 4 * 0.7e-9
    assert not drift.rate[0, 1:].any()
    assert np.abs(drift.correction - true)[0].max() < 4 * 0.7e-9 * 210
    assert not notes


def test_drift_of_the_machine_has_a_direction():
    rate = np.array([(0, 6e-8, -4e-8, 0), (0, 0, 0, 5e-8)])
    d, time, place, e, noise, true = a_record(2, rate)
    drift = estimate_drift(d, time, place, e, noise, ["A", "B"], [])
    spread = np.sqrt(sum(np.where(np.isfinite(s.change), s.change, 0.0) ** 2 for s in drift.sources))
    # What is left is within its stated uncertainty; what a steady shift adds is the station's.
    left = drift.correction - true
    assert np.mean(np.abs(left) <= 2 * spread + 1e-12) > 0.9
    assert np.abs(left).max() < 0.3 * np.abs(true).max()


def test_no_drift_is_subtracted_if_there_is_none():
    taken = []
    for seed in range(20):
        d, time, place, e, noise, _ = a_record(seed, np.zeros((2, 4)))
        taken.append(np.any(estimate_drift(d, time, place, e, noise, ["A", "B"], []).correction, axis=1))
    assert np.mean(taken) <= 0.1  # of 40 set-ups, 2 % by the test


def test_repeatability_is_the_scatter_of_returns_beyond_the_noise():
    d, time, place, e, noise, _ = a_record(3, np.zeros((2, 4)), repeatability=3e-6)
    notes = []
    drift = estimate_drift(d, time, place, e, noise, ["A", "B"], notes)
    # 24 differences: a standard deviation to 15 %.
    assert drift.repeatability == pytest.approx(3e-6, rel=0.5)
    assert "repeatability" in notes[0]


def test_missing_returns_are_noted():
    d, time, place, e, noise, _ = a_record(4, np.zeros((2, 4)))
    notes = []
    once = slice(0, TARGETS)
    drift = estimate_drift(d[:, once], time[:, once], place[once], e[:, once], noise[:, once], ["A", "B"], notes)
    assert drift.pairs == 0
    assert np.isnan(drift.rate).all()
    assert not drift.correction.any()
    assert "visited again" in notes[0]
