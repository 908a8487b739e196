"""The figures of ISO 230-2 against a manual calculation, and against a second implementation in plain Python."""

import statistics

import numpy as np
import pytest

from errormotion.methods.linear_positioning.identification import standard
from errormotion.methods.linear_positioning.identification.standard import FIGURES

# Three targets, three runs, um. Means forward 1, 4, 7 and backward 0, 2, 8; standard deviations forward 1, 2, 1 and
# backward 1, 1, 2.
FORWARD = [[0.0, 2.0, 6.0], [1.0, 4.0, 7.0], [2.0, 6.0, 8.0]]
BACKWARD = [[-1.0, 1.0, 6.0], [0.0, 2.0, 8.0], [1.0, 3.0, 10.0]]
BY_HAND = {
    "A_forward": 10.0,  # max(3, 8, 9) - min(-1, 0, 5)
    "A_backward": 14.0,  # max(2, 4, 12) - min(-2, 0, 4)
    "A": 14.0,  # 12 - (-2)
    "E_forward": 6.0,
    "E_backward": 8.0,
    "E": 8.0,  # 8 - 0
    "R_forward": 8.0,  # 4 * 2
    "R_backward": 8.0,
    "R": 8.0,  # max(2+2+1, 4+2+2, 2+4+1; 4, 8, 8)
    "M": 7.0,  # means 0.5, 3, 7.5
    "B": 2.0,  # 1, 2, -1
    "B_mean": 2.0 / 3.0,
}


def of(readings):
    return dict(zip(FIGURES, standard.figures(standard.statistics(np.array(readings, float))), strict=True))


def second_implementation(readings):
    """Return the figures of readings (approach, run, target), computed one target after the other."""
    targets = range(len(readings[0][0]))
    columns = [[[run[i] for run in approach] for i in targets] for approach in readings]
    mean = [[statistics.fmean(c) for c in approach] for approach in columns]
    s = [[statistics.stdev(c) for c in approach] for approach in columns]
    up = [[m + 2 * d for m, d in zip(*row, strict=True)] for row in zip(mean, s, strict=True)]
    low = [[m - 2 * d for m, d in zip(*row, strict=True)] for row in zip(mean, s, strict=True)]
    B = [mean[0][i] - mean[1][i] for i in targets]
    R = [max(2 * s[0][i] + 2 * s[1][i] + abs(B[i]), 4 * s[0][i], 4 * s[1][i]) for i in targets]
    middle = [(mean[0][i] + mean[1][i]) / 2 for i in targets]
    return {
        "A": max(*up[0], *up[1]) - min(*low[0], *low[1]),
        "A_forward": max(up[0]) - min(low[0]),
        "A_backward": max(up[1]) - min(low[1]),
        "E": max(*mean[0], *mean[1]) - min(*mean[0], *mean[1]),
        "E_forward": max(mean[0]) - min(mean[0]),
        "E_backward": max(mean[1]) - min(mean[1]),
        "R": max(R),
        "R_forward": 4 * max(s[0]),
        "R_backward": 4 * max(s[1]),
        "M": max(middle) - min(middle),
        "B": max(abs(b) for b in B),
        "B_mean": statistics.fmean(B),
    }


def test_figures_agree_with_a_manual_calculation():
    assert of([FORWARD, BACKWARD]) == pytest.approx(BY_HAND, abs=1e-12)


@pytest.mark.parametrize("seed", range(20))
def test_figures_agree_with_a_second_implementation(seed):
    generator = np.random.default_rng(seed)
    runs, targets = generator.integers(2, 8), generator.integers(2, 30)
    curve, reversal = 5.0 * generator.normal(size=targets), generator.normal(size=(2, 1, targets))
    readings = curve + reversal + generator.normal(size=(2, runs, targets))
    assert of(readings) == pytest.approx(second_implementation(readings.tolist()), rel=1e-12)


def test_figures_of_both_directions_are_unknown_where_one_was_not_measured():
    found = of([FORWARD, np.full_like(FORWARD, np.nan)])
    known = {name for name, value in found.items() if np.isfinite(value)}
    assert known == {"A_forward", "E_forward", "R_forward"}


def test_mean_and_deviation_are_those_of_the_readings_that_are_not_missing():
    readings = np.array([FORWARD, BACKWARD])
    readings[0, 2, 1] = np.nan  # the target has 2 and 4 left
    found = standard.statistics(readings)
    assert found.mean[0, 1] == pytest.approx(3.0)
    assert found.s[0, 1] == pytest.approx(np.sqrt(2.0))


def test_the_method_states_the_figures_of_the_standard(raw_of, identify):
    readings = 1e-6 * np.array([FORWARD, BACKWARD])
    raw = raw_of(readings.transpose(1, 0, 2)[None], [0.0, 0.1, 0.2])
    settings = {"uncertainty": {"length": 0.0, "alignment": 0.0, "drift": 1e-6}}
    errors = identify(raw, **settings)
    assert {name: 1e6 * float(errors[name]) for name in FIGURES} == pytest.approx(BY_HAND)
    assert errors["A"].attrs["units"] == "m"
