"""Networks of arrays, without raw data: the bound of a layout, and solutions for studies."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.kinematics.twists import rigid_motions
from errormotion.measurement.identification import solve as solved_of
from errormotion.measurement.observed import Solved, as_expected
from errormotion.methods.multilateration import determinacy
from errormotion.methods.multilateration.model import Sources, network
from errormotion.methods.multilateration.start import Stations, gross, initial_stations, readings

__all__ = ["Network", "bound", "solve", "station_covariance"]


@dataclass(frozen=True, eq=False)
class Network:
    """A solution: n stations and m targets, in the frame of the nominal targets; NaN where unknown."""

    solved: Solved
    reading: Array
    wrong: NDArray[np.bool_]

    @cached_property
    def target(self) -> Array:
        """Positions, (m, 3), m."""
        free = self.solved.fit.problem.unknowns.target.freed
        return np.where(free, self.solved.fit.unknowns.target, np.nan)

    @property
    def stations(self) -> Stations:
        """Positions and dead paths."""
        table = self.solved.fit.unknowns.station
        return Stations(table[:, :3], table[:, 3])

    @cached_property
    def covariance(self) -> Array:
        """Of each target, (m, 3, 3), m^2."""
        errors = self.solved.relative.errors
        return np.where(np.isfinite(errors.value)[..., None], errors.covariance, np.nan)

    @property
    def uncertainty(self) -> Array:
        """Standard uncertainty of each target, three coordinates together, (m,), m."""
        return np.asarray(np.sqrt(np.trace(self.covariance, axis1=1, axis2=2)))

    @property
    def station_covariance(self) -> Array:
        """Of each position of a station by the readings, (n, 3, 3), m^2."""
        n = len(self.stations.position)
        return station_covariance(self.solved).reshape(n, 4, n, 4)[np.arange(n), :3, np.arange(n), :3]

    @property
    def freedom(self) -> int:
        """Readings minus unknowns."""
        return self.solved.fit.freedom

    @property
    def sigma0(self) -> float:
        """Scatter of the readings over the stated one."""
        return self.solved.scatter.ratio

    @property
    def notes(self) -> list[str]:
        """Notes for the operator."""
        return [note for note in (*self.solved.observed.notes, *self.solved.observed.doubts) if note]

    @property
    def residual(self) -> Array:
        """Reading minus model, (n, m), m, also of wrong readings; NaN without a position of the target."""
        every = replace(self.solved.fit.problem, readings=self.reading.ravel())
        residual = every.residuals(self.solved.fit.linear.at).reshape(self.reading.shape)
        return np.where(np.isfinite(self.target[:, 0]), residual, np.nan)

    @property
    def redundancy(self) -> Array:
        """Share of the error of a reading that appears in its residual, (n, m); NaN without a reading."""
        fit = self.solved.fit
        return np.where(fit.linear.used, 1.0 - fit.leverage, np.nan).reshape(self.wrong.shape)

    @cached_property
    def left_out(self) -> tuple[tuple[int, int], ...]:
        """Readings (station, target) that are wrong."""
        excluded = self.wrong.copy()
        for each in () if self.solved.cleaned is None else self.solved.cleaned.made:
            excluded |= each.readings.reshape(excluded.shape) & (not each.rivals)
        return tuple((int(j), int(i)) for j, i in np.argwhere(excluded))

    @cached_property
    def undecided(self) -> tuple[int, ...]:
        """Targets with a wrong reading that is not identified."""
        made = () if self.solved.cleaned is None else self.solved.cleaned.made
        stations = [np.flatnonzero(each.readings.reshape(self.wrong.shape).any(axis=0)) for each in made if each.rivals]
        return tuple(sorted({int(i) for each in stations for i in each}))


def solve(
    displacement: ArrayLike,
    target: ArrayLike,
    station: ArrayLike | None = None,
    *,
    noise: ArrayLike = 1e-6,
    sources: Sources | None = None,
    robust: bool = True,
) -> Network:
    """Return targets, stations and dead paths from displacements.

    Parameters
    ----------
    displacement : array_like (n, m)
        Readings of station j for target i, m; NaN where there is none.
    target : array_like (m, 3)
        Nominal targets, m: start and datum.
    station : array_like (n, 3), optional
        Approximate positions of the stations, m; default: from the distances.
    noise : array_like, broadcast to (n, m)
        Standard deviation of a reading, m. It is used as stated.
    sources : Sources, optional
        What is uncertain besides.
    robust : bool
        Whether to find outliers.

    Raises
    ------
    MethodError
        Fewer readings than unknowns, positions with an undetermined freedom, or readings that fit no network.
    """
    d, u = np.array(displacement, dtype=float), np.array(target, dtype=float)
    if d.ndim != 2 or u.shape != (d.shape[1], 3):
        raise MethodError(
            f"Expected displacements (station, target) and targets (target, 3); found {d.shape} and {u.shape}. "
            "State a row of displacements for every station and a position for every target.",
            code="network.shape",
        )
    sd = np.broadcast_to(np.asarray(noise, dtype=float), d.shape)
    if not (sd > 0).all():
        raise MethodError(
            "Expected a positive standard deviation of every reading. State the instrument's noise, m.",
            code="network.noise.not_positive",
        )
    known = np.isfinite(d)
    determinacy.refuse_too_few(known & (known.sum(axis=0) >= 3), None, u)
    start = initial_stations(
        d, np.where(np.isfinite(d), 1.0 / sd, 0.0), u, None if station is None else np.asarray(station, dtype=float)
    )
    wrong = gross(d, u, start, float(np.median(sd))) if robust else np.zeros(d.shape, dtype=bool)
    observed = network(
        np.where(wrong, np.nan, d), sd, u, start, sources, noise_increases=False, robust=robust, resolution=0.0
    )
    return Network(solved_of(observed), d, wrong)


def bound(
    target: ArrayLike,
    station: ArrayLike,
    *,
    noise: ArrayLike = 1e-6,
    seen: ArrayLike | None = None,
    sources: Sources | None = None,
) -> Network:
    """Return the network of error-free readings, with the expected covariances.

    Parameters
    ----------
    target : array_like (m, 3)
        m.
    station : array_like (n, 3)
        m.
    noise : array_like, broadcast to (n, m)
        Standard deviation of a reading, m.
    seen : array_like of bool (n, m), optional
        Which readings exist; default: all.
    sources : Sources, optional
        What is uncertain besides.

    Raises
    ------
    MethodError
        Positions with an undetermined freedom.
    """
    u, U = np.asarray(target, dtype=float), np.asarray(station, dtype=float)
    if u.ndim != 2 or u.shape[1] != 3 or U.ndim != 2 or U.shape[1] != 3:
        raise MethodError(
            f"Expected positions (target, 3) and (station, 3); found {u.shape} and {U.shape}.", code="network.shape"
        )
    if not (np.isfinite(u).all() and np.isfinite(U).all()):
        raise MethodError(
            "Expected finite positions of targets and stations; found NaN or infinite ones.",
            code="network.position.form",
        )
    stations = Stations(U, np.zeros(len(U)))
    d = readings(u, stations)
    if seen is not None:
        d = np.where(np.asarray(seen, dtype=bool), d, np.nan)
    observed = as_expected(network(d, np.asarray(noise, dtype=float), u, stations, sources))
    return Network(solved_of(observed), d, np.zeros(d.shape, dtype=bool))


def station_covariance(solved: Solved) -> Array:
    """Return the covariance (4 n, 4 n) of (U_1, L_1, U_2, ...) by the readings in the datum, m^2.

    With a_i the displacement of target i by its own readings, of covariance D_i, and ds that of the stations,
    ``s - T H sum_k G_k' (a_k + F_k ds)`` with ``H = (sum_k G_k' G_k)^-1``.
    """
    normal, x = solved.fit.normal, solved.fit.unknowns
    free = solved.fit.problem.unknowns.target.freed[:, 0]
    n = len(x.station)
    centre = x.target[free].mean(axis=0)
    T = Stations(x.station[:, :3], x.station[:, 3]).motions(centre).reshape(4 * n, 6)
    G = rigid_motions(x.target[free], centre)
    H = np.linalg.inv(np.einsum("pag,pah->gh", G, G))
    shift = H @ np.einsum("pag,par->gr", G, normal.shared[free])
    K = H @ np.einsum("pag,pab,pbh->gh", G, normal.own[free], G, optimize=True) @ H
    F = normal.root[: 4 * n] - T @ shift
    return np.asarray(solved.factor * (F @ F.T + T @ K @ T.T))
