"""Drift of a set-up and repeatability of the machine, from positions that are visited again.

During one set-up the machine moves slowly relative to the tracker, and the tracker's dead path changes. A reading at
time t is then longer than one at the middle of the set-up by

    (t - t_j) (c_j + e_ij . v_j)

with the rate c_j of the dead path and the velocity v_j of the machine. It is determined from repeated visits to a
position, whose difference also contains noise and repeatability. A rigid drift from one set-up to the next needs no
correction: it is contained in the position of the station.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtri, fdtri

from errormotion.arrays import Array
from errormotion.methods.multilateration.model import Shared

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

SAME_POSITION = 1e-9
"""Distance below which commanded positions are the same, m."""
FALSE_ALARM = 1e-3
"""Probability of a note on returns that scatter as stated."""
DRIFT_SIGNIFICANCE = 0.01
"""Probability of a correction for a set-up without drift."""
_MAX_CONDITION = 1e4
"""Of terms of the drift that are estimated together."""


@dataclass(frozen=True)
class Drift:
    """Drift of every set-up.

    Attributes
    ----------
    rate : ndarray (station, 4)
        Dead path, then X, Y, Z of the machine relative to the tracker, m/s; 0 if it is not significant, NaN without
        returns.
    correction : ndarray (station, target)
        To be subtracted from the readings, m.
    sources : list of Shared
        Its uncertainty.
    repeatability : float
        Scatter of the returns minus the noise of the readings, standard deviation of one coordinate, m; NaN without
        returns.
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
        m and s; NaN for missing readings.
    position : ndarray (m,)
        From `positions`.
    e : ndarray (n, m, 3)
        Unit vectors from the stations to the targets.
    noise : ndarray (n, m)
        Standard deviation of each reading, stated repeatability included, m.
    names : sequence of str
        Of the stations.
    notes : list of str
        To which remarks are appended.
    certain : bool
        Use the noise unless the returns contradict it; otherwise use their scatter if it is larger.
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
        residual = d
        if order:
            solution, *_ = np.linalg.lstsq(A[:, :order], d)
            C = scatter[0] * np.asarray(np.linalg.inv(A[:, :order].T @ A[:, :order]), dtype=float)
            rate[j, :order] = solution
            correction[j] = terms[:, :order] @ solution
            residual = d - A[:, :order] @ solution
            sources += _sources(names[j], j, terms[:, :order], C, (n, m))
        square, freedom = square + float(residual @ residual), freedom + len(d) - order
    mean = float(np.sqrt(np.nanmean(noise**2)))
    ratio = square / freedom if freedom else np.nan
    repeatability = mean * float(np.sqrt(max(ratio - 1, 0.0)))
    if freedom and square > chdtri(freedom, FALSE_ALARM):
        notes.append(
            f"Repeated visits to positions differ {np.sqrt(ratio):.2g} times as much as expected from the noise of the "
            f"readings: a repeatability of {repeatability * 1e6:.2g} um, or a drift that is not linear."
        )
    if not pairs:
        notes.append(
            "No position was visited again within a set-up: drift and repeatability are not determined. Measure some "
            "targets twice (measuring.returns)."
        )
    return Drift(rate, correction, sources, repeatability, pairs, square, freedom)


def _visits(position: NDArray[np.intp], known: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Return the known targets of each position that has more than one."""
    again = np.bincount(position[known], minlength=position.max(initial=-1) + 1) > 1
    targets = np.flatnonzero(known & again[position])
    targets = targets[np.argsort(position[targets], kind="stable")]
    groups = np.split(targets, np.flatnonzero(np.diff(position[targets])) + 1)
    return [group for group in groups if len(group)]


def _within(groups: list[NDArray[np.intp]], d: Array, terms: Array, noise: Array) -> tuple[Array, Array]:
    """Return whitened readings and terms of each position minus their weighted mean; one row fewer than visits."""
    readings, rows = [], []
    for group in groups:
        w = 1 / noise[group]
        # Rows orthogonal to the weights: the mean is removed and the rest remains white.
        Q = np.linalg.qr(w[:, None], mode="complete")[0][:, 1:]
        readings.append(Q.T @ (w * d[group]))
        rows.append(Q.T @ (w[:, None] * terms[group]))
    return np.concatenate(readings), np.concatenate(rows)


def _scatter(returns: list[tuple[Array, Array]]) -> tuple[float, int]:
    """Return the ratio, at least 1, of the variance with free drifts to the stated one, and its degrees of freedom."""
    square, freedom = 0.0, 0
    for d, A in returns:
        order = max(_orders(d, A), default=0)
        residual = d - A[:, :order] @ np.linalg.lstsq(A[:, :order], d)[0] if order else d
        square, freedom = square + float(residual @ residual), freedom + len(d) - order
    return (max(square / freedom, 1.0), freedom) if freedom else (1.0, 0)


def _orders(d: Array, A: Array) -> list[int]:
    """Return the possible numbers of columns of A: 1, or all four."""
    return [k for k in (1, A.shape[1]) if len(d) > k and np.linalg.cond(A[:, :k]) <= _MAX_CONDITION]


def _order(d: Array, A: Array, scatter: tuple[float, int]) -> int:
    """Return the number of significant columns of A: none, 1, or all four.

    ``scatter`` is the variance with its degrees of freedom; 0: exact.
    """
    square, accepted = float(d @ d), 0
    variance, freedom = scatter
    for order in _orders(d, A):
        part, more = A[:, :order], order - accepted
        residual = d - part @ np.linalg.lstsq(part, d)[0]
        limit = more * fdtri(more, freedom, 1 - DRIFT_SIGNIFICANCE) if freedom else chdtri(more, DRIFT_SIGNIFICANCE)
        if square - float(residual @ residual) > variance * limit:
            square, accepted = float(residual @ residual), order
    return accepted


def _sources(name: str, j: int, terms: Array, C: Array, shape: tuple[int, int]) -> list[Shared]:
    values, vectors = np.linalg.eigh(C)
    sources = []
    for k, value in enumerate(values):
        change = np.zeros(shape)
        change[j] = terms @ vectors[:, k] * np.sqrt(value)
        sources.append(Shared(f"drift at station {name}.{k}", change))
    return sources
