"""Encoder counts that overflow."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from errormotion.arrays import Array

OVERFLOW = 2.0**32
"""Counts after which an encoder starts again from zero."""


def unwrapped(counts: ArrayLike, middle: float) -> Array:
    """Return encoder counts corrected by whole overflows to be nearest to the count in the middle of the axis."""
    counts = np.asarray(counts, dtype=float)
    return np.asarray(counts - OVERFLOW * np.rint((counts - middle) / OVERFLOW))
