"""Two general point clouds, which are no height maps: point-to-plane ICP of Open3D, with the covariance of its pose.

A pair of a warm point p and its nearest cold point q with the normal n has the residual r = n . (M p - q), and for a
small further twist at c the row J = (n, (M p - c) x n). The noise of a cold point is in all pairs that share it: with
equal noise in both clouds and s^2 the variance of r,

    C = H^-1 (s^2 / 2) (H + sum over q of j_q j_q^T) H^-1,   H = sum J^T J,   j_q the sum of q's rows.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from errormotion.arrays import NORMAL_MAD, Array
from errormotion.kinematics.twists import cross_matrix
from errormotion.methods.crossbeam_scan.identification.registration import clouds
from errormotion.methods.crossbeam_scan.identification.registration.freedoms import freedoms, refuse, scales
from errormotion.methods.crossbeam_scan.identification.registration.result import Registration
from errormotion.methods.crossbeam_scan.identification.registration.solver import inverse

NOISY = 10.0
"""Information counts beyond this many times what the noise of the normals makes of nothing."""
GATE = 5.0
"""Pairs further apart along the normal than this many robust standard deviations do not count."""


def register_clouds(cold: ArrayLike, warm: ArrayLike, *, point: ArrayLike | None = None) -> Registration:
    """Find how the sensor's frame has moved between two clouds of one artefact.

    Parameters
    ----------
    cold, warm : array_like (n, 3), (m, 3)
        Points, m; rows with NaN are left out. Start: no motion beyond 0.3 mm anywhere.
    point : array_like (3,), optional
        Functional point of the result, m; default: the middle of the cold cloud.

    Returns
    -------
    Registration
        Backend "open3d_plane"; its maps are empty.

    Raises
    ------
    MethodError
        Open3D is not installed, no clouds, nothing in common, or freedoms that the artefact leaves undetermined.
    """
    old, new = (np.asarray(each, dtype=float) for each in (cold, warm))
    pose, rms, steps = clouds.plane_icp(old, new)
    old, new = (each[np.isfinite(each).all(axis=1)] for each in (old, new))
    moved, middle = np.asarray(pose.apply(new)), old.mean(axis=0)
    distance, found = cKDTree(old).query(moved, distance_upper_bound=clouds.NEAREST)
    near = np.isfinite(distance)
    moved, nearest = moved[near], np.asarray(found)[near]
    normals, tilt = clouds.normals(old)
    normal = normals[nearest]
    residual = np.sum(normal * (moved - old[nearest]), axis=1)
    scale = NORMAL_MAD * float(np.median(np.abs(residual)))
    used = np.abs(residual) <= GATE * scale
    J = np.hstack([normal, np.cross(moved - middle, normal)])[used]
    H = J.T @ J
    arm = moved[used] - middle
    radius = float(np.sqrt(np.mean(np.sum(arm**2, axis=1))))
    free = freedoms(H, len(J), NOISY * tilt * _of_tilted_normals(arm), radius)
    refuse(free, "a cloud")
    _, shared = np.unique(nearest[used], return_inverse=True)
    of_point = np.column_stack([np.bincount(shared, weights=column) for column in J.T])
    unit = scales(free.radius, 0)
    inverted = inverse(H * np.outer(unit, unit), free.motions) * np.outer(unit, unit)
    variance = float(np.mean(residual[used] ** 2))
    covariance = 0.5 * variance * inverted @ (H + of_point.T @ of_point) @ inverted
    sigma = float(np.sqrt(0.5 * variance))
    own = Registration(
        backend="open3d_plane", pose=pose, point=middle, covariance=covariance, residual=np.empty((0, 0)),
        x=np.empty(0), y=np.empty(0), rms=rms, points=int(used.sum()), noise=(sigma, sigma), line_jitter=(0.0, 0.0),
        condition=free.condition, loose=free.loose, iterations=steps, extra_names=(), extra=np.empty(0),
        joint_covariance=covariance, cold_share=0.5,
    )  # fmt: skip
    if point is None:
        return own
    at = np.asarray(point, dtype=float)
    elsewhere = own.at(at)[1]
    return replace(own, point=at, covariance=elsewhere, joint_covariance=elsewhere)


def _of_tilted_normals(arm: Array) -> Array:
    """Return what normals with a variance of 1 about every direction add to the information of points at ``arm``."""
    moved = np.concatenate([np.tile(np.eye(3), (len(arm), 1, 1)), cross_matrix(arm)], axis=1)
    return np.asarray(np.einsum("nik,njk->ij", moved, moved))
