"""Curves with bands along a scale, and values with bars at single objects."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from errormotion.arrays import Array
from errormotion.datasets.results.places import Scale, scale_of
from errormotion.datasets.results.plotting.scales import COLOURS, MARKERS, UNITS, legend, mark, over
from errormotion.datasets.units import convert

_SPREAD = 0.5
"""Fraction of the distance between two objects over which the freedoms are distributed."""


def draw(axes: Axes, ds: xr.Dataset, freedoms: tuple[str, ...], unit: str, band: xr.DataArray) -> None:
    """Draw freedoms of one unit; of two dims, one freedom, with a curve for each label of the shorter dim."""
    names, dims = ds.em.iso_names(), ds.em.dims
    title = ""
    if len(dims) == 2:
        (freedom,) = freedoms
        along = over(ds)
        other = next(dim for dim in dims if dim != along)
        labels = scale_of(ds, other)
        title = labels.label
        texts = labels.texts or [f"{value:.5g}" for value in labels.values]
        values, bands = (each.transpose(other, along).values for each in (ds[freedom], band.sel(dof=freedom)))
        series = list(zip(texts, values, bands, strict=True))
        label, scale = f"{names[freedom]} / {unit}", scale_of(ds, along)
    else:
        series = [(names[name], ds[name].values, band.sel(dof=name).values) for name in freedoms]
        scale = scale_of(ds, dims[0]) if dims else Scale(np.arange(1.0, len(freedoms) + 1), "", [], joined=False)
        label = unit
    for k, (name, values, bands) in enumerate(series):
        if np.isnan(values).all():
            continue
        inside = UNITS[freedoms[0]][0]
        y, half = (np.atleast_1d(convert(each, inside, unit)) for each in (values, bands))
        if scale.joined:
            _band(axes, scale.values, y, half, name, COLOURS[k % len(COLOURS)])
        else:
            aside = _SPREAD * ((k + 0.5) / len(series) - 0.5)
            x = scale.values + aside if dims else scale.values[k : k + 1]
            _bars(axes, x, y, half, name, k)
    if dims:
        mark(axes.xaxis, scale)
        if not scale.joined:
            axes.set_xlim(0.4, scale.values.size + 0.6)
        legend(axes, title)
    else:
        axes.set_xticks(scale.values.tolist(), [name for name, *_ in series], parse_math=False)
        axes.margins(x=0.3)
    axes.set_ylabel(label, parse_math=False)
    axes.grid(alpha=0.3)


def _band(axes: Axes, x: Array, y: Array, half: Array, name: str, colour: str) -> None:
    # A value between two unknown ones is not part of a line.
    known = np.isfinite(y)
    alone = known & ~np.append(known[1:], False) & ~np.append(False, known[:-1])
    axes.plot(x, y, label=name, color=colour, linewidth=1.2)
    if alone.any():
        axes.plot(x[alone], y[alone], linestyle="", marker=".", color=colour)
    if half.any():
        axes.fill_between(x, y - half, y + half, color=colour, alpha=0.2, linewidth=0)


def _bars(axes: Axes, x: Array, y: Array, half: Array, name: str, k: int) -> None:
    axes.errorbar(
        x,
        y,
        yerr=half if np.nan_to_num(half).any() else None,
        color=COLOURS[k % len(COLOURS)],
        marker=MARKERS[k % len(MARKERS)],
        markersize=4,
        linestyle="",
        linewidth=1,
        capsize=2,
        label=name,
    )
