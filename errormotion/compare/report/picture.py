"""The figure of a comparison: for each freedom the values of all datasets with bands, and En of each pair."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from errormotion.arrays import Array
from errormotion.compare.pairs import COVERAGE_FACTOR
from errormotion.datasets.results.places import in_field_units
from errormotion.datasets.schemas import ERROR_DIMS
from errormotion.kinematics.iso import DOF
from errormotion.report.canvas import COLOURS, GREEN, curve, style

PANEL = 1.6
"""Height of a panel, inches."""
SIZE = 9.0
"""Width of the figure, inches."""
MAX_NAMED = 7
"""Largest number of entries of a legend."""
GREY = "#777777"
"""Colour of pairs without entries in the legend."""
MIN_EN = 1.5
"""Smallest limit of the ordinate of En."""


def plot(ds: xr.Dataset) -> Figure:
    """Return the figure of a comparison: values with bands (k = 2) and normalised errors, a row for each freedom."""
    with style():
        figure = Figure(figsize=(SIZE, height(ds)), facecolor="white")
        paint(figure, ds)
        figure.suptitle(
            f"{ds.attrs['machine']}: {ds.attrs['component']}, bands k = 2", x=0.01, y=0.995, ha="left", va="top"
        )
    return figure


def height(ds: xr.Dataset) -> float:
    """Return the height of the figure, inches."""
    return PANEL * ds.sizes["dof"] + 0.9


def paint(figure: Figure, ds: xr.Dataset) -> None:
    """Draw the panels of a comparison into a figure."""
    names = [str(name) for name in ds["dof"].values]
    panels = figure.subplots(
        len(names), 2, sharex="col" if common(ds) else False, squeeze=False, gridspec_kw={"hspace": 0.16, "wspace": 0.2}
    )
    high = figure.get_size_inches()[1]
    figure.subplots_adjust(left=0.08, right=0.985, top=1 - 0.3 / high, bottom=0.75 / high)
    band = COVERAGE_FACTOR * np.sqrt(np.maximum(np.diagonal(ds["covariance"].values, axis1=-2, axis2=-1), 0.0))
    for k, (name, (left, right)) in enumerate(zip(names, panels, strict=True)):
        factor, unit = field(name)
        _values(left, ds, factor * ds["value"].values[..., k], factor * band[..., k])
        _normalised(right, ds, ds["en"].values[..., k])
        left.set_ylabel(f"{name} / {unit}" if unit else name)
        right.set_ylabel(f"En of {name}")
        if name != names[-1]:
            left.tick_params(labelbottom=False)
            right.tick_params(labelbottom=False)
    figure.align_ylabels()
    for axes, shown in zip(panels[-1], _named(ds), strict=True):
        axes.set_xlabel(abscissa(ds)[1] if common(ds) else "")
        handles = [axes.plot([], [], color=colour, label=label)[0] for label, colour in shown.items()]
        axes.legend(handles=handles, loc="upper left", bbox_to_anchor=(0.0, -0.3), ncols=3, borderaxespad=0)


def _values(axes: Axes, ds: xr.Dataset, values: Array, band: Array) -> None:
    colours = _colours(ds)
    if not common(ds):
        places = np.arange(len(values))
        for i, colour in enumerate(colours):
            axes.errorbar(places[i], values[i], yerr=band[i], fmt="o", ms=4, capsize=3, color=colour)
        axes.set_xticks([])
        axes.margins(x=0.2)
        return
    x, _, joined = abscissa(ds)
    for i, colour in enumerate(colours):
        if joined:
            curve(axes, x, values[i], band[i], colour=colour)
        else:
            shift = 0.12 * (i - (len(values) - 1) / 2)
            axes.errorbar(x + shift, values[i], yerr=band[i], fmt="o", ms=2.5, lw=0.8, color=colour)


def _normalised(axes: Axes, ds: xr.Dataset, en: Array) -> None:
    axes.axhspan(-1, 1, color=GREEN, alpha=0.12, linewidth=0)
    axes.axhline(0, color="#888888", lw=0.5)
    colours = _pair_colours(len(en))
    if not common(ds):
        for j, colour in enumerate(colours):
            axes.plot([j, j], [0, en[j]], color=colour, lw=3)
        axes.set_xticks([])
        axes.margins(x=0.2)
    else:
        x, _, joined = abscissa(ds)
        for j, colour in enumerate(colours):
            axes.plot(x, en[j], color=colour, lw=1, ls="-" if joined else "", marker="" if joined else ".", alpha=0.8)
    largest = max(MIN_EN, float(np.nanmax(np.abs(en), initial=0.0)) * 1.08)
    axes.set_ylim(-largest, largest)


def _groups(ds: xr.Dataset) -> list[str]:
    """Return the label of each curve: the group of the dataset, or its name."""
    return [str(name) for name in (ds["group"] if "group" in ds.variables else ds["dataset"]).values]


def _colours(ds: xr.Dataset) -> list[str]:
    groups = _groups(ds)
    order = list(dict.fromkeys(groups))
    return [COLOURS[order.index(group) % len(COLOURS)] for group in groups]


def _pair_colours(count: int) -> list[str]:
    if count > MAX_NAMED:
        return [GREY] * count
    return [COLOURS[(j + 3) % len(COLOURS)] for j in range(count)]  # not the colours of the first datasets


def _named(ds: xr.Dataset) -> tuple[dict[str, str], dict[str, str]]:
    """Return the entries of both legends, with their colours."""
    curves = dict(zip(_groups(ds), _colours(ds), strict=True))
    if len(curves) > MAX_NAMED:
        kept = list(curves.items())[: MAX_NAMED - 1]
        curves = {**dict(kept), f"and {len(curves) - len(kept)} more": "none"}
    pairs = [str(name) for name in ds["pair"].values]
    colours = _pair_colours(len(pairs))
    shown = dict(zip(pairs, colours, strict=True)) if len(pairs) <= MAX_NAMED else {f"{len(pairs)} pairs": GREY}
    return curves, shown


def common(ds: xr.Dataset) -> str:
    """Return the common dimension; empty for single values."""
    dims = [str(dim) for dim in ds["consensus"].dims if dim != "dof"]
    return dims[0] if dims else ""


def abscissa(ds: xr.Dataset) -> tuple[Array, str, bool]:
    """Return the places along the common dimension, its label, and whether lines join the values."""
    dim = common(ds)
    if dim == "time":
        return np.asarray(ds["time"].values) / 60.0, "time / min", True
    for name in ("x", "y", "z"):
        if dim == "position" and name in ds.coords and ds[name].dims == (dim,):
            return np.asarray(ds[name].values) * 1e3, f"{name.upper()} / mm", True
    if dim not in ERROR_DIMS and dim in ds.coords and ds[dim].dtype.kind == "f":
        places, unit = in_field_units(ds[dim])
        return places, dim if unit == "1" else f"{dim} / {unit}", True
    return np.arange(ds.sizes[dim], dtype=float), f"{dim} number", False


def field(name: str) -> tuple[float, str]:
    """Return factor and name of the printed unit of a freedom; 1 and an empty name for other quantities."""
    if name not in DOF:
        return 1.0, ""
    return (1e6, "µm") if name in DOF[:3] else (648000 / np.pi, "arcsec")
