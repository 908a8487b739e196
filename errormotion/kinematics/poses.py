"""Exact poses (scipy's ``RigidTransform``), and their conversion to and from twists.

``T_ab`` maps coordinates in b to coordinates in a; ``T_ab * T_bc`` is ``T_ac``. Twists are ordered as everywhere in
this package: translation first, then rotation.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation

from errormotion.arrays import Array
from errormotion.kinematics.twists import adjoint

__all__ = ["adjoint_of", "displaced", "displacement", "exp", "log"]


def exp(twist: ArrayLike) -> RigidTransform:
    """Return the pose after a constant motion with this twist for unit time.

    Parameters
    ----------
    twist : array_like, (..., 6)
        Translation (m) and rotation (rad) at the origin.
    """
    t = np.asarray(twist, dtype=float)
    return RigidTransform.from_exp_coords(np.concatenate([t[..., 3:], t[..., :3]], axis=-1))


def log(pose: RigidTransform) -> Array:
    """Return the twist, (..., 6), whose `exp` is the pose."""
    coordinates = np.asarray(pose.as_exp_coords(), dtype=float)
    return np.concatenate([coordinates[..., 3:], coordinates[..., :3]], axis=-1)


def displaced(twist: ArrayLike, point: ArrayLike = (0.0, 0.0, 0.0)) -> RigidTransform:
    """Return the pose of a body that is rotated about a point by the rotation vector R and shifted by E, exactly.

    This is the definition of a finite error: the functional point is displaced by (EX, EY, EZ), independently of the
    rotation.

    Parameters
    ----------
    twist : array_like, (..., 6)
    point : array_like, (..., 3)
        The functional point of the twist, m.
    """
    t, p = np.asarray(twist, dtype=float), np.asarray(point, dtype=float)
    rotation = Rotation.from_rotvec(t[..., 3:])
    return RigidTransform.from_components(p + t[..., :3] - rotation.apply(p), rotation)


def displacement(pose: RigidTransform, point: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
    """Return the twist, (..., 6), at a point of the body: the displacement of the point, and the rotation vector.

    The inverse of `displaced`.
    """
    p = np.asarray(point, dtype=float)
    return np.concatenate([pose.apply(p) - p, pose.rotation.as_rotvec()], axis=-1)


def adjoint_of(pose: RigidTransform) -> Array:
    """Return the 6x6 matrix of the change of frame ``pose * exp(twist) * pose.inv()``, twists at the frames' origins.

    Parameters
    ----------
    pose : RigidTransform
        Converts coordinates of the old frame to coordinates of the new one.

    Returns
    -------
    ndarray, (..., 6, 6)
    """
    origin_of_new_in_old = pose.inv().translation
    return adjoint(pose.rotation, origin_of_new_in_old)
