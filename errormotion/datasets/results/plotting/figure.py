"""The figure of an error dataset: its form, panels and titles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Literal, NamedTuple, get_args

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from errormotion.datasets.results.places import scale_of
from errormotion.datasets.results.plotting import arrows, curves, maps
from errormotion.datasets.results.plotting.scales import MAX_LINES, UNITS, over
from errormotion.datasets.results.tables import chosen
from errormotion.errors import DatasetError

Form = Literal["auto", "curves", "map", "arrows"]


class _Panel(NamedTuple):
    """One panel with freedoms of one unit."""

    freedoms: tuple[str, ...]
    unit: str


def plot_errors(
    ds: xr.Dataset,
    freedoms: str | Sequence[str] | None = None,
    at: ArrayLike | None = None,
    k: float = 2.0,
    ax: Axes | Sequence[Axes] | None = None,
    form: Form = "auto",
) -> Figure:
    """Return a figure of an error dataset: displacements in um, rotations in arcsec.

    Parameters
    ----------
    ds : Dataset
        Error dataset over at most two dims.
    freedoms : str or sequence of str, optional
        Names such as ``EX``, or those of ISO 230-1 such as ``EXY``; default: all that are known.
    at : array_like, (3,), optional
        Functional point, m; default: that of the dataset.
    k : float
        Coverage factor of the uncertainties; with 0 they are not drawn.
    ax : Axes or sequence of Axes, optional
        Axes, one for each panel; arrows need axes with ``projection="3d"``. Default: a new figure.
    form : {"auto", "curves", "map", "arrows"}
        ``curves`` with bands or bars over one dim, or one curve for each label of the shorter of two dims; ``map``
        over two dims, a panel for each freedom; ``arrows`` at the targets of a volume. ``auto`` draws arrows if
        displacements are known at targets in space, curves over one dim, and a map over two dims if the shorter
        one has more than 8 labels.

    Raises
    ------
    DatasetError
        More than two dims, an unknown freedom, a form that the dataset does not have, or a wrong number of axes.
    """
    if not 0 <= k < math.inf:
        raise DatasetError(f"Expected a coverage factor k of 0 or more; found {k!r}", code="plot.coverage_factor")
    if at is not None:
        ds = ds.em.at(at)
    dims = ds.em.dims
    if len(dims) > 2:
        raise DatasetError(
            f"A plot shows errors over one or two dims; found {', '.join(dims)}. Select along the others first, such "
            f"as ds.isel({dims[0]}=0)",
            code="plot.dims.too_many",
        )
    names = chosen(ds, freedoms)
    if freedoms is None:
        names = [name for name in names if np.isfinite(ds[name].values).any()] or names
    given = None if ax is None else [ax] if isinstance(ax, Axes) else list(ax)
    drawn = _form(ds, names, form, given)
    panels = _panels(ds, names, drawn)
    figure, axes = _axes(panels, drawn, given)
    band = float(k) * ds.em.expanded(k=1)
    for each, panel in zip(axes, panels, strict=True):
        if drawn == "arrows":
            arrows.draw(each, ds, panel.freedoms, panel.unit, band, k)
        elif drawn == "map":
            maps.draw(each, ds, panel.freedoms[0], panel.unit, band, k)
        else:
            curves.draw(each, ds, panel.freedoms, panel.unit, band)
    if given is None:
        if drawn != "arrows" and dims:
            _share(axes)
        words = f"{ds.attrs['machine']}: {ds.attrs['component']} ({ds.attrs['method']})"
        if drawn == "curves" and k:
            words += f", {'bands' if _joined(ds) else 'bars'} k = {k:g}"
        figure.suptitle(words, parse_math=False)
    return figure


def _form(ds: xr.Dataset, names: list[str], form: str, given: Sequence[Axes] | None) -> str:
    if form not in get_args(Form):
        raise DatasetError(f"Expected a form of {', '.join(get_args(Form))}; found {form!r}", code="plot.form.unknown")
    dims = ds.em.dims
    spatial = len(dims) == 1 and all(axis in ds.coords and ds[axis].dims == dims for axis in "xyz")
    triples = [triple for triple in arrows.TRIPLES if set(triple) <= set(names)]
    whole = bool(triples) and len(names) == 3 * len(triples)
    if form == "arrows" and not (spatial and whole):
        raise DatasetError(
            "Arrows show EX, EY, EZ (or EA, EB, EC) at targets with x, y and z; found "
            f"{', '.join(names)} over {', '.join(dims) or 'a single position'}",
            code="plot.arrows.no_targets",
        )
    if form == "map" and len(dims) != 2:
        raise DatasetError(f"A map shows errors over two dims; found {', '.join(dims) or 'none'}", code="plot.map.dims")
    if form != "auto":
        return form
    flat = given is not None and any(axes.name != "3d" for axes in given)
    if spatial and triples and not flat and dims[0] == "target":
        return "arrows"
    if len(dims) == 2 and min(ds.sizes[dim] for dim in dims) > MAX_LINES:
        return "map"
    return "curves"


def _panels(ds: xr.Dataset, names: list[str], form: str) -> list[_Panel]:
    if form == "map" or len(ds.em.dims) == 2:
        return [_Panel((name,), UNITS[name][1]) for name in names]
    if form == "arrows":
        return [_Panel(triple, UNITS[triple[0]][1]) for triple in arrows.TRIPLES if set(triple) <= set(names)]
    units = dict.fromkeys(UNITS[name][1] for name in names)
    return [_Panel(tuple(name for name in names if UNITS[name][1] == unit), unit) for unit in units]


def _joined(ds: xr.Dataset) -> bool:
    dims = ds.em.dims
    return bool(dims) and scale_of(ds, over(ds) if len(dims) == 2 else dims[0]).joined


def _axes(panels: list[_Panel], form: str, given: Sequence[Axes] | None) -> tuple[Figure, Sequence[Axes]]:
    if given is not None:
        if len(given) != len(panels):
            shown = "; ".join(f"{', '.join(panel.freedoms)} in {panel.unit}" for panel in panels)
            raise DatasetError(f"Expected {len(panels)} axes ({shown}); found {len(given)}", code="plot.axes.count")
        if form == "arrows" and any(axes.name != "3d" for axes in given):
            raise DatasetError('Arrows need axes that were made with projection="3d"', code="plot.axes.projection")
        whole = given[0].get_figure(root=True)
        if whole is None:
            raise DatasetError(
                "Expected axes of a figure; found axes that were removed from theirs", code="plot.axes.removed"
            )
        return whole, given
    rows, columns = len(panels), 1
    if form == "arrows":
        rows, columns = 1, len(panels)
        size, subplots = (7.0 * columns, 6.5), {"projection": "3d"}
    else:
        if len(panels) > 3:
            rows, columns = math.ceil(len(panels) / 2), 2
        size, subplots = ((8.0 if columns == 1 else 11.0), 3.0 * rows if rows > 1 else 4.0), {}
    figure = Figure(figsize=size, layout="constrained")
    # Displacements in the left column, rotations in the right one.
    drawn = figure.subplots(rows, columns, squeeze=False, subplot_kw=subplots)
    order = drawn.T.ravel() if form != "arrows" else drawn.ravel()
    for spare in order[len(panels) :]:
        spare.remove()
    return figure, list(order[: len(panels)])


def _share(axes: Sequence[Axes]) -> None:
    """Share the abscissa of the panels of a column; only the lowest one has labels."""
    for each, below in pairwise(axes):
        each.sharex(axes[-1])
        if each.get_subplotspec().colspan == below.get_subplotspec().colspan:  # type: ignore[union-attr]
            each.set_xlabel("")
            each.tick_params(labelbottom=False)
