"""Interactive figures for the browser: curves with bands of U (k = 2), as JSON for BokehJS."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from bokeh.embed import json_item
from bokeh.layouts import gridplot
from bokeh.models import ColumnDataSource, HoverTool, Range1d, Whisker
from bokeh.plotting import figure

from errormotion.compare.pairs import COVERAGE_FACTOR
from errormotion.compare.report.picture import abscissa, common, field
from errormotion.dashboard.curves import Curve, CurveSet, thin
from errormotion.report.canvas import COLOURS, DASHES

HEIGHT = 300
"""Height of one panel, pixels."""
MIN_MARGIN = 0.05
"""Smallest margin above and below the values, in um or arcsec, so that rounding errors do not fill the ordinate."""
FEW = 20
"""Largest number of values of a curve that are marked by dots."""
MAX_NAME = 40
"""Longest name at an axis, characters."""
FONT = "system-ui, 'Segoe UI', 'Liberation Sans', Arial, sans-serif"
INK, SOFT, LINE = "#1b252d", "#44525c", "#dfe5e9"


def errors_item(found: CurveSet, freedoms: Sequence[str] = ()) -> dict[str, Any]:
    """Return the figure of a result: one panel for each unit, with the chosen freedoms, by default all.

    Colour and dashes of a freedom do not depend on the choice.
    """
    looks = {each.freedom: k for k, each in enumerate(found.curves)}
    chosen = [each for each in found.curves if not freedoms or each.freedom in freedoms]
    units = list(dict.fromkeys(each.unit for each in chosen))
    panels: list[figure] = []
    for unit in units:
        own = [each for each in chosen if each.unit == unit]
        plot = _panel(found, unit, _ordinate(own), last=unit == units[-1])
        for curve in own:
            _draw(plot, found, curve, looks[curve.freedom])
        _legend(plot)
        panels.append(plot)
    return _stacked(panels)


def comparison_item(ds: xr.Dataset) -> dict[str, Any]:
    """Return the figure of a comparison: one panel for each freedom, with every dataset and its band."""
    names = [plain(str(name)) for name in ds["dataset"].values]
    places, label, joined = abscissa(ds) if common(ds) else (np.zeros(1), "", False)
    texts = () if joined else tuple(f"{each + 1:.0f}" if common(ds) else "" for each in places)
    expanded = COVERAGE_FACTOR * np.sqrt(np.maximum(np.diagonal(ds["covariance"].values, axis1=-2, axis2=-1), 0.0))
    freedoms, panels = [str(name) for name in ds["dof"].values], list[figure]()
    for k, freedom in enumerate(freedoms):
        factor, unit = field(freedom)
        values = factor * ds["value"].values[..., k].reshape(len(names), -1)
        bands = factor * expanded[..., k].reshape(len(names), -1)
        curves = [Curve(freedom, *each) for each in zip(names, [unit] * len(names), values, bands, strict=True)]
        known = [(i, each) for i, each in enumerate(curves) if np.isfinite(each.values).any()]
        if not known:
            continue
        found = CurveSet(label, np.asarray(places, dtype=float), texts, tuple(curves), np.zeros(3), {})
        plot = _panel(
            found, f"{freedom} / {unit}", _ordinate([each for _, each in known]), last=freedom == freedoms[-1]
        )
        for i, curve in known:
            beside = 0.0 if joined else 0.12 * (i - (len(names) - 1) / 2)
            _draw(plot, replace(found, places=found.places + beside), curve, i)
        _legend(plot)
        panels.append(plot)
    return _stacked(panels)


def live_item(units: Mapping[str, str]) -> dict[str, Any]:
    """Return a figure over time without data: one panel for each unit; the browser fills in the data of each name.

    ``units`` states the unit of each quantity by name.
    """
    panels: list[figure] = []
    kinds = list(dict.fromkeys(units.values()))
    for unit in kinds:
        plot = _axes(unit, None, last=unit == kinds[-1], x_axis_type="datetime")
        for number, name in enumerate(name for name, own in units.items() if own == unit):
            colour, dash = _look(number)
            source = ColumnDataSource({"x": [], "y": []}, name=name)
            line = plot.line(
                "x", "y", source=source, color=colour, line_width=1.8, line_dash=list(dash), legend_label=plain(name)
            )
            tips = [("time", "@x{%H:%M:%S}"), (plain(name), f"@y{{0.000}} {unit}")]
            plot.add_tools(HoverTool(renderers=[line], tooltips=tips, formatters={"@x": "datetime"}, mode="mouse"))
        _legend(plot)
        panels.append(plot)
    return _stacked(panels)


def following_item() -> dict[str, Any]:
    """Return a figure of the offsets of a compensation without data; the browser fills in the data of X, Y and Z."""
    panels: list[figure] = []
    looks = (("asked", "from the prediction", 0), ("offset", "offset", 1), ("applied", "in effect", 2))
    for axis in "XYZ":
        plot = _axes(f"{axis} / µm", None, last=axis == "Z", x_axis_type="datetime")
        plot.height = 150 + 35 * (axis == "X") + 40 * (axis == "Z")
        plot.xaxis.visible = axis == "Z"
        columns = ("x", "asked", "low", "high", "offset", "applied")
        source = ColumnDataSource({name: [] for name in columns}, name=axis)
        plot.varea("x", "low", "high", source=source, color=_look(0)[0], alpha=0.18)
        for name, title, number in looks:
            dash = [6, 4] if name == "applied" else []
            given = {"legend_label": title} if axis == "X" else {}
            line = plot.line("x", name, source=source, color=_look(number)[0], line_width=2.0, line_dash=dash, **given)
            tips = [("time", "@x{%H:%M:%S}"), (title, f"@{name}{{0.00}} µm")]
            plot.add_tools(HoverTool(renderers=[line], tooltips=tips, formatters={"@x": "datetime"}, mode="mouse"))
        if axis == "X":
            _legend(plot)
        panels.append(plot)
    return _stacked(panels)


def _stacked(panels: Sequence[figure]) -> dict[str, Any]:
    """Return panels above each other, with a common abscissa."""
    for panel in panels[1:]:
        panel.x_range = panels[0].x_range
    rows = [[panel] for panel in panels]
    return dict(json_item(gridplot(rows, sizing_mode="stretch_width", toolbar_options={"logo": None})))


def plain(text: str) -> str:
    """Return a name for drawing: shortened, printable, and without the delimiter of mathematics (``$$``)."""
    shown = "".join(each if each.isprintable() else "?" for each in text[:MAX_NAME])
    return shown.replace("$$", "$\N{ZERO WIDTH SPACE}$") + ("…" if len(text) > MAX_NAME else "")


def _ordinate(curves: Sequence[Curve]) -> Range1d:
    """Return the range of the ordinate: all values with their bands."""
    ends = [each.values + sign * np.nan_to_num(each.expanded) for each in curves for sign in (-1.0, 1.0)]
    known = np.concatenate(ends)[np.isfinite(np.concatenate(ends))]
    low, high = float(known.min()), float(known.max())
    margin = max(0.06 * (high - low), MIN_MARGIN)
    return Range1d(low - margin, high + margin)


def _panel(found: CurveSet, unit: str, ordinate: Range1d, *, last: bool) -> figure:
    plot = _axes(unit, plain(found.label) if last else None, last=last, y_range=ordinate)
    if found.names:
        ticks = np.unique(np.linspace(0, len(found.names) - 1, min(len(found.names), 12)).astype(int))
        plot.xaxis.ticker = [int(k) for k in ticks]
        plot.xaxis.major_label_overrides = {int(k): plain(found.names[k]) for k in ticks}
        plot.x_range = Range1d(-0.6, len(found.names) - 0.4)
    return plot


def _axes(unit: str, label: str | None, *, last: bool, **options: Any) -> figure:
    plot = figure(
        height=HEIGHT + 30 * last,
        sizing_mode="stretch_width",
        tools="pan,box_zoom,wheel_zoom,reset,save",
        active_drag="box_zoom",
        x_axis_label=label,
        y_axis_label=unit,
        output_backend="canvas",
        **options,
    )
    for axis in plot.axis:
        axis.axis_label_text_font, axis.major_label_text_font = FONT, FONT
        axis.axis_label_text_font_style, axis.axis_label_text_font_size = "normal", "14px"
        axis.major_label_text_font_size, axis.major_label_text_color = "12px", SOFT
        axis.axis_label_text_color, axis.axis_line_color = INK, SOFT
        axis.minor_tick_line_color, axis.major_tick_line_color = None, SOFT
    plot.grid.grid_line_color, plot.outline_line_color = LINE, None
    return plot


def _look(number: int) -> tuple[str, tuple[float, ...]]:
    """Return colour and dashes of a curve by its number."""
    return COLOURS[number % len(COLOURS)], DASHES[number // len(COLOURS) % len(DASHES)] or ()


def _legend(plot: figure) -> None:
    """Place the legend above the axes, where it hides no curve."""
    legend = plot.legend[0]
    plot.center.remove(legend)
    plot.add_layout(legend, "above")
    legend.orientation, legend.border_line_color, legend.padding = "horizontal", None, 2
    legend.ncols, legend.label_text_font, legend.label_text_font_size = 8, FONT, "14px"
    legend.label_text_color = INK


def _draw(plot: figure, found: CurveSet, curve: Curve, number: int) -> None:
    colour, dash = _look(number)
    kept = thin(curve.values)
    values, expanded = curve.values[kept], curve.expanded[kept]
    data: dict[str, Any] = {"x": found.places[kept], "y": values, "U": expanded}
    data |= {"low": values - expanded, "high": values + expanded}
    tips = [(curve.name, f"@y{{0.000}} {curve.unit}"), ("U (k=2)", f"@U{{0.000}} {curve.unit}")]
    if found.names:
        data["place"] = [plain(found.names[k]) for k in kept]
        tips.insert(0, (plain(found.label), "@place"))
    else:
        tips.insert(0, (plain(found.label), "@x{0.000}"))
    source = ColumnDataSource(data)
    if found.names:
        whisker = Whisker(source=source, base="x", lower="low", upper="high", line_color=colour, line_width=1.2)
        for head in (whisker.upper_head, whisker.lower_head):
            head.size, head.line_color = 6, colour
        plot.add_layout(whisker)
        drawn = plot.scatter("x", "y", source=source, size=7, color=colour, legend_label=curve.name)
    else:
        plot.varea("x", "low", "high", source=source, color=colour, alpha=0.18)
        drawn = plot.line(
            "x", "y", source=source, color=colour, line_width=1.8, line_dash=list(dash), legend_label=curve.name
        )
        if len(kept) <= FEW:  # a single value has no line
            plot.scatter("x", "y", source=source, size=6, color=colour)
    plot.add_tools(HoverTool(renderers=[drawn], tooltips=tips, mode="mouse" if found.names else "vline"))
