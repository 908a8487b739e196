"""Compiled loops over readings and positions: weights and their numbers, sums for the datum, a rigid motion.

The functions are documented in `vectorised`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.methods.multilateration.network.kernels.compiling import compiled


@compiled()
def weigh(d: Array, sigma: Array) -> tuple[Array, Array, bool]:  # pragma: no cover - compiled
    """Return readings, weights (n, m), and whether the standard deviations ((n, 1) or (n, m)) are positive."""
    n, m = d.shape
    reading, weight, positive = np.empty((n, m)), np.empty((n, m)), True
    number = np.zeros(m, dtype=np.int64)
    for j in range(n):
        bad = 0
        if sigma.shape[1] == m:
            for i in range(m):
                known = d[j, i] - d[j, i] == 0.0
                bad += 1 if known and not sigma[j, i] > 0.0 else 0
                reading[j, i] = d[j, i] if known else np.nan
                weight[j, i] = 1.0 / sigma[j, i] if known else 0.0
                number[i] += known
        else:
            w = 1.0 / sigma[j, 0]
            for i in range(m):
                known = d[j, i] - d[j, i] == 0.0
                reading[j, i] = d[j, i] if known else np.nan
                weight[j, i] = w if known else 0.0
                number[i] += known
                bad += 1 if known and not sigma[j, 0] > 0.0 else 0
        positive = positive and bad == 0
    for i in range(m):
        if number[i] < 3:
            for j in range(n):
                weight[j, i] = 0.0
    return reading, weight, positive


@compiled()
def count(weight: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:  # pragma: no cover - compiled
    """Return how many weights (n, m) are not 0, by column and by row."""
    n, m = weight.shape
    by_target, by_station = np.zeros(m, dtype=np.int64), np.zeros(n, dtype=np.int64)
    for j in range(n):
        some = 0
        for i in range(m):
            by_target[i] += weight[j, i] > 0.0
            some += weight[j, i] > 0.0
        by_station[j] = some
    return by_target, by_station


@compiled()
def copied(u: Array) -> tuple[Array, Array]:  # pragma: no cover - compiled
    """Return a copy of positions (m, 3), and their mean (3,)."""
    own, x, y, z = np.empty(u.shape), 0.0, 0.0, 0.0
    for i in range(len(u)):
        own[i, 0], own[i, 1], own[i, 2] = u[i, 0], u[i, 1], u[i, 2]
        x += u[i, 0]
        y += u[i, 1]
        z += u[i, 2]
    return own, np.array([x, y, z]) / max(len(u), 1)


@compiled()
def moments(
    position: Array, nominal: Array, used: NDArray[np.bool_], centre: Array
) -> Array:  # pragma: no cover - compiled
    """Return number, sums and products (16,) of used targets (3, m) and nominal ones (m, 3), about ``centre``."""
    sums, u, v = np.zeros(16), np.empty(3), np.empty(3)
    for i in range(len(nominal)):
        if used[i]:
            sums[0] += 1.0
            for k in range(3):
                u[k], v[k] = position[k, i] - centre[k], nominal[i, k] - centre[k]
                sums[1 + k] += u[k]
                sums[4 + k] += v[k]
            for k in range(3):
                for h in range(3):
                    sums[7 + 3 * k + h] += v[k] * u[h]
    return sums


@compiled()
def moved(position: Array, a: Array, b: Array, R: Array, traces: Array) -> Array:  # pragma: no cover - compiled
    """Return R (u - a) + b (m, 3) of targets u (3, m); NaN where the traces (m,) is infinite."""
    target = np.empty((position.shape[1], 3))
    for i in range(len(target)):
        x, y, z = position[0, i] - a[0], position[1, i] - a[1], position[2, i] - a[2]
        for k in range(3):
            found = R[k, 0] * x + R[k, 1] * y + R[k, 2] * z + b[k]
            target[i, k] = found if traces[i] < np.inf else np.nan
    return target
