"""Graphs of a test as in the standard: runs, means and bands of two standard deviations, and the figures."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from errormotion.methods.linear_positioning.report.view import View
from errormotion.report import canvas
from errormotion.report.document import Figure
from errormotion.report.text import fixed

APPROACHES = (("forward", canvas.BLUE), ("backward", canvas.VERMILLION))
DARK = "#555555"
HEIGHTS = (2.6, 1.1)
"""Heights of the panels of deviations and of the reversal error, inch."""


def over_position(view: View, key: str, limits: Mapping[str, tuple[float, float]]) -> Figure:
    """Return the graph of runs, means and mean ± 2 s of both approaches, with the reversal error below."""
    P = view.position

    def paint(figure: Canvas) -> None:
        upper, lower = canvas.stack(figure, HEIGHTS, right=0.75)
        ends = []
        for k, (name, colour) in enumerate(APPROACHES):
            if not np.isfinite(view.mean[k]).any():
                continue
            upper.fill_between(
                P, view.mean[k] - 2 * view.s[k], view.mean[k] + 2 * view.s[k], color=colour, alpha=0.15, linewidth=0
            )
            for j, run in enumerate(view.readings[k]):
                upper.plot(P, run, color=colour, linewidth=0.45, alpha=0.55, label=f"run {j + 1}, {name}")
            upper.plot(P, view.mean[k], color=colour, linewidth=1.4, marker="o", markersize=3.2, label=f"mean {name}")
            ends.append((float(view.mean[k][-1]), name, colour))
        middle = view.mean.mean(axis=0)
        if np.isfinite(middle).any():
            upper.plot(P, middle, color=canvas.BLACK, linewidth=0.9, linestyle=(0, (5, 2)), label="mean of both")
        _levels(upper, view)
        if view.name[:2] in limits:
            lower_limit, upper_limit = (each / view.size for each in limits[view.name[:2]])
            canvas.limit_lines(upper, [(view.name, lower_limit, upper_limit)])
        canvas.label_ends(upper, ends)
        upper.set_ylabel(f"{view.name} / {view.unit}", labelpad=2)
        reversal = view.mean[0] - view.mean[1]
        lower.axhline(0, color=DARK, linewidth=0.6)
        lower.vlines(P, 0, reversal, color=canvas.GREEN, linewidth=1.2)
        lower.plot(P, reversal, color=canvas.GREEN, marker="s", markersize=3.2, linewidth=0, label="B")
        lower.set_ylabel(f"B / {view.unit}", labelpad=2)
        lower.set_xlabel("target position / mm")

    caption = (
        f"{view.name}: deviations over the target position, thin: each run; bold: mean unidirectional deviations; "
        "band: mean ± 2 s; dashed: mean bidirectional deviation; dotted: largest mean + 2 s and smallest mean − 2 s, "
        "whose distance is A. Below: reversal error at each target."
    )
    if view.straight:
        caption += " The least-squares line of the mean bidirectional deviations is removed."
    alt = ", ".join(
        f"{name} {fixed(view.value[name], 2)} {view.unit}"
        for name in ("A", "E", "R", "B")
        if math.isfinite(view.value[name])
    )
    return Figure(canvas.draw(paint, key, canvas.stack_height(HEIGHTS)), caption, f"{view.name}: {alt}.")


def _levels(axes: Axes, view: View) -> None:
    """Draw the limits of A."""
    known = np.isfinite(view.s)
    if known.any():
        for level in (np.nanmax(view.mean + 2 * view.s), np.nanmin(view.mean - 2 * view.s)):
            axes.axhline(level, color=DARK, linewidth=0.7, linestyle=(0, (1.5, 1.5)))


def against_limits(view: View, limits: dict[str, float], key: str) -> Figure:
    """Return the bar chart of the figures that have a limit, in per cent of it, with expanded uncertainties."""
    names = list(limits)

    def paint(figure: Canvas) -> None:
        (axes,) = canvas.stack(figure, [0.32 * len(names) + 0.1], right=0.9)
        for row, name in enumerate(names):
            share, U = 100 * view.value[name] / limits[name], 100 * view.expanded(name) / limits[name]
            colour = canvas.GREEN if share + U <= 100 else canvas.VERMILLION if share - U > 100 else canvas.ORANGE
            axes.barh(row, share, height=0.55, color=colour, alpha=0.75)
            axes.errorbar(share, row, xerr=U, color=canvas.BLACK, capsize=3, linewidth=1)
        axes.axvline(100, color=canvas.BLACK, linewidth=1.2)
        axes.set_yticks(range(len(names)), names)
        axes.set_ylim(len(names) - 0.5, -0.5)
        axes.set_xlim(left=0)
        axes.grid(visible=False, axis="y")
        axes.set_xlabel("share of the limit / %")

    shown = ", ".join(f"{name} {fixed(100 * view.value[name] / limits[name], 0)} %" for name in names)
    caption = (
        "Figures as a share of their limits, with U. Green: within the limit; red: above it; ochre: the limit is "
        "within the uncertainty (ISO 14253-1)."
    )
    return Figure(canvas.draw(paint, key, 0.32 * len(names) + 0.1 + canvas.TOP + canvas.BOTTOM), caption, shown + ".")


def limits_of(errors: xr.Dataset, names: dict[str, str]) -> dict[str, float]:
    """Return the limits that the attributes of a result state, by figure, µm."""
    return {name: float(errors.attrs[key]) * 1e6 for name, key in names.items() if key in errors.attrs}
