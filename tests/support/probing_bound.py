"""Cramer-Rao bound of any unbiased estimate, from the complete information matrix.

It is deliberately independent of the estimator: dense, from true positions, without elimination.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from errormotion.arrays import Array
from errormotion.methods.normal_vector.model import knot_weights

if TYPE_CHECKING:
    from errormotion.methods.normal_vector.identification.freedoms import Motion


def bound(
    position: Array,
    normal: Array,
    motion: Motion,
    *,
    noise: float,
    cycles: int = 2,
    time: Array | None = None,
    touch_time: Array | None = None,
    reach: Literal["touch", "ball"] = "touch",
) -> Array:
    """Return the least covariance of the twists of all cycles, (cycles, 6, 6), m and rad; NaN where not determined.

    Parameters
    ----------
    position : ndarray (b, m, 3)
        Positions of the tip at the m touches of each of b balls, m.
    normal : ndarray (b, m, 3)
        Unit vectors from the centre of the ball to the tip.
    motion : Motion
        The errors to determine.
    noise : float
        Standard deviation of a touch along its normal, m.
    cycles : int
        Number of cycles, including the cold one.
    time : ndarray (k,), optional
        Times of the twists, s; with ``touch_time`` if the drift within a cycle is considered.
    touch_time : ndarray (k, b, m), optional
    reach : "touch" or "ball"
        The unknowns common to all cycles: a reach for every touch, or centre and radius of every ball. If every cycle
        has every touch, both give the same twists.
    """
    b, m, _ = position.shape
    H = motion.design(position, normal).reshape(b * m, -1)
    p = H.shape[1]
    if time is not None and touch_time is not None:
        cycles = len(time)
        weights = knot_weights(time, touch_time, interpolate=True).reshape(cycles, b * m, 3)
    else:
        weights = np.tile([0.0, 1.0, 0.0], (cycles, b * m, 1))
        weights[0] = 0.0
    if reach == "touch":
        shared = np.eye(b * m)
    else:
        shared = np.zeros((b, m, b, 4))
        for i in range(b):
            shared[i, :, i, :3], shared[i, :, i, 3] = normal[i], 1.0
        shared = shared.reshape(b * m, 4 * b)
    size = np.ones(p)
    size[3:] = 1.0 / np.abs(H[:, 3:]).max(initial=1e-30)
    J = np.zeros((cycles, b * m, cycles + 2, p))
    for k in range(cycles):
        for s in range(3):
            J[k, :, k + s] = weights[k, :, s, None] * H * size
    twists = J[:, :, 2 : cycles + 1].reshape(cycles * b * m, (cycles - 1) * p)
    A = np.concatenate([twists, np.tile(shared, (cycles, 1))], axis=1)
    covariance = np.linalg.inv(A.T @ A)[: (cycles - 1) * p, : (cycles - 1) * p] * noise**2
    blocks = np.einsum("kikj->kij", covariance.reshape(cycles - 1, p, cycles - 1, p)) * size * size[:, None]
    found = np.full((cycles, 6, 6), np.nan)
    rows = np.array(motion.seen)
    found[0, rows[:, None], rows] = 0.0
    found[1:, rows[:, None], rows] = blocks
    return found
