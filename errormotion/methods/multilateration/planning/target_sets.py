"""Choice of targets: the set of candidates of a grid with the smallest uncertainty over the whole volume.

The unknowns have the Gaussian information M = M_0 + sum_i B_i^T B_i, with one term for each chosen target; the quantity
of interest at position c is Phi_c times the unknowns, with covariance Phi_c M^-1 Phi_c^T + K_c.

* ``target``: the unknowns are the positions and dead paths of the stations. A target with n readings contributes n - 3
  equations, after elimination of its own position: B_i = (1 - hat) W^1/2 Q_i, of rank one with four stations. The
  quantity is the position of a further target at c: K_c from its own readings, Phi_c the effect of the stations.
* ``axes``: the unknowns are also the errors of the axes, series of polynomials with coefficients of an expected size
  (see `errormotion.kinematics.volumes`): B_i = W^1/2 [e A_i, Q_i]. The quantity is the volumetric error at c.

Both are in the datum of the whole grid, without rigid motions. Targets are added one by one, each with the largest
gain; then exchanged one by one while that is a gain, estimated by an update of rank n and calculated exactly for the
best. The largest uncertainty is approximated by a power mean.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from errormotion.arrays import Array
from errormotion.kinematics.twists import rigid_motions
from errormotion.kinematics.volumes import Term, first_order, is_rotation
from errormotion.methods.multilateration.axes import volume_of
from errormotion.methods.multilateration.start import Stations, directions

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

POWERS = {"mean": 1.0, "largest": 16.0}
_PRIOR = 0.1
"""Prior standard uncertainty of stations and dead paths, m: without effect, but the information has an inverse."""
_OUT, _IN = 4, 6
"""Exchanges calculated exactly in each iteration: removed targets, and replacements of each."""
_MAX_EXCHANGES = 400
_MIN_GAIN = 1e-6
_EXPONENT = 2.0
"""Exponent of the decrease of expected coefficients with their order."""


@dataclass(frozen=True)
class Expected:
    """Expected errors of the axes.

    Attributes
    ----------
    columns : ndarray (k, 3, term)
        Effect of a unit of each coefficient at each candidate, m.
    size : ndarray (term,)
        Standard deviation of each coefficient.
    """

    columns: Array
    size: Array

    @classmethod
    def of(
        cls, chain: str, position: Array, reflector: Array, order: int, displacement: float, rotation: float
    ) -> Expected:
        """Return the expected errors at axis positions (k, 3), m, with ``reflector`` (3,) at the tool.

        Raises
        ------
        MethodError
            Not a chain of X, Y and Z.
        """
        at = np.tile(reflector, (len(position), 1))
        model = volume_of(chain, position, at)
        terms = model.terms(order)
        size = np.array([_size(term, displacement, rotation) for term in terms])
        return cls(model.columns(terms, position, at), size)


def _size(term: Term, displacement: float, rotation: float) -> float:
    """Return the standard deviation of a coefficient: as expected for the lowest order, smaller for higher ones."""
    if term.order < 0:
        return rotation
    higher = term.order - first_order(term.error) + 1
    return float((rotation if is_rotation(term.error) else displacement) / higher**_EXPONENT)


@dataclass(frozen=True)
class Volume:
    """Candidates, the rows of their readings in the design matrix, and the quantity of interest at each.

    Attributes
    ----------
    rows : ndarray (k, n, P)
        B of every candidate.
    known : ndarray (P, P)
        M_0.
    wanted : ndarray (k, 3, P)
        Phi.
    own : ndarray (k,)
        Trace of K, m^2.
    fine : ndarray of bool (k,)
        Candidates visible from three stations.
    further : ndarray (l, n, P)
        B of the targets of the layout as set, which are not candidates.
    """

    rows: Array
    known: Array
    wanted: Array
    own: Array
    fine: NDArray[np.bool_]
    further: Array

    @classmethod
    def of(
        cls, station: Array, point: Array, sees: NDArray[np.bool_], noise: float, expected: Expected | None, count: int
    ) -> Volume:
        """Return the candidates and their rows.

        Parameters
        ----------
        station : ndarray (n, 3)
            m.
        point : ndarray (k + l, 3)
            m.
        sees : ndarray of bool (n, k + l)
        noise : float
            Of a reading, m.
        expected : Expected or None
            Of the errors of the axes at all positions; None: the quantity is the position of a further target.
        count : int
            k: number of candidates, the first of the positions.
        """
        n, k = len(station), len(point)
        stations = Stations(station, np.zeros(n))
        e = directions(point, station).transpose(1, 0, 2)
        fine = sees.sum(axis=0) >= 3
        w = np.where(sees.T & fine[:, None], 1.0 / noise, 0.0)
        Q = np.zeros((k, n, 4 * n))
        for j in range(n):
            Q[:, j, 4 * j : 4 * j + 3] = -e[:, j]
            Q[:, j, 4 * j + 3] = -1.0
        Q *= w[..., None]
        E = w[..., None] * e
        centre = point[:count].mean(axis=0)
        G = rigid_motions(point[:count], centre)
        if expected is None:
            A = np.einsum("kja,kjb->kab", E, E)
            A[~fine] = np.eye(3)
            fine = fine & (np.linalg.cond(A) < 1e12)
            A[~fine] = np.eye(3)
            D = np.where(fine[:, None, None], np.linalg.inv(A), 0.0)
            basis = _without_motions(stations.motions(centre).reshape(4 * n, 6))
            Q = Q @ basis
            F = -D @ np.einsum("kja,kjp->kap", E, Q)
            rows = np.where(fine[:, None, None], Q + E @ F, 0.0)
            wanted = _in_datum(F[:count], G, fine[:count])
            own, known = np.trace(D[:count], axis1=1, axis2=2), np.eye(basis.shape[1]) / _PRIOR**2
            return cls(rows[:count], known, wanted, own, fine[:count], rows[count:])
        rows = np.concatenate([E @ expected.columns, Q], axis=2)
        known = np.diag(np.concatenate([expected.size**-2.0, np.full(4 * n, _PRIOR**-2.0)]))
        shown = _in_datum(expected.columns[:count], G, np.ones(count, bool))
        wanted = np.concatenate([shown, np.zeros((count, 3, 4 * n))], axis=2)
        return cls(rows[:count], known, wanted, np.zeros(count), fine[:count], rows[count:])

    def covariance(self, chosen: Sequence[int] | NDArray[np.intp] | None = None) -> Array:
        """Return the covariance (P, P) of the unknowns with the chosen candidates; default: the further targets."""
        rows = self.further if chosen is None else self.rows[np.asarray(chosen, dtype=np.intp)]
        B = rows.reshape(-1, self.known.shape[0])
        return _inverse(self.known + B.T @ B)

    def worth(self, chosen: Sequence[int] | NDArray[np.intp] | None = None) -> Array:
        """Return the standard uncertainty at every candidate, (k,), m, with the chosen ones measured."""
        return self.sigma(self.covariance(chosen))

    def sigma(self, C: Array) -> Array:
        """Return the standard uncertainty, three coordinates together, at every candidate, (k,), m; NaN if unknown."""
        variance = np.einsum("kap,pq,kaq->k", self.wanted, C, self.wanted, optimize=True) + self.own
        return np.where(self.fine | ~self.own.any(), np.sqrt(np.maximum(variance, 0.0)), np.nan)

    def choose(self, count: int, minimise: Literal["largest", "mean"]) -> list[int]:
        """Return the numbers of the candidates to measure."""
        power = POWERS[minimise]
        chosen: list[int] = []
        C = _inverse(self.known)
        for _ in range(count):
            gain = self._gains(C, self._weight(C, power))
            gain[chosen] = -np.inf
            chosen.append(int(np.argmax(gain)))
            C = self.covariance(chosen)
        return self._exchanged(chosen, power)

    def _exchanged(self, chosen: list[int], power: float) -> list[int]:
        """Return the set after exchanges of one target each, while there is a gain."""
        C = self.covariance(chosen)
        best = self._cost(C, power)
        for _ in range(_MAX_EXCHANGES):
            V = self._weight(C, power)
            trials = []
            for out in np.argsort(self._losses(C, V, chosen))[:_OUT]:
                rest = [*chosen[:out], *chosen[out + 1 :]]
                gain = self._gains(self.covariance(rest), V)
                gain[chosen] = -np.inf
                for new in np.argsort(-gain)[:_IN]:
                    if np.isfinite(gain[new]):
                        trials.append([*rest, int(new)])
            costs = [self._cost(self.covariance(trial), power) for trial in trials]
            if not costs or not min(costs) < best * (1 - _MIN_GAIN):
                break
            best = min(costs)
            chosen = trials[int(np.argmin(costs))]
            C = self.covariance(chosen)
        return sorted(chosen)

    def _cost(self, C: Array, power: float) -> float:
        """Return the power mean of the uncertainties, m."""
        sigma = self.sigma(C)
        sigma = sigma[np.isfinite(sigma)]
        top = float(sigma.max())
        return top * float(np.mean((sigma / top) ** power) ** (1 / power))

    def _weight(self, C: Array, power: float) -> Array:
        """Return V (P, P): the cost decreases with the trace of V C."""
        sigma = self.sigma(C)
        weight = np.nan_to_num((sigma / np.nanmax(sigma)) ** (power - 2.0))
        return np.asarray(np.einsum("k,kap,kaq->pq", weight, self.wanted, self.wanted, optimize=True))

    def _gains(self, C: Array, V: Array) -> Array:
        """Return the decrease of the trace of V C by each candidate, (k,); -inf for candidates that are not visible."""
        BC = self.rows @ C
        inner = np.eye(self.rows.shape[1]) + BC @ self.rows.transpose(0, 2, 1)
        gain = np.trace(np.linalg.solve(inner, BC @ V @ BC.transpose(0, 2, 1)), axis1=1, axis2=2)
        return np.where(self.fine, gain, -np.inf)

    def _losses(self, C: Array, V: Array, chosen: list[int]) -> Array:
        """Return the increase of the trace of V C without each of the chosen candidates."""
        B = self.rows[chosen]
        BC = B @ C
        inner = np.eye(B.shape[1]) * (1 + 1e-9) - BC @ B.transpose(0, 2, 1)
        return np.asarray(np.trace(np.linalg.solve(inner, BC @ V @ BC.transpose(0, 2, 1)), axis1=1, axis2=2))


def _inverse(M: Array) -> Array:
    scale = 1.0 / np.sqrt(np.diag(M))
    outer = np.outer(scale, scale)
    return np.asarray(np.linalg.inv(M * outer) * outer)


def _without_motions(T: Array) -> Array:
    """Return orthonormal columns that span the stations' parameters without rigid motions T (4 n, 6)."""
    return np.asarray(np.linalg.qr(T / np.linalg.norm(T, axis=0), mode="complete")[0][:, 6:])


def _in_datum(F: Array, G: Array, fine: NDArray[np.bool_]) -> Array:
    """Return effects (k, 3, P) minus their best-fit rigid motions G (k, 3, 6) at the candidates ``fine``."""
    some = fine.nonzero()[0]
    shift = np.linalg.lstsq(G[some].reshape(-1, 6), F[some].reshape(3 * len(some), -1))[0]
    return np.asarray(F - G @ shift)
