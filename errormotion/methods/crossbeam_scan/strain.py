"""From what the maps say to how the profiler moved: a scan is no rigid picture, because the carriage turns on its way.

A line at the feed s shows (x, 0, z) in the profiler's frame. In the cold frame of the artefact's middle it lies at
(x, 0, z) + s f, with f the feed's direction. What is registered is the map Q = (x, s, z), so P = B Q with

    B = 1 + (f - e_y) e_y^T .

The warm carriage displaces a point by T + r x (x, 0, z) + s g: (T, r) is the twist of the profiler at its origin when
the axis stands over the artefact's middle, and g = dT/dY says how this changes along the scan. (A rigid picture would
have g = r x f.) Two maps differ by B^-1 of that, which registration states as a twist (T_Q, R_Q) at the origin and
displacements c per metre of feed. By equal coefficients of 1, x, z and s,

    EC = f_y EC_Q,   EA = f_y EA_Q,   EB = EB_Q - f_z EC_Q,   T = B T_Q,   g = B (c + R_Q x e_y) .

Roll and yaw of the maps show nearly as g does; what tells them apart is the artefact's relief alone. But g is the slope
of T along the axis, and T is known at every artefact: by a spline through the neighbours the slope is, too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline
from scipy.linalg import block_diag, cho_factor, cho_solve
from scipy.spatial.transform import RigidTransform

from errormotion.kinematics.twists import cross_matrix
from errormotion.methods.crossbeam_scan.chain import feed_direction

Array = NDArray[np.float64]

FEED = ("feed_x", "feed_y", "feed_z")
"""Parameters of the registration that take the drift along a scan."""
_DRIFT = slice(6, 9)
# Metres and radians of one size, so that the normal equations are well scaled.
_UNIT = np.array([1e-6] * 3 + [1e-5] * 3 + [1e-5] * 3)
_LEAST_SLOPE_ERROR = 1e-8


@dataclass(frozen=True)
class Motions:
    """How the profiler moved at every artefact.

    Attributes
    ----------
    twist : ndarray (n, 6)
        (T, r) at the profiler's origin and in its frame, m and rad.
    covariance : ndarray (n, 6, 6)
        Of these, the registration's noise alone.
    gain : ndarray (6 n, 9 n)
        What takes all observations (T, r, g) to the twists.
    slope_error : ndarray (3,)
        What the spline's slope is taken to be off by, standard deviation, 1.
    """

    twist: Array
    covariance: Array
    gain: Array
    slope_error: Array


def from_maps(profiler_pose: RigidTransform) -> Array:
    """Return the matrix (9, 9) that takes (T_Q, R_Q, c) at the map's origin to (T, r, g)."""
    f = feed_direction(profiler_pose)
    B = np.eye(3)
    B[:, 1] = f
    W = np.zeros((9, 9))
    W[:3, :3] = W[6:, 6:] = B
    W[3:6, 3:6] = np.diag([f[1], 1.0, f[1]])
    W[4, 5] = -f[2]
    W[6:, 3:6] = B @ -cross_matrix(np.array([0.0, 1.0, 0.0]))
    return W


def rigid(profiler_pose: RigidTransform) -> Array:
    """Return the matrix (9, 6) that takes (T_Q, R_Q) to (T, r, g) where the picture counts as rigid."""
    return from_maps(profiler_pose)[:, :6]


def slopes(places: ArrayLike) -> tuple[Array, Array]:
    """Return two matrices (n, n) that take values at places to their slopes there: by a cubic spline, and by less.

    The second uses one neighbour on each side; for two places it says 0. Its difference from the first is a measure of
    what the first misses.
    """
    y = np.asarray(places, dtype=float)
    n = y.size
    if n < 2:
        return np.zeros((n, n)), np.zeros((n, n))
    fine = np.asarray(CubicSpline(y, np.eye(n), bc_type="not-a-knot")(y, 1))
    if n == 2:
        return fine, np.zeros((2, 2))
    return fine, np.asarray(np.gradient(np.eye(n), y, axis=0, edge_order=1 if n == 3 else 2))


def combined(observations: ArrayLike, covariance: ArrayLike, places: ArrayLike, *, neighbours: bool = True) -> Motions:
    """Return the motion of the profiler at every artefact from all registrations of one cycle: least squares.

    Parameters
    ----------
    observations : (n, 9)
        (T, r, g) of every artefact.
    covariance : (n, 9, 9)
        Of these.
    places : (n,)
        Of the artefacts along the axis, m, rising.
    neighbours : bool
        Whether g is the slope of T along the axis; else it is an unknown of every scan.
    """
    o, C, y = (np.asarray(value, dtype=float) for value in (observations, covariance, places))
    n = len(y)
    if not neighbours or n < 2:
        gain = block_diag(*[np.eye(6, 9)] * n)
        return Motions(o[:, :6].copy(), C[:, :6, :6].copy(), gain, np.full(3, np.inf))
    fine, coarse = slopes(y)
    A = np.zeros((n, 9, n, 6))
    for k in range(n):
        A[k, :6, k] = np.eye(6)
        for axis in range(3):
            A[k, 6 + axis, :, axis] = fine[k]
    missed = np.sqrt(np.mean(((fine - coarse) @ o[:, :3]) ** 2, axis=0))
    missed = np.maximum(missed, _LEAST_SLOPE_ERROR)
    unit = _UNIT[:6]
    scaled = (A / _UNIT[:, None, None] * unit).reshape(9 * n, 6 * n)
    noise = C.copy()
    noise[:, range(6, 9), range(6, 9)] += missed**2
    weight = np.linalg.inv(noise / np.outer(_UNIT, _UNIT))
    weighted = np.einsum("kij,kjm->kim", weight, scaled.reshape(n, 9, 6 * n)).reshape(9 * n, 6 * n)
    factor = cho_factor(scaled.T @ weighted)
    gain = cho_solve(factor, weighted.T)
    inverse = cho_solve(factor, np.eye(6 * n))
    blocks = np.stack([inverse[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(n)]) * np.outer(unit, unit)
    gain = gain * np.tile(unit, n)[:, None] / np.tile(_UNIT, n)
    return Motions((gain @ o.ravel()).reshape(n, 6), blocks, gain, missed)
