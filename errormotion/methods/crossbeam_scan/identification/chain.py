"""From the registered motion of the profiler's frame to the six errors of the carriage, and the effect of a wrong pose.

M registers a warm scan onto the cold one: a point at p in the warm profiler frame is at M p in the cold one. With H the
pose of the profiler in the tool frame and S the shift by the lever (x_y, 0, z_y), the error of the carriage is the
conjugate E = S H M (S H)^-1 (eq. 3 of Zhao et al.), for small motions the adjoint of S H applied to the twist of M. The
remainder is of second order: lever times angle squared, 1 nm at 2 m and 30 urad.

A scan is assembled along the feed. The carriage travels along Y of the machine: line y is displaced from the profiler's
plane by y times `feed_direction`, which is Y of the machine in the profiler's frame, not Y of that frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

from errormotion.arrays import Array
from errormotion.datasets.provenance import identity
from errormotion.errors import MethodError
from errormotion.kinematics.poses import adjoint_of
from errormotion.kinematics.twists import adjoint, cross_matrix, transform, transform_covariance

#: Names of the influences, and their groups in the budget.
SOURCES = (*(f"profiler pose {k}" for k in range(1, 7)), "lever x", "lever y", "lever z")
SOURCE_GROUPS = ("profiler pose",) * 6 + ("lever",) * 3
POSE_UNIT = np.array([1e-3, 1e-3, 1e-3, 1e-5, 1e-5, 1e-5])
"""Units of (a, b, g, dx, dy, dz) in which the principal axes of their covariance are determined, rad and m."""


@dataclass(frozen=True)
class CarriageErrors:
    """Thermal errors of the carriage at its origin, in machine directions.

    Attributes
    ----------
    values : ndarray, (..., 6)
        EX EY EZ in m, EA EB EC in rad; NaN where there was no registration.
    covariance : ndarray, (..., 6, 6)
        Of the registration and the influences together.
    influence : ndarray, (source, ..., 6)
        Effect of one standard uncertainty of each source, the same draw for all values.
    sources, source_groups : tuple of str
        Names and groups of the influences, for `errormotion.datasets.build_errors`.
    """

    values: Array
    covariance: Array
    influence: Array
    sources: tuple[str, ...] = SOURCES
    source_groups: tuple[str, ...] = SOURCE_GROUPS


def feed_direction(profiler_pose: RigidTransform) -> Array:
    """Return the direction of the feed (Y of the machine) in the profiler's frame, (..., 3)."""
    return np.asarray(profiler_pose.rotation.inv().apply([0.0, 1.0, 0.0]))


def carriage_errors(
    motion: ArrayLike,
    covariance: ArrayLike,
    profiler_pose: RigidTransform,
    lever: ArrayLike,
    *,
    pose_covariance: ArrayLike | None = None,
    lever_uncertainty: ArrayLike = (0.0, 0.0, 0.0),
) -> CarriageErrors:
    """Return the errors of the carriage from the registered motions of the profiler's frame.

    Parameters
    ----------
    motion : (..., 6)
        Twists of M at the origin of the profiler's frame, in that frame: warm onto cold; m and rad.
    covariance : (..., 6, 6)
        Covariance of the twists from the registration alone.
    profiler_pose : RigidTransform
        H, profiler to tool frame.
    lever : (3,)
        (x_y, 0, z_y), carriage to tool frame, m.
    pose_covariance : (6, 6), optional
        Of (a, b, g, dx, dy, dz), from the calibration; without it the pose is taken as exact.
    lever_uncertainty : (3,)
        Standard uncertainty of the lever, m.

    Raises
    ------
    MethodError
        Shapes that do not fit.
    """
    M, C, x = (np.asarray(value, dtype=float) for value in (motion, covariance, lever))
    if M.shape[-1:] != (6,) or C.shape != (*M.shape, 6) or x.shape != (3,):
        raise MethodError(
            "Expected motions (..., 6), covariances (..., 6, 6) and a lever (3,); found "
            f"{M.shape}, {C.shape} and {x.shape}."
        )
    to_carriage = carriage_adjoint(profiler_pose, x)
    E = transform(M, to_carriage)
    errors = np.concatenate(
        [
            root(pose_covariance) @ pose_twists(profiler_pose, x),
            np.asarray(lever_uncertainty, dtype=float)[:, None] * np.eye(3, 6),
        ]
    )
    influence = np.stack([commutator(error, E) for error in errors])
    total = transform_covariance(C, to_carriage) + np.einsum("s...i,s...j->...ij", influence, influence)
    return CarriageErrors(E, total, influence)


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
        raise MethodError(f"Expected a symmetric covariance (6, 6) of the profiler's pose; found shape {C.shape}.")
    size, vectors = np.linalg.eigh(C / np.outer(POSE_UNIT, POSE_UNIT))
    return np.asarray((vectors * np.sqrt(np.maximum(size, 0.0)) * POSE_UNIT[:, None]).T[::-1])
