"""Zero point of the beam, from planes with known points.

With the reading d = offset + g . s on a plane through the point P, and g . u = -1, the zero point p0 of the sensor (the
stage at 0) fulfils

    offset = g . (p0 - P),

one condition per plane: three planes with independent normals determine it. Gradients and offsets are corrected for
g . u = -1. The estimate is by generalised least squares; its derivatives by every gradient, offset and known point are
returned for the propagation of uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array

if TYPE_CHECKING:
    from errormotion.methods.beam_direction.identification.direction import Direction


MIN_SINGULAR_VALUE = 0.02
"""Of the normals, divided by the root of their number, for which they determine a point."""


@dataclass(frozen=True)
class Origin:
    """The zero point of a beam.

    Attributes
    ----------
    origin : ndarray (3,)
        m, while the stage is at 0.
    by_reading : ndarray (3, k, 4)
        Derivatives by the gradient and the offset of each plane; m, 1.
    by_point : ndarray (3, k)
        Derivatives by the displacement of each plane along its normal.
    misfit : ndarray (k,)
        Distance of each plane from its known point, along the reading, m.
    chi2 : float
        Of these misfits, with k - 3 degrees of freedom.
    """

    origin: Array
    by_reading: Array
    by_point: Array
    misfit: Array
    chi2: float


def locate(
    direction: Direction, offsets: Array, covariances: Array, points: Array, point_uncertainty: float
) -> Origin | None:
    """Return the zero point of a beam with known direction; None if the planes do not determine it.

    Parameters
    ----------
    direction : Direction
        From `direction.solve` on the same planes.
    offsets : ndarray (k,)
        Reading at the stage position 0, m.
    covariances : ndarray (k, 4, 4)
        Of (gradient, offset), SI.
    points : ndarray (k, 3)
        A point of each plane, m; NaN if unknown.
    point_uncertainty : float
        Standard uncertainty of the points along the normals, m; independent by plane.
    """
    known = np.isfinite(points).all(axis=1)
    fitted, u = direction.gradients_fitted, direction.direction
    size = np.linalg.norm(fitted, axis=1)
    normals = (fitted / size[:, None])[known]
    if len(normals) < 3 or np.linalg.svd(normals, compute_uv=False)[2] < MIN_SINGULAR_VALUE * np.sqrt(len(normals)):
        return None
    S, cross = covariances[:, :3, :3], covariances[:, :3, 3]
    # The correction to g.u = -1 also changes the offset: d(g, offset) = d - G (u . dg + g . du).
    gain = np.concatenate([S @ u, (cross @ u)[:, None]], axis=1) / np.einsum("i,kij,j->k", u, S, u)[:, None]
    corrected = offsets - gain[:, 3] * direction.discrepancy
    correct = np.broadcast_to(np.eye(4), (len(gain), 4, 4)).copy()
    correct[:, :, :3] -= gain[:, :, None] * u
    left = correct @ covariances @ np.swapaxes(correct, -1, -2)

    A, b = fitted[known], (corrected + np.sum(fitted * np.nan_to_num(points), axis=1))[known]
    p0 = np.linalg.solve(A.T @ A, A.T @ b)
    for _ in range(3):
        arm = np.concatenate([np.nan_to_num(points) - p0, np.ones((len(points), 1))], axis=1)
        variance = np.einsum("ki,kij,kj->k", arm, left, arm) + (size * point_uncertainty) ** 2
        # The weight of a plane is at most a million times that of the worst one (in standard deviations).
        W = 1 / np.maximum(variance[known], 1e-12 * variance[known].max())
        K = np.linalg.solve((A * W[:, None]).T @ A, (A * W[:, None]).T)
        p0 = K @ b
    misfit = np.full(len(points), np.nan)
    misfit[known] = b - A @ p0

    # d misfit_k = arm . d(g, offset)_corrected + |g| d(point) - g . dp0; the corrected ones depend on g, offset and u.
    k = len(points)
    by_own = np.einsum("ki,kij->kj", arm, correct)
    by_direction = -np.einsum("ki,ki->k", arm, gain)[:, None] * fitted
    by_reading, by_point = np.zeros((3, k, 4)), np.zeros((3, k))
    by_reading[:, known] = K[:, :, None] * by_own[known]
    by_reading[:, :, :3] += np.einsum("pk,ki,ijl->pjl", K, by_direction[known], direction.by_gradient)
    by_point[:, known] = K * size[known]
    return Origin(p0, by_reading, by_point, misfit, float(np.sum(misfit[known] ** 2 * W)))
