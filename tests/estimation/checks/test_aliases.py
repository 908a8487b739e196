"""Waves that sampling makes slow: their frequency in the samples, and what a mean of these contains."""

import numpy as np
import pytest

from errormotion.estimation.checks.aliases import aliases, share_left


@pytest.mark.parametrize(
    ("frequency", "rate", "count"),
    [(50.016, 50.0, 25), (7.3, 50.0, 25), (249.0, 1500.0, 750), (3.0, 1e3, 500), (50.0, 50.0, 10)],
)
def test_the_share_is_that_of_means_of_a_sampled_wave(frequency: float, rate: float, count: int) -> None:
    phase = 2 * np.pi * frequency * np.arange(count) / rate
    # the largest mean over all phases is the length of the complex mean
    assert float(share_left(frequency, rate, count)) == pytest.approx(abs(np.exp(1j * phase).mean()), abs=1e-9)


def test_the_alias_has_the_same_samples_as_the_wave() -> None:
    frequency, rate = 3001 / 60, 50.0
    (first, second) = aliases(frequency, rate, 25)
    assert (first.order, second.order) == (1, 2)
    t = np.arange(3000) / rate
    assert np.cos(2 * np.pi * frequency * t) == pytest.approx(np.cos(2 * np.pi * first.frequency * t), abs=1e-6)
    assert 1 / first.frequency == pytest.approx(60.0)
    assert first.share > 0.99


@pytest.mark.parametrize(("speed", "rate", "length"), [(15000, 20e3, 0.5), (15000, 1500.0, 0.5), (600, 1e3, 0.5)])
def test_whole_turns_leave_nothing(speed: float, rate: float, length: float) -> None:
    assert aliases(speed / 60, rate, round(rate * length)) == []


def test_parts_of_few_turns_and_one_sample_a_turn_leave_something() -> None:
    (half, *_) = aliases(3.0, 1e3, 500)  # one and a half turns
    assert half.share == pytest.approx(1 / (1.5 * np.pi), rel=0.01)
    (once, *_) = aliases(50.0, 50.0, 25)
    assert (once.frequency, once.share) == (0.0, 1.0)
    assert [each.order for each in aliases(25.0, 50.0, 25)] == [2]  # the oval, twice a turn
