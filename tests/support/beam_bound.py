"""Cramer-Rao bound of a beam from readings on planes, from the complete information matrix of all readings.

It is deliberately independent of the estimator: the readings of a ray on planes, differentiated by beam, normals and
distances, without gradients and their condition.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag

from errormotion.arrays import Array
from errormotion.kinematics.beams import across, turned


def bound(
    stages: Sequence[Array],
    normals: Array,
    u: Array,
    noise: float,
    speckle: float = 0.0,
    speckle_length: float = 50e-6,
    *,
    origin: Array | None = None,
    points: Array | None = None,
    point_uncertainty: float = 0.0,
) -> Array:
    """Return the least covariance (6, 6) of zero point and direction; NaN for the former without known points.

    Parameters
    ----------
    stages : sequence of ndarray (n, 3)
        Stage positions on each plane, m.
    normals : ndarray (k, 3)
        Unit normals of the planes, which are unknown.
    u : ndarray (3,)
        Direction of the beam.
    noise, speckle, speckle_length : float
        Of the readings, m.
    origin : ndarray (3,), optional
        Zero point of the beam, m.
    points : ndarray (k, 3), optional
        Known points of the planes, m, with ``point_uncertainty`` along the normals.
    """
    k, known = len(normals), points is not None
    p0 = np.zeros(3) if origin is None else origin
    P = np.array([p0 + stage.mean(axis=0) for stage in stages]) if points is None else points

    def readings(z: Array) -> Array:
        direction, start = turned(u, z[:2]), p0 + z[2:5]
        found = []
        for i, (stage, N) in enumerate(zip(stages, normals, strict=True)):
            tilted = turned(N, z[5 + 3 * i : 7 + 3 * i])
            distance = (P[i] - start - stage) @ tilted + z[7 + 3 * i]
            found.append(distance / (tilted @ direction))
        return np.concatenate(found)

    steps = 1e-6 * np.eye(5 + 3 * k)
    J = np.stack([(readings(h) - readings(-h)) / 2e-6 for h in steps], axis=1)
    parts = []
    for stage in stages:
        apart = np.linalg.norm(stage[:, None] - stage[None], axis=2)
        parts.append(noise**2 * np.eye(len(stage)) + speckle**2 * np.exp(-apart / speckle_length))
    information = J.T @ np.linalg.solve(block_diag(*parts), J)
    distances = 7 + 3 * np.arange(k)
    used = np.ones(5 + 3 * k, dtype=bool)
    if not known:
        used[2:5] = False
    elif point_uncertainty > 0:
        information[distances, distances] += point_uncertainty**-2.0
    else:
        used[distances] = False
    scale = np.sqrt(np.diag(information))[used]
    C = np.zeros((5 + 3 * k, 5 + 3 * k))
    size, own = np.outer(scale, scale), np.ix_(used, used)
    C[own] = np.linalg.inv(information[own] / size) / size
    chart = np.zeros((6, 5))
    chart[:3, 2:], chart[3:, :2] = np.eye(3), across(u).T
    found = chart @ C[:5, :5] @ chart.T
    if not known:
        found[:3] = found[:, :3] = np.nan
    return found
