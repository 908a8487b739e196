"""The equation of multilateration: readings from targets, stations, drift, and what is known with an uncertainty.

    d_ij (1 + s) + g_ij . z = |u_i - U_j| - L_j + c_ij . p_j

u_i is target i, U_j station j, L_j its dead path, and p_j the drift of its set-up in standard uncertainties, with known
effects c_ij. s are relative errors of all lengths, z errors of the machine's scales, both 0 but for their uncertainty.
The targets are eliminated (`errormotion.estimation`), so that cost and memory are linear in their number.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.estimation.blocks import Block, Constant, Index, Noise
from errormotion.estimation.problem import READINGS, Problem
from errormotion.kinematics.twists import rigid_motions

T = TypeVar("T")

STATIONS, DRIFT, AIR, TRACKER, SCALES = "stations", "drift", "refraction", "scale of the tracker", "scales"
"""Groups of the sources: noise of the tracker, drift of set-ups, lengths by the air and by the tracker, expansion."""
LINEAR = 1e6
"""Scale, in standard uncertainties, of what the equation is linear in: differences as large as readings are exact."""


@dataclass(frozen=True)
class Shared:
    """A source that many readings share, as the change of the readings by its standard uncertainty, (n, m), m."""

    name: str
    group: str
    change: Array = field(repr=False)


@dataclass(frozen=True)
class Sources:
    """What is uncertain besides the noise of the readings.

    Attributes
    ----------
    air, tracker : mapping of str to float
        Relative standard uncertainties of all lengths by name.
    scales : sequence of Shared
        Expansion of the machine's scales.
    drift : sequence of Shared
        Of single set-ups; the readings may improve it.
    """

    air: Mapping[str, float] = field(default_factory=dict)
    tracker: Mapping[str, float] = field(default_factory=dict)
    scales: Sequence[Shared] = ()
    drift: Sequence[Shared] = ()


class Unknowns(NamedTuple, Generic[T]):
    """Targets (m, 3), stations with their dead paths (n, 4), m, and drift (n, k)."""

    target: T
    station: T
    drift: T


class Known(NamedTuple, Generic[T]):
    """Relative errors of lengths (1, 1), and errors of the scales in standard uncertainties (1, k)."""

    air: T
    tracker: T
    scales: T


@dataclass(frozen=True)
class Stations:
    """Positions (n, 3) and dead paths (n,) of the stations, m."""

    position: Array
    dead_path: Array

    @property
    def table(self) -> Array:
        """Positions and dead paths, (n, 4)."""
        return np.column_stack([self.position, self.dead_path])

    def motions(self, centre: Array) -> Array:
        """Return the effect (n, 4, 6) of rigid motions of the network about ``centre`` on positions and dead paths."""
        T = np.zeros((len(self.position), 4, 6))
        T[:, :3] = rigid_motions(self.position, centre)
        return T


def readings(target: Array, stations: Stations) -> Array:
    """Return the displacements (n, m), m, of targets (m, 3) from stations."""
    return np.asarray(np.linalg.norm(target - stations.position[:, None], axis=-1) - stations.dead_path[:, None])


def directions(target: Array, position: Array) -> Array:
    """Return the unit vectors (n, m, 3) from stations at positions (n, 3) to targets (m, 3)."""
    v = target - position[:, None]
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True), dtype=float)


def stated(reading: Array, sd: Array, target: Array, stations: Stations, sources: Sources | None = None) -> Problem:
    """Return the problem of readings (n, m), m, NaN for none, with standard deviations of the same shape.

    It starts at targets (m, 3) and stations. A target with fewer than three readings keeps its start, and its readings
    are not used.
    """
    n, m = reading.shape
    sources = sources or Sources()
    free = np.isfinite(reading).sum(axis=0) >= 3
    station, every = np.repeat(np.arange(n), m), np.zeros(n * m, dtype=np.intp)
    c, has_drift = _by_station(sources.drift, n, m)
    g = np.array([np.nan_to_num(each.change).ravel() for each in sources.scales]).reshape(-1, n * m).T

    def equation(y: Array, x: Unknowns[Array], known: Known[Array]) -> Array:
        length = y * (1.0 + known.air[:, 0] + known.tracker[:, 0]) + np.einsum("ns,ns->n", g, known.scales)
        v = x.target - x.station[:, :3]
        distance = np.sqrt(np.einsum("na,na->n", v, v))
        return np.asarray(length - distance + x.station[:, 3] - np.einsum("nk,nk->n", c, x.drift))

    def derivatives(_: Array, x: Unknowns[Array], __: Known[Array]) -> Mapping[str, Array]:
        v = x.target - x.station[:, :3]
        e = v / np.sqrt(np.einsum("na,na->n", v, v))[:, None]
        one = np.ones((len(e), 1))
        by_station = np.concatenate([e, one], axis=1)
        return {"target": -e[:, None], "station": by_station[:, None], "drift": -c[:, None], READINGS: one[:, None]}

    return Problem(
        equation=equation,
        derivatives=derivatives,
        readings=np.where(free, reading, np.nan).ravel(),
        unknowns=Unknowns(
            target=Block(start=target, index=np.tile(np.arange(m), n), scale=1.0, free=free),
            station=Block(start=stations.table, index=station, scale=1.0, group=STATIONS),
            drift=Block(
                start=np.zeros(has_drift.shape), index=station, scale=1.0, free=has_drift, prior=1.0, group=DRIFT
            ),
        ),
        constants=Known(
            air=_relative(sources.air, every, AIR),
            tracker=_relative(sources.tracker, every, TRACKER),
            scales=Constant(
                value=np.zeros((1, g.shape[1])), factor=np.eye(g.shape[1])[None], index=every, scale=LINEAR,
                group=SCALES, names=[each.name for each in sources.scales],
            ),
        ),
        noise=Noise(sd=np.broadcast_to(sd, reading.shape).ravel()),
        gauge={"station": np.moveaxis(stations.motions(target.mean(axis=0)), 2, 0)},
    )  # fmt: skip


def _relative(by_name: Mapping[str, float], index: Index, group: str) -> Constant:
    """Return the relative errors of all lengths by independent causes."""
    causes = {name: u for name, u in by_name.items() if u > 0}
    factor = np.array([*causes.values()], dtype=float).reshape(1, 1, -1)
    return Constant(value=np.zeros((1, 1)), factor=factor, index=index, scale=1.0, group=group, names=[*causes])


def _by_station(drift: Sequence[Shared], n: int, m: int) -> tuple[Array, NDArray[np.bool_]]:
    """Return the effects (n m, k) of drift on each reading, and which of the k parts each station has, (n, k)."""
    parts: list[list[Array]] = [[] for _ in range(n)]
    for each in drift:
        [j] = np.flatnonzero(np.nan_to_num(each.change).any(axis=1))
        parts[j].append(np.nan_to_num(each.change[j]))
    most = max(map(len, parts), default=0)
    c, has = np.zeros((n, m, most)), np.zeros((n, most), dtype=bool)
    for station, its in enumerate(parts):
        has[station, : len(its)] = True
        for k, effect in enumerate(its):
            c[station, :, k] = effect
    return c.reshape(n * m, most), has
