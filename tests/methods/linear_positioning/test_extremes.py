"""Bias and uncertainty of figures that are extreme values, against a known truth."""

from functools import cache

import numpy as np
import pytest
from scipy import stats

from errormotion.measurement.identification import solve
from errormotion.methods.linear_positioning import Settings
from errormotion.methods.linear_positioning.identification import standard
from errormotion.methods.linear_positioning.identification.identify import evaluate, figures_of, observe
from errormotion.methods.linear_positioning.identification.standard import FIGURES, Statistics
from errormotion.methods.linear_positioning.simulation import Behaviour, raw_and_truth

SEEDS = 60
SETTINGS = Settings(trials=300)
BEHAVIOURS = {"usual": Behaviour(), "drifting": Behaviour(noise=0.2e-6, offset=1e-6, slope=1e-6, opposite=0.5e-6)}


def true_figures(truth, behaviour):
    """Return the figures of an infinite number of runs."""
    P = truth["x"].values
    z = (P - P.mean()) / (np.ptp(P) / 2.0)
    variances = behaviour.noise**2 + behaviour.offset**2 + behaviour.opposite**2 + (behaviour.slope * z) ** 2
    curve = truth["EX"].values
    mean = np.stack([curve + behaviour.reversal / 2.0, curve - behaviour.reversal / 2.0])
    return standard.figures(Statistics(mean, np.tile(np.sqrt(variances), (2, 1))))


@cache
def compared(name):
    """Return figures less the true ones, their bias and their standard uncertainty, each (seed, figure)."""
    found = []
    for seed in range(SEEDS):
        raw, truth = raw_and_truth(SETTINGS, seed, BEHAVIOURS[name])
        seen = evaluate(raw, SETTINGS)
        (of,) = figures_of(seen, solve(observe(raw, seen, SETTINGS)), SETTINGS.trials)
        found.append((of.value - true_figures(truth, BEHAVIOURS[name]), of.bias, of.u))
    return np.array(found).transpose(1, 0, 2)


@pytest.mark.parametrize("name", BEHAVIOURS)
def test_intervals_contain_the_true_figures(name):
    error, bias, u = compared(name)
    held = (np.abs(error - bias) <= 2.0 * u).sum(axis=0)
    # 95 % of intervals, less what a binomial with one of a thousand may miss, by 12 figures
    fewest = stats.binom.ppf(1e-3 / len(FIGURES), SEEDS, 0.95)
    assert not {name: count for name, count in zip(FIGURES, held, strict=True) if count < fewest}


def test_the_excess_of_extreme_values_is_estimated():
    """Scatter increases the repeatabilities of a typical axis; after the correction, a small part of it remains."""
    error, bias, _ = compared("usual")
    k = FIGURES.index("R_forward")
    assert error[:, k].mean() > 0.4e-6
    assert abs((error - bias)[:, k].mean()) < error[:, k].mean()
