"""The published construction: rotation of two planes through four balls, by Cayley's transform (Yang et al., 2.2, 2.3).

With h the unit normal of a plane as measured by the warm machine and H by the cold one, H = R h and

    H - h = U (H + h),    U = [u]x,    R = (I + U) (I - U)^-1.

U is singular, like every 3 x 3 antisymmetric matrix, and is not inverted: the equation is linear in u,
u x (H + h) = H - h, with three equations of rank two for each normal, and six of rank three for both. The displacement
follows from the mean of the four centres. (In eq. (5) of the paper the sign of the term in row 2, column 3 must be
negative, as in its eqs. (1) to (3).)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.kinematics.twists import cross_matrix
from errormotion.methods.normal_vector.identification.freedoms import rotated

STEP = 1e-6
"""Step of the derivative, m; its square over the distances of the balls is far below the rounding of a twist."""

PARALLEL = 1e-3
"""Sine of the angle between the planes below which they count as parallel."""
ONE_PLANE = (
    "The normals are unknown: their four balls lie in one plane, so that both normals are equal, and a rotation about "
    "them is not determined."
)
"""Note on such balls."""


def chosen(names: Sequence[str], stated: Sequence[str] | None) -> list[int]:
    """Return the indices of the stated balls P1 P2 P3 P4, by default of the first four.

    Raises
    ------
    MethodError
        A stated ball does not exist.
    """
    balls = stated or names[:4]
    if missing := [name for name in balls if name not in names]:
        raise MethodError(
            f"normals_balls: expected names of {', '.join(names)}; found {', '.join(missing)}",
            code="probing.balls.unknown",
        )
    return [names.index(name) for name in balls]


def plane_normals(centre: Array) -> Array:
    """Return the unit normals of the planes P1 P2 P3 and P1 P2 P4 of centres (..., 4, 3): (..., 2, 3)."""
    first, second, third, fourth = (centre[..., i, :] for i in range(4))
    normals = np.stack([np.cross(second - first, other - first) for other in (third, fourth)], axis=-2)
    return np.asarray(normals / np.linalg.norm(normals, axis=-1, keepdims=True))


def planes_apart(centre: Array) -> bool:
    """Return whether the planes through centres (4, 3) differ enough to determine the rotation about their normals."""
    first, second = plane_normals(centre)
    return bool(np.linalg.norm(np.cross(first, second)) > PARALLEL)


def cayley_rotation(before: Array, after: Array) -> Array:
    """Return the rotation vectors (..., 3), rad, that rotate unit vectors ``before`` (..., n, 3) into ``after``."""
    A = -cross_matrix(after + before)  # u x v = -[v]x u
    difference = after - before
    A = A.reshape(*A.shape[:-3], -1, 3)
    At = np.swapaxes(A, -1, -2)
    u = np.linalg.solve(At @ A, At @ difference.reshape(*A.shape[:-1], 1))[..., 0]
    length = np.linalg.norm(u, axis=-1, keepdims=True)
    return np.asarray(u * 2 * np.where(length > 0, np.arctan(length) / np.where(length > 0, length, 1.0), 1.0))


def twist(cold: Array, now: Array, point: Array) -> Array:
    """Return the twists (..., 6) at ``point`` from centres ``cold`` (4, 3) and ``now`` (..., 4, 3), all m.

    The displacement of the tool side is opposite to the apparent displacement of the balls.
    """
    rotation = cayley_rotation(plane_normals(now), plane_normals(cold))
    middle = now.mean(axis=-2)
    displacement = cold.mean(axis=-2) - point - rotated(rotation, middle - point)
    return np.concatenate([displacement, rotation], axis=-1)


def jacobian(cold: Array, point: Array) -> Array:
    """Return the derivative of the twist with respect to the current centres, (6, 4, 3).

    The derivative with respect to the cold centres is its negative.
    """
    steps = STEP * np.eye(12).reshape(12, 4, 3)
    return np.asarray(((twist(cold, cold + steps, point) - twist(cold, cold - steps, point)) / (2 * STEP)).T).reshape(
        6, 4, 3
    )


def covariance(cold: Array, now: Array, point: Array, centres: Array) -> Array:
    """Return the covariance (k, 6, 6) of the twists.

    It follows from the covariances ``now`` (k, 4, 3, 3) and ``cold`` (4, 3, 3) of the centres, m^2. ``centres`` (4, 3),
    m, are those of the cold state; the effect of the errors on the derivative is negligible.
    """
    J = jacobian(centres, point)
    return np.asarray(np.einsum("ubi,kbij,vbj->kuv", J, now + cold, J, optimize=True))
