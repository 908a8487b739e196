"""Readings that do not change: found where it is no accident, and not where the scale is coarse."""

from __future__ import annotations

import numpy as np
import pytest

from errormotion.estimation.checks.frozen import frozen


def noisy(series: int = 5, n: int = 60, step: float = 0.0, seed: int = 0) -> np.ndarray:
    y = np.random.default_rng(seed).standard_normal((series, n))
    return np.round(y / step) * step if step else y


@pytest.mark.parametrize("step", [0.0, 0.1, 0.5])
def test_a_channel_that_hangs_is_found_with_its_readings(step: float) -> None:
    y = noisy(step=step)
    y[3, 20:45] = y[3, 20]
    found = frozen(y)
    assert found is not None
    assert (found.series, found.value, found.every) == (3, y[3, 20], False)
    assert found.first <= 20
    assert found.count >= 25


def test_an_instrument_all_of_whose_channels_hang_is_found() -> None:
    y = noisy()
    y[:, 30:] = y[:, 30:31]
    found = frozen(y)
    assert found is not None
    assert (found.first, found.count) == (30, 30)


def test_readings_that_are_all_equal_are_found() -> None:
    found = frozen(np.full((2, 8), 3.5))
    assert found is not None
    assert (found.every, found.count, found.value) == (True, 16, 3.5)


@pytest.mark.parametrize("step", [0.0, 0.1, 0.5, 1.0, 3.0])
def test_scattering_readings_are_never_found(step: float) -> None:
    assert not any(frozen(noisy(step=step, seed=seed)) for seed in range(100))


def test_rest_on_a_coarse_scale_is_no_fault() -> None:
    # noise 0.05 of a step: equal while nothing moves, then a motion of many steps
    t = np.arange(200)
    y = np.round(0.3 + 0.05 * noisy(1, 200) + np.where(t < 100, 0.0, 0.37 * (t - 100)))
    assert len(np.unique(y[0, :100])) == 1
    assert frozen(y) is None


def test_missing_readings_are_no_equal_ones() -> None:
    y = noisy()
    y[2, 10:50] = np.nan
    assert frozen(y) is None


def test_a_vector_must_have_all_numbers_equal() -> None:
    y = np.stack([noisy(4, 30), np.ones((4, 30))], axis=2)  # one number is commanded
    assert frozen(y) is None
    y[1, 10:20] = y[1, 10]
    found = frozen(y)
    assert found is not None
    assert (found.series, found.count) == (1, 10)
    assert np.isnan(found.value)
