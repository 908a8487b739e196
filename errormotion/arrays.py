"""The type of arrays, and small functions on arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Array of float64; its shape and unit are stated in the docstrings of functions."""


def filled(values: Array) -> Array:
    """Return a copy with 0 for NaN."""
    values_filled: Array = np.where(np.isnan(values), 0.0, values)
    return values_filled


def products(influence: Array) -> Array:
    """Return the sums over sources of products of their effects: from (source, ..., d) to covariances (..., d, d).

    NaN counts as 0.
    """
    rows = np.array(np.moveaxis(influence, 0, -1), order="C")  # contiguous, for BLAS
    rows[np.isnan(rows)] = 0.0
    result: Array = np.matmul(rows, np.swapaxes(rows, -1, -2))
    return result
