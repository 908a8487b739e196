"""Diagonals of a volume: coverage of the errors along them, of their figures and of squareness."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from errormotion.methods.linear_positioning import LinearPositioning, LinearPositioningSettings

TITLE = "Diagonals of a volume"
SEEDS = 1000
RUNS = (5, 8, 20)
NAMES = ("PP0", "NP0", "P0P", "N0P", "0PP", "0NP", "PPP")
HALF_REVERSAL = 0.75e-6
"""Of the simulated axis."""


def section(seeds: int) -> Iterator[str]:
    """Yield the lines of the section."""
    yield (
        f"{seeds} virtual machines in each row, each with the diagonals {', '.join(NAMES)}, 5 targets, runs in both "
        "directions. `deviations`, `E`, `squareness`: share of the 95 % intervals that contain the truth of the "
        "virtual machine: the error of the position along the diagonal, the bidirectional error, and the angle of "
        "two axes from each pair of face diagonals. `spread`: standard deviation of the error of squareness in its "
        "standard uncertainty, which includes a factor for few runs, so that the coverage is also correct with few "
        "runs; it is 1 with many. `mean`: of the error of squareness in its standard uncertainty; its own standard "
        "deviation is `spread` divided by the root of their number."
    )
    yield from (
        "",
        "| runs | deviations | E | squareness | spread | mean | u of squareness |",
        "|---|---|---|---|---|---|---|",
    )
    for runs in RUNS:
        yield row(runs, seeds)


def row(runs: int, seeds: int) -> str:
    """Return one row of the table."""
    settings = LinearPositioningSettings.model_validate(
        {"diagonals": {"names": NAMES}, "count": 5, "runs": runs, "trials": 400}
    )
    method = LinearPositioning()
    inside, largest, square, sizes = [], [], [], []
    for seed in range(seeds):
        raw, truth = method.simulate(settings, seed)
        errors = method.identify(raw, settings)
        off = errors["deviation"].values - truth["deviation"].values
        inside.append(np.abs(off) <= 2.0 * np.sqrt(errors["deviation_variance"].values))
        u = np.sqrt(np.diagonal(errors["squareness_covariance"].values))
        square.append((errors["squareness"].values - truth["squareness"].values) / u)
        sizes.append(u)
        both = truth["deviation"].values[:, None] + HALF_REVERSAL * np.array([1.0, -1.0])[:, None]
        figures = {each.name: each for each in method.figures(errors)}
        for name, true in zip(errors["diagonal"].values, np.ptp(both, axis=(1, 2)), strict=True):
            figure = figures[f"E of {name} (ISO 230-6)"]
            largest.append(abs(figure.value - true) <= figure.expanded_uncertainty)
    held = " | ".join(f"{np.mean(each):.1%}" for each in (inside, largest, np.abs(square) <= 2.0))
    spread = np.std(square)
    return f"| {runs} | {held} | {spread:.3f} | {np.mean(square):+.3f} | {np.mean(sizes) * 1e6:.2f} urad |"
