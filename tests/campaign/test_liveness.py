"""Sensors that no longer measure are found, and those that measure are not doubted, over seeds."""

import numpy as np
import pytest

from errormotion.campaign.monitor.liveness import BLOCK, COMMON_CHANGES, SHORTEST, Liveness, _expected, _score

SEEDS = 40
LIVE, BEFORE, WITHIN = 3600, 400, 420
"""Readings of a measuring sensor, before a failure, and after it, until which it must be found."""


def readings(rng: np.random.Generator, count: int, noise: float, step: float, drift: float = 0.2) -> np.ndarray:
    """Return temperatures that drift by a period of two hours, with noise and a resolution, degC."""
    place, phase = rng.uniform(0.0, 1.0), rng.uniform(0.0, 2 * np.pi)
    true = 20 + place + drift * np.sin(2 * np.pi * np.arange(count) / 7200 + phase)
    values = true + rng.normal(0.0, noise, count)
    return np.round(values / step) * step if step else values


def first_doubt(*series: np.ndarray) -> int | None:
    """Return the number of the reading after which a sensor is doubted; None if none is."""
    liveness = Liveness()
    for k, row in enumerate(zip(*series, strict=True)):
        liveness.put({f"sensor {number}": float(value) for number, value in enumerate(row)})
        if liveness.found():
            return k
    return None


NOISE_AND_STEP = [(5e-3, 0.0), (5e-3, 1e-3), (10e-3, 10e-3), (5e-3, 10e-3), (2e-3, 10e-3), (5e-3, 0.1), (20e-3, 0.1)]


@pytest.mark.parametrize(("noise", "step"), [*NOISE_AND_STEP, (50e-3, 0.1), (0.0, 0.1), (0.0, 0.01), (0.0, 0.0)])
@pytest.mark.parametrize("drift", [0.0, 0.2])
def test_a_measuring_sensor_is_not_doubted(noise: float, step: float, drift: float) -> None:
    found = [first_doubt(readings(np.random.default_rng(seed), LIVE, noise, step, drift)) for seed in range(8)]
    assert found == [None] * 8  # expected: fewer than 8 * 3600 * 1e-9


@pytest.mark.parametrize(("noise", "step"), [(5e-3, 0.0), (5e-3, 1e-3), (10e-3, 10e-3), (6e-3, 10e-3), (0.1, 0.1)])
def test_a_sensor_that_repeats_its_last_value_is_found(noise: float, step: float) -> None:
    found = []
    for seed in range(SEEDS):
        values = readings(np.random.default_rng(seed), BEFORE + WITHIN, noise, step)
        values[BEFORE:] = values[BEFORE]
        found.append(first_doubt(values))
    assert all(each is None or each >= BEFORE + SHORTEST - BLOCK for each in found)
    assert sum(each is not None for each in found) >= 0.9 * SEEDS


def test_a_sensor_whose_device_updates_it_seldom_is_found_in_proportion() -> None:
    for seed in range(8):
        slow = np.repeat(readings(np.random.default_rng(seed), 500, 10e-3, 1e-3), 5)
        assert first_doubt(slow) is None
        slow[1500:] = slow[1500]
        found = first_doubt(slow)
        assert found is not None
        assert 1500 + 5 * SHORTEST <= found + 5 <= 1500 + 5 * WITHIN


def test_a_coarse_sensor_that_flickers_between_two_values_may_come_to_rest() -> None:
    for seed in range(8):
        rng = np.random.default_rng(seed)
        flickers = 20.1 + 0.1 * rng.integers(0, 2, 1000)
        assert first_doubt(np.concatenate([flickers, np.full(3000, 20.2)])) is None


def test_a_warming_without_noise_may_come_to_rest() -> None:
    warming = np.concatenate([20 + 1e-3 * np.arange(1000), np.full(3000, 21.0)])
    assert first_doubt(warming) is None


@pytest.mark.parametrize(("noise", "step"), NOISE_AND_STEP)
def test_two_sensors_at_one_place_are_not_doubted(noise: float, step: float) -> None:
    for seed in range(8):
        rng = np.random.default_rng(seed)
        true = 20 + rng.uniform(0, 1) + 0.5 * np.sin(np.arange(LIVE) / 600)
        pair = [true + rng.normal(0, 0.05) + rng.normal(0, noise, LIVE) for _ in range(2)]
        assert first_doubt(*(np.round(each / step) * step if step else each for each in pair)) is None


@pytest.mark.parametrize(("noise", "step"), [(5e-3, 0.0), (10e-3, 10e-3), (50e-3, 0.1)])
def test_two_sensors_that_are_one_are_found(noise: float, step: float) -> None:
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        first, other = (readings(rng, BEFORE + WITHIN, noise, step) for _ in range(2))
        other[BEFORE:] = first[BEFORE:]
        found = first_doubt(first, other)
        assert found is not None
        assert BEFORE + COMMON_CHANGES - 1 <= found < BEFORE + 20 * COMMON_CHANGES


def test_equal_and_constant_values_are_no_agreement() -> None:
    assert first_doubt(np.full(2000, 20.1), np.full(2000, 20.1)) is None


def test_a_value_that_is_not_read_again_proves_nothing_and_the_next_change_ends_the_doubt() -> None:
    values = readings(np.random.default_rng(3), BEFORE, 5e-3, 1e-3)
    liveness = Liveness()
    for value in values:
        liveness.put({"a": float(value)})
    for _ in range(1000):
        liveness.put({})
        liveness.put({"a": float("nan")})
    assert not liveness.found()
    for _ in range(SHORTEST + 1):
        liveness.put({"a": 20.0})
    assert list(liveness.found()) == ["a"]
    liveness.put({"a": 20.001})
    assert not liveness.found()


@pytest.mark.parametrize(("s", "f"), [(0.3, 0.0), (0.3, 0.5), (0.5, 0.25), (1.0, 0.1), (3.0, 0.0)])
def test_the_expected_score_is_the_mean_of_many_blocks(s: float, f: float) -> None:
    rng = np.random.default_rng(7)
    blocks = np.round(f + rng.normal(0.0, s, (20_000, BLOCK)))
    counts = np.array([len(set(block)) for block in blocks])
    scores = np.where(counts >= 3, counts, 1)
    assert _expected(s, f) == pytest.approx(scores.mean(), abs=4 * scores.std() / np.sqrt(len(scores)) + 1e-6)
    assert np.mean([_score(list(block)) for block in blocks[:2000]]) <= scores.mean() + 0.1  # turns are required too
