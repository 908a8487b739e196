"""A shift in time between two datasets: its effect, from the smoothed errors of one of them, and its size.

If the errors of the first dataset are E(t) and the clock of the second one is late by s, the second one states
E(t - s), and the difference of the changes since the first common time is ``E(t) - E(t - s)`` minus its value at this
time. E(t) is a smoothing spline over all times of a dataset, also those before and after the common ones; its residuals
are as large as the noise. Beyond the record it is constant. The effect is not linear in s: several sizes are tested,
and the best one is refined by the Gauss-Newton method.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import xarray as xr
from scipy.interpolate import BSpline, splrep

from errormotion.arrays import Array, products
from errormotion.datasets.results.reduction import influence_of
from errormotion.estimation.low_rank import Whitener
from errormotion.kinematics.iso import DOF

MIN_SHIFT = 1.0
"""Smallest shift that is tested, s."""
TRIES = 16
"""Number of shifts of each sign that are tested, up to a quarter of the common time."""
REFINEMENTS = 12


class Shift(NamedTuple):
    """Shift of the second dataset with its standard uncertainty, s, and the decrease of the sum of squares."""

    value: float
    standard_uncertainty: float
    gain: float


@dataclass(frozen=True)
class SmoothCurves:
    """Smoothed errors of one dataset over the common time axis, one curve for each freedom.

    Attributes
    ----------
    curves : tuple of BSpline
    first, last : float
        First and last time of the record, s.
    instants : int
        Number of times of the record.
    """

    curves: tuple[BSpline, ...]
    first: float
    last: float
    instants: int

    def __call__(self, time: Array) -> Array:
        """Return the errors at times, (n, d)."""
        inside = np.clip(time, self.first, self.last)
        return np.stack([np.asarray(curve(inside), dtype=float) for curve in self.curves], axis=-1)

    def effect(self, time: Array, shift: float, sign: float) -> Array:
        """Return the difference of the changes for a shift of the second dataset; sign -1: the curves are its own."""
        effect = sign * (self(time) - self(time - sign * shift))
        changed: Array = effect - effect[0]
        return changed


def smooth(time: Array, values: Array, u: Array) -> SmoothCurves | None:
    """Return smoothed values (n, d) with standard uncertainties (n, d); None if too few are known."""
    curves = []
    for y, sigma in zip(values.T, u.T, strict=True):
        known = np.isfinite(y) & np.isfinite(sigma)
        if known.sum() < 4:
            return None
        least = max(float(sigma[known].max()), 1e-6 * float(np.ptp(y[known])), np.finfo(float).tiny)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a curve that is less smooth than requested is acceptable
            weights = 1 / np.maximum(sigma[known], 1e-3 * least)
            t, c, k = splrep(time[known], y[known], w=weights, s=float(known.sum()))
        curves.append(BSpline(t, c, k, extrapolate=True))
    return SmoothCurves(tuple(curves), float(time[0]), float(time[-1]), len(time))


def curves_of(ds: xr.Dataset, freedoms: Sequence[str]) -> SmoothCurves | None:
    """Return the smoothed errors of a dataset over time."""
    columns = [DOF.index(name) for name in freedoms]
    own = np.asarray(ds["covariance"].values, dtype=float) - products(influence_of(ds))
    u = np.sqrt(np.maximum(np.diagonal(own, axis1=1, axis2=2), 0.0))
    values = np.stack([ds[name].values for name in freedoms], axis=-1)
    return smooth(np.asarray(ds["time"].values, dtype=float), values, u[:, columns])


def fitted(curves: SmoothCurves, sign: float, time: Array, difference: Array, white: Whitener) -> Shift | None:
    """Return the shift that explains a difference (n, d) best; None if the errors do not change.

    Parameters
    ----------
    curves : SmoothCurves
    sign : float
        1: the smoothed errors are those of the first dataset of the pair; -1: of the second one.
    time : ndarray, (n,)
        Times, s.
    difference : ndarray, (n, d)
        First minus second dataset; NaN if unknown.
    white : Whitener
        Whitener of its covariance.
    """
    known = np.isfinite(difference)

    def effect(shift: float) -> Array:
        return np.where(known, curves.effect(time, shift, sign), 0.0)

    sizes = np.geomspace(MIN_SHIFT, max(float(np.ptp(time)) / 4, 2 * MIN_SHIFT), TRIES)
    tries = np.concatenate([-sizes[::-1], sizes])
    squares = [white.square(difference - effect(shift)) for shift in tries]
    best = int(np.argmin(squares))
    shift, least = float(tries[best]), squares[best]
    information = 0.0
    for _ in range(REFINEMENTS):
        step = max(MIN_SHIFT, 0.02 * abs(shift))
        slope = (effect(shift + step) - effect(shift - step)) / (2 * step)
        normal, gradient = white.normal(slope[None], difference - effect(shift))
        information = float(normal[0, 0])
        if not information > 0:
            return None
        move = float(gradient[0]) / information
        while abs(move) > 0.01 / np.sqrt(information):
            square = white.square(difference - effect(shift + move))
            if square < least:
                break
            move /= 2
        else:
            break
        shift, least = shift + move, square
    return Shift(shift, float(1 / np.sqrt(information)), white.square(difference) - least)
