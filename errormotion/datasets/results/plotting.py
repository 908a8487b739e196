"""The figure behind ``ds.em.plot()``."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from errormotion.datasets.schemas import ERROR_DIMS
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
    groups = [
        (names, unit, inside)
        for names, unit, inside in (
            (("EX", "EY", "EZ"), "um", "m"),
            (("EA", "EB", "EC"), "arcsec", "rad"),
            (("deviation",), "um", "m"),
        )
        if set(names) <= set(ds.em.names)
    ]
    figure = Figure(figsize=(8, 3 * len(groups)), layout="constrained")
    panels = figure.subplots(len(groups), 1, sharex=True, squeeze=False)[:, 0]
    places, label = _abscissa(ds, dims)
    bands = ds.em.expanded(k=2)
    names = ds.em.iso_names()
    for axes, (freedoms, unit, inside) in zip(panels, groups, strict=True):
        for freedom in freedoms:
            values = np.atleast_1d(convert(ds[freedom].values, inside, unit))
            band = np.atleast_1d(convert(bands.sel(dof=freedom).values, inside, unit))
            if not np.isnan(values).all():
                _curve(axes, places, values, band, names[freedom], joined=_is_scale(ds, dims))
        axes.set_ylabel(unit)
        axes.grid(alpha=0.3)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="best")
    panels[-1].set_xlabel(label)
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
    if _is_scale(ds, dims):
        return ds[dim].values, f"{dim} / {ds[dim].attrs.get('units', '1')}"
    return np.arange(ds.sizes[dim]), f"{dim} number"


def _is_scale(ds: xr.Dataset, dims: tuple[str, ...]) -> bool:
    """Whether the errors lie along a scale, so that a line may join them, and are not single objects."""
    return dims in (("time",), ("position",)) or (
        len(dims) == 1 and dims[0] not in ERROR_DIMS and ds[dims[0]].dtype.kind in "iuf"
    )


def _curve(axes: Axes, places: Any, values: Any, band: Any, name: str, *, joined: bool) -> None:
    if joined:
        (line,) = axes.plot(places, values, label=name)
        axes.fill_between(places, values - band, values + band, color=line.get_color(), alpha=0.2, linewidth=0)
    else:
        axes.errorbar(places, values, yerr=band, fmt="o", capsize=3, label=name)
