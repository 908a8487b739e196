"""Alternating choice of targets and stations: targets for given stations, stations for given targets."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.multilateration.networks import bound
from errormotion.methods.multilateration.planning import layout
from errormotion.methods.multilateration.planning.choosing import positions, refuse_count
from errormotion.methods.multilateration.planning.target_sets import POWERS, Expected, Volume

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from errormotion.methods.multilateration.planning.sight import Sight
    from errormotion.methods.multilateration.settings import Choosing, MultilaterationSettings, Planning

_ROUNDS = 3
_MIN_GAIN = 0.01
"""Relative gain of a round below which it is the last."""
_COARSE = 4
"""Candidates along each axis in the search of stations."""


@dataclass(frozen=True)
class Choice:
    """The choice, and its uncertainty over the volume.

    Attributes
    ----------
    position : ndarray (k, 3)
        Axis positions of the candidates, m.
    chosen : ndarray of int
        Numbers of those to measure.
    station : ndarray (n, 3)
        Positions of the tracker, m.
    own, best : ndarray (k,)
        Uncertainty at the candidates with the layout as set, and with the choice, m; NaN where not visible.
    before : ndarray (k,)
        With the chosen targets, from the stations as set.
    sees : ndarray of bool (n, k)
        Lines of sight from the best stations.
    """

    position: Array
    chosen: NDArray[np.intp]
    station: Array
    own: Array
    best: Array
    before: Array
    sees: NDArray[np.bool_]

    @property
    def better(self) -> bool:
        """Whether the choice differs from the layout as set."""
        return self.best is not self.own


def choose(
    settings: MultilaterationSettings, planning: Planning, choosing: Choosing, sight: Sight, boxes: Array, noise: float
) -> Choice:
    """Return the targets and stations with the smallest uncertainty over the volume.

    Raises
    ------
    MethodError
        A box beyond the travel, more targets than candidates, too few to determine the stations, or no chain.
    """
    p = settings.layout
    position = positions(choosing, p.low, p.high)
    k, own_stations = len(position), np.array(p.stations, np.float64)
    everywhere = np.concatenate([position, layout.grid(p)[0]])
    point = everywhere + np.array(p.reflector)
    sight = replace(sight, middle=point[:k].mean(axis=0))
    expected = _expected(settings, choosing, everywhere)

    def volume(station: Array) -> Volume:
        return Volume.of(station, point, sight.sees(station, point), noise, expected, k)

    now = volume(own_stations)
    refuse_count(choosing.wanted, int(now.fine.sum()), len(own_stations))
    own = now.worth()
    if not now.further.any():
        raise MethodError(
            "Layout as set: no target is visible from three stations. Check the lines of sight.",
            code="network.plan.no_sight",
        )
    chosen = np.array(now.choose(choosing.wanted, planning.minimise))
    station, before = own_stations, now.worth(chosen)
    best, cost = before, power_mean(before, planning)
    some = _coarse(choosing)
    for turn in range(_ROUNDS):
        trial = layout.optimise(
            point[chosen], boxes, sight, noise=noise, start=station, minimise=planning.minimise, thorough=turn == 0,
            worth=_Worth(point, chosen, some, sight, noise, expected),
        )  # fmt: skip
        there = volume(trial)
        again = np.array(there.choose(choosing.wanted, planning.minimise))
        sets = [chosen, again] if there.fine[chosen].all() else [again]
        worth = [there.worth(each) for each in sets]
        costs = [power_mean(each, planning) for each in worth]
        which = int(np.argmin(costs))
        if not costs[which] < cost:
            break
        gained, cost = 1 - costs[which] / cost, costs[which]
        station, chosen, best = trial, sets[which], worth[which]
        if gained < _MIN_GAIN:
            break
    sees = sight.sees(station, point[:k])
    try:
        bound(point[chosen], station, noise=noise, seen=sees[:, chosen])
    except MethodError as error:
        raise MethodError(
            f"The best {len(chosen)} targets do not determine positions and dead paths of the stations. {error} Choose "
            "more targets, or add a station.",
            code="network.plan.undetermined",
        ) from error
    return Choice(position, chosen, station, own, best, before, sees)


def power_mean(sigma: Array, planning: Planning) -> float:
    """Return the minimised quantity, m; positions that are not visible increase it."""
    known = sigma[np.isfinite(sigma)]
    top, power = float(known.max()), POWERS[planning.minimise]
    unseen = 1 - len(known) / len(sigma)
    return top * float(np.mean((known / top) ** power) ** (1 / power) * np.exp(10 * unseen))


def _expected(settings: MultilaterationSettings, choosing: Choosing, position: Array) -> Expected | None:
    if choosing.uncertainty == "target":
        return None
    if settings.chain is None:
        raise MethodError(
            "chain: expected the chain of the machine, such as workpiece-X-Y-bed-Z-spindle-tool, to choose targets for "
            "the errors of the axes; found none. State it, or use planning.targets.uncertainty = 'target'.",
            code="network.chain.missing",
        )
    reflector = np.array(settings.layout.reflector, np.float64)
    return Expected.of(
        settings.chain, position, reflector, choosing.max_order, choosing.expected_displacement,
        choosing.expected_rotation,
    )  # fmt: skip


def _coarse(choosing: Choosing) -> NDArray[np.intp]:
    """Return evenly distributed candidates, faces included."""
    number = np.arange(int(np.prod(choosing.candidates))).reshape(choosing.candidates)
    kept = [np.unique(np.linspace(0, c - 1, min(c, _COARSE)).round().astype(int)) for c in choosing.candidates]
    return np.asarray(number[np.ix_(*kept)].ravel(), dtype=np.intp)


class _Worth:
    """Uncertainty at some candidates with the chosen ones measured, as a function of the stations."""

    def __init__(
        self, point: Array, chosen: NDArray[np.intp], some: NDArray[np.intp], sight: Sight, noise: float,
        expected: Expected | None,
    ) -> None:  # fmt: skip
        which = np.concatenate([some, chosen])
        self.point, self.count, self.sight, self.noise = point[which], len(some), sight, noise
        self.expected = None if expected is None else Expected(expected.columns[which], expected.size)

    def __call__(self, station: Array) -> Array:
        sees = self.sight.sees(station, self.point)
        return Volume.of(station, self.point, sees, self.noise, self.expected, self.count).worth()
