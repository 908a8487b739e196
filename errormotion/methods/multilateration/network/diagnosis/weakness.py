"""Weakly determined targets: excluded, since each would affect the datum of all.

If a target has three readings and is nearly in one plane with the three stations, a displacement of a millimetre out of
that plane changes its distances by only a micrometre. Such a target does not determine the stations.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array
from errormotion.methods.multilateration.network.diagnosis.determinacy import refuse_not_finite
from errormotion.methods.multilateration.network.model import directions
from errormotion.methods.multilateration.network.start import initial_stations

FLAT = 1e-10
"""Determinant of the products of a target's directions, over the cube of their trace, without a position."""
_SAMPLE = 1000

if TYPE_CHECKING:
    from numpy.typing import NDArray

WEAK = 10.0
"""Uncertainty of a weakly determined target over the median one, with the stations known. Of m targets, one with the
ratio sqrt(m) does not harm the datum: the limit is half of this if that is larger."""


def weak_targets(displacement: Array, nominal: Array, station: Array | None, noise: Array) -> NDArray[np.bool_]:
    """Return which targets (m,) are weakly determined by three readings or more.

    Parameters
    ----------
    displacement, noise : ndarray (n, m)
        m; NaN where there is no reading.
    nominal : ndarray (m, 3)
        m.
    station : ndarray (n, 3) or None
        Approximate positions, m; default: calculated from the distances of the nominal targets.
    """
    known = np.isfinite(displacement)
    weight = np.where(known, 1 / noise, 0.0)
    fixed = np.count_nonzero(known, axis=0) >= 3
    if not fixed.any():
        return np.zeros(len(nominal), dtype=bool)
    position = initial_stations(np.nan_to_num(displacement), weight, nominal, station).position
    e = directions(nominal, position)
    information = np.einsum("jt,jta,jtb->tab", weight**2, e, e)
    values = np.linalg.eigvalsh(information)
    with np.errstate(divide="ignore"):
        u = np.sqrt((1 / np.maximum(values, 0.0)).sum(axis=1))
    return np.asarray(fixed & ~(u <= _limit(len(nominal)) * float(np.median(u[fixed]))), dtype=bool)


def unlocated(reading: Array, sd: Array, target: Array, position: Array) -> NDArray[np.bool_]:
    """Return which targets (m,) have fewer than three readings (n, m), or lie in one plane with their stations."""
    known = np.isfinite(reading)
    few = known.sum(axis=0) < 3
    with np.errstate(all="ignore"):
        E = np.where(known, 1.0 / sd, 0.0)[:, :, None] * directions(target, position)
        A = np.einsum("jta,jtb->tab", E, E)
    refuse_not_finite(A[~few])
    A[few] = np.eye(3)
    pivots = np.linalg.det(A) / np.trace(A, axis1=1, axis2=2) ** 3
    return np.asarray(few | ~(pivots > FLAT))


def datum_targets(traces: Array) -> NDArray[np.bool_]:
    """Return which targets (m,) define the datum, by the traces (m,) of their covariances with known stations, m^2.

    A trace is infinite if a target has no position. If there are many targets, the median is that of a sample.
    """
    return np.asarray(traces <= _limit(len(traces)) ** 2 * _middle(traces, max(1, len(traces) // _SAMPLE)))


def _middle(traces: Array, every: int) -> float:
    """Return the median of every ``every``-th value, of all if none of these is finite, or 0 if none is."""
    for some in (traces[::every], traces):
        known = some[some < np.inf]
        if len(known):
            return float(np.median(known))
    return 0.0


def _limit(targets: int) -> float:
    return float(max(WEAK, 0.5 * np.sqrt(targets)))
