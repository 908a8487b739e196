"""Model of multilateration: readings from targets and stations, their derivatives, and the order of the parameters.

    d_ij = |u_i - U_j| - L_j + sum_k p_k c_kij

u_i is target i, U_j station j, L_j its dead path, and p_k further parameters with known coefficients. The order of the
stations' parameters is (U_1, L_1, U_2, L_2, ..., p).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.kinematics.twists import rigid_motions

if TYPE_CHECKING:
    import scipy.sparse as sp


@dataclass(frozen=True)
class Stations:
    """Positions (n, 3) and dead paths (n,) of the stations, m, and further parameters (k,)."""

    position: Array
    dead_path: Array
    value: Array

    def stepped(self, step: Array) -> Stations:
        """Return the stations after a step (4 n + k,) of their parameters."""
        n = len(self.position)
        block = step[: 4 * n].reshape(n, 4)
        return Stations(self.position + block[:, :3], self.dead_path + block[:, 3], self.value + step[4 * n :])

    @property
    def vector(self) -> Array:
        """Parameters (4 n + k,)."""
        return np.concatenate([np.column_stack([self.position, self.dead_path]).ravel(), self.value])

    def motions(self, centre: Array) -> Array:
        """Return the effect (4 n + k, 6) of rigid motions of the network (t, r about ``centre``) on the parameters."""
        n = len(self.position)
        T = np.zeros((4 * n + len(self.value), 6))
        T[: 4 * n].reshape(n, 4, 6)[:, :3] = rigid_motions(self.position, centre)
        return T

    def complement(self, centre: Array, free: NDArray[np.bool_]) -> Array:
        """Return orthonormal columns (4 n + k, p) that span the free parameters without the rigid motions."""
        T = self.motions(centre)[free]
        size = np.linalg.norm(T, axis=0)
        Z = np.zeros((len(free), len(T) - 6))
        Z[free] = np.linalg.qr(T / np.where(size > 0, size, 1.0), mode="complete")[0][:, 6:]
        return Z


def readings(target: Array, stations: Stations, extra: Array | None = None) -> Array:
    """Return the displacements (n, m), m, of targets (m, 3) from stations."""
    distance = np.linalg.norm(target - stations.position[:, None], axis=-1)
    found: Array = distance - stations.dead_path[:, None]
    return found if extra is None else found + np.tensordot(stations.value, extra, 1)


def directions(target: Array, stations: Stations) -> Array:
    """Return the unit vectors (n, m, 3) from the stations to the targets."""
    v = target - stations.position[:, None]
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True), dtype=float)


def jacobian(target: Array, stations: Stations, known: NDArray[np.bool_]) -> sp.csr_array:
    """Return the sparse derivatives of the known readings by (u_1, ..., u_m, U_1, L_1, ..., U_n, L_n).

    Parameters
    ----------
    target : ndarray (m, 3)
        m.
    stations : Stations
        Without further parameters.
    known : ndarray (n, m)
        Rows of the result: by target, then by station.
    """
    import scipy.sparse as sp

    n, m = known.shape
    e = directions(target, stations).transpose(1, 0, 2)
    values = np.concatenate([e, -e, np.full((m, n, 1), -1.0)], axis=-1)
    i, j = np.arange(m)[:, None, None], np.arange(n)[None, :, None]
    columns = np.concatenate(np.broadcast_arrays(3 * i + np.arange(3), 3 * m + 4 * j + np.arange(3)), axis=-1)
    columns = np.concatenate([columns, np.broadcast_to(3 * m + 4 * j + 3, (m, n, 1))], axis=-1)
    some = known.T
    rows = 7 * np.arange(np.count_nonzero(some) + 1)
    return sp.csr_array((values[some].ravel(), columns[some].ravel(), rows), shape=(len(rows) - 1, 3 * m + 4 * n))
