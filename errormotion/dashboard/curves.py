"""A result as curves: values with U (k = 2) at a functional point, reduced to the resolution of a screen."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.datasets.results.places import in_field_units
from errormotion.datasets.units import convert
from errormotion.errors import DatasetError
from errormotion.report.exports.tables import plain_text

MAX_POINTS = 2000
"""Number of points of a reduced curve: about two for each pixel of a wide screen."""
FIELD = {"m": ("um", "µm"), "rad": ("arcsec", "arcsec")}
"""Printed unit of an error by SI unit: name for the conversion, and text."""
_SCALES = {"time": ("s", "min", "time"), "position": ("m", "mm", "position")}


@dataclass(frozen=True)
class Curve:
    """One freedom: values and expanded uncertainties (k = 2), both (n,), in ``unit``; NaN where unknown."""

    freedom: str
    name: str
    unit: str
    values: Array
    expanded: Array


@dataclass(frozen=True)
class CurveSet:
    """The errors of one result over one dimension.

    Attributes
    ----------
    label : str
        Name and unit of the abscissa.
    places : ndarray, (n,)
        Abscissa.
    names : tuple of str
        Names of the places if they have no scale; else empty.
    curves : tuple of Curve
    point : ndarray, (3,)
        Functional point, m.
    others : mapping of str to int
        Lengths of the further dimensions, of which one index is shown.
    """

    label: str
    places: Array
    names: tuple[str, ...]
    curves: tuple[Curve, ...]
    point: Array
    others: Mapping[str, int]


def curves_of(
    ds: xr.Dataset, point: Sequence[float] | None = None, select: Mapping[str, int] | None = None
) -> CurveSet:
    """Return the curves of an error dataset.

    Parameters
    ----------
    ds : Dataset
        Error dataset.
    point : sequence of float, optional
        Another functional point, m; values and covariance are recomputed.
    select : mapping of str to int, optional
        Index along each dimension other than the abscissa; default 0.

    Raises
    ------
    DatasetError
        The dataset is not an error dataset, an index is beyond its dimension, or the functional point is fixed.
    """
    moved = ds if point is None else ds.em.at(point)
    dims = moved.em.dims
    shown = next((dim for dim in dims if dim in _SCALES), dims[0] if dims else "")
    others = {dim: int(moved.sizes[dim]) for dim in dims if dim != shown}
    for dim, size in others.items():
        index = (select or {}).get(dim, 0)
        if not 0 <= index < size:
            raise DatasetError(
                f"{dim}: expected an index from 0 to {size - 1}; found {index}", code="request.index.outside"
            )
        moved = moved.isel({dim: index})
    expanded, names = moved.em.expanded(k=2), moved.em.iso_names()
    curves = []
    for freedom in moved.em.names:
        unit, written = FIELD[str(moved[freedom].attrs["units"])]
        inside = str(moved[freedom].attrs["units"])
        values, bands = (
            np.atleast_1d(np.asarray(convert(each.values, inside, unit), dtype=float))
            for each in (moved[freedom], expanded.sel(dof=freedom))
        )
        if np.isfinite(values).any():
            curves.append(Curve(freedom, names[freedom], written, values, bands))
    label, places, texts = _abscissa(moved, shown)
    here = np.asarray(moved.attrs.get("functional_point", (np.nan,) * 3), dtype=float)
    return CurveSet(label, places, texts, tuple(curves), here, others)


def thin(values: Array, most: int = MAX_POINTS) -> NDArray[np.intp]:
    """Return the indices of a reduced curve: first and last value, and the extremes and a gap of each interval.

    Parameters
    ----------
    values : ndarray, (n,)
    most : int
        Approximate largest number of indices; minimum, maximum and a gap of every interval are included.

    Returns
    -------
    ndarray of int
        Indices in ascending order.
    """
    n, bins = len(values), max(1, (most - 2) // 3)
    if n <= most:
        return np.arange(n)
    width = -(-n // bins)
    padded = np.full(bins * width, np.nan)
    padded[:n] = values
    rows = padded.reshape(bins, width)
    start, known = np.arange(bins) * width, np.isfinite(rows)
    some = known.any(axis=1)
    kept = [
        (start + np.where(known, rows, np.inf).argmin(axis=1))[some],
        (start + np.where(known, rows, -np.inf).argmax(axis=1))[some],
        (start + known.argmin(axis=1))[~known.all(axis=1)],
    ]
    indices: NDArray[np.intp] = np.unique(np.concatenate([[0, n - 1], *kept]))
    return indices[indices < n]


def as_csv(found: CurveSet) -> str:
    """Return all values of a set of curves as comma-separated text; unknown values are empty."""
    out = io.StringIO()
    table = csv.writer(out)
    heads = [f"{each.name} / {each.unit}" for each in found.curves]
    columns_of = (text for head in heads for text in (head, f"U (k=2) of {head}"))
    table.writerow([plain_text(text) for text in (found.label, *columns_of)])
    columns = [column for each in found.curves for column in (each.values, each.expanded)]
    for k, place in enumerate(found.places):
        first = plain_text(found.names[k]) if found.names else f"{place:.9g}"
        table.writerow([first, *(f"{column[k]:.6g}" if np.isfinite(column[k]) else "" for column in columns)])
    return out.getvalue()


def _abscissa(ds: xr.Dataset, dim: str) -> tuple[str, Array, tuple[str, ...]]:
    """Return label and places of a dimension, and their names if they have no scale."""
    if not dim:
        return "", np.zeros(1), (str(ds.attrs.get("component", "")),)
    if dim in _SCALES:
        inside, unit, name = _SCALES[dim]
        letter = str(ds.attrs.get("component", "")).lower()
        coordinate = letter if dim == "position" and letter in ds.coords else dim
        if coordinate in ds.coords and ds[coordinate].dims == (dim,):
            return f"{name} / {unit}", np.asarray(convert(ds[coordinate].values, inside, unit), dtype=float), ()
    size = ds.sizes[dim]
    if dim in ds.coords and ds[dim].dtype.kind in "iuf":
        if dim not in ("target", "beam"):
            places, unit = in_field_units(ds[dim])
            return (dim if unit == "1" else f"{dim} / {unit}"), places, ()
        return f"number of the {dim}", np.arange(size, dtype=float), tuple(f"{each:g}" for each in ds[dim].values)
    texts = ds[dim].values if dim in ds.coords else np.arange(size)
    return dim, np.arange(size, dtype=float), tuple(str(each) for each in texts)
