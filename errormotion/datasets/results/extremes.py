"""Extreme values of noisy curves: their mean excess by noise, and their uncertainty.

The largest of noisy values is too large on average, and the range of a curve at rest is that of its noise. Standards do
not correct for this ``bias``. It is estimated from the measured curve (SIMEX: Cook, Stefanski, J. Am. Stat. Assoc. 89
(1994) 1314): noise of the same size is added once more, which increases a figure by d on average. The bias of a curve
that is flat about its extremes is proportional to the standard deviation of the noise, so that it is
``d / (sqrt(2) - 1)``; that of a curve with pointed extremes is proportional to the variance, so that it is d. The first
is stated. Half of it is added to the standard deviation of the figure under noise as its standard uncertainty (root sum
of squares).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from errormotion.arrays import Array

SEED = 230
DRAWS = 300
BIAS_UNCERTAINTY = 0.5
"""Standard uncertainty of a bias, relative to it."""
FLAT = 1.0 / (np.sqrt(2.0) - 1.0)
"""Ratio of the bias of a figure to its change by additional noise of the same size, for flat curves."""
_VALUES = 1_000_000
"""Largest number of simulated values; fewer draws are made for longer curves."""
_FEWEST = 100


@dataclass(frozen=True)
class Extremes:
    """Figures that are extreme values, or one of them; NaN = unknown.

    Attributes
    ----------
    value : ndarray
        Of the measured curve.
    bias : ndarray
        Typical excess over the true figure.
    u : ndarray
        Standard uncertainty of ``value - bias``.
    """

    value: Array
    bias: Array
    u: Array


def expanded(bias: Array | float, u: Array | float) -> Array:
    """Return the expanded uncertainty (k = 2) of a value that is not corrected for its bias (JCGM 100, F.2.4.5)."""
    return np.asarray(2.0 * np.asarray(u) + np.abs(bias))


def by_added_noise(figures: Callable[[Array], Array], values: Array, half: Array) -> Extremes:
    """Return figures of measured values with their bias and uncertainty, by noise that is added once more.

    Parameters
    ----------
    figures : callable
        From values (..., *shape) to figures (...) or (..., figure).
    values : ndarray
        Measured.
    half : ndarray, (draw, *shape)
        Draws of the noise; they are used with both signs, so that they cause no bias.
    """
    first = figures(values)
    again = figures(values + np.concatenate([half, -half]))
    bias = FLAT * (again.mean(axis=0) - first)
    return Extremes(first, bias, np.hypot(again.std(axis=0, ddof=1), BIAS_UNCERTAINTY * bias))


def range_from_reference(values: Array, variance: Array, shared: Array) -> Extremes:
    """Return the range of a curve and of its reference state, whose value is 0 by definition.

    Parameters
    ----------
    values, variance : ndarray, (n,)
        Values and the variance that is independent from value to value.
    shared : ndarray, (source, n)
        Effect of one standard uncertainty of each source that the values share.
    """
    draw = np.random.default_rng(SEED).standard_normal
    count = int(np.clip(_VALUES // max(values.size, 1), _FEWEST, DRAWS)) // 2
    half = np.sqrt(variance) * draw((count, values.size)) + draw((count, len(shared))) @ shared
    return by_added_noise(_range, values, half)


def _range(values: Array) -> Array:
    return np.asarray(np.maximum(values.max(axis=-1), 0.0) - np.minimum(values.min(axis=-1), 0.0))
