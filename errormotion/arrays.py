"""The type of the arrays that the package computes with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Array of float64; its shape and unit stand in the docstring of the function that takes it."""


def products(influence: Array) -> Array:
    """Return the sums over sources of products of their effects: (source, ..., d) gives covariances (..., d, d).

    NaN counts as 0.
    """
    rows = np.nan_to_num(np.moveaxis(influence, 0, -1))  # a contiguous copy, for BLAS
    if not rows.shape[-1]:
        return np.zeros((*rows.shape[:-1], rows.shape[-2]))
    rows = np.ascontiguousarray(rows)
    found: Array = np.matmul(rows, np.swapaxes(rows, -1, -2))
    return found
