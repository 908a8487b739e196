"""Error datasets of very many targets: built and checked block by block, since a check needs several copies."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets import build_errors

if TYPE_CHECKING:
    from collections.abc import Mapping

    Array = Array

BLOCK = 50_000
"""Targets that are checked at a time."""


def build(
    values: Array, covariance: Array, influence: Array, coords: Mapping[str, Any], extras: Mapping[str, xr.DataArray],
    **told: Any,
) -> xr.Dataset:  # fmt: skip
    """Return the error dataset over ``target``; see `errormotion.datasets.build_errors`.

    Parameters
    ----------
    values, covariance, influence : ndarray (m, 6), (m, 6, 6), (source, m, 6)
        Become part of the dataset where there are many; unknown ones are set NaN in place.
    coords : mapping
        Name to (dims, array, attrs).
    extras : mapping of str to DataArray
    **told
        The rest of what `build_errors` is told.

    Raises
    ------
    DatasetError
        Any violation of the schema.
    """
    m = len(values)
    if m <= BLOCK:
        return build_errors(
            values, covariance, influence=influence, dims=("target",), coords=coords, extras=extras, **told
        )
    pieces: list[xr.Dataset] = []
    for begin in range(0, m, BLOCK):
        part = slice(begin, min(begin + BLOCK, m))
        piece = build_errors(
            values[part], covariance[part], influence=influence[:, part], dims=("target",),
            coords={name: (dims, array[part] if "target" in dims else array, attrs)
                    for name, (dims, array, attrs) in coords.items()},
            extras={name: array.isel(target=part) if "target" in array.dims else array
                    for name, array in extras.items()} if not pieces else None,
            **told,
        )  # fmt: skip
        covariance[part] = piece["covariance"].values
        influence[:, part] = piece["influence"].values
        pieces = pieces or [piece]
    first = pieces[0]
    whole: dict[str, Any] = {"covariance": covariance, "influence": influence}
    whole |= {name: values[:, k] for k, name in enumerate(first["dof"].values)}
    variables = {name: (first[name].dims, array, first[name].attrs) for name, array in whole.items()}
    own = {name: first.coords[name] for name in first.coords if "target" not in first[name].dims}
    places = {
        name: (first[name].dims, array, first[name].attrs)
        for name, (dims, array, _) in coords.items() if "target" in dims
    }  # fmt: skip
    return xr.Dataset(variables, {**own, **places}, first.attrs).assign(dict(extras))
