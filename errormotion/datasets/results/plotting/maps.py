"""Maps of one freedom over two dims with a cell for each value."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import CenteredNorm, LinearSegmentedColormap

from errormotion.arrays import Array
from errormotion.datasets.results.places import Scale, scale_of
from errormotion.datasets.results.plotting.scales import UNITS, mark
from errormotion.datasets.units import convert, format_quantity

DIVERGING = LinearSegmentedColormap.from_list(
    "errors", ["#00305A", "#0072B2", "#9CCBE8", "#FFFFFF", "#F5BE98", "#D55E00", "#6B2A00"]
)
"""Blue below zero, white at zero, vermillion above: distinguishable with every colour vision."""

_UNKNOWN = "#D9D9D9"


def draw(axes: Axes, ds: xr.Dataset, freedom: str, unit: str, band: xr.DataArray, k: float) -> None:
    """Draw one freedom over two dims, with time as the abscissa; unknown values are grey."""
    upward, right = sorted(ds.em.dims, key=lambda dim: (dim == "time", scale_of(ds, dim).joined, ds.sizes[dim]))
    inside = UNITS[freedom][0]
    values = np.asarray(convert(ds[freedom].transpose(upward, right).values, inside, unit))
    scales = [_increasing(scale_of(ds, dim)) for dim in (right, upward)]
    limit = float(np.nanmax(np.abs(values))) if np.isfinite(values).any() else 1.0
    norm = CenteredNorm(0.0, limit or 1.0)
    axes.set_facecolor(_UNKNOWN)
    cells = axes.pcolormesh(
        edges(scales[0].values), edges(scales[1].values), values, cmap=DIVERGING, norm=norm, rasterized=True
    )
    for axis, scale in zip((axes.xaxis, axes.yaxis), scales, strict=True):
        mark(axis, scale)
    axes.figure.colorbar(cells, ax=axes, label=unit)
    title = ds.em.iso_names()[freedom]
    largest = band.sel(dof=freedom).values
    if k and np.isfinite(largest).any():
        title += f", U up to {format_quantity(float(np.nanmax(largest)), unit, 2)} (k = {k:g})"
    if (unknown := int(np.isnan(values).sum())) and unknown < values.size:
        title += f", {unknown} unknown (grey)"
    axes.set_title(title, fontsize=9, loc="left", parse_math=False)


def edges(middles: Array) -> Array:
    """Return the n + 1 edges of cells around n increasing middles."""
    if middles.size == 1:
        return np.array([middles[0] - 0.5, middles[0] + 0.5])
    between = (middles[1:] + middles[:-1]) / 2
    return np.concatenate([[2 * middles[0] - between[0]], between, [2 * middles[-1] - between[-1]]])


def _increasing(scale: Scale) -> Scale:
    """Return a scale whose cells do not overlap: the numbers of the values if these are not monotonic."""
    steps = np.diff(scale.values)
    if (steps > 0).all() or (steps < 0).all():
        return scale
    texts = [f"{value:.5g}" for value in scale.values]
    return Scale(np.arange(1.0, scale.values.size + 1), scale.label, texts, joined=False)
