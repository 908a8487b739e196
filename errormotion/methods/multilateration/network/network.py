"""Result of a multilateration: positions, dead paths, and their covariances.

The datum is a free network: the rigid motion that is the best fit of the targets to their nominal positions. With a_i
the displacement of target i by its own readings, of covariance D_i, and ds the displacement of the stations,

    u_i = a_i + F_i ds - G_i H (sum_k G_k^T (a_k + F_k ds)),   H = (sum_k G_k^T G_k)^-1,

G_i = [1, -(c_i x)] is the displacement of target i by rigid motions. The covariances of targets i and k are then

    D_i delta_ik + F'_i F'_k^T - D_i G_i H G_k^T - G_i H G_k^T D_k + G_i K G_k^T,   K = H (sum G^T D G) H,

with F' the factor of the stations in the datum. A weakly determined target does not define the datum: it is excluded
from the sums and from the terms in its own D G. Quantities that follow from a solution (datum, covariances, residuals
and notes) are calculated on first access and cached.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.kinematics.twists import rigid_motions
from errormotion.methods.multilateration.network import target_sums
from errormotion.methods.multilateration.network.model import Stations, directions


@dataclass(frozen=True)
class Datum:
    """Free network on the targets, and quantities for the transformation of covariances into it.

    Attributes
    ----------
    centre : ndarray (3,)
        Mean of the targets, m.
    factor : ndarray (4 n + k, p)
        W, W W^T the covariance of the stations' parameters in some datum.
    shift : ndarray (6, p)
        H sum(G^T F) W.
    H, K : ndarray (6, 6)
        See the module.
    """

    centre: Array
    factor: Array
    shift: Array
    H: Array
    K: Array


class _OnDemand:
    """Descriptor of the datum of a network: as passed, or else calculated on first access."""

    def __set__(self, network: Network, value: Any) -> None:
        network.__dict__["_datum"] = None if value is self else value

    def __get__(self, network: Network | None, owner: type) -> Any:
        if network is None:
            return self
        if network.__dict__["_datum"] is None:
            network.__dict__["_datum"] = network._calculated_datum()
        return network.__dict__["_datum"]


@dataclass(frozen=True)
class Network:
    """Targets and stations from displacements.

    Attributes
    ----------
    target : ndarray (m, 3)
        Estimated positions, m, in the frame of the nominal ones; NaN where readings do not determine a target.
    stations : Stations
        Positions, dead paths and further parameters in the same frame.
    reading : ndarray (n, m)
        Displacements, m; NaN where there is none.
    weight : ndarray (n, m)
        1 / standard deviation, 1/m; 0 for readings that are missing or ignored.
    left_out : tuple of (int, int)
        Outliers (station, target), from 0.
    undecided : tuple of int
        Targets with an outlier that is not identified; they are NaN.
    sigma0 : float
        Root mean square of the residuals over the expected one: 1 if the noise is as stated.
    freedom : int
        Valid readings minus parameters.
    iterations : int
        Passes over the targets.
    converged : bool
        Whether a further step would be below the tolerance.
    condition : float
        Condition of the stations' information, scaled to a diagonal of 1, without the rigid motions.
    extra : ndarray (k, n, m)
        Derivatives of the readings by further parameters.
    in_datum : ndarray of bool (m,)
        Targets that define the datum: those that are not weakly determined.
    centre : ndarray (3,)
        Mean of these, m.
    factor : ndarray (4 n + k, p)
        W, W W^T the covariance of the stations' parameters in some datum.
    approximate : ndarray (n, 3) or None
        Stated approximate positions of the stations, m.
    datum : Datum
        Quantities for the transformation of covariances into the datum.
    """

    target: Array
    stations: Stations
    reading: Array = field(repr=False)
    weight: Array = field(repr=False)
    left_out: tuple[tuple[int, int], ...]
    undecided: tuple[int, ...]
    sigma0: float
    freedom: int
    iterations: int
    converged: bool
    condition: float
    extra: Array = field(repr=False)
    in_datum: NDArray[np.bool_] = field(repr=False)
    centre: Array = field(repr=False)
    factor: Array = field(repr=False)
    approximate: Array | None = field(repr=False)
    datum: Datum = field(default=cast(Any, _OnDemand()), repr=False)

    def _calculated_datum(self) -> Datum:
        GG, GDG, GF = target_sums.datum_sums(
            self.weight, self.station, self.extra, self.target, self.in_datum, self.centre
        )
        H = np.asarray(np.linalg.inv(GG), dtype=np.float64)
        return Datum(self.centre, self.factor, H @ GF @ self.factor, H, H @ GDG @ H)

    @cached_property
    def joint_covariance(self) -> Array:
        """Covariance (4 n + k, 4 n + k) of (U_1, L_1, U_2, ..., p) in the datum, m^2."""
        T = self.stations.motions(self.datum.centre)
        F = self.datum.factor - T @ self.datum.shift
        return np.asarray(F @ F.T + T @ self.datum.K @ T.T)

    @property
    def target_covariance(self) -> Array:
        """Covariances (m, 3, 3), m^2, in the datum, in which the six rigid motions have none."""
        return self._examined[0]

    @property
    def redundancy(self) -> Array:
        """Share (n, m) of the error of a reading that appears in its residual, 0 to 1; NaN without a valid reading."""
        return self._examined[1]

    @cached_property
    def residual(self) -> Array:
        """Reading minus model (n, m), m, of every reading of a target with a position, outliers included; else NaN.

        The residual of an outlier is its whole error, since it did not contribute to the position.
        """
        s = self.stations
        return np.asarray(
            target_sums.residuals(self.reading, s.position, s.dead_path, self.extra, s.value, self.target)
        )

    @cached_property
    def _examined(self) -> tuple[Array, Array]:
        datum = self.datum
        covariance, redundancy = target_sums.examine(
            self.weight, self.station, self.extra, self.target, self.in_datum,
            datum.centre, datum.factor, datum.shift, datum.H, datum.K,
        )  # fmt: skip
        return covariance, redundancy

    @property
    def station(self) -> Array:
        """Positions of the stations, (n, 3), m."""
        return self.stations.position

    @property
    def dead_path(self) -> Array:
        """Dead paths (n,), m."""
        return self.stations.dead_path

    @property
    def station_covariance(self) -> Array:
        """Covariances of the stations' positions, (n, 3, 3), m^2."""
        n = len(self.station)
        blocks = self.joint_covariance[: 4 * n, : 4 * n].reshape(n, 4, n, 4)
        return np.ascontiguousarray(blocks[np.arange(n), :3, np.arange(n), :3])

    def blocks(self, targets: NDArray[np.intp] | slice = slice(None)) -> tuple[Array, Array, Array]:
        """Return the components of the joint covariances of some targets (t of them).

        Returns
        -------
        own : ndarray (t, 3, 3)
            D, m^2: covariance from a target's own readings, with known stations.
        factor : ndarray (t, 3, p)
            F', m: effect of one standard uncertainty of each independent part of the stations, in the datum.
        G : ndarray (t, 3, 6)
            Displacements by rigid motions about the centre of the datum.
        """
        u, w = self.target[targets], self.weight[:, targets]
        e = directions(u, self.stations)
        A = np.einsum("jt,jta,jtb->tab", w**2, e, e)
        own = np.full_like(A, np.nan)
        fine = np.isfinite(self.target_covariance[targets]).all(axis=(1, 2))
        own[fine] = np.linalg.inv(A[fine])
        n = len(self.station)
        W = self.datum.factor[: 4 * n].reshape(n, 4, -1)
        q = -np.einsum("jta,jap->jtp", e, W[:, :3]) - W[:, None, 3]
        if len(self.extra):
            q = q + np.einsum("kjt,kp->jtp", self.extra[:, :, targets], self.datum.factor[4 * n :])
        G = rigid_motions(u, self.datum.centre)
        factor = -own @ np.einsum("jt,jta,jtp->tap", w**2, e, q) - G @ self.datum.shift
        return own, factor, G

    def influence(self) -> Array:
        """Return the effect of the stations' uncertainty on all targets, (p, m, 3), m.

        One row for each independent part of the stations' covariance: the sources of ``influence`` of an error
        dataset. The remainder of ``target_covariance`` is independent from target to target, except for small terms
        of the datum, of the order 6 / (3 m) of it.
        """
        return np.ascontiguousarray(self.blocks()[1].transpose(2, 0, 1))

    def covariance(self, targets: NDArray[np.intp] | slice = slice(None)) -> Array:
        """Return the joint covariance (3 t, 3 t), m^2, of some targets (t of them)."""
        own, F, G = self.blocks(targets)
        t, DG = len(own), np.where(self.in_datum[targets][:, None, None], own @ G, 0.0)
        F, DG, G = F.reshape(3 * t, -1), DG.reshape(3 * t, 6), G.reshape(3 * t, 6)
        side = DG @ self.datum.H @ G.T
        C: Array = F @ F.T - side - side.T + G @ self.datum.K @ G.T
        C.reshape(t, 3, t, 3)[np.arange(t), :, np.arange(t), :] += own
        return C

    def response(self, change: Array) -> tuple[Array, Array]:
        """Return the effect of a change (n, m), m, of the readings on targets (m, 3) and stations (4 n + k,).

        To first order; for systematic effects: refraction, a drift between set-ups, a wrong wavelength. Readings that
        are not used have no effect.
        """
        w = self.weight
        used = np.isfinite(self.target_covariance).all(axis=(1, 2))
        own, factor, G = self.blocks()
        e = directions(self.target, self.stations)
        d = np.where((w > 0) & used, change, 0.0)
        alone = np.einsum("tab,jt,jta->tb", own, w**2 * d, e)
        alone[~used] = 0.0
        # Gradient of the stations: derivatives of the readings by them, times the residuals of the targets.
        rest = w**2 * (d - np.einsum("jta,ta->jt", np.nan_to_num(e), alone))
        g = np.concatenate([-np.einsum("jt,jta->ja", rest, np.nan_to_num(e)), -rest.sum(axis=1)[:, None]], axis=1)
        gradient = np.concatenate([g.ravel(), np.einsum("kjt,jt->k", self.extra, rest)])
        parts = self.datum.factor.T @ gradient
        shift = self.datum.H @ np.einsum("tab,ta->b", G[self.in_datum], alone[self.in_datum])
        moved = alone + factor @ parts - G @ shift
        T = self.stations.motions(self.datum.centre)
        return moved, self.datum.factor @ parts - T @ (self.datum.shift @ parts + shift)

    @property
    def uncertainty(self) -> Array:
        """Standard uncertainty of each target: root of the trace of its covariance, (m,), m."""
        return np.asarray(np.sqrt(np.trace(self.target_covariance, axis1=1, axis2=2)), dtype=float)
