"""The type of the arrays that the package computes with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Array of float64; its shape and unit stand in the docstring of the function that takes it."""

NORMAL_MAD = 1.4826
"""Standard deviation of normally distributed values over the median of their absolute deviations: 1 / ndtri(0.75).

`scipy.stats.median_abs_deviation` does not work in compiled loops, and takes 0.3 s to import.
"""


def filled(values: Array) -> Array:
    """Return a copy with 0 for NaN."""
    found: Array = np.where(np.isnan(values), 0.0, values)
    return found


def products(influence: Array) -> Array:
    """Return the sums over sources of products of their effects: (source, ..., d) gives covariances (..., d, d).

    NaN counts as 0.
    """
    rows = np.array(np.moveaxis(influence, 0, -1), order="C")  # contiguous, for BLAS
    rows[np.isnan(rows)] = 0.0
    found: Array = np.matmul(rows, np.swapaxes(rows, -1, -2))
    return found
