"""A shift in time, estimated from a curve that bends at the start of the warm-up."""

import numpy as np
import pytest

from errormotion.compare.diagnosis.shift import fitted, smooth
from errormotion.estimation.low_rank import whitener

SIZE, NOISE = np.array([10e-6, 5e-6, 20e-6]), 1e-7
LATE = 183.0


def warm_up(t):
    """Return errors (n, 3) of a warm-up that starts at 60 s."""
    after = np.maximum(np.asarray(t) - 60.0, 0.0)[:, None]
    return SIZE * (1 - np.exp(-after / np.array([300.0, 1500.0, 2500.0])))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_shift_is_found_without_bias(sign):
    rng = np.random.default_rng(1)
    dense, grid = np.arange(0.0, 7201.0, 30.0), np.arange(LATE, 7200.0, 240.0)
    late = 0.0 if sign > 0 else LATE  # the curves are those of the first dataset, or of the second one
    score = []
    for _ in range(25):
        curves = smooth(
            dense, warm_up(dense - late) + NOISE * rng.normal(size=(dense.size, 3)), np.full((dense.size, 3), NOISE)
        )
        both = warm_up(grid) - warm_up(grid - LATE) + 2**0.5 * NOISE * rng.normal(size=(grid.size, 3))
        difference = both - both[0]
        own = np.tile(2 * NOISE**2 * np.eye(3), (grid.size, 1, 1))
        own[0] = 0.0
        reference = np.zeros((3, grid.size, 3))
        reference[:, 1:] = 2**0.5 * NOISE * np.eye(3)[:, None]
        found = fitted(curves, sign, grid, difference, whitener(own, reference))
        score.append((found.value - LATE) / found.standard_uncertainty)
    assert abs(np.mean(score)) < 1.0
    assert np.abs(score).max() < 5


def test_no_shift_is_reported_for_constant_errors():
    t = np.arange(0.0, 3600.0, 60.0)
    curves = smooth(t, np.zeros((t.size, 2)), np.full((t.size, 2), NOISE))
    white = whitener(np.tile(NOISE**2 * np.eye(2), (t.size, 1, 1)), np.zeros((0, t.size, 2)))
    assert fitted(curves, 1.0, t, NOISE * np.random.default_rng(2).normal(size=(t.size, 2)), white) is None
