"""Data of a graph for the script of the page: the range of each panel, and the curves with their uncertainty.

The script reads values from the drawn curves and these attributes; no numbers are stored twice.
"""

from __future__ import annotations

import re
from weakref import WeakKeyDictionary

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import to_hex
from matplotlib.dates import AutoDateFormatter, ConciseDateFormatter, DateFormatter
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Annotation, Text
from matplotlib.ticker import FixedFormatter, FuncFormatter

from errormotion.arrays import Array

Marks = dict[str, dict[str, str]]
"""Attributes of elements by their identifiers."""

_EXPANDED: WeakKeyDictionary[Line2D, Array] = WeakKeyDictionary()
_UNIT = re.compile(r"^(.*?)\s*/\s*\(?([^()/]*(?:/[^()/]*)?)\)?\s*$")
_UNITS = ("µm", "mm", "m", "arcsec", "°C", "K", "s", "min", "%")
_MAX_POINTS = 2000
"""Points of a curve with an uncertainty each."""


def state_uncertainty(line: Line2D, expanded: Array) -> None:
    """State the expanded uncertainty of each point of a drawn line, in the unit of its ordinate."""
    if expanded.size <= _MAX_POINTS:
        _EXPANDED[line] = np.asarray(expanded, dtype=float)


def name_parts(figure: Figure) -> None:
    """Give panels, curves and texts of a figure the identifiers that `marks` refers to."""
    for k, axes in enumerate(figure.axes):
        axes.set_gid(f"panel-{k}")
        for j, line in enumerate(_curves(axes)):
            line.set_gid(f"curve-{k}-{j}")
        for j, text in enumerate(axes.texts):
            if _in_data(axes, text):
                text.set_gid(f"place-{k}-{j}")


def marks(figure: Figure) -> Marks:
    """Return the attributes of panels, curves and texts of a drawn figure."""
    found: Marks = {}
    wide, high = 72 * figure.get_size_inches()
    for k, axes in enumerate(figure.axes):
        found |= {str(text.get_gid()): {"class": "place"} for text in axes.texts if text.get_gid()}
        curves = _curves(axes)
        if not curves:
            continue
        x0, y0, x1, y1 = axes.get_position().extents
        box = (x0 * wide, (1 - y1) * high, (x1 - x0) * wide, (y1 - y0) * high)
        x_name, x_unit = _label(_across(axes))
        kinds = _kind(axes.xaxis, axes.get_xscale()), _kind(axes.yaxis, axes.get_yscale())
        unit = _label(axes.get_ylabel())[1] or _label(axes.get_title(loc="left"))[1]
        panel = {
            "class": "panel",
            "data-box": " ".join(f"{each:.2f}" for each in box),
            "data-x": " ".join(f"{each:.9g}" for each in axes.get_xlim()),
            "data-y": " ".join(f"{each:.9g}" for each in axes.get_ylim()),
            "data-x-kind": kinds[0],
            "data-y-kind": kinds[1],
            "data-x-name": x_name,
            "data-x-unit": x_unit,
        }
        if kinds == ("linear", "linear"):
            panel["data-zoom"] = ""
        if any(tick.label1.get_visible() for tick in axes.xaxis.get_major_ticks()):
            panel["data-x-ticks"] = "1"
        found[f"panel-{k}"] = panel
        for j, line in enumerate(curves):
            found[f"curve-{k}-{j}"] = _curve(line, unit)
    return found


def _curve(line: Line2D, unit: str) -> dict[str, str]:
    label = str(line.get_label())
    found = {"data-curve": "", "data-colour": to_hex(line.get_color()), "data-unit": unit}
    if not label.startswith("_"):
        found["data-name"] = label.strip()
    expanded = _EXPANDED.get(line)
    known = np.isfinite(np.asarray(line.get_xydata(), dtype=float)).all(axis=1)
    if expanded is not None and expanded.size == known.size and np.isfinite(expanded).any():
        found["data-u"] = " ".join(f"{each:.3g}" for each in expanded[known])
    return found


def _curves(axes: Axes) -> list[Line2D]:
    """Return the lines in data coordinates, without reference lines across the panel and dots on a curve."""
    return [
        line
        for line in axes.get_lines()
        if line.get_transform() == axes.transData and line.get_label() != "_nolegend_" and np.size(line.get_xdata())
    ]


def _in_data(axes: Axes, text: Text) -> bool:
    """Return whether the position of a text is a value of the data, not a fraction of the panel."""
    if isinstance(text, Annotation):
        return text.xycoords != "axes fraction"
    return text.get_transform() == axes.transData


def _across(axes: Axes) -> str:
    """Return the label of the abscissa, which may be that of another panel."""
    siblings = axes.get_shared_x_axes().get_siblings(axes)
    return next((label for each in (axes, *siblings) if (label := each.get_xlabel())), "")


def _label(text: str) -> tuple[str, str]:
    """Return name and unit of a label such as ``time / min``."""
    if text in _UNITS:
        return "", text
    found = _UNIT.match(text)
    return (found[1], found[2]) if found else (text, "")


def _kind(axis: Axis, scale: str) -> str:
    formatter = axis.get_major_formatter()
    if isinstance(formatter, (AutoDateFormatter, ConciseDateFormatter, DateFormatter)):
        return "date"
    return "fixed" if isinstance(formatter, (FixedFormatter, FuncFormatter)) else scale
