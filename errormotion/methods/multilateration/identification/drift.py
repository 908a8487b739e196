"""Drift of a set-up and repeatability of the machine, from positions that are visited again.

During one set-up the machine moves slowly relative to the tracker, and the tracker's dead path changes. A reading at
time t is then longer than one at the middle of the set-up by

    (t - t_j) (c_j + e_ij . v_j)

with the rate c_j of the dead path and the velocity v_j of the machine. Two visits of a position show it; the rest of
their difference is noise and repeatability. A rigid drift from one set-up to the next needs no correction: the position
of the station contains it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtri, fdtri

from errormotion.arrays import Array
from errormotion.methods.multilateration.identification.expansion import Shared

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

SAME_POSITION = 1e-9
"""Commanded positions closer than this are one, m."""
FALSE_ALARM = 1e-3
"""Probability of a note on returns that scatter as stated."""
DRIFT_SIGNIFICANCE = 0.01
"""Probability of a correction for a set-up that does not drift."""
_LARGEST_CONDITION = 1e4
"""Of terms of the drift that are estimated together."""


@dataclass(frozen=True)
class Drift:
    """Drift of every set-up.

    Attributes
    ----------
    rate : ndarray (station, 4)
        Dead path, then X, Y, Z of the machine relative to the tracker, m/s; 0 where the returns need none, NaN where
        there are no returns.
    correction : ndarray (station, target)
        To be taken off the readings, m.
    sources : list of Shared
        Its uncertainty.
    repeatability : float
        Scatter of the returns without that of the readings' noise, standard deviation of one coordinate, m; NaN
        without returns.
    pairs : int
        Visits after the first one of each position.
    square, freedom : float, int
        Sum of squares of the residuals of the returns over the noise, and its degrees of freedom.
    """

    rate: Array
    correction: Array
    sources: list[Shared]
    repeatability: float
    pairs: int
    square: float = 0.0
    freedom: int = 0


def positions(nominal: Array) -> NDArray[np.intp]:
    """Return for every target the number of its position, (m,); targets commanded to one position share a number."""
    keys = np.round(nominal / SAME_POSITION).astype(np.int64)
    return np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)


def estimate_drift(
    displacement: Array, time: Array, position: NDArray[np.intp], e: Array, noise: Array, names: Sequence[str],
    notes: list[str], *, certain: bool = True,
) -> Drift:  # fmt: skip
    """Return the drift from the returns.

    Each set-up gets no rate, one of its dead path, or one of its dead path and three of the machine: the model whose
    improvement is significant (``DRIFT_SIGNIFICANCE``).

    Parameters
    ----------
    displacement, time : ndarray (n, m)
        m and s; NaN where there is no reading.
    position : ndarray (m,)
        From `positions`.
    e : ndarray (n, m, 3)
        Unit vectors from the stations to the targets.
    noise : ndarray (n, m)
        Standard deviation of each reading, repeatability included where it is stated, m.
    names : sequence of str
        Of the stations.
    notes : list of str
        Added to.
    certain : bool
        The noise is used unless the returns contradict it; otherwise their scatter is used where it is larger.
    """
    n, m = displacement.shape
    rate, correction = np.full((n, 4), np.nan), np.zeros((n, m))
    sources: list[Shared] = []
    returns: dict[int, tuple[Array, Array, Array]] = {}
    for j in range(n):
        known = np.isfinite(displacement[j]) & np.isfinite(time[j])
        groups = _visits(position, known)
        if not groups:
            continue
        middle = float(np.mean(time[j, known]))
        since = np.where(known, time[j] - middle, 0.0)
        terms = np.concatenate([np.ones((m, 1)), e[j]], axis=1) * since[:, None]
        returns[j] = (terms, *_within(groups, displacement[j], terms, noise[j]))
    scatter = _scatter([(d, A) for _, d, A in returns.values()])
    if certain and scatter[0] * scatter[1] <= chdtri(max(scatter[1], 1), FALSE_ALARM):
        scatter = (1.0, 0)
    square, freedom, pairs = 0.0, 0, 0
    for j, (terms, d, A) in returns.items():
        pairs += len(d)
        order = _order(d, A, scatter)
        rate[j] = 0.0
        left = d
        if order:
            solution, *_ = np.linalg.lstsq(A[:, :order], d)
            C = scatter[0] * np.asarray(np.linalg.inv(A[:, :order].T @ A[:, :order]), dtype=float)
            rate[j, :order] = solution
            correction[j] = terms[:, :order] @ solution
            left = d - A[:, :order] @ solution
            sources += _sources(names[j], j, terms[:, :order], C, (n, m))
        square, freedom = square + float(left @ left), freedom + len(d) - order
    mean = float(np.sqrt(np.nanmean(noise**2)))
    ratio = square / freedom if freedom else np.nan
    repeatability = mean * float(np.sqrt(max(ratio - 1, 0.0)))
    if freedom and square > chdtri(freedom, FALSE_ALARM):
        notes.append(
            f"Positions visited again differ {np.sqrt(ratio):.2g} times as much as expected from the noise of the "
            f"readings: a repeatability of {repeatability * 1e6:.2g} um, or a drift that is not linear."
        )
    if not pairs:
        notes.append(
            "No position was visited again within a set-up: drift and repeatability are not determined. Return to some "
            "targets."
        )
    return Drift(rate, correction, sources, repeatability, pairs, square, freedom)


def _visits(position: NDArray[np.intp], known: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Return the known targets of each position that has several."""
    found = np.flatnonzero(known)
    found = found[np.argsort(position[found], kind="stable")]
    groups = np.split(found, np.flatnonzero(np.diff(position[found])) + 1)
    return [group for group in groups if len(group) > 1]


def _within(groups: list[NDArray[np.intp]], d: Array, terms: Array, noise: Array) -> tuple[Array, Array]:
    """Return readings and terms of each position without their weighted mean, whitened; one row fewer than visits."""
    left, rows = [], []
    for group in groups:
        w = 1 / noise[group]
        # Rows orthogonal to the weights: the mean is removed and the rest stays white.
        Q = np.linalg.qr(w[:, None], mode="complete")[0][:, 1:]
        left.append(Q.T @ (w * d[group]))
        rows.append(Q.T @ (w[:, None] * terms[group]))
    return np.concatenate(left), np.concatenate(rows)


def _scatter(returns: list[tuple[Array, Array]]) -> tuple[float, int]:
    """Return by how much the variance is larger than stated when all drifts are free (1 or more), and its freedoms."""
    square, freedom = 0.0, 0
    for d, A in returns:
        order = max((k for k in _orders(d, A)), default=0)
        left = d - A[:, :order] @ np.linalg.lstsq(A[:, :order], d)[0] if order else d
        square, freedom = square + float(left @ left), freedom + len(d) - order
    return (max(square / freedom, 1.0), freedom) if freedom else (1.0, 0)


def _orders(d: Array, A: Array) -> list[int]:
    """Return how many of the columns of A may be tried: 1, or all four."""
    return [k for k in (1, A.shape[1]) if len(d) > k and np.linalg.cond(A[:, :k]) <= _LARGEST_CONDITION]


def _order(d: Array, A: Array, scatter: tuple[float, int]) -> int:
    """Return how many of the columns of A explain d: none, 1, or all four.

    ``scatter`` is the variance and from how many freedoms it is known, 0: exactly.
    """
    square, found = float(d @ d), 0
    variance, freedom = scatter
    for order in _orders(d, A):
        part, more = A[:, :order], order - found
        left = d - part @ np.linalg.lstsq(part, d)[0]
        limit = more * fdtri(more, freedom, 1 - DRIFT_SIGNIFICANCE) if freedom else chdtri(more, DRIFT_SIGNIFICANCE)
        if square - float(left @ left) > variance * limit:
            square, found = float(left @ left), order
    return found


def _sources(name: str, j: int, terms: Array, C: Array, shape: tuple[int, int]) -> list[Shared]:
    values, vectors = np.linalg.eigh(C)
    found = []
    for k, value in enumerate(values):
        change = np.zeros(shape)
        change[j] = terms @ vectors[:, k] * np.sqrt(value)
        found.append(Shared(f"drift at station {name}.{k}", "drift", change))
    return found
