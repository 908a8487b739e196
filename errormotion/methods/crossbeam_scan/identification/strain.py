"""From registered maps to the motion of the profiler: a scan is not rigid, because the carriage moves during the feed.

A line at the feed s measures (x, 0, z) in the profiler's frame. In the cold frame at the artefact's middle, this point
is P = (x, 0, z) + s f, with f the direction of the feed. The registered map is Q = (x, s, z), so that P = B Q with

    B = 1 + (f - e_y) e_y^T .

The warm carriage displaces a point by T + r x (x, 0, z) + s g: (T, r) is the twist of the profiler at its origin when
the axis is over the artefact's middle, and g = dT/dY is its change along the scan. (For a rigid scan, g = r x f.) Two
maps differ by B^-1 times this; the registration states it as a twist (T_Q, R_Q) at the origin and displacements c per
metre of feed. Comparison of the coefficients of 1, x, z and s results in

    EC = f_y EC_Q,   EA = f_y EA_Q,   EB = EB_Q - f_z EC_Q,   T = B T_Q,   g = B (c + R_Q x e_y) .

Yaw and pitch are determined by the relief along the lines alone: pitch EA moves a point along the feed by -z EA. The
slope along the feed would show both if the scan were rigid, but it is g, which does not depend on them. Where the
carriage follows a guide, pitch and yaw are the slopes of the guide, EA = dEZ/dY and EC = -dEX/dY: `guided` adds this
with a stated uncertainty; the slopes are those of a spline through the artefacts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag, cho_factor, cho_solve
from scipy.spatial.transform import RigidTransform

from errormotion.arrays import Array
from errormotion.kinematics.twists import cross_matrix
from errormotion.methods.crossbeam_scan.identification.chain import feed_direction

FEED = ("feed_x", "feed_y", "feed_z")
"""Parameters of the registration that describe the drift along a scan."""
DRIFT = 1e-3
"""Standard deviation of their prior, 1: a millimetre per metre, far more than the drift of any carriage. With it, an
artefact of little relief results in a large uncertainty instead of an error."""
# Units of metres and radians, so that the normal equations are well scaled.
_UNIT = np.array([1e-6] * 3 + [1e-5] * 3)
# (rotation, displacement, sign): EA = dEZ/dY, EC = -dEX/dY
_GUIDE = ((3, 2, 1.0), (5, 0, -1.0))


@dataclass(frozen=True)
class Guided:
    """Twists of the profiler at every artefact, with the guide taken into account.

    Attributes
    ----------
    twist : ndarray (n, 6)
        (T, r) at the profiler's origin and in its frame, m and rad.
    covariance : ndarray (n, 6, 6)
        Of ``twist``.
    gain : ndarray (6 n, 6 n)
        Derivative of ``twist`` with respect to the registered twists.
    assumed : ndarray (2 n, 6 n)
        Effect of one standard uncertainty of each assumption on ``twist``: pitch and yaw follow the guide.
    slope_error : ndarray (2,)
        Estimated standard deviation of the error of the spline's slopes of EZ and EX, 1.
    """

    twist: Array
    covariance: Array
    gain: Array
    assumed: Array
    slope_error: Array


def from_maps(profiler_pose: RigidTransform) -> Array:
    """Return the matrix (..., 9, 9) that converts (T_Q, R_Q, c) at the map's origin to (T, r, g)."""
    f = feed_direction(profiler_pose)
    B = np.zeros((*f.shape, 3)) + np.eye(3)
    B[..., 1] = f
    W = np.zeros((*f.shape[:-1], 9, 9))
    W[..., :3, :3] = W[..., 6:, 6:] = B
    W[..., 3, 3] = W[..., 5, 5] = f[..., 1]
    W[..., 4, 4], W[..., 4, 5] = 1.0, -f[..., 2]
    W[..., 6:, 3:6] = B @ -cross_matrix(np.array([0.0, 1.0, 0.0]))
    return W


def slopes(positions: ArrayLike) -> tuple[Array, Array]:
    """Return two matrices (n, n) from values at positions to their slopes: by a cubic spline, and by differences.

    The second uses one neighbour on each side; for two positions it is 0. Its difference from the first is a measure of
    the error of the first.
    """
    from scipy.interpolate import CubicSpline

    y = np.asarray(positions, dtype=float)
    n = y.size
    if n < 2:
        return np.zeros((n, n)), np.zeros((n, n))
    fine = np.asarray(CubicSpline(y, np.eye(n), bc_type="not-a-knot")(y, 1))
    if n == 2:
        return fine, np.zeros((2, 2))
    return fine, np.asarray(np.gradient(np.eye(n), y, axis=0, edge_order=1 if n == 3 else 2))


def guided(
    twist: ArrayLike, covariance: ArrayLike, positions: ArrayLike, to_carriage: ArrayLike, uncertainty: float
) -> Guided:
    """Return the twists of one cycle by least squares, with pitch and yaw of the carriage following the guide.

    Parameters
    ----------
    twist, covariance : (n, 6), (n, 6, 6)
        (T, r) of every artefact from its registration alone, m and rad.
    positions : (n,)
        Of the artefacts along the axis, m, increasing.
    to_carriage : (6, 6)
        Converts twists of the profiler to errors of the carriage.
    uncertainty : float
        Standard uncertainty of EA - dEZ/dY and of EC + dEX/dY, rad. The error of the spline's slopes is added.
    """
    e, C, A = (np.asarray(value, dtype=float) for value in (twist, covariance, to_carriage))
    n = len(e)
    if n < 2:
        return Guided(e.copy(), C.copy(), np.eye(6 * n), np.zeros((2 * n, 6 * n)), np.zeros(2))
    fine, coarse = slopes(positions)
    E = e @ A.T
    rows, errors = np.zeros((2, n, n, 6)), np.zeros(2)
    difference = fine - coarse
    for i, (turn, shift, sign) in enumerate(_GUIDE):
        by_noise = np.mean(difference**2 @ np.einsum("a,kab,b->k", A[shift], C, A[shift]))
        errors[i] = np.sqrt(max(np.mean((difference @ E[:, shift]) ** 2) - by_noise, 0.0))
        rows[i] = np.eye(n)[:, :, None] * A[turn] - sign * fine[:, :, None] * A[shift]
    sigma = np.sqrt(uncertainty**2 + errors**2)
    scaled = (rows * _UNIT).reshape(2, n, 6 * n) / sigma[:, None, None]
    weight = block_diag(*np.linalg.inv(C / np.outer(_UNIT, _UNIT)))
    prior = np.einsum("ika,ikb->ab", scaled, scaled)
    factor = cho_factor(weight + prior)
    gain = cho_solve(factor, weight)
    inverse = cho_solve(factor, np.eye(6 * n))
    blocks = np.stack([inverse[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(n)]) * np.outer(_UNIT, _UNIT)
    unit = np.tile(_UNIT, n)
    gain = gain * unit[:, None] / unit
    assumed = scaled.reshape(2 * n, 6 * n) @ inverse * unit
    return Guided((gain @ e.ravel()).reshape(n, 6), blocks, gain, assumed, errors)
