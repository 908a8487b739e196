"""Small errors of a rigid body as twists, and their transformation to other points and frames.

A twist ``(EX, EY, EZ, EA, EB, EC)`` consists of the displacement (m) of one point of the body, the functional point,
and the small rotation (rad) of the body about X, Y, Z. An unknown freedom is NaN. It affects only results that depend
on it: where its coefficient is exactly zero, it has no effect.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from errormotion.arrays import Array

if TYPE_CHECKING:
    from scipy.spatial.transform import RigidTransform, Rotation

__all__ = [
    "adjoint",
    "cross_matrix",
    "known_product",
    "move",
    "rigid_motions",
    "to_frame",
    "transform",
    "transform_covariance",
]

# An entry of a rotation matrix smaller than this is rounding of a zero (a quarter turn leaves cos 90 deg = 6e-17).
ROUNDING_OF_ROTATION = 1e-15


def cross(a: Array, b: Array) -> Array:
    """Return the vector products of (..., 3) and (..., 3), as `np.cross`; several times faster for few vectors."""
    a0, a1, a2 = a[..., 0], a[..., 1], a[..., 2]
    b0, b1, b2 = b[..., 0], b[..., 1], b[..., 2]
    x = a1 * b2 - a2 * b1
    out = np.empty((*x.shape, 3))
    out[..., 0], out[..., 1], out[..., 2] = x, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
    return out


def cross_matrix(v: ArrayLike) -> Array:
    """Return the matrix of the cross product: ``cross_matrix(v) @ w`` is ``v x w``.

    Parameters
    ----------
    v : array_like, (..., 3)

    Returns
    -------
    ndarray, (..., 3, 3)

    Raises
    ------
    ValueError
        The last axis of ``v`` does not have length 3.
    """
    v = _with_last("vector", v, 3)
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    zero = np.zeros_like(x)
    return np.stack(
        [np.stack([zero, -z, y], axis=-1), np.stack([z, zero, -x], axis=-1), np.stack([-y, x, zero], axis=-1)],
        axis=-2,
    )


def adjoint(rotation: ArrayLike | Rotation | None = None, shift: ArrayLike | None = None) -> Array:
    """Return the 6x6 matrix that transforms a twist to another functional point and into another frame.

    First the functional point is moved, ``E' = E + R x shift`` with ``shift`` in the old frame; then both parts are
    rotated into the new frame, ``v_new = rotation @ v_old``.

    Parameters
    ----------
    rotation : array_like, (..., 3, 3), or Rotation, optional
        Converts coordinates of the old frame to coordinates of the new one; default: same frame.
        Entries below 1e-15 are taken as rounded zeros.
    shift : array_like, (..., 3), optional
        From the old functional point to the new one, m, in the old frame; default: same point.

    Returns
    -------
    ndarray, (..., 6, 6)

    Raises
    ------
    ValueError
        Wrong shape, or ``rotation`` is not a proper rotation.
    """
    Q = _rotation_matrix(rotation)
    S = cross_matrix(np.zeros(3) if shift is None else shift)
    batch = np.broadcast_shapes(Q.shape[:-2], S.shape[:-2])
    A = np.zeros((*batch, 6, 6))
    A[..., :3, :3] = Q
    A[..., 3:, 3:] = Q
    A[..., :3, 3:] = -Q @ S
    return A


def transform(twist: ArrayLike, A: ArrayLike) -> Array:
    """Return ``A @ twist``; an unknown freedom (NaN) affects only results that depend on it.

    Parameters
    ----------
    twist : array_like, (..., 6)
    A : array_like, (..., 6, 6)
        Usually from `adjoint`.

    Returns
    -------
    ndarray, (..., 6)
    """
    return known_product(_six_by_six("matrix", A), _with_last("twist", twist, 6))


def known_product(A: Array, x: Array) -> Array:
    """Return ``A @ x`` over the last axes; a NaN in ``x`` has no effect where its coefficient is zero.

    Parameters
    ----------
    A : ndarray, (..., m, n)
    x : ndarray, (..., n)

    Returns
    -------
    ndarray, (..., m)
    """
    unknown = np.isnan(x)
    if not unknown.any():
        return _product(A, x)
    known = _product(A, np.where(unknown, 0.0, x))
    affected = _product((A != 0).astype(float), unknown.astype(float)) > 0
    return np.where(affected, np.nan, known)


def transform_covariance(covariance: ArrayLike, A: ArrayLike) -> Array:
    """Return ``A @ covariance @ A.T``; NaN rows and columns affect only results that depend on them.

    Parameters
    ----------
    covariance : array_like, (..., 6, 6)
        Symmetric, in m^2, m rad and rad^2.
    A : array_like, (..., 6, 6)
        Usually from `adjoint`.

    Returns
    -------
    ndarray, (..., 6, 6)
        Symmetric to the last bit.
    """
    C, A = _six_by_six("covariance", covariance), _six_by_six("matrix", A)
    At = np.swapaxes(A, -1, -2)
    unknown = np.isnan(C)
    moved = A @ np.where(unknown, 0.0, C) @ At
    moved = 0.5 * (moved + np.swapaxes(moved, -1, -2))
    if not unknown.any():
        return moved
    affected = ((A != 0).astype(float) @ unknown.astype(float) @ (At != 0).astype(float)) > 0
    return np.where(affected, np.nan, moved)


def rigid_motions(points: Array, centre: Array) -> Array:
    """Return the displacements (n, 3, 6) of points (n, 3), m, by the six motions of a body.

    A motion is a displacement t and a rotation r about ``centre`` (3,): ``t + r x (point - centre)``.
    """
    x, y, z = (points - centre).T
    G = np.zeros((len(points), 3, 6))
    G[:, 0, 0] = G[:, 1, 1] = G[:, 2, 2] = 1.0
    G[:, 0, 4], G[:, 0, 5], G[:, 1, 5] = z, -y, x
    G[:, 1, 3], G[:, 2, 3], G[:, 2, 4] = -z, y, -x
    return G


def move(twist: ArrayLike, shift: ArrayLike) -> Array:
    """Return the twist of the same body at another point: ``E' = E + R x shift``.

    Parameters
    ----------
    twist : array_like, (..., 6)
    shift : array_like, (..., 3)
        From the old functional point to the new one, m.

    Returns
    -------
    ndarray, (..., 6)
    """
    return transform(twist, adjoint(shift=shift))


def to_frame(twist: ArrayLike, pose: RigidTransform) -> Array:
    """Return the twist, at the same functional point, in another frame: both parts are rotated.

    Parameters
    ----------
    twist : array_like, (..., 6)
    pose : RigidTransform
        Converts coordinates of the old frame to coordinates of the new one. Only its rotation affects the twist. The
        functional point is the same point, with the coordinates ``pose.apply(functional_point)`` in the new frame.

    Returns
    -------
    ndarray, (..., 6)
    """
    return transform(twist, adjoint(rotation=pose.rotation))


def _product(A: Array, x: Array) -> Array:
    if A.ndim == 2:
        return x @ A.T
    product: Array = (A @ x[..., None])[..., 0]
    return product


def _rotation_matrix(rotation: ArrayLike | Rotation | None) -> Array:
    if rotation is None:
        return np.eye(3)
    Q = np.array(rotation.as_matrix() if hasattr(rotation, "as_matrix") else rotation, dtype=float)
    if Q.ndim < 2 or Q.shape[-2:] != (3, 3):
        raise ValueError(f"expected a rotation of shape (..., 3, 3), found {Q.shape}")
    if not np.allclose(Q @ np.swapaxes(Q, -1, -2), np.eye(3), rtol=0, atol=1e-6) or np.any(np.linalg.det(Q) < 0):
        raise ValueError("expected a proper rotation matrix (orthonormal, determinant +1); check the matrix's rows")
    Q[np.abs(Q) < ROUNDING_OF_ROTATION] = 0.0
    return Q


def _with_last(what: str, value: ArrayLike, length: int) -> Array:
    array = np.asarray(value, dtype=float)
    if array.ndim == 0 or array.shape[-1] != length:
        raise ValueError(f"expected a {what} of shape (..., {length}), found {array.shape}")
    return array


def _six_by_six(what: str, value: ArrayLike) -> Array:
    array = np.asarray(value, dtype=float)
    if array.ndim < 2 or array.shape[-2:] != (6, 6):
        raise ValueError(f"expected a {what} of shape (..., 6, 6), found {array.shape}")
    return array
