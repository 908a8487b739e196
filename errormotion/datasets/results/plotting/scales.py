"""Scales of figures: times, positions, targets, labels; units of the drawn values."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.axis import Axis, XAxis
from matplotlib.ticker import MaxNLocator

from errormotion.arrays import Array
from errormotion.datasets.schemas import ERROR_DIMS
from errormotion.datasets.units import convert

UNITS = {
    **dict.fromkeys(("EX", "EY", "EZ", "deviation"), ("m", "um")),
    **dict.fromkeys(("EA", "EB", "EC"), ("rad", "arcsec")),
}
"""SI unit and field unit of each estimate."""

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#B5558A", "#3291C8", "#B07800", "#222222", "#8C6D00")
"""Colours after Okabe and Ito, distinguishable with any colour vision."""

MARKERS = "os^Dv<>P"

MAX_LINES = 8
"""Largest number of curves; more are drawn as a map."""

MAX_LABELS = 16
"""Largest number of texts of an axis."""

MAX_LABEL = 24
"""Characters."""


class Scale(NamedTuple):
    """Values along a dim, n of them.

    Attributes
    ----------
    values : ndarray, (n,)
        In the field unit; their numbers if they have texts or no coordinate.
    label : str
        Name and unit.
    texts : list of str
        Names of the values, if they have names; else empty.
    joined : bool
        Whether the values are points of a continuous scale, which a line may join, and not single objects.
    """

    values: Array
    label: str
    texts: list[str]
    joined: bool


def scale_of(ds: xr.Dataset, dim: str) -> Scale:
    """Return the scale of a dim of a dataset."""
    numbers = np.arange(1.0, ds.sizes[dim] + 1)
    letter = str(ds.attrs["component"]).lower()
    name = letter if dim == "position" and letter in ds.coords and ds[letter].dims == (dim,) else dim
    if dim == "position" and name == dim:
        own = [axis for axis in "xyzabcuvw" if axis in ds.coords and ds[axis].dims == (dim,)]
        name = own[0] if len(own) == 1 else name
    if name in ds.coords and ds[name].dims == (dim,):
        coordinate = ds[name]
        if coordinate.dtype.kind in "UO":
            return Scale(numbers, dim, [short(text) for text in coordinate.values], joined=False)
        inside = str(coordinate.attrs.get("units", {"time": "s", "position": "m"}.get(dim, "1")))
        if dim in ("time", "position") or dim not in ERROR_DIMS:
            unit = _field_unit(inside, coordinate.values)
            values = np.asarray(convert(np.asarray(coordinate.values, float), inside, unit))
            shown = {"position": f"{name} position"}.get(dim, dim) if name != dim else dim
            return Scale(values, shown if unit == "1" else f"{shown} / {unit}", [], joined=True)
        if np.unique(coordinate.values).size == coordinate.size:  # numbers as names of targets
            return Scale(numbers, dim, [f"{value:g}" for value in coordinate.values], joined=False)
    return Scale(numbers, f"{dim} number", [], joined=dim in ("time", "position"))


def over(ds: xr.Dataset) -> str:
    """Return the dim of two that is the abscissa of curves: the longer one; if equal, the one that is not the time."""
    return str(max(ds.em.dims, key=lambda dim: (scale_of(ds, dim).joined, ds.sizes[dim], dim != "time")))


def mark(axis: Axis, scale: Scale) -> None:
    """Label an axis, with the names of single objects if they fit."""
    axis.set_label_text(scale.label)
    if scale.texts:
        step = -(-len(scale.texts) // MAX_LABELS)
        axis.set_ticks(scale.values[::step].tolist(), scale.texts[::step], parse_math=False)
        if isinstance(axis, XAxis) and sum(map(len, scale.texts[::step])) > 50:
            axis.set_tick_params(rotation=30)
    elif not scale.joined:
        axis.set_major_locator(MaxNLocator(integer=True))


def short(text: object) -> str:
    """Return a text that is short enough for a drawing."""
    words = " ".join(str(text).split())
    return words if len(words) <= MAX_LABEL else words[: MAX_LABEL - 3] + "..."


def legend(axes: Axes, title: str = "") -> None:
    """Draw a legend if there are labels, with texts verbatim."""
    handles, labels = axes.get_legend_handles_labels()
    if not handles:
        return
    drawn = axes.legend(handles, labels, loc="best", title=title or None, fontsize=8, title_fontsize=8)
    for text in drawn.get_texts():
        text.set_parse_math(False)


def _field_unit(inside: str, values: Array) -> str:
    span = float(np.ptp(values)) if np.size(values) else 0.0
    return {"s": "min" if span > 120 else "s", "m": "mm", "rad": "deg"}.get(inside, inside)
