"""Scales of values with outliers, by the median of absolute values (MAD; Hampel, J. Am. Stat. Assoc. 69 (1974) 383).

Up to half of the values may be outliers. For few values the scale is too small: for five normal ones by a fifth on
average (Croux and Rousseeuw, Computational Statistics 1 (1992) 411).
"""

from __future__ import annotations

import numpy as np

from errormotion.arrays import Array

NORMAL_MAD = 1.4826
"""Standard deviation of normally distributed values over the median of their absolute deviations: 1 / ndtri(0.75)."""


def scale_about_zero(values: Array) -> float:
    """Return the robust standard deviation of residuals of any shape; NaN is unknown, and the result without values."""
    return _scale(values[~np.isnan(values)])


def scale_about_median(values: Array) -> float:
    """Return the robust standard deviation of values of any shape about their median; NaN as in `scale_about_zero`."""
    known = values[~np.isnan(values)]
    return _scale(known - np.median(known)) if known.size else float("nan")


def _scale(known: Array) -> float:
    return NORMAL_MAD * float(np.median(np.abs(known))) if known.size else float("nan")
