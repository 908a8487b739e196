"""The graph of a line as in the standard: runs, means and bands of two standard deviations, and the reversal error."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from errormotion.report import canvas
from errormotion.report.document import Block, Figure, Source
from errormotion.report.elements.quantities import unit_of
from errormotion.report.text import fixed

APPROACHES = (("forward", canvas.BLUE), ("backward", canvas.VERMILLION))
DARK = "#555555"
HEIGHTS = (2.6, 1.1)
"""Heights of the panels of deviations and of the reversal error, inch."""


def over_position(source: Source, key: str) -> list[Block]:
    """Return the graph of runs, means and mean ± 2 s of both approaches, with the reversal error below."""
    line, name = source.errors, source.errors.attrs["line"]
    unit, size = unit_of(line["mean"].attrs["units"])
    place = 1e3 * line["place"].values
    readings, mean, s, reversal, both = (
        line[each].values / size for each in ("reading", "mean", "s", "reversal", "both")
    )

    def paint(figure: Canvas) -> None:
        upper, lower = canvas.stack(figure, HEIGHTS, right=0.75)
        ends = []
        for k, (approach, colour) in enumerate(APPROACHES):
            if not np.isfinite(mean[k]).any():
                continue
            upper.fill_between(place, mean[k] - 2 * s[k], mean[k] + 2 * s[k], color=colour, alpha=0.15, linewidth=0)
            for j, run in enumerate(readings[k]):
                upper.plot(place, run, color=colour, linewidth=0.45, alpha=0.55, label=f"run {j + 1}, {approach}")
            upper.plot(
                place, mean[k], color=colour, linewidth=1.4, marker="o", markersize=3.2, label=f"mean {approach}"
            )
            ends.append((float(mean[k][-1]), approach, colour))
        if np.isfinite(both).any():
            upper.plot(place, both, color=canvas.BLACK, linewidth=0.9, linestyle=(0, (5, 2)), label="mean of both")
        _levels(upper, mean, s)
        if name[:2] in source.limits:
            canvas.limit_lines(upper, [(name, *(each / size for each in source.limits[name[:2]]))])
        canvas.label_ends(upper, ends)
        upper.set_ylabel(f"{name} / {unit}", labelpad=2)
        lower.axhline(0, color=DARK, linewidth=0.6)
        lower.vlines(place, 0, reversal, color=canvas.GREEN, linewidth=1.2)
        lower.plot(place, reversal, color=canvas.GREEN, marker="s", markersize=3.2, linewidth=0, label="B")
        lower.set_ylabel(f"B / {unit}", labelpad=2)
        lower.set_xlabel("target position / mm")

    caption = (
        f"{name}: deviations over the target position, thin: each run; bold: mean unidirectional deviations; "
        "band: mean ± 2 s; dashed: mean bidirectional deviation; dotted: largest mean + 2 s and smallest mean − 2 s, "
        "whose distance is A. Below: reversal error at each target."
    )
    if line.attrs["kind"] == "Straightness":
        caption += " The least-squares line of the mean bidirectional deviations is removed."
    figures = {each: float(line["figure_value"].sel(figure=each)) / size for each in ("A", "E", "R", "B")}
    alt = ", ".join(f"{each} {fixed(value, 2)} {unit}" for each, value in figures.items() if math.isfinite(value))
    return [Figure(canvas.draw(paint, key, canvas.stack_height(HEIGHTS)), caption, f"{name}: {alt}.")]


def _levels(axes: Axes, mean: np.ndarray, s: np.ndarray) -> None:
    """Draw the limits of A."""
    if np.isfinite(s).any():
        for level in (np.nanmax(mean + 2 * s), np.nanmin(mean - 2 * s)):
            axes.axhline(level, color=DARK, linewidth=0.7, linestyle=(0, (1.5, 1.5)))
