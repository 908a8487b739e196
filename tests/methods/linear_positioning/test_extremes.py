"""Bias and uncertainty of figures that are extreme values, against a known truth."""

from functools import cache

import numpy as np
import pytest
from scipy import stats

from errormotion.measurement.identification import solve
from errormotion.methods.linear_positioning import LinearPositioningSettings
from errormotion.methods.linear_positioning.identification import extremes, standard
from errormotion.methods.linear_positioning.identification.identify import evaluate, observe, statistics_of
from errormotion.methods.linear_positioning.identification.scatter import scatter
from errormotion.methods.linear_positioning.identification.standard import FIGURES, Statistics
from errormotion.methods.linear_positioning.simulation import Behaviour, raw_and_truth

SEEDS = 60
SETTINGS = LinearPositioningSettings(trials=300)
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
        (of,), _ = statistics_of(seen, solve(observe(raw, seen, SETTINGS)), SETTINGS, ("freedom", "position"), {})
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


@pytest.mark.parametrize("runs", [5, 10])
def test_the_repeatability_of_an_axis_with_one_bad_target_is_within_its_uncertainty(runs):
    """One of eleven targets scatters seven times as much as the others, which determines R."""
    z, seeds, held = np.linspace(-1.0, 1.0, 11), 60, 0
    sd = 1e-6 * np.where(np.arange(11) == 4, 3.0, 0.4)
    for seed in range(seeds):
        draw = np.random.default_rng(seed).normal
        x = 3e-6 * z**2 + 0.3e-6 * draw(size=(1, runs, 1)) + sd * draw(size=(2, runs, 11))
        found = scatter(x, z, kind="auto", drift=None, stated=None)
        of = extremes.figures(x, z, found, np.zeros((0, 11)), 0.0, straight=False, trials=300)
        true = np.tile(np.hypot(sd, 0.3e-6), (2, 1))
        k = FIGURES.index("R_forward")
        R = standard.figures(Statistics(np.tile(3e-6 * z**2, (2, 1)), true))[k]
        held += abs(of.value[k] - of.bias[k] - R) <= 2.0 * of.u[k]
    assert held >= stats.binom.ppf(1e-3, seeds, 0.9)  # 53 and 75 % if the largest is drawn as one of the others
