"""Choosing targets: the set of a grid of candidates that leaves least uncertain what is wanted of the whole volume.

What is not known before measuring has Gaussian information M = M_0 + sum_i B_i^T B_i, one term for each chosen target;
what is wanted at place c is Phi_c times the unknowns, with covariance Phi_c M^-1 Phi_c^T + K_c.

* ``target``: the unknowns are the stations' places and dead paths. A target with n readings tells n - 3 numbers of
  them, what is left of its readings when it has taken its own place: B_i = (1 - hat) W^1/2 Q_i, of rank one with four
  stations. At c a further target is measured: K_c from its own readings, Phi_c what the stations do to it.
* ``axes``: the unknowns are the errors of the axes as well, series of polynomials whose coefficients are expected to
  have a size (see `parameters`). Readings tell of both: B_i = W^1/2 [e A_i, Q_i]. At c the volumetric error is wanted.

Both have the datum of the whole grid: motions of the whole are left out. Targets are taken one by one, the one that
helps most first; then exchanged one for one while that helps, each by an update of rank n and the best of them
reckoned anew. For the largest uncertainty the mean of a high power of it stands in.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from errormotion.arrays import Array
from errormotion.methods.multilateration.identification.parameters import Chain, Term, first_order, unknowns
from errormotion.methods.multilateration.network.model import Stations, directions, motions

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

POWERS = {"mean": 1.0, "largest": 16.0}
_LOOSE = 0.1
"""What is known of stations and dead paths before, m: nothing that matters, and a matrix that has an inverse."""
_OUT, _IN = 4, 6
"""Exchanges that are reckoned exactly in each turn: targets that go, and that come for each."""
_TURNS = 400
_GAIN = 1e-6
_FALLOFF = 2.0
"""How fast coefficients are expected to fall with their order."""


@dataclass(frozen=True)
class Expected:
    """Errors of the axes as they are expected before measuring.

    Attributes
    ----------
    columns : ndarray (k, 3, term)
        What a unit of each coefficient does at each candidate, m.
    size : ndarray (term,)
        Standard deviation of each coefficient.
    """

    columns: Array
    size: Array

    @classmethod
    def of(
        cls, chain: str, position: Array, reflector: Array, order: int, displacement: float, rotation: float
    ) -> Expected:
        """Return them for axis positions (k, 3), m, with ``reflector`` (3,) at the tool.

        Raises
        ------
        MethodError
            Not a chain of X, Y and Z.
        """
        at = np.tile(reflector, (len(position), 1))
        model = Chain.of(chain, position, at)
        terms = unknowns(model, order)
        size = np.array([_size(term, displacement, rotation) for term in terms])
        return cls(model.columns(terms, position, at), size)


def _size(term: Term, displacement: float, rotation: float) -> float:
    """Return the standard deviation of a coefficient: of the lowest order as large as expected, of higher ones less."""
    if term.order < 0:
        return rotation
    higher = term.order - first_order(term.error) + 1
    return float((rotation if term.error[1] in "ABC" else displacement) / higher**_FALLOFF)


@dataclass(frozen=True)
class Volume:
    """Candidates, the rows of their readings in the design matrix, and what is required at each.

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
        Candidates that three stations see.
    further : ndarray (l, n, P)
        B of further targets, which may be measured and are not to be chosen.
    """

    rows: Array
    known: Array
    wanted: Array
    own: Array
    fine: NDArray[np.bool_]
    further: Array

    @classmethod
    def of(
        cls, station: Array, place: Array, sees: NDArray[np.bool_], noise: float, expected: Expected | None, count: int
    ) -> Volume:
        """Return the candidates and their rows.

        Parameters
        ----------
        station : ndarray (n, 3)
            m.
        place : ndarray (k + l, 3)
            m.
        sees : ndarray of bool (n, k + l)
        noise : float
            Of a reading, m.
        expected : Expected or None
            Of the errors of the axes at all places; None: a further target is wanted.
        count : int
            k: so many places are candidates, and the volume.
        """
        n, k = len(station), len(place)
        stations = Stations(station, np.zeros(n), np.zeros(0))
        e = directions(place, stations).transpose(1, 0, 2)
        fine = sees.sum(axis=0) >= 3
        w = np.where(sees.T & fine[:, None], 1.0 / noise, 0.0)
        Q = np.zeros((k, n, 4 * n))
        for j in range(n):
            Q[:, j, 4 * j : 4 * j + 3] = -e[:, j]
            Q[:, j, 4 * j + 3] = -1.0
        Q *= w[..., None]
        E = w[..., None] * e
        centre = place[:count].mean(axis=0)
        G = motions(place[:count], centre)
        if expected is None:
            A = np.einsum("kja,kjb->kab", E, E)
            A[~fine] = np.eye(3)
            fine = fine & (np.linalg.cond(A) < 1e12)
            A[~fine] = np.eye(3)
            D = np.where(fine[:, None, None], np.linalg.inv(A), 0.0)
            basis = _without_motions(stations.motions(centre))
            Q = Q @ basis
            F = -D @ np.einsum("kja,kjp->kap", E, Q)
            rows = np.where(fine[:, None, None], Q + E @ F, 0.0)
            wanted = _in_datum(F[:count], G, fine[:count])
            own, known = np.trace(D[:count], axis1=1, axis2=2), np.eye(basis.shape[1]) / _LOOSE**2
            return cls(rows[:count], known, wanted, own, fine[:count], rows[count:])
        rows = np.concatenate([E @ expected.columns, Q], axis=2)
        known = np.diag(np.concatenate([expected.size**-2.0, np.full(4 * n, _LOOSE**-2.0)]))
        shown = _in_datum(expected.columns[:count], G, np.ones(count, bool))
        wanted = np.concatenate([shown, np.zeros((count, 3, 4 * n))], axis=2)
        return cls(rows[:count], known, wanted, np.zeros(count), fine[:count], rows[count:])

    def covariance(self, chosen: Sequence[int] | NDArray[np.intp] | None = None) -> Array:
        """Return that of the unknowns, (P, P), when the chosen ones are measured, or without them the further ones."""
        rows = self.further if chosen is None else self.rows[np.asarray(chosen, dtype=np.intp)]
        B = rows.reshape(-1, self.known.shape[0])
        return _inverse(self.known + B.T @ B)

    def worth(self, chosen: Sequence[int] | NDArray[np.intp] | None = None) -> Array:
        """Return the standard uncertainty at every candidate, (k,), m, when these are measured."""
        return self.sigma(self.covariance(chosen))

    def sigma(self, C: Array) -> Array:
        """Return the standard uncertainty, three coordinates together, at every candidate, (k,), m; NaN where none."""
        variance = np.einsum("kap,pq,kaq->k", self.wanted, C, self.wanted, optimize=True) + self.own
        return np.where(self.fine | ~self.own.any(), np.sqrt(np.maximum(variance, 0.0)), np.nan)

    def choose(self, count: int, minimise: Literal["largest", "mean"]) -> list[int]:
        """Return the candidates to measure, by number."""
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
        """Return the set after exchanges, one for one, while they help."""
        C = self.covariance(chosen)
        best = self._cost(C, power)
        for _ in range(_TURNS):
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
            if not costs or not min(costs) < best * (1 - _GAIN):
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
        """Return V (P, P): the cost falls with the trace of V C."""
        sigma = self.sigma(C)
        weight = np.nan_to_num((sigma / np.nanmax(sigma)) ** (power - 2.0))
        return np.asarray(np.einsum("k,kap,kaq->pq", weight, self.wanted, self.wanted, optimize=True))

    def _gains(self, C: Array, V: Array) -> Array:
        """Return the decrease of the trace of V C by each candidate, (k,); -inf for candidates that are not seen."""
        BC = self.rows @ C
        inner = np.eye(self.rows.shape[1]) + BC @ self.rows.transpose(0, 2, 1)
        gain = np.trace(np.linalg.solve(inner, BC @ V @ BC.transpose(0, 2, 1)), axis1=1, axis2=2)
        return np.where(self.fine, gain, -np.inf)

    def _losses(self, C: Array, V: Array, chosen: list[int]) -> Array:
        """Return by how much the trace of V C rises without each of the chosen ones."""
        B = self.rows[chosen]
        BC = B @ C
        inner = np.eye(B.shape[1]) * (1 + 1e-9) - BC @ B.transpose(0, 2, 1)
        return np.asarray(np.trace(np.linalg.solve(inner, BC @ V @ BC.transpose(0, 2, 1)), axis1=1, axis2=2))


def _inverse(M: Array) -> Array:
    scale = 1.0 / np.sqrt(np.diag(M))
    outer = np.outer(scale, scale)
    return np.asarray(np.linalg.inv(M * outer) * outer)


def _without_motions(T: Array) -> Array:
    """Return orthonormal columns that span the stations' parameters without motions T (4 n, 6) of the whole."""
    return np.asarray(np.linalg.qr(T / np.linalg.norm(T, axis=0), mode="complete")[0][:, 6:])


def _in_datum(F: Array, G: Array, fine: NDArray[np.bool_]) -> Array:
    """Return effects (k, 3, P) less the motions (k, 3, 6) of the whole that fit them best at the fine candidates."""
    some = fine.nonzero()[0]
    shift = np.linalg.lstsq(G[some].reshape(-1, 6), F[some].reshape(3 * len(some), -1))[0]
    return np.asarray(F - G @ shift)
