"""The figure behind ``ds.em.plot()``."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from errormotion.datasets.units import convert
from errormotion.errors import DatasetError

_LABELS = {"time": ("s", "min", "time"), "position": ("m", "mm", "position")}


def plot_errors(ds: xr.Dataset) -> Figure:
    """Return a figure of an error dataset: curves with k = 2 bands, displacements in um and rotations in arcsec.

    Parameters
    ----------
    ds : Dataset
        Error dataset over at most one dim.

    Raises
    ------
    DatasetError
        More than one dim.
    """
    dims = ds.em.dims
    if len(dims) > 1:
        raise DatasetError(f"A plot shows errors over one dim; found {', '.join(dims)}. Select along the others first")
    figure = Figure(figsize=(8, 6), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    places, label = _abscissa(ds, dims)
    bands = ds.em.expanded(k=2)
    names = ds.em.iso_names()
    for axes, freedoms, unit, inside in (
        (upper, ("EX", "EY", "EZ"), "um", "m"),
        (lower, ("EA", "EB", "EC"), "arcsec", "rad"),
    ):
        for freedom in freedoms:
            values = np.atleast_1d(convert(ds[freedom].values, inside, unit))
            band = np.atleast_1d(convert(bands.sel(dof=freedom).values, inside, unit))
            if not np.isnan(values).all():
                _curve(axes, places, values, band, names[freedom], joined=dims in (("time",), ("position",)))
        axes.set_ylabel(unit)
        axes.grid(alpha=0.3)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="best")
    lower.set_xlabel(label)
    figure.suptitle(f"{ds.attrs['machine']}: {ds.attrs['component']} ({ds.attrs['method']}), bands k = 2")
    return figure


def _abscissa(ds: xr.Dataset, dims: tuple[str, ...]) -> tuple[Any, str]:
    if not dims:
        return [ds.attrs["component"]], ""
    (dim,) = dims
    if dim in _LABELS:
        source, unit, name = _LABELS[dim]
        letter = str(ds.attrs["component"]).lower()
        coordinate = letter if dim == "position" and letter in ds.coords else dim
        if coordinate in ds.coords and ds.coords[coordinate].dims == (dim,):
            return convert(ds[coordinate].values, source, unit), f"{name} / {unit}"
    if dim in ds.coords and ds[dim].dtype.kind in "UO":
        return [str(text) for text in ds[dim].values], dim
    return np.arange(ds.sizes[dim]), f"{dim} number"


def _curve(axes: Axes, places: Any, values: Any, band: Any, name: str, *, joined: bool) -> None:
    if joined:
        (line,) = axes.plot(places, values, label=name)
        axes.fill_between(places, values - band, values + band, color=line.get_color(), alpha=0.2, linewidth=0)
    else:
        axes.errorbar(places, values, yerr=band, fmt="o", capsize=3, label=name)
