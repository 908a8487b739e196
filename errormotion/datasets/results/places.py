"""Places of errors in field units: the scale along a dimension, and places as text.

Times are in min or s, positions in mm, places of an angle in degrees.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets.schemas import ERROR_DIMS
from errormotion.datasets.units import convert

MAX_LABEL = 24
"""Characters of a text of a scale."""

_DEFAULT = {"time": "s", "position": "m", **dict.fromkeys("xyz", "m"), **dict.fromkeys("abc", "rad")}
"""SI unit of a coordinate that states none."""
_LONG = 120.0
"""Record from which on times are in min, s."""


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
    name = coordinate_of(ds, dim)
    if name in ds.coords and ds[name].dims == (dim,):
        coordinate = ds[name]
        if coordinate.dtype.kind in "UO":
            return Scale(numbers, dim, [short(text) for text in coordinate.values], joined=False)
        if dim in ("time", "position") or dim not in ERROR_DIMS:
            values, unit = in_field_units(coordinate)
            shown = {"position": f"{name} position"}.get(dim, dim) if name != dim else dim
            return Scale(values, shown if unit == "1" else f"{shown} / {unit}", [], joined=True)
        if np.unique(coordinate.values).size == coordinate.size:  # numbers as names of targets
            return Scale(numbers, dim, [f"{value:g}" for value in coordinate.values], joined=False)
    return Scale(numbers, f"{dim} number", [], joined=dim in ("time", "position"))


def coordinate_of(ds: xr.Dataset, dim: str) -> str:
    """Return the name of the coordinate along a dim: for positions that of the axis, if there is one."""
    letter = str(ds.attrs.get("component", "")).lower()
    if dim != "position":
        return dim
    if letter in ds.coords and ds[letter].dims == (dim,):
        return letter
    own = [axis for axis in "xyzabcuvw" if axis in ds.coords and ds[axis].dims == (dim,)]
    return own[0] if len(own) == 1 else dim


def in_field_units(coordinate: xr.DataArray) -> tuple[Array, str]:
    """Return the values of a coordinate in its field unit, and this unit: min or s, mm, deg, else as it is."""
    default = _DEFAULT.get(str(coordinate.name), "1")
    inside = str(coordinate.attrs.get("units", default))
    values = np.asarray(coordinate.values, dtype=float)
    span = float(np.ptp(values)) if values.size else 0.0
    unit = {"s": "min" if span > _LONG else "s", "m": "mm", "rad": "deg"}.get(inside, inside)
    return (values if unit == inside else np.asarray(convert(values, inside, unit), dtype=float)), unit


def place_of(ds: xr.Dataset, dims: Sequence[str], index: Sequence[Any]) -> str:
    """Return a place as text, such as ``angle 15 deg, sphere 2``; a dim of one value is omitted.

    Parameters
    ----------
    ds : Dataset
        Contains the coordinates.
    dims : sequence of str
    index : sequence of int
        Along each dim.
    """
    parts = []
    for dim, i in zip(dims, index, strict=True):
        if ds.sizes[dim] == 1:
            continue
        name = coordinate_of(ds, dim)
        if name not in ds.coords or ds[name].dims != (dim,):
            parts.append(f"{dim} {i + 1}")
        elif ds[name].dtype.kind == "f" and (dim in ("time", "position") or dim not in ERROR_DIMS):
            values, unit = in_field_units(ds[name])
            parts.append(f"{name} {values[i]:.6g} {unit}".removesuffix(" 1"))
        else:
            parts.append(f"{name} {ds[name].values[i]}")
    return ", ".join(parts)


def short(text: object) -> str:
    """Return a text that is short enough for a drawing."""
    words = " ".join(str(text).split())
    return words if len(words) <= MAX_LABEL else words[: MAX_LABEL - 3] + "..."
