"""Compiled sums over the blocks of a map: its middle, what its slopes tell, and what a registration has used.

And medians out of every so many values: a robust scale needs no more.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.methods.crossbeam_scan.identification.registration.kernels import _median, compiled


@compiled()
def middle(height: Array, variance: Array, x: Array, y: Array) -> Array:  # pragma: no cover - compiled
    """Return the mean place (3,), m, of the blocks whose variance is finite."""
    total, count = np.zeros(3), 0
    for i in range(len(y)):
        for j in range(len(x)):
            if variance[i, j] < np.inf:
                total[0] += x[j]
                total[1] += y[i]
                total[2] += height[i, j]
                count += 1
    return total / count


@compiled()
def normals_by_place(
    height: Array, slope_x: Array, slope_y: Array, variance: Array, x: Array, y: Array, centre: Array, step: int
) -> Array:  # pragma: no cover - compiled
    """Return (1, X, Y, Z) about the centre, times -Sx, -Sy and 1, of every ``step``-th known block: (12, n)."""
    q, n = np.empty((12, (len(y) // step + 1) * (len(x) // step + 1))), 0
    for i in range(step // 2, len(y), step):
        for j in range(step // 2, len(x), step):
            if variance[i, j] < np.inf:
                q[8, n], q[9, n], q[10, n], q[11, n] = 1.0, x[j] - centre[0], y[i] - centre[1], height[i, j] - centre[2]
                for k in range(4):
                    q[k, n], q[4 + k, n] = -slope_x[i, j] * q[8 + k, n], -slope_y[i, j] * q[8 + k, n]
                n += 1
    return q[:, :n]


@compiled()
def within(
    residual: Array, points: NDArray[np.int64], gate: float
) -> tuple[float, int, int]:  # pragma: no cover - compiled
    """Return the sum of squares (m^2), number and points of the blocks whose residual is below a gate."""
    square, count, used = 0.0, 0, 0
    for i in range(residual.shape[0]):
        for j in range(residual.shape[1]):
            if abs(residual[i, j]) < gate:
                square += residual[i, j] ** 2
                count += 1
                used += points[i, j]
    return square, count, used


@compiled()
def median_of_some(values: Array, step: int) -> float:  # pragma: no cover - compiled
    """Return the median of the finite among every ``step``-th value (n,); NaN where there is none."""
    room, n = np.empty(len(values) // step + 1), 0
    for i in range(0, len(values), step):
        if abs(values[i]) < np.inf:
            room[n] = values[i]
            n += 1
    return _median(room, n) if n else np.nan


@compiled()
def median_size_of_some(values: Array, step: int) -> float:  # pragma: no cover - compiled
    """Return the median of the absolute finite among every ``step``-th value (n,); NaN where there is none."""
    room, n = np.empty(len(values) // step + 1), 0
    for i in range(0, len(values), step):
        if abs(values[i]) < np.inf:
            room[n] = abs(values[i])
            n += 1
    return _median(room, n) if n else np.nan
