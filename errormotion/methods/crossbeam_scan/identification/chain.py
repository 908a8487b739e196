"""The chain: from a registered map to the motion of the profiler's frame, and on to the six errors of the carriage.

M registers a warm scan onto the cold one: a point at p in the warm profiler frame is at M p in the cold one. With H the
pose of the profiler in the tool frame and S the shift by the lever (x_y, 0, z_y), the error of the carriage is the
conjugate E = S H M (S H)^-1 (eq. 3 of Zhao et al.), for small motions the adjoint of S H applied to the twist of M. The
remainder is of second order: lever times angle squared, 1 nm at 2 m and 30 urad.

A scan is assembled along the feed, and it is not rigid, because the carriage moves during the feed. The carriage
travels along Y of the machine: line y is displaced from the profiler's plane by y times `feed_direction` f, which is Y
of the machine in the profiler's frame, not Y of that frame. A line at the feed s measures (x, 0, z). In the cold frame
at the artefact's middle, this point is P = (x, 0, z) + s f. The registered map is Q = (x, s, z), so that P = B Q with

    B = 1 + (f - e_y) e_y^T .

The warm carriage displaces a point by T + r x (x, 0, z) + s g: (T, r) is the twist of the profiler at its origin when
the axis is over the artefact's middle, and g = dT/dY is its change along the scan. (For a rigid scan, g = r x f.) Two
maps differ by B^-1 times this; the registration states it as a twist (T_Q, R_Q) at the origin and displacements c per
metre of feed. Comparison of the coefficients of 1, x, z and s results in

    EC = f_y EC_Q,   EA = f_y EA_Q,   EB = EB_Q - f_z EC_Q,   T = B T_Q,   g = B (c + R_Q x e_y) .

Yaw and pitch are determined by the relief along the lines alone: pitch EA moves a point along the feed by -z EA. The
slope along the feed would show both if the scan were rigid, but it is g, which does not depend on them.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

from errormotion.arrays import Array
from errormotion.datasets.provenance import identity
from errormotion.errors import MethodError
from errormotion.kinematics.poses import adjoint_of
from errormotion.kinematics.twists import adjoint, cross_matrix, transform, transform_covariance

SOURCES = (*(f"profiler pose {k}" for k in range(1, 7)), "lever x", "lever y", "lever z")
"""Names of the sources of pose and lever."""
POSE_UNIT = np.array([1e-3, 1e-3, 1e-3, 1e-5, 1e-5, 1e-5])
"""Units of (a, b, g, dx, dy, dz) in which the principal axes of their covariance are determined, rad and m."""


@dataclass(frozen=True)
class Rig:
    """Pose of the profiler and lever, with their uncertainty.

    Attributes
    ----------
    pose : RigidTransform
        H, profiler to tool frame.
    lever : ndarray, (3,)
        (x_y, 0, z_y), carriage to tool frame, m.
    pose_covariance : ndarray, (6, 6), optional
        Of (a, b, g, dx, dy, dz), from the calibration; without it the pose is taken as exact.
    lever_uncertainty : ndarray, (3,)
        m.
    """

    pose: RigidTransform
    lever: Array
    pose_covariance: Array | None = None
    lever_uncertainty: Array = field(default_factory=lambda: np.zeros(3))


def feed_direction(profiler_pose: RigidTransform) -> Array:
    """Return the direction of the feed (Y of the machine) in the profiler's frame, (..., 3)."""
    return np.asarray(profiler_pose.as_matrix()[..., 1, :3])


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


def carriage_errors(motion: ArrayLike, covariance: ArrayLike, rig: Rig) -> tuple[Array, Array]:
    """Return the errors of the carriage (..., 6) from motions of the profiler, and their covariance (..., 6, 6).

    Pose and lever are contained to first order: an error of the frame changes a twist by their Lie bracket.

    Parameters
    ----------
    motion, covariance : (..., 6), (..., 6, 6)
        Twists of M at the origin of the profiler's frame, in that frame: warm onto cold; m and rad.
    rig : Rig
    """
    to_carriage = carriage_adjoint(rig.pose, rig.lever)
    E = transform(np.asarray(motion, dtype=float), to_carriage)
    of_lever = np.diag(rig.lever_uncertainty) @ np.eye(3, 6)
    sources = [*(root(rig.pose_covariance) @ pose_twists(rig.pose, rig.lever)), *of_lever]
    effects = np.stack([commutator(error, E) for error in sources])
    C = transform_covariance(np.asarray(covariance, dtype=float), to_carriage)
    return E, C + np.einsum("s...i,s...j->...ij", effects, effects)


def carriage_adjoint(profiler_pose: RigidTransform, lever: ArrayLike) -> Array:
    """Return the matrix (..., 6, 6) that converts twists in the profiler's frame to twists of the carriage."""
    shift = np.asarray(lever, dtype=float)
    return adjoint(shift=-shift) @ adjoint_of(profiler_pose)


def pose_twists(profiler_pose: RigidTransform, lever: ArrayLike) -> Array:
    """Return the effect of each parameter (a, b, g, dx, dy, dz) of the pose on S H as a twist of the carriage, (6, 6).

    Row k is the motion of the profiler per radian or metre of parameter k, in the carriage's frame and at its origin.
    """
    a, b, _ = profiler_pose.rotation.as_euler("XYZ")
    axes = np.array(
        [[1, 0, 0], Rotation.from_euler("X", a).apply([0, 1, 0]), Rotation.from_euler("XY", [a, b]).apply([0, 0, 1])]
    )
    centre = np.asarray(lever, dtype=float) + profiler_pose.translation  # all angles turn about the profiler's origin
    return np.block([[np.cross(centre, axes), axes], [np.eye(3), np.zeros((3, 3))]])


def commutator(error: ArrayLike, twist: ArrayLike) -> Array:
    """Return the change of a twist when its frame is displaced by a small motion: their Lie bracket, (..., 6).

    Parameters
    ----------
    error : (6,)
        Small motion of the frame, m and rad.
    twist : (..., 6)
        m and rad, in the same frame and at the same point.
    """
    v, w = np.split(np.asarray(error, dtype=float), 2)
    bracket = np.zeros((6, 6))
    bracket[:3, :3] = bracket[3:, 3:] = cross_matrix(w)
    bracket[:3, 3:] = cross_matrix(v)
    return transform(np.asarray(twist, dtype=float), bracket)


def pose_identities(profiler_pose: RigidTransform, covariance: ArrayLike | None) -> dict[str, str]:
    """Return the identity of each source of a calibrated pose by its name; none for a pose that is taken as exact."""
    if covariance is None:
        return {}
    rows = root(covariance)
    size = np.linalg.norm(rows / POSE_UNIT, axis=1, keepdims=True)
    along = rows / POSE_UNIT / np.where(size > 0, size, 1.0)
    return {
        name: identity(profiler_pose.as_matrix(), covariance, part=f"part {k + 1}", along=along[k])
        for k, name in enumerate(SOURCES[:6])
    }


def root(covariance: ArrayLike | None) -> Array:
    """Return rows whose outer products add up to the covariance, (6, 6), largest first in units of `POSE_UNIT`."""
    if covariance is None:
        return np.zeros((6, 6))
    C = np.asarray(covariance, dtype=float)
    if C.shape != (6, 6) or not np.allclose(C, C.T, rtol=1e-6, atol=0) or np.any(np.diag(C) < 0):
        raise MethodError(
            f"Expected a symmetric covariance (6, 6) of the profiler's pose; found shape {C.shape}.",
            code="scan.pose.covariance",
        )
    size, vectors = np.linalg.eigh(C / np.outer(POSE_UNIT, POSE_UNIT))
    return np.asarray((vectors * np.sqrt(np.maximum(size, 0.0)) * POSE_UNIT[:, None]).T[::-1])
