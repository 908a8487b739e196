"""Choice of the places at which trials are stored, so that the memory does not grow with the length of a record."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

PLACES = 200
"""Largest number of places; of a longer result, evenly spaced places including the ends are used."""


def chosen_places(errors: xr.Dataset) -> tuple[NDArray[np.intp], dict[str, NDArray[np.intp]]]:
    """Return the rows of the chosen places among the stacked places, and their indices along each dimension.

    The longest dimensions are reduced first; the chosen places form a grid.
    """
    dims = [str(dim) for dim in errors.em.dims]
    count = {dim: errors.sizes[dim] for dim in dims}
    while np.prod(list(count.values()), dtype=np.int64) > PLACES:
        longest = max(count, key=count.__getitem__)
        others = int(np.prod([n for dim, n in count.items() if dim != longest], dtype=np.int64))
        count[longest] = max(min(count[longest] - 1, PLACES // others), 1)
    where = {
        dim: np.unique(np.linspace(0, errors.sizes[dim] - 1, n).round().astype(np.intp)) for dim, n in count.items()
    }
    rows = np.arange(int(np.prod([errors.sizes[dim] for dim in dims], dtype=np.int64)))
    grid = rows.reshape([errors.sizes[dim] for dim in dims])
    return np.asarray(grid[np.ix_(*where.values())].ravel() if dims else rows, dtype=np.intp), where
