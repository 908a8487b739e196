"""Targets that their readings hardly determine: excluded, since each would affect the datum of all.

A target with three readings and its three stations nearly in one plane can move out of that plane by a millimetre
before its distances change by a micrometre. Such a target does not determine the stations.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array
from errormotion.methods.multilateration.network.model import Stations, directions
from errormotion.methods.multilateration.network.start import initial_stations

_SAMPLE = 1000

if TYPE_CHECKING:
    from numpy.typing import NDArray

WEAK = 10.0
"""So many times as uncertain as the middle one, the stations known. Of m targets one of sqrt(m) times is harmless to
the datum, so that the limit is half of this where it is larger."""


def weak_targets(displacement: Array, nominal: Array, station: Array | None, noise: Array) -> NDArray[np.bool_]:
    """Return which targets (m,) to leave out: those with three readings or more that hardly fix them.

    Parameters
    ----------
    displacement, noise : ndarray (n, m)
        m; NaN where there is no reading.
    nominal : ndarray (m, 3)
        m.
    station : ndarray (n, 3) or None
        Rough places, m; without them they are reckoned from the nominal targets.
    """
    known = np.isfinite(displacement)
    weight = np.where(known, 1 / noise, 0.0)
    fixed = np.count_nonzero(known, axis=0) >= 3
    if not fixed.any():
        return np.zeros(len(nominal), dtype=bool)
    place = initial_stations(np.nan_to_num(displacement), weight, nominal, station).place
    e = directions(nominal, Stations(place, np.zeros(len(place)), np.zeros(0)))
    information = np.einsum("jt,jta,jtb->tab", weight**2, e, e)
    values = np.linalg.eigvalsh(information)
    with np.errstate(divide="ignore"):
        u = np.sqrt((1 / np.maximum(values, 0.0)).sum(axis=1))
    return np.asarray(fixed & ~(u <= _limit(len(nominal)) * float(np.median(u[fixed]))), dtype=bool)


def carriers(openness: Array) -> NDArray[np.bool_]:
    """Return which targets (m,) may carry the datum, by the traces (m,) of their covariances, m^2, the stations known.

    Infinite where a target has no place. The middle one is that of an even choice where there are many.
    """
    return np.asarray(openness <= _limit(len(openness)) ** 2 * _middle(openness, max(1, len(openness) // _SAMPLE)))


def _middle(openness: Array, every: int) -> float:
    """Return the median of every so many-th value, of all where none of these is finite; 0 where none is."""
    for some in (openness[::every], openness):
        known = some[some < np.inf]
        if len(known):
            return float(np.median(known))
    return 0.0


def _limit(targets: int) -> float:
    return float(max(WEAK, 0.5 * np.sqrt(targets)))
