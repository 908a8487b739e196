"""Interpolation: coverage of the intervals at omitted instants."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from validation.comparisons.drawn import NOISE, at, warm_up
from validation.comparisons.pool import Pool

Z95 = 1.959964
STEPS = (60.0, 120.0, 240.0, 600.0)
FACTORS = (0.1, 1.0, 3.0)
START_UP = 1200.0


def one(task: tuple[str, int, float, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return scores (point, 6) at instants between, the instants, and the share of variance that interpolation adds."""
    kind, seed, step, factor = task
    t, E, _ = warm_up(seed, kind)
    rng = np.random.default_rng([seed, int(step), int(10 * factor)])
    ds = replace(at(seed, step, "A", kind), factor=factor).dataset(rng)
    new = t[(t < 7200) & (t % step > 0)]
    new = np.sort(rng.choice(new, min(len(new), 60), replace=False))
    found = ds.em.to_times(new)
    variance = np.diagonal(found["covariance"].values, axis1=1, axis2=2)
    w = (new % step) / step
    noise = np.multiply.outer((1 - w) ** 2 + w**2, (factor * NOISE) ** 2)
    score = (found.em.twist().values - E[np.isin(t, new)]) / np.sqrt(variance)
    return score, new, 1 - noise / variance


def section(seeds: int, pool: Pool) -> list[str]:
    """Return the lines of the section."""
    rows, every = [], []
    for kind in ("gantry", "cframe"):
        for step in STEPS:
            for factor in FACTORS:
                runs = pool.mapped(one, [(kind, seed, step, factor) for seed in range(seeds)])
                score, new, added = (np.concatenate([run[k] for run in runs]) for k in range(3))
                inside = np.abs(score) <= Z95
                early = new < START_UP
                every.append(inside.mean())
                rows.append(
                    f"| {kind} | {step:g} s | {factor * NOISE[0] * 1e6:g} um, {factor * NOISE[3] * 1e6:g} urad | "
                    f"{inside.mean():.1%} | {inside[early].mean():.1%} | {inside[~early].mean():.1%} | "
                    f"{np.sqrt(np.mean(score**2)):.2f} | {added.mean():.0%} |"
                )
    return [
        f"{seeds} warm-ups of each machine, sampled at equal intervals with noise; 60 instants between are estimated. "
        "`rms`: root mean square of deviation over standard uncertainty (1 is right); `added`: mean share of the "
        f"variance that is due to interpolation. Coverage of 95 % intervals, all cases: {np.mean(every):.1%}.",
        "",
        f"| machine | interval | noise | coverage | first {START_UP / 60:g} min | later | rms | added |",
        "|---|---|---|---|---|---|---|---|",
        *rows,
    ]
