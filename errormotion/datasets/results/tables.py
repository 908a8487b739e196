"""Error datasets as tables in field units, behind ``ds.em.to_dataframe()``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets.schemas import DOF
from errormotion.datasets.units import convert
from errormotion.errors import DatasetError

if TYPE_CHECKING:
    import pandas as pd

_FIELD = {"m": "um", "rad": "arcsec"}
_COORDINATES = {"s": "min", "m": "mm", "rad": "deg"}


def to_dataframe(ds: xr.Dataset, freedoms: str | Sequence[str] | None = None, k: float = 2.0) -> pd.DataFrame:
    """Return the errors and their expanded uncertainties as a table with one row for each place.

    Parameters
    ----------
    ds : Dataset
        Error dataset.
    freedoms : str or sequence of str, optional
        Names such as ``EX``, or those of ISO 230-1; default: all.
    k : float
        Coverage factor of the uncertainties.

    Returns
    -------
    DataFrame
        Columns with their unit in the name: the coordinates of the errors (min, mm, deg, degC), then each freedom and
        its uncertainty (um, arcsec), such as ``EXC / um`` and ``U(EXC) / um``. NaN where unknown. ``attrs`` contains
        machine, component, method, functional point (m) and k.

    Raises
    ------
    DatasetError
        No such freedom.
    """
    dims, names = ds.em.dims, chosen(ds, freedoms)
    sizes = {dim: ds.sizes[dim] for dim in dims}
    own = ds.em.iso_names()
    columns: dict[str, Array] = {}
    for name in [*(dim for dim in dims if dim in ds.coords), *(str(each) for each in ds.coords if each not in dims)]:
        columns |= _columns(ds[name], name, sizes)
    for dim in dims:  # labels of targets are coordinates; without labels, their numbers
        if not any(ds[name].dims == (dim,) for name in ds.coords):
            columns[f"number of {dim}"] = _spread(xr.Variable((dim,), np.arange(1, sizes[dim] + 1)), sizes)
    U = float(k) * ds.em.expanded(k=1)
    for name in names:
        inside = "rad" if name in DOF[3:] else "m"
        unit = _FIELD[inside]
        columns[f"{own[name]} / {unit}"] = np.asarray(convert(_spread(ds[name].variable, sizes), inside, unit))
        spread = _spread(U.sel(dof=name, drop=True).variable, sizes)
        columns[f"U({own[name]}) / {unit}"] = np.asarray(convert(spread, inside, unit))
    import pandas as pd

    table = pd.DataFrame(columns)
    table.attrs = {name: str(ds.attrs[name]) for name in ("machine", "component", "method", "reference")}
    table.attrs |= {"functional_point": np.asarray(ds.attrs["functional_point"], float).tolist(), "k": float(k)}
    return table


def chosen(ds: xr.Dataset, freedoms: str | Sequence[str] | None) -> list[str]:
    """Return the names of chosen freedoms, each once; names of ISO 230-1 are accepted.

    Raises
    ------
    DatasetError
        An unknown name, or none.
    """
    own: dict[str, str] = ds.em.iso_names()
    if freedoms is None:
        return list(own)
    by_name = {**{iso.upper(): name for name, iso in own.items()}, **{name.upper(): name for name in own}}
    asked = [freedoms] if isinstance(freedoms, str) else list(freedoms)
    unknown = [str(name) for name in asked if str(name).upper() not in by_name]
    if unknown or not asked:
        shown = list(own) if list(own) == list(own.values()) else [*own, *own.values()]
        raise DatasetError(
            f"Expected freedoms of {', '.join(shown)}; found {', '.join(unknown) or 'none'}",
            code="errors.freedoms.unknown",
        )
    return list(dict.fromkeys(by_name[str(name).upper()] for name in asked))


def _columns(coordinate: xr.DataArray, name: str, sizes: dict[str, int]) -> dict[str, Array]:
    """Return the columns of a coordinate of the errors: one for each sensor of temperatures; none for others."""
    spare = [dim for dim in coordinate.dims if dim not in sizes]
    if not coordinate.dims or len(spare) == len(coordinate.dims) or len(spare) > 1:
        return {}
    if spare:
        (dim,) = spare
        labels = coordinate[dim].values if dim in coordinate.coords else np.arange(1, coordinate.sizes[dim] + 1)
        each = {f"{name} {label}": coordinate.isel({dim: number}, drop=True) for number, label in enumerate(labels)}
        return {key: found for label, part in each.items() for key, found in _columns(part, label, sizes).items()}
    values = _spread(coordinate.variable, sizes)
    if coordinate.dtype.kind not in "iuf":
        return {name: values}
    default = {"time": "s", "x": "m", "y": "m", "z": "m", "position": "m"}.get(name, "")
    inside = str(coordinate.attrs.get("units", default))
    unit = _COORDINATES.get(inside, inside)
    if unit in ("", "1"):
        return {name: values}
    shown = f"({unit})" if "/" in unit else unit
    return {f"{name} / {shown}": np.asarray(convert(values.astype(float), inside, unit) if unit != inside else values)}


def _spread(variable: xr.Variable, sizes: dict[str, int]) -> Array:
    """Return the values at all places in the order of the dims, repeated along dims that the variable does not have."""
    spread = variable.set_dims(sizes)  # type: ignore[no-untyped-call]
    return np.asarray(spread.transpose(*sizes).values).ravel()
