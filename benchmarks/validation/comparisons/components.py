"""Repeats: coverage of the intervals of repeatability, between groups, and of reproducibility."""

from __future__ import annotations

import numpy as np

from errormotion.compare.repeats import KINDS, interval_coverage
from validation.comparisons.pool import Pool

TRIALS = 20
"""Simulated studies for each seed."""
CASES = (
    (3, 3, 1.0, 1, 0.0),
    (3, 3, 0.3, 1, 0.0),
    (3, 3, 3.0, 1, 0.0),
    (5, 10, 1.0, 1, 0.0),
    (3, 3, 1.0, 20, 0.95),
    (3, 3, 1.0, 20, 0.3),
    (5, 10, 1.0, 20, 0.3),
)
"""Groups, repeats in each, standard deviation between groups over that within, points, share of common variance."""


def one(task: tuple[int, int, float, int, float, int]) -> dict[str, float]:
    """Return the coverage of one case."""
    groups, size, ratio, points, shared, trials = task
    return interval_coverage(groups, size, trials, 7, ratio=ratio, points=points, shared=shared)


def section(seeds: int, pool: Pool) -> list[str]:
    """Return the lines of the section."""
    trials = TRIALS * seeds
    found = pool.mapped(one, [(*case, trials) for case in CASES])
    rows = []
    for (groups, size, ratio, points, shared), each in zip(CASES, found, strict=True):
        held = " | ".join(f"{each[kind]:.1%}" for kind in KINDS)
        rows.append(f"| {groups} x {size} | {ratio:g} | {points} | {shared:.0%} | {held} |")
    return [
        f"{trials} simulated studies in each row: groups (such as operators) of repeats, with the standard deviation "
        "between groups over that within (`ratio`), over a number of points whose variance is common to all points "
        "of a repeat to some extent. Coverage of 95 % intervals (standard deviation "
        f"{np.sqrt(0.05 * 0.95 / trials):.1%}). The effective degrees of freedom are estimated, and intentionally too "
        "small for independent points: the coverage of the intervals is then larger.",
        "",
        f"| groups x repeats | ratio | points | common | {' | '.join(KINDS)} |",
        "|---|---|---|---|---|---|---|",
        *rows,
    ]
