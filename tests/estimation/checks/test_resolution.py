"""Steps of the scale of rounded readings, and the uncertainty by rounding against its simulation."""

import numpy as np
import pytest

from errormotion.estimation.checks.resolution import common, noise_before, step_of


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.2, 0.3])
def test_what_rounded_repeats_have_in_common_and_their_scatter(noise: float) -> None:
    rng = np.random.default_rng(1)
    value = rng.uniform(-50, 50, 4000)
    y = np.rint(value[:, None] + noise * rng.standard_normal((4000, 200)))
    variance = np.mean(y.var(axis=1, ddof=1))
    b = np.sqrt(np.mean(np.square(y.mean(axis=1) - value)) - variance / 200)
    assert float(common(1.0, noise)) == pytest.approx(b, rel=0.03)
    assert noise_before(1.0, float(np.sqrt(variance))) == pytest.approx(noise, abs=0.01)


def test_without_noise_it_is_the_rectangular_distribution_and_with_much_noise_nothing() -> None:
    assert float(common(2.0, 0.0)) == pytest.approx(2 / np.sqrt(12), rel=1e-9)
    assert float(common(1.0, 1.0)) < 1e-8
    assert float(common(0.0, 1.0)) == 0.0


def test_unrounded_readings_have_no_step() -> None:
    rng = np.random.default_rng(2)
    found = [step_of(rng.normal(1e-3, 1e-6, rng.integers(2, 40))) for _ in range(1000)]
    assert not any(found)


@pytest.mark.parametrize("step", [1e-9, 0.5e-6, 1e-6 * (1 + 3e-7), 1e-4])
@pytest.mark.parametrize("spread", [0.3, 3.0, 300.0])
def test_the_step_is_found_whatever_the_noise(step: float, spread: float) -> None:
    rng = np.random.default_rng(3)
    for n in (20, 200):
        y = np.rint(2e3 + spread * rng.standard_normal(n)) * step
        y[3] = np.nan
        assert step_of(y) == pytest.approx(step, rel=1e-6)
    assert step_of(y.astype(np.float32)) == pytest.approx(step, rel=1e-3)


def test_few_different_readings_prove_no_step() -> None:
    assert step_of([1.0, 2.0, 3.0]) == 0.0
    assert step_of([1.0, np.nan]) == 0.0
    assert step_of([2.0, 2.0, 2.0, 2.0]) == 0.0
    assert step_of([1.0, 2.0, 2.0, 1.0, 1.0]) == 1.0
