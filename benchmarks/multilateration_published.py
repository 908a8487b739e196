"""Published schemes for comparison: stations and targets alternately, and dead paths from the first target.

Takeuchi et al., section 2.2, equations (6) and (7), with L_j = |u_1 - U_j|. The position of the first target is fixed,
all others are relative to it. Each half of an iteration is a set of least-squares problems of three unknowns. The
convergence is linear and slow, since each half keeps the result of the other fixed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.multilateration.model import Shared, Sources
from errormotion.methods.multilateration.networks import Network, bound
from errormotion.methods.multilateration.start import Stations, directions

TOLERANCE = 1e-9
_HALF_STEPS = 2


@dataclass(frozen=True)
class Alternated:
    """Result of the alternating scheme.

    Attributes
    ----------
    target : ndarray (m, 3)
        m, fitted to the nominal targets as a free network.
    station : ndarray (n, 3)
        m, in the same frame.
    iterations : int
        Pairs of steps (i) and (ii).
    converged : bool
        Whether the last pair moved no target by more than the tolerance. The remaining error can be much larger: at a
        rate of 1 - 1e-4 it is ten thousand times the last step.
    moved : float
        Largest displacement of a target by the last pair, m.
    rate : float
        Ratio of the last two of these, at most 1.
    rms : float
        Root mean square of the residuals, m.
    """

    target: Array
    station: Array
    iterations: int
    converged: bool
    moved: float
    rate: float
    rms: float

    @property
    def remaining(self) -> float:
        """Estimate of the remaining displacement of the targets, m: the rest of a geometric series."""
        return float(self.moved * self.rate / (1.0 - self.rate)) if self.rate < 1.0 else np.inf


def alternate(
    displacement: ArrayLike,
    target: ArrayLike,
    station: ArrayLike,
    *,
    tolerance: float = TOLERANCE,
    iterations: int = 1000,
) -> Alternated:
    """Estimate targets and stations alternately.

    Parameters
    ----------
    displacement : array_like (n, m)
        m, all known; only differences from those of the first target are used.
    target : array_like (m, 3)
        Reference targets, m.
    station : array_like (n, 3)
        Approximate positions of the stations, m.
    tolerance : float
        Displacement of the targets by a pair of steps, m, below which the iteration ends.
    iterations : int
        Maximum number of pairs of steps.

    Raises
    ------
    MethodError
        A displacement is NaN.
    """
    d, u, U = (np.array(a, dtype=float) for a in (displacement, target, station))
    if not np.isfinite(d).all():
        raise MethodError("Expected all displacements, for the alternating scheme; found NaN. Use the solver.")
    d -= d[:, :1]
    nominal, moved, rate, done = u.copy(), np.inf, 1.0, 0
    while done < iterations:
        done += 1
        before, last = u.copy(), moved
        for _ in range(_HALF_STEPS):
            U = _stations(d, u, U)
        length = np.linalg.norm(u[0] - U, axis=1)
        for _ in range(_HALF_STEPS):
            u[1:] = _targets(d[:, 1:] + length[:, None], u[1:], U)
        moved = float(np.sqrt(((u - before) ** 2).sum(axis=1).max()))
        rate = moved / last if last < np.inf else 1.0
        if moved < tolerance:
            break
    r = d - (np.linalg.norm(u - U[:, None], axis=-1) - np.linalg.norm(u[0] - U, axis=1)[:, None])
    u, U = fitted(u, U, nominal)
    return Alternated(u, U, done, moved < tolerance, moved, min(rate, 1.0), float(np.sqrt(np.mean(r**2))))


def _stations(d: Array, u: Array, U: Array) -> Array:
    """Return the stations after a Gauss-Newton step on equation (6)."""
    v = u - U[:, None]
    distance = np.linalg.norm(v, axis=-1)
    e = v / distance[..., None]
    r, J = d - (distance - distance[:, :1]), e[:, :1] - e
    A = J.transpose(0, 2, 1) @ J
    step = np.linalg.solve(A, np.einsum("jia,ji->ja", J, r)[..., None])[..., 0]
    # At most half the distance to the nearest target.
    share = np.minimum(1.0, 0.5 * distance.min(axis=1) / np.maximum(np.linalg.norm(step, axis=1), 1e-300))
    moved: Array = U + share[:, None] * step
    return moved


def _targets(reach: Array, u: Array, U: Array) -> Array:
    """Return the targets after a Gauss-Newton step on equation (7), from known stations and distances."""
    v = u - U[:, None]
    distance = np.linalg.norm(v, axis=-1)
    e = v / distance[..., None]
    A = np.einsum("jia,jib->iab", e, e)
    b = np.einsum("jia,ji->ia", e, reach - distance)
    moved: Array = u + np.linalg.solve(A, b[..., None])[..., 0]
    return moved


def fitted(target: Array, station: Array, nominal: Array) -> tuple[Array, Array]:
    """Return targets (m, 3) and stations (n, 3) moved to the best fit of the targets to the nominal ones."""
    a, b = target.mean(axis=0), nominal.mean(axis=0)
    U, _, Vt = np.linalg.svd((nominal - b).T @ (target - a))
    U[:, 2] *= np.sign(np.linalg.det(U @ Vt))
    R = U @ Vt
    return (target - a) @ R.T + b, (station - a) @ R.T + b


def relative_bound(target: Array, station: Array, *, noise: float, first: int = 0) -> tuple[Array, Network]:
    """Return the covariances (m, 3, 3) of the formulation relative to one target, and the network with those it states.

    It assumes the readings of that target to be exact: their noise affects all results, but is not in the stated
    covariance.
    """
    sd = np.full((len(station), len(target)), noise)
    sd[:, first] *= 1e-3
    changes = np.zeros((len(station), *sd.shape))
    changes[np.arange(len(station)), np.arange(len(station)), first] = noise
    sources = Sources(scales=[Shared(f"station {j + 1}", each) for j, each in enumerate(changes)])
    return bound(target, station, noise=sd, sources=sources).covariance, bound(target, station, noise=sd)


def jacobian(target: Array, stations: Stations, known: NDArray[np.bool_]) -> sp.csr_array:
    """Return the sparse derivatives of the known readings by (u_1, ..., u_m, U_1, L_1, ..., U_n, L_n).

    Parameters
    ----------
    target : ndarray (m, 3)
        m.
    stations : Stations
    known : ndarray (n, m)
        Rows of the result: by target, then by station.
    """
    n, m = known.shape
    e = directions(target, stations.position).transpose(1, 0, 2)
    values = np.concatenate([e, -e, np.full((m, n, 1), -1.0)], axis=-1)
    i, j = np.arange(m)[:, None, None], np.arange(n)[None, :, None]
    columns = np.concatenate(np.broadcast_arrays(3 * i + np.arange(3), 3 * m + 4 * j + np.arange(3)), axis=-1)
    columns = np.concatenate([columns, np.broadcast_to(3 * m + 4 * j + 3, (m, n, 1))], axis=-1)
    some = known.T
    rows = 7 * np.arange(np.count_nonzero(some) + 1)
    return sp.csr_array((values[some].ravel(), columns[some].ravel(), rows), shape=(len(rows) - 1, 3 * m + 4 * n))
