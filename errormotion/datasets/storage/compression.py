"""Compression of the large variables of an error dataset; influences are rounded to 28 significant bits."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets.results.checks import error_violations
from errormotion.datasets.schemas import SCHEMA

MIN_COMPRESSED = 2**16
"""Smallest size of a compressed variable, bytes; below, chunks need the space that compression saves."""

MIN_ROUNDED = 2**20
"""Smallest size of a rounded influence, bytes."""

SIGNIFICANT_BITS = 28
"""Significant bits of a stored influence: a relative change of at most 2^-28, 4e-9."""

ROUNDED = "_QuantizeBitRoundNumberOfSignificantBits"
"""Attribute with the number of significant bits, after the convention of NetCDF."""

MAX_CHUNK = 2**17
"""Largest number of values of a chunk, which fits into the cache of HDF5."""

MIN_SERIES = 2**10
"""Smallest number of values of a chunk of one series; shorter series share chunks."""

_INFLUENCES = ("influence", "deviation_influence")


def as_stored(ds: xr.Dataset) -> xr.Dataset:
    """Return an error dataset as stored in a file: large influences are rounded to 28 significant bits.

    All other values, including the covariance, are unchanged. The influences of a long record are two thirds of its
    size, and their last digits are noise of the readings. Rounding changes the covariance between two positions by at
    most 8e-9 of the contribution of each source. The attribute `ROUNDED` states the rounding. Other datasets are
    returned unchanged, as is one whose covariance is hardly larger than that of its influences, so that rounding would
    make the independent covariance negative.
    """
    if ds.attrs.get("schema") != SCHEMA:
        return ds
    rounded = {}
    for name in _INFLUENCES:
        variable = ds.variables.get(name)
        if variable is not None and variable.dtype == np.float64 and variable.nbytes >= MIN_ROUNDED:
            kept = variable.copy(data=round_significand(np.asarray(variable.values)))
            kept.attrs = {**variable.attrs, ROUNDED: SIGNIFICANT_BITS}
            rounded[name] = kept
    stored = ds.assign(rounded)
    return ds if rounded and error_violations(stored) else stored


def encoding(ds: xr.Dataset) -> dict[Any, dict[str, Any]]:
    """Return the NetCDF encoding of the large variables of an error dataset: lossless, supported by all readers.

    Raw datasets are not compressed, since the compression of noise takes long and saves little.
    """
    if ds.attrs.get("schema") != SCHEMA:
        return {}
    large = {
        name: each for name, each in ds.variables.items() if each.dtype.kind in "fiu" and each.nbytes >= MIN_COMPRESSED
    }
    return {
        name: {"zlib": True, "complevel": 1, "shuffle": True, **_chunks(each, ds["EX"].dims)}
        for name, each in large.items()
    }


def _chunks(variable: xr.Variable, along: tuple[Any, ...]) -> dict[str, Any]:
    """Return chunks with one series over the dimensions of the errors each, whose neighbouring values are similar."""
    sizes = [size if dim in along else 1 for dim, size in variable.sizes.items()]
    for k in range(len(sizes)):
        sizes[k] = max(1, min(sizes[k], MAX_CHUNK * sizes[k] // math.prod(sizes)))
    return {"chunksizes": tuple(sizes)} if math.prod(sizes) >= MIN_SERIES else {}


def round_significand(values: Array) -> Array:
    """Return finite numbers with `SIGNIFICANT_BITS` bits of the significand, rounded half to even."""
    dropped = np.uint64(53 - SIGNIFICANT_BITS)  # a significand of 53 bits, the first of which is not stored
    bits = np.ascontiguousarray(values, dtype=np.float64).view(np.uint64)
    one = np.uint64(1)
    half = (one << (dropped - one)) - one + ((bits >> dropped) & one)
    rounded = ((bits + half) & ~((one << dropped) - one)).view(np.float64)
    return np.where(np.isfinite(values) & np.isfinite(rounded), rounded, values)
