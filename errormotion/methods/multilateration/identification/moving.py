"""Which station was moved between its readings, when the readings contradict one another.

A station that moved halfway is two stations. For every station and a number of places to cut its readings, the network
is solved with the two parts as stations of their own; the cut that explains the readings is found coarse to fine.
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

_MOST = 1000  # targets that are looked at
_CUTS = 9
_FEWEST = 5  # readings of a part
_EXPLAINS = 0.5
"""Share of the excess that a cut has to take away."""
_GAIN = 50.0
"""How much smaller a cut has to make the sum of squares, over what it leaves per freedom: its four further unknowns do
that by chance once in 3e9 cuts."""


@dataclass(frozen=True)
class Move:
    """Station ``station`` stood elsewhere from its reading of target ``target`` on, by ``distance`` m."""

    station: int
    target: int
    distance: float
    sigma0_before: float
    sigma0: float


def find_move(displacement: Array, nominal: Array, station: Array | None, noise: Array, time: Array) -> Move | None:
    """Return which station was moved and when; None where no single move explains the readings.

    Parameters
    ----------
    displacement, noise, time : ndarray (n, m)
        m, m, s; the time of each reading, or its number.
    nominal : ndarray (m, 3)
        m.
    station : ndarray (n, 3) or None
        Rough places, m.
    """
    n, m = displacement.shape
    some = np.arange(0, m, max(1, m // _MOST))
    d, u, sigma, t = displacement[:, some], nominal[some], noise[:, some], time[:, some]
    whole, before = _excess(d, u, station, sigma)
    best: tuple[float, int, float, float, float] | None = None
    for j in range(n):
        when = np.sort(t[j, np.isfinite(d[j])])
        low, high = _FEWEST, len(when) - _FEWEST
        while high >= low:
            cuts = np.unique(np.linspace(low, high, _CUTS).astype(int))
            found = [_cut(d, u, station, sigma, j, t[j] >= when[cut]) for cut in cuts]
            i = int(np.argmin([excess for excess, *_ in found]))
            if best is None or found[i][0] < best[0]:
                best = (found[i][0], j, float(when[cuts[i]]), *found[i][1:])
            if high - low < _CUTS:
                break
            step = (high - low) // (_CUTS - 1) + 1
            low, high = max(low, int(cuts[i]) - step), min(high, int(cuts[i]) + step)
    if best is None or not whole - best[0] > max(_EXPLAINS * whole, _GAIN * max(best[3], 1.0) ** 2):
        return None
    later = np.where(np.isfinite(displacement[best[1]]) & (time[best[1]] >= best[2]), time[best[1]], np.inf)
    return Move(best[1], int(np.argmin(later)), best[4], before, best[3])


def _excess(d: Array, u: Array, station: Array | None, noise: Array) -> tuple[float, float]:
    """Return how much larger the sum of squares is than expected, and its root mean square over the noise."""
    try:
        network = solve(d, u, station, noise=noise, robust=False)
    except MethodError:
        return np.inf, np.inf
    return network.freedom * max(network.sigma0**2 - 1, 0.0), network.sigma0


def _cut(
    d: Array, u: Array, station: Array | None, noise: Array, j: int, late: NDArray[np.bool_]
) -> tuple[float, float, float]:
    """Return the excess, sigma0 and distance of the two parts (m) where station j is cut in two."""
    early, rest = np.where(late, np.nan, d[j]), np.where(late, d[j], np.nan)
    parted = np.concatenate([d, rest[None]])
    parted[j] = early
    places = None if station is None else np.concatenate([station, station[j : j + 1]])
    try:
        network = solve(parted, u, places, noise=np.concatenate([noise, noise[j : j + 1]]), robust=False)
    except MethodError:
        return np.inf, np.inf, np.nan
    excess = network.freedom * max(network.sigma0**2 - 1, 0.0)
    return excess, network.sigma0, float(np.linalg.norm(network.station[-1] - network.station[j]))
