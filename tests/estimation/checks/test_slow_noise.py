"""Noise beyond the stated one, of values that are smooth without it and that no other reading checks."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.signal import lfilter

from errormotion.arrays import Array
from errormotion.estimation.checks.slow_noise import FEWEST, SlowNoise, slow_noise

SEEDS = 60
STATED = 3e-9
FURTHER = 2 * STATED
Made = Callable[[np.random.Generator, int], Array]


def white(rng: np.random.Generator, n: int) -> Array:
    return rng.standard_normal((5, n))


def autoregressive(phi: float) -> Made:
    """Return noise with a correlation of neighbours, after it has become stationary."""

    def made(rng: np.random.Generator, n: int) -> Array:
        return np.asarray(lfilter([1], [1, -phi], np.sqrt(1 - phi**2) * white(rng, n + 2000)))[:, 2000:]

    return made


def pink(rng: np.random.Generator, n: int) -> Array:
    """Return noise with a power of 1 / f over four lengths, as of an amplifier, with the standard deviation 1."""
    f = np.fft.rfftfreq(4 * n)
    power = np.concatenate([[0.0], f[1:] ** -0.5])
    made = np.fft.irfft(np.fft.rfft(white(rng, 4 * n)) * power)
    return np.asarray(made[:, :n] / made.std())


def warm_up(time: Array, rng: np.random.Generator) -> Array:
    """Return five curves of micrometres from three bodies that warm up after the time 0, and a slow wave of the air."""
    bodies = 1 - np.exp(-np.maximum(time, 0.0) / np.array([[400.0], [1500.0], [6000.0]]))
    air = np.sin(2 * np.pi * time / 2e4)
    return 1e-5 * rng.normal(size=(5, 3)) @ bodies + 1e-7 * rng.normal(size=(5, 1)) * air


def searched(n: int, step: float, further: Made | None, seed: int, size: float = FURTHER) -> SlowNoise | None:
    rng = np.random.default_rng([seed, n])
    time = step * np.arange(n)
    values = warm_up(time, rng) + STATED * white(rng, n)
    if further is not None:
        values = values + size * further(rng, n)
    return slow_noise(time, values, np.full((5, n), STATED))


@pytest.mark.parametrize(("n", "step"), [(24, 250.0), (60, 60.0)])
def test_stated_noise_is_no_finding(n: int, step: float) -> None:
    found = [searched(n, step, None, seed) is not None for seed in range(SEEDS)]
    # 4 % by design; more than 7 of 60 with a probability of 0.3 %
    assert sum(found) <= 7


@pytest.mark.parametrize(
    ("further", "n", "step", "least"),
    [
        (white, 24, 250.0, 0.95),
        (pink, 24, 250.0, 0.95),
        (autoregressive(0.8), 24, 250.0, 0.8),
        (autoregressive(0.8), 400, 20.0, 0.95),
        (autoregressive(0.99), 1600, 0.5, 0.95),
    ],
)
def test_further_noise_is_found_with_its_size(further: Made, n: int, step: float, least: float) -> None:
    found = [searched(n, step, further, seed) for seed in range(20)]
    sizes = [each.sd for each in found if each is not None]
    assert len(sizes) >= least * len(found)
    assert 0.5 * FURTHER < np.median(sizes) < 2 * FURTHER


def test_one_noisy_channel_is_the_one_with_further_noise() -> None:
    rng = np.random.default_rng(1)
    time = 20.0 * np.arange(400)
    values = warm_up(time, rng) + STATED * white(rng, 400)
    values[2] += 4 * FURTHER * autoregressive(0.8)(rng, 400)[0]
    found = slow_noise(time, values, np.full((5, 400), STATED))
    assert found is not None
    assert int(np.argmax(found.sd)) == 2
    assert 0.5 < found.sd[2] / (4 * FURTHER) < 2.0
    assert found.duration > 20.0


def test_few_values_and_steps_at_stated_times_are_no_finding() -> None:
    rng = np.random.default_rng(2)
    time = 20.0 * np.arange(200)
    values = warm_up(time, rng) + STATED * white(rng, 200) + 1e-6 * (time >= 3000)
    sd = np.full(values.shape, STATED)
    assert slow_noise(time, values, sd) is not None
    assert slow_noise(time, values, sd, [3000.0]) is None
    few = FEWEST - 1
    assert slow_noise(time[:few], 1e-6 * white(rng, few), sd[:, :few]) is None
    assert slow_noise(time[:0], values[:, :0], sd[:, :0]) is None
    values[3] = np.nan
    assert slow_noise(time, values, sd) is None
