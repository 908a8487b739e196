"""Figures of a crossbeam campaign: the six errors over time and position, and curves along either."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import matplotlib
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from errormotion.arrays import Array
from errormotion.methods.crossbeam_scan.report.view import Campaign, after, millimetres
from errormotion.report import canvas
from errormotion.report.budget import FREEDOMS
from errormotion.report.document import Figure
from errormotion.report.drawings import maps as crossbeam_maps
from errormotion.report.fields import field, unit_of
from errormotion.report.text import finite, fixed

_MAX_CURVES = 10  # in one panel
_ROW, _GAP, _FOOT, _HEAD = 1.42, 0.42, 0.46, 0.26  # inch: panels, room between them, below and above
_LEFT, _BETWEEN, _END = 0.52, 0.45, 0.08  # inch
_BAR, _LEGEND = 0.48, 0.3  # inch: colour bar with its numbers, a line of the legend

Paint = Callable[[Axes, int], None]


def surfaces(seen: Campaign, key: str) -> Figure | None:
    """Return the six errors as filled contours over time and position; None for one warm cycle or one artefact."""
    if min(seen.warm.size, seen.position.size) < 2 or not seen.known[seen.warm].any():
        return None
    time, order = seen.time / 60, np.argsort(seen.position, kind="stable")
    place = 1e3 * seen.position[order]
    if (np.diff(time) <= 0).any() or (np.diff(place) <= 0).any():
        return None

    def paint(axes: Axes, i: int) -> None:
        unit, size = unit_of(i)
        values = seen.values[:, order, i].T / size
        scale = crossbeam_maps.scale_of(values, 10)
        crossbeam_maps.contours(axes, time, place, values, scale)
        _dots(axes, time, place, np.isfinite(values))
        axes.grid(visible=False)
        x, y, width, height = axes.get_position().bounds
        wide = axes.figure.get_figwidth()  # type: ignore[union-attr]
        bar = (x + width + 0.06 / wide, y, 0.08 / wide, height)
        crossbeam_maps.colour_bar(axes, scale, bar, unit)

    svg = _six(seen, paint, key, ("time / min", "y / mm"), [], right=_BAR)
    holes = int((~seen.known).sum())
    missing = " Crosses: no value; the area up to the neighbouring scans is blank." if holes else ""
    caption = (
        "The six thermal errors over warm-up time and position of the axis. Dots: the scans; between them the values "
        f"are interpolated linearly. White and the dark line: zero.{missing}"
    )
    return Figure(svg, caption, f"Filled contours of the six errors over time and position: {spans(seen)}.")


def by_position(seen: Campaign, key: str) -> Figure | None:
    """Return the six errors along the axis, one curve a warm-up time; None for one artefact or none."""
    if seen.position.size < 2:
        return None
    cycles = [k for k in seen.warm if seen.known[k].any()]
    picks = _picked(cycles)
    if not picks:
        return None
    colours = _ordered(len(picks))
    order = np.argsort(seen.position, kind="stable")
    place = 1e3 * seen.position[order]
    smooth = _smooth(seen, "smooth_position", "place", "time")

    def paint(axes: Axes, i: int) -> None:
        size = unit_of(i)[1]
        for colour, k in zip(colours, picks, strict=True):
            values, expanded = seen.values[k, order, i] / size, 2 * seen.sigma[k, order, i] / size
            if smooth is not None:
                along, curve, band = smooth
                canvas.curve(axes, 1e3 * along, curve[k, :, i] / size, 2 * band[k, :, i] / size, colour=colour)
            _points(axes, place, values, expanded, colour, joined=smooth is None)

    labels = [after(seen.time[k]) for k in picks]
    svg = _six(seen, paint, key, ("y / mm", ""), list(zip(labels, colours, strict=True)))
    return Figure(
        svg,
        f"The six thermal errors along the axis, by warm-up time. {_how(smooth is not None)}{_some(picks, cycles)}",
        f"Curves of the six errors over position at {len(picks)} warm-up times: {spans(seen)}.",
    )


def by_time(seen: Campaign, key: str) -> Figure | None:
    """Return the six errors over time, one curve an artefact; None for one warm cycle or none."""
    if seen.warm.size < 2:
        return None
    artefacts = [k for k in np.argsort(seen.position, kind="stable") if seen.known[seen.warm, k].any()]
    picks = _picked(artefacts)
    if not picks:
        return None
    colours = _ordered(len(picks))
    smooth = _smooth(seen, "smooth_time", "moment", "position")

    def paint(axes: Axes, i: int) -> None:
        size = unit_of(i)[1]
        for colour, k in zip(colours, picks, strict=True):
            values, expanded = seen.values[:, k, i] / size, 2 * seen.sigma[:, k, i] / size
            if smooth is not None:
                along, curve, band = smooth
                canvas.curve(axes, along / 60, curve[k, :, i] / size, 2 * band[k, :, i] / size, colour=colour)
            _points(axes, seen.scan_time[:, k] / 60, values, expanded, colour, joined=smooth is None)

    labels = [f"{millimetres(seen.position[k])} mm" for k in picks]
    svg = _six(seen, paint, key, ("time / min", ""), list(zip(labels, colours, strict=True)))
    return Figure(
        svg,
        f"The six thermal errors over time, by position y. {_how(smooth is not None)}{_some(picks, artefacts)}",
        f"Curves of the six errors over time at {len(picks)} positions: {spans(seen)}.",
    )


def spans(seen: Campaign) -> str:
    """Return the lowest and the highest value of each freedom as text."""
    words = []
    for i, freedom in enumerate(FREEDOMS):
        unit, size = unit_of(i)
        values = seen.values[..., i] / size
        low, high = finite(np.min, values), finite(np.max, values)
        known = f"{fixed(low, 1)} to {fixed(high, 1)} {unit}" if np.isfinite(low) else "not determined"
        words.append(f"{seen.names[freedom]} {known}")
    return "; ".join(words)


def _how(smooth: bool) -> str:
    if smooth:
        return "Points and curves: registrations and smoothed errors; bars and bands: expanded uncertainty (k = 2)."
    return "Points: each registration; bars and bands: expanded uncertainty, k = 2."


def _some(picks: Sequence[int], all_of_them: Sequence[int]) -> str:
    return "" if len(picks) == len(all_of_them) else f" {len(picks)} of {len(all_of_them)} curves are shown."


def _picked(indices: Sequence[int]) -> list[int]:
    """Return at most `_MAX_CURVES` of the indices, including the first and the last."""
    if not len(indices):
        return []
    return [int(indices[k]) for k in np.unique(np.linspace(0, len(indices) - 1, _MAX_CURVES).round().astype(int))]


def _ordered(n: int) -> list[str]:
    """Return n colours from light to dark that indicate an order and are distinguishable in grey."""
    scale = matplotlib.colormaps["viridis_r"]
    return [matplotlib.colors.to_hex(scale(place)) for place in np.linspace(0.22 if n > 1 else 1.0, 1.0, n)]


def _smooth(seen: Campaign, name: str, along: str, each: str) -> tuple[Array, Array, Array] | None:
    """Return (abscissa, curves (each, along, 6), standard uncertainties); None where the dataset has none."""
    errors = seen.errors
    if name not in errors or set(errors[name].dims) != {each, along, "dof"} or along not in errors.coords:
        return None
    curve = field(errors, name, each, along, "dof")
    if not np.isfinite(curve).any():
        return None
    band = field(errors, f"{name}_u", each, along, "dof") if f"{name}_u" in errors else np.full_like(curve, np.nan)
    return np.asarray(errors[along].values, float), curve, band


def _points(axes: Axes, x: Array, values: Array, expanded: Array, colour: str, *, joined: bool) -> None:
    if joined:
        canvas.curve(axes, x, values, expanded, colour=colour, width=0.9)
    bars = np.where(np.isfinite(expanded), expanded, 0.0)
    known = np.isfinite(values)
    if known.any():
        axes.errorbar(
            x[known],
            values[known],
            bars[known],
            fmt="o",
            markersize=2.1,
            color=colour,
            elinewidth=0.7,
            markeredgewidth=0,
        )


def _dots(axes: Axes, x: Array, y: Array, known: np.ndarray) -> None:
    """Mark points with and without a value; ``known`` (y, x)."""
    across, up = np.meshgrid(x, y)
    look: dict[str, Any] = {"linestyle": "", "clip_on": False, "zorder": 5}
    axes.plot(across[known], up[known], marker="o", markersize=1.5, color="#333333", markeredgewidth=0, **look)
    axes.plot(across[~known], up[~known], marker="x", markersize=4, color="#222222", markeredgewidth=0.9, **look)


def _six(
    seen: Campaign,
    paint: Paint,
    key: str,
    labels: tuple[str, str],
    legend: Sequence[tuple[str, str]],
    *,
    right: float = 0.0,
) -> Markup:
    """Return six panels, displacements above rotations; those that are not observed are labelled."""
    foot = _FOOT + (_LEGEND + 0.17 * ((len(legend) - 1) // 10) if legend else 0.0)
    high = _HEAD + 2 * _ROW + _GAP + foot
    panel = (canvas.WIDTH - _LEFT - 2 * _BETWEEN - _END - 3 * right) / 3

    def draw(figure: Canvas) -> None:
        for i, freedom in enumerate(FREEDOMS):
            left = _LEFT + (i % 3) * (panel + _BETWEEN + right)
            bottom = foot + (1 - i // 3) * (_ROW + _GAP)
            axes = figure.add_axes((left / canvas.WIDTH, bottom / high, panel / canvas.WIDTH, _ROW / high))
            name = seen.names[freedom]
            axes.set_title(name if labels[1] else f"{name} / {unit_of(i)[0]}")
            if i % 3 == 0 and labels[1]:
                axes.set_ylabel(labels[1])
                axes.yaxis.set_label_coords(-(_LEFT - 0.09) / panel, 0.5)
            if i >= 3:
                axes.set_xlabel(labels[0])
            if not np.isfinite(seen.values[..., i]).any():
                axes.text(0.5, 0.5, "not determined", transform=axes.transAxes, ha="center", va="center")
                axes.set_xticks([])
                axes.set_yticks([])
                continue
            if labels[0].startswith("time"):
                axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 1.5, 2, 3, 6, 10]))
            else:
                axes.xaxis.set_major_locator(MaxNLocator(5))
            if not labels[1]:
                axes.axhline(0, color="#888888", linewidth=0.6)
                axes.margins(x=0.03, y=0.08)
            paint(axes, i)
        if legend:
            handles = [Line2D([], [], color=colour, marker="o", markersize=2.5, linewidth=1.4) for _, colour in legend]
            figure.legend(
                handles,
                [name for name, _ in legend],
                loc="lower center",
                ncols=min(10, len(legend)),
                handlelength=1.1,
                handletextpad=0.4,
                columnspacing=1.0,
                borderaxespad=0.1,
            )

    return canvas.draw(draw, key, high)
