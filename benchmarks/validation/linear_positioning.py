"""Linear positioning: coverage of the errors over the position, their bound, and bias and coverage of the figures."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from errormotion.methods.linear_positioning import LinearPositioning, LinearPositioningSettings
from errormotion.methods.linear_positioning.identification import standard
from errormotion.methods.linear_positioning.identification.standard import FIGURES, Statistics
from errormotion.methods.linear_positioning.simulation import Behaviour, raw_and_truth

TITLE = "Linear positioning"
SEEDS = 1000
Z95 = 1.959964
SETTINGS = LinearPositioningSettings(trials=1000)
BEHAVIOURS = {
    "usual: scatter 0.3 um, drift 0.4 um, reversal 1.5 um": Behaviour(),
    "drifting: scatter 0.2 um, drift 1 um and 1 um in slope": Behaviour(0.2e-6, 1e-6, 1e-6, 0.5e-6),
    "no drift: scatter 0.5 um": Behaviour(0.5e-6, 0.0, 0.0, 0.0),
    "scatter 2 um alone: no drift, no reversal": Behaviour(2e-6, 0.0, 0.0, 0.0, 0.0),
}


def section(seeds: int) -> Iterator[str]:
    """Yield the lines of the section."""
    yield f"11 targets over {SETTINGS.travel[1] - SETTINGS.travel[0]:g} m, {SETTINGS.runs} runs in both directions."
    for name, behaviour in BEHAVIOURS.items():
        yield from ("", f"### Axis {name}", "", *table(seeds, behaviour))


def table(seeds: int, behaviour: Behaviour) -> list[str]:
    """Coverage of the errors, spread against the bound of the means, and figure by figure excess and coverage."""
    held, ratio, figures = [], [], []
    method = LinearPositioning()
    for seed in range(seeds):
        raw, truth = raw_and_truth(SETTINGS, seed, behaviour)
        errors = method.identify(raw, SETTINGS)
        u = np.sqrt(errors["covariance"].values[:, 0, 0])
        off = (errors["EX"] - truth["EX"]).values
        held.append(np.abs(off) <= Z95 * u)
        ratio.append(off**2 / bound(behaviour, errors["x"].values))
        value, bias, u = (np.array([float(errors[name + part]) for name in FIGURES]) for part in ("", "_bias", "_u"))
        figures.append((value - true_figures(truth, behaviour), bias, u))
    error, bias, u = np.array(figures).transpose(1, 0, 2)
    coverage = 100.0 * np.mean(held)
    spread = np.sqrt(np.mean(ratio))
    lines = [
        f"Error over the position: coverage of the 95 % intervals {coverage:.1f}%; spread over the bound of a known "
        f"model {spread:.3f}. Figures, compared with those of an infinite number of runs:",
        "",
        "| figure | mean excess | mean excess stated | left, in u | within 2 u | within U as printed |",
        "|---|---|---|---|---|---|",
    ]
    for k, name in enumerate(FIGURES):
        left = error[:, k] - bias[:, k]
        within = 100.0 * np.mean(np.abs(left) <= 2.0 * u[:, k])
        printed = 100.0 * np.mean(np.abs(error[:, k]) <= 2.0 * u[:, k] + np.abs(bias[:, k]))
        lines.append(
            f"| {name} | {1e6 * error[:, k].mean():.2f} um | {1e6 * bias[:, k].mean():.2f} um | "
            f"{np.mean(left / u[:, k]):+.2f} | {within:.1f}% | {printed:.1f}% |"
        )
    return lines


def bound(behaviour: Behaviour, P: np.ndarray) -> np.ndarray:
    """Return the Cramer-Rao bound of a mean bidirectional deviation, including instrument and expansion, m^2."""
    z = (P - P.mean()) / (np.ptp(P) / 2.0)
    runs, lever = SETTINGS.runs, P - P[0]
    of_runs = (behaviour.noise**2 / 2.0 + behaviour.offset**2 + (behaviour.slope * z) ** 2) / runs
    budget = SETTINGS.uncertainty
    of_instrument = budget.length_or_assumed**2 + budget.alignment_or_assumed**4
    relative = of_instrument + (0.6e-6 * 2.0) ** 2 + (11.5e-6 * budget.temperature) ** 2
    return of_runs + relative * lever**2


def true_figures(truth, behaviour: Behaviour) -> np.ndarray:
    """Return the figures of an infinite number of runs, m."""
    P, curve = truth["x"].values, truth["EX"].values
    z = (P - P.mean()) / (np.ptp(P) / 2.0)
    variances = behaviour.noise**2 + behaviour.offset**2 + behaviour.opposite**2 + (behaviour.slope * z) ** 2
    mean = np.stack([curve + behaviour.reversal / 2.0, curve - behaviour.reversal / 2.0])
    return standard.figures(Statistics(mean, np.tile(np.sqrt(variances), (2, 1))))
