"""Scales of figures: times, positions, targets, labels; units of the drawn values."""

from __future__ import annotations

import xarray as xr
from matplotlib.axes import Axes
from matplotlib.axis import Axis, XAxis
from matplotlib.ticker import MaxNLocator

from errormotion.datasets.results.places import Scale, scale_of

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


def legend(axes: Axes, title: str = "") -> None:
    """Draw a legend if there are labels, with texts verbatim."""
    handles, labels = axes.get_legend_handles_labels()
    if not handles:
        return
    drawn = axes.legend(handles, labels, loc="best", title=title or None, fontsize=8, title_fontsize=8)
    for text in drawn.get_texts():
        text.set_parse_math(False)
