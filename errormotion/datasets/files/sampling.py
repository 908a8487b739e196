"""Samples of large variables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import xarray as xr

SAMPLE = 100_000
"""Largest number of values of one variable in a check."""

_BLOCKS = 16


def sample(variable: xr.Variable, limit: int = SAMPLE) -> np.ndarray:
    """Return values distributed over a variable: all of a small one, else runs of neighbours from start to end.

    Runs are read instead of single values, since a stored array is read chunk by chunk.

    Parameters
    ----------
    variable : Variable
        May be lazy; only the returned values are read.
    limit : int
        Largest number of values.

    Returns
    -------
    ndarray, (n,)
    """
    if variable.size <= limit:
        return np.asarray(variable.values).ravel()
    return np.concatenate([np.asarray(variable[window].values).ravel() for window in _windows(variable.sizes, limit)])


def steps(variable: xr.Variable, limit: int = SAMPLE) -> Iterator[np.ndarray]:
    """Yield runs of neighbours of a one-dimensional variable, in order, for a check of its increments."""
    if variable.size <= limit:
        yield np.asarray(variable.values)
        return
    for window in _windows(variable.sizes, limit):
        yield np.asarray(variable[window].values)


def _windows(sizes: Mapping[str, int] | Mapping[object, int], limit: int) -> Iterator[dict[object, slice]]:
    """Yield blocks on the diagonal of an array, from its first corner to its last."""
    lengths: dict[object, int] = {}
    budget = float(max(limit // _BLOCKS, 1))
    by_size = sorted(sizes.items(), key=lambda item: item[1])
    for done, (dim, size) in enumerate(by_size):
        lengths[dim] = min(size, max(1, int(budget ** (1 / (len(by_size) - done)))))
        budget /= lengths[dim]
    for block in range(_BLOCKS):
        starts = {dim: round((size - lengths[dim]) * block / (_BLOCKS - 1)) for dim, size in sizes.items()}
        yield {dim: slice(start, start + lengths[dim]) for dim, start in starts.items()}
