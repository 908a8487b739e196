"""Periodic parts of readings that sampling turns into slow ones: the run-out of a spindle, its harmonics, the mains.

A wave of the frequency f, sampled at the rate r, has the same samples as one of the frequency |f - r n|, n = f / r
rounded. A mean over m samples leaves the share

    |sin(pi m f / r) / (m sin(pi f / r))|

of its amplitude, which is 1 at multiples of the rate: a slow wave, or for samples taken once a turn an offset that does
not change. Frequencies are never exact, and the share is the largest one within their spread.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from errormotion.arrays import Array

__all__ = ["Alias", "aliases", "share_left"]

LEFT = 0.05
"""Share of an amplitude from which a mean is said to contain the wave."""
ORDERS = 2
"""Harmonics of a turn: eccentricity, and an oval."""
SPREAD = 1e-3
"""Relative deviation of a speed from the stated one."""


@dataclass(frozen=True)
class Alias:
    """A wave that means of samples contain.

    Attributes
    ----------
    order : int
        Harmonic of the frequency.
    frequency : float
        Of the wave that the samples show, Hz.
    share : float
        Part of its amplitude in a mean.
    """

    order: int
    frequency: float
    share: float


def share_left(frequency: ArrayLike, rate: float, count: int) -> Array:
    """Return the share of the amplitude of a wave, Hz, that a mean over ``count`` samples of a rate, Hz, leaves."""
    x = np.pi * np.mod(np.asarray(frequency, dtype=float) / rate + 0.5, 1.0) - np.pi / 2
    small = np.abs(np.sin(x)) < 1e-9
    return np.where(small, 1.0, np.abs(np.sin(count * x)) / (count * np.where(small, 1.0, np.abs(np.sin(x)))))


def aliases(
    frequency: float, rate: float, count: int, *, orders: int = ORDERS, spread: float = SPREAD, left: float = LEFT
) -> list[Alias]:
    """Return the harmonics of a frequency (Hz) that means over ``count`` samples of a rate (Hz) contain."""
    result = []
    for order in range(1, orders + 1):
        f = order * frequency
        # half a lobe of the share is rate / (2 count) wide
        points = int(np.clip(np.ceil(8 * spread * f * count / rate), 1, 10_000))
        near = f * (1 + spread * np.linspace(-1.0, 1.0, 2 * points + 1))
        if np.floor(near[-1] / rate) > np.floor(near[0] / rate):  # a multiple of the rate between two of them
            near = np.append(near, rate * np.floor(near[-1] / rate))
        share = float(share_left(near, rate, count).max())
        if share > left:
            result.append(Alias(order, abs(f - rate * round(f / rate)), share))
    return result
