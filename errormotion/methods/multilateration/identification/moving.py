"""Detection of a station that was moved between its readings, if the readings contradict one another.

Readings of a station that was moved are those of two stations. For every station and a number of cuts of its sequence
of readings, the network is solved with the two parts as separate stations, first with a coarse, then a fine search.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.multilateration.network.solver import solve

if TYPE_CHECKING:
    from numpy.typing import NDArray

_MAX_TARGETS = 1000
_CUTS = 9
_MIN_READINGS = 5  # of a part
_MIN_SHARE = 0.5
"""Share of the excess that a cut must explain."""
_MIN_DECREASE = 50.0
"""Decrease of the sum of squares by a cut, over the remaining variance; with four additional unknowns its probability
by chance is 3e-10."""


@dataclass(frozen=True)
class Move:
    """Station ``station`` was moved by ``distance`` (m) before its reading of target ``target``."""

    station: int
    target: int
    distance: float
    sigma0_before: float
    sigma0: float


def find_move(displacement: Array, nominal: Array, station: Array | None, noise: Array, time: Array) -> Move | None:
    """Return which station was moved and when; None if no single move explains the readings.

    Parameters
    ----------
    displacement, noise, time : ndarray (n, m)
        m, m, s; the time of each reading, or its number.
    nominal : ndarray (m, 3)
        m.
    station : ndarray (n, 3) or None
        Approximate positions, m.
    """
    n, m = displacement.shape
    some = np.arange(0, m, max(1, m // _MAX_TARGETS))
    d, u, sigma, t = displacement[:, some], nominal[some], noise[:, some], time[:, some]
    whole, before = _excess(d, u, station, sigma)
    best: tuple[float, int, float, float, float] | None = None
    for j in range(n):
        times = np.sort(t[j, np.isfinite(d[j])])
        low, high = _MIN_READINGS, len(times) - _MIN_READINGS
        while high >= low:
            cuts = np.unique(np.linspace(low, high, _CUTS).astype(int))
            trials = [_cut(d, u, station, sigma, j, t[j] >= times[cut]) for cut in cuts]
            i = int(np.argmin([excess for excess, *_ in trials]))
            if best is None or trials[i][0] < best[0]:
                best = (trials[i][0], j, float(times[cuts[i]]), *trials[i][1:])
            if high - low < _CUTS:
                break
            step = (high - low) // (_CUTS - 1) + 1
            low, high = max(low, int(cuts[i]) - step), min(high, int(cuts[i]) + step)
    if best is None or not whole - best[0] > max(_MIN_SHARE * whole, _MIN_DECREASE * max(best[3], 1.0) ** 2):
        return None
    later = np.where(np.isfinite(displacement[best[1]]) & (time[best[1]] >= best[2]), time[best[1]], np.inf)
    return Move(best[1], int(np.argmin(later)), best[4], before, best[3])


def _excess(d: Array, u: Array, station: Array | None, noise: Array) -> tuple[float, float]:
    """Return the excess of the sum of squares over the expected one, and the rms residual over the noise."""
    try:
        network = solve(d, u, station, noise=noise, robust=False)
    except MethodError:
        return np.inf, np.inf
    return network.freedom * max(network.sigma0**2 - 1, 0.0), network.sigma0


def _cut(
    d: Array, u: Array, station: Array | None, noise: Array, j: int, late: NDArray[np.bool_]
) -> tuple[float, float, float]:
    """Return the excess, sigma0 and distance of the two parts (m), with station j cut in two."""
    first, second = np.where(late, np.nan, d[j]), np.where(late, d[j], np.nan)
    cut = np.concatenate([d, second[None]])
    cut[j] = first
    stations = None if station is None else np.concatenate([station, station[j : j + 1]])
    try:
        network = solve(cut, u, stations, noise=np.concatenate([noise, noise[j : j + 1]]), robust=False)
    except MethodError:
        return np.inf, np.inf, np.nan
    excess = network.freedom * max(network.sigma0**2 - 1, 0.0)
    return excess, network.sigma0, float(np.linalg.norm(network.station[-1] - network.station[j]))
