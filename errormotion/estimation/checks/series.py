"""Values in their order, such as time or runs: single ones that stand out from their neighbours, and a trend.

A value y_t with independent neighbours on a smooth curve has the difference

    d_t = y_t - (y_(t-1) + y_(t+1)) / 2,    var d = 3/2 s^2,

with the noise s. A spike of size a makes ``d = -a/2, a, -a/2``, a step -a/2, a/2, a turn of the curve a single one. A
spike is a value with an improbable d_t whose neighbours are about -d_t / 2. s follows from all d by their median, so
that spikes do not hide each other.

A trend of n values with independent scatter s is the slope of their line, with ``t = slope / u(slope)`` and n - 2
degrees of freedom.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr, stdtrit

from errormotion.arrays import Array
from errormotion.estimation.checks.resolution import step_of
from errormotion.estimation.robust import scale_about_zero

__all__ = ["Trend", "spikes", "trend"]

FALSE_ALARM = 1e-3
"""Probability of a spike in valid values."""
FEWEST = 12
"""Values from which their noise is known well enough."""
_EFFICIENCY = 0.37
"""Of the median of absolute values as an estimate of a standard deviation (Hampel, 1974): its degrees of freedom."""
FEWEST_OF_A_TREND = 4
SIGNIFICANT = 0.02
"""Probability of a trend of values without one."""


def spikes(values: Array, *, false_alarm: float = FALSE_ALARM) -> NDArray[np.bool_]:
    """Return which values (n,) stand out from both neighbours; one beside a missing value (NaN) has no two of them."""
    is_spike = np.zeros(values.shape, dtype=bool)
    if values.size < FEWEST:
        return is_spike
    d = values[1:-1] - (values[:-2] + values[2:]) / 2
    count = int(np.isfinite(d).sum())
    if count < FEWEST - 2:
        return is_spike
    # a value on the next mark of a coarse scale is no spike
    s = np.hypot(scale_about_zero(d) / np.sqrt(1.5), step_of(values) / 2)
    limit = -float(stdtrit(_EFFICIENCY * count, false_alarm / (2 * count))) * np.sqrt(1.5) * s
    beside = np.concatenate([[np.nan], d, [np.nan]])
    is_half = [~(np.abs(each + d / 2) > np.abs(d) / 4 + limit / 2) for each in (beside[:-2], beside[2:])]
    is_spike[1:-1] = (np.abs(d) > limit) & is_half[0] & is_half[1]
    return is_spike


@dataclass(frozen=True)
class Trend:
    """The line of values in their order.

    Attributes
    ----------
    range : float
        Change from the first to the last one.
    u : float
        Its standard uncertainty, from the scatter of the values about the line.
    probability : float
        Of a range of at least this size without a trend.
    """

    range: float
    u: float
    probability: float

    @property
    def significant(self) -> bool:
        """Whether there is a trend."""
        return self.probability < SIGNIFICANT


def trend(values: Array) -> Trend | None:
    """Return the trend of values (n,) with equal distances in their order; None if fewer than four are known."""
    t = np.flatnonzero(np.isfinite(values))
    if t.size < FEWEST_OF_A_TREND:
        return None
    y, x = values[t], t - t.mean()
    slope = float(x @ y / (x @ x))
    rest = y - y.mean() - slope * x
    extent, freedom = float(np.ptp(t)), t.size - 2
    u = extent * float(np.sqrt(rest @ rest / freedom / (x @ x)))
    size = slope * extent
    if not u > 0:
        return Trend(size, u, 0.0 if size else 1.0)
    return Trend(size, u, float(2 * stdtr(freedom, -abs(size) / u)))
