"""Result of a multilateration: positions, dead paths, and their covariances.

The datum is a free network: the rigid motion that is the best fit of the targets to their nominal positions. With a_i
the displacement of target i by its own readings, of covariance D_i, and ds the displacement of the stations,

    u_i = a_i + F_i ds - G_i H (sum_k G_k^T (a_k + F_k ds)),   H = (sum_k G_k^T G_k)^-1,

G_i = [1, -(c_i x)] is the displacement of target i by rigid motions (`errormotion.estimation.datum`). A weakly
determined target does not define the datum. Quantities that follow from a solution are calculated on first access.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.estimation.datum import Datum, Relative, relative
from errormotion.estimation.fit import Fit
from errormotion.estimation.sources import Errors, Places, errors_of
from errormotion.kinematics.twists import rigid_motions
from errormotion.methods.multilateration.network.model import DRIFT, STATIONS, Stations

BY_READINGS = (STATIONS, DRIFT)
"""Groups of the sources that follow from readings."""


@dataclass(frozen=True)
class Network:
    """Targets and stations from displacements.

    Attributes
    ----------
    fit : Fit
        Of `model.Unknowns`, in the datum.
    reading : ndarray (n, m)
        Displacements, m, also those that were ignored; NaN where there is none.
    nominal : ndarray (m, 3)
        Nominal targets, m.
    in_datum : ndarray of bool (m,)
        Targets that define the datum: those that are not weakly determined.
    condition : float
        Condition of the stations' information, scaled to a diagonal of 1, without the rigid motions.
    left_out : tuple of (int, int)
        Outliers (station, target), from 0.
    undecided : tuple of int
        Targets with an outlier that is not identified; they are NaN.
    approximate : ndarray (n, 3) or None
        Stated approximate positions of the stations, m.
    """

    fit: Fit
    reading: Array = field(repr=False)
    nominal: Array = field(repr=False)
    in_datum: NDArray[np.bool_] = field(repr=False)
    condition: float
    left_out: tuple[tuple[int, int], ...] = ()
    undecided: tuple[int, ...] = ()
    approximate: Array | None = field(default=None, repr=False)

    @cached_property
    def determined(self) -> NDArray[np.bool_]:
        """Whether the readings determine each target, (m,)."""
        return np.asarray(self.fit.problem.unknowns.target.freed[:, 0])

    @cached_property
    def target(self) -> Array:
        """Estimated positions (m, 3), m, in the frame of the nominal ones; NaN where not determined."""
        return np.where(self.determined[:, None], self.fit.unknowns.target, np.nan)

    @cached_property
    def stations(self) -> Stations:
        """Positions and dead paths in the same frame."""
        table = self.fit.unknowns.station
        return Stations(table[:, :3], table[:, 3])

    @property
    def station(self) -> Array:
        """Positions of the stations, (n, 3), m."""
        return self.stations.position

    @property
    def dead_path(self) -> Array:
        """Dead paths (n,), m."""
        return self.stations.dead_path

    @cached_property
    def weight(self) -> Array:
        """1 / standard deviation of each reading (n, m), 1/m; 0 for readings that are missing or ignored."""
        sd = np.asarray(self.fit.problem.noise.sd)
        return np.where(self.fit.linear.used[:, 0], 1.0 / sd, 0.0).reshape(self.reading.shape)

    @property
    def freedom(self) -> int:
        """Valid readings minus parameters."""
        return self.fit.freedom

    @cached_property
    def sigma0(self) -> float:
        """Root mean square of the residuals over the expected one: 1 if the noise is as stated."""
        return float(np.sqrt(self.fit.chi2 / self.freedom)) if self.freedom > 0 else float("nan")

    @cached_property
    def residual(self) -> Array:
        """Reading minus model (n, m), m, of every reading of a target with a position, outliers included; else NaN.

        The residual of an outlier is its whole error, since it did not contribute to the position.
        """
        problem = self.fit.problem
        rows = [table.rows(value) for table, value in zip(problem.tables, self._tables, strict=True)]
        found = problem.evaluate(self.reading.ravel(), rows).reshape(self.reading.shape)
        return np.where(self.determined, found, np.nan)

    @cached_property
    def redundancy(self) -> Array:
        """Share (n, m) of the error of a reading that appears in its residual, 0 to 1; NaN without a valid reading."""
        return np.where(self.weight > 0, 1.0 - self.fit.leverage.reshape(self.reading.shape), np.nan)

    @property
    def _tables(self) -> list[Array]:
        at = self.fit.linear.at
        return [*at.tables, *self.fit.problem.constant_tables(at)]

    @cached_property
    def datum(self) -> Datum:
        """The free network."""
        target = np.where(self.determined[:, None], self.target, self.nominal)
        G = rigid_motions(target, target[self.in_datum].mean(axis=0))
        return Datum(G, np.repeat(self.in_datum[:, None], 3, axis=1).astype(float), STATIONS)

    @cached_property
    def errors(self) -> Errors:
        """The targets with all sources of their uncertainty, in a frame of the stations."""
        found = errors_of(self.fit, Places(lambda x, _: x.target, len(self.nominal)), shared=STATIONS)
        found.value[~self.determined], found.own[~self.determined] = np.nan, np.nan
        return found

    @cached_property
    def moved(self) -> Relative:
        """The same in the datum, whose own sources follow the others."""
        return relative(self.errors, self.datum)

    @cached_property
    def target_covariance(self) -> Array:
        """Covariances (m, 3, 3), m^2, by the readings, in the datum, in which the six rigid motions have none."""
        own, F = self.moved.errors.own, [each.effect for each in self.moved.errors.sources if each.group in BY_READINGS]
        found = own + np.einsum("spi,spj->pij", F, F, optimize=True)
        return np.where(self.determined[:, None, None], found, np.nan)

    @property
    def uncertainty(self) -> Array:
        """Standard uncertainty of each target by the readings: root of the trace of its covariance, (m,), m."""
        return np.asarray(np.sqrt(np.trace(self.target_covariance, axis1=1, axis2=2)), dtype=float)

    @cached_property
    def joint_covariance(self) -> Array:
        """Covariance (4 n, 4 n) of (U_1, L_1, U_2, ...) in the datum, m^2."""
        n, normal, datum = len(self.station), self.fit.normal, self.datum
        T = self.stations.motions(self.target[self.in_datum].mean(axis=0)).reshape(4 * n, 6)
        G = datum.columns[self.in_datum]
        H = np.linalg.inv(np.einsum("pag,pah->gh", G, G))
        shift = H @ np.einsum("pag,par->gr", G, normal.shared[self.in_datum])
        K = H @ np.einsum("pag,pab,pbh->gh", G, normal.own[self.in_datum], G, optimize=True) @ H
        F = normal.root[: 4 * n] - T @ shift
        return np.asarray(F @ F.T + T @ K @ T.T)

    @property
    def station_covariance(self) -> Array:
        """Covariances of the stations' positions, (n, 3, 3), m^2."""
        n = len(self.station)
        blocks = self.joint_covariance.reshape(n, 4, n, 4)
        return np.ascontiguousarray(blocks[np.arange(n), :3, np.arange(n), :3])
