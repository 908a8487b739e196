"""Compiled loops over the targets: each is moved to the best fit of its distances, then its block is eliminated.

The equations, and the arguments of the public functions, are those of `vectorised`. A chunk of targets is summed by one
thread, and the sums of the chunks are added in their order: the result is identical with any number of threads.
"""

from __future__ import annotations

import math

import numpy as np

from errormotion.arrays import Array
from errormotion.methods.multilateration.network.kernels.compiling import (
    CHUNK,
    FAST,
    chunks,
    compiled,
    in_chunks,
    of_four,
)
from errormotion.methods.multilateration.network.kernels.four import reduce_four, screen_four, settle_four

LANES = 128
"""Number of equations whose products are summed together."""
# As in `vectorised`; the last one is the root of its NO_POSITION.
_FLAT = 1e-13
_STEPS = 8
_SHORT = 1e-3
_LAST_STEPS = 30
_SETTLED = 1e-7
_NO_POSITION = 1e-6


@compiled(inner=True)
def _step(reach: Array, w: Array, station: Array, u: Array) -> float:  # pragma: no cover - compiled
    """Move a target ``u`` (3,) by one Gauss-Newton step on its distances ``reach`` (n,); return its length, m."""
    a00, a01, a02, a11, a12, a22, b0, b1, b2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    nearest = np.inf
    for j in range(len(station)):
        if w[j] == 0.0:
            continue
        x, y, z = u[0] - station[j, 0], u[1] - station[j, 1], u[2] - station[j, 2]
        distance = math.sqrt(x * x + y * y + z * z)
        nearest = min(nearest, distance)
        k = w[j] / distance
        x, y, z, r = x * k, y * k, z * k, w[j] * (reach[j] - distance)
        a00 += x * x
        a01 += x * y
        a02 += x * z
        a11 += y * y
        a12 += y * z
        a22 += z * z
        b0 += x * r
        b1 += y * r
        b2 += z * r
    c00, c01, c02 = a11 * a22 - a12 * a12, a02 * a12 - a01 * a22, a01 * a12 - a02 * a11
    determinant = a00 * c00 + a01 * c01 + a02 * c02
    if not determinant > _FLAT * (a00 + a11 + a22) ** 3:
        return 0.0
    s0 = (c00 * b0 + c01 * b1 + c02 * b2) / determinant
    s1 = (c01 * b0 + (a00 * a22 - a02 * a02) * b1 + (a01 * a02 - a00 * a12) * b2) / determinant
    s2 = (c02 * b0 + (a01 * a02 - a00 * a12) * b1 + (a00 * a11 - a01 * a01) * b2) / determinant
    size = math.sqrt(s0 * s0 + s1 * s1 + s2 * s2)
    if not size > 0.0:
        return 0.0
    share = min(1.0, 0.5 * nearest / size)
    u[0] += share * s0
    u[1] += share * s1
    u[2] += share * s2
    return size


@compiled(inner=True)
def _locate(
    reach: Array, w: Array, station: Array, u: Array, steps: int, short: float
) -> float:  # pragma: no cover - compiled
    """Move a target to the best fit of its distances; return the length of the first step, m."""
    first = _step(reach, w, station, u)
    size = first
    for _ in range(steps):
        # The next step is about the square of this one over the distance.
        if size < short:
            break
        size = _step(reach, w, station, u)
    return first


@compiled(inner=True)
def reflect(
    reach: Array, w: Array, station: Array, u: Array, e: Array, r: Array, E: Array, Q: Array
) -> None:  # pragma: no cover - compiled
    """Fill directions e (n, 3), weighted residuals r (n,), and the result of the reflections: E = Q^T R, Q (n, n)."""
    n = len(station)
    for j in range(n):
        x, y, z = u[0] - station[j, 0], u[1] - station[j, 1], u[2] - station[j, 2]
        distance = math.sqrt(x * x + y * y + z * z)
        e[j, 0], e[j, 1], e[j, 2] = x / distance, y / distance, z / distance
        r[j] = w[j] * (reach[j] - distance) if w[j] > 0.0 else 0.0
        E[j, 0], E[j, 1], E[j, 2] = w[j] * e[j, 0], w[j] * e[j, 1], w[j] * e[j, 2]
        for k in range(n):
            Q[j, k] = 1.0 if j == k else 0.0
    for c in range(3):
        square = 0.0
        for j in range(c, n):
            square += E[j, c] * E[j, c]
        if square == 0.0:
            continue
        alpha = -math.copysign(math.sqrt(square), E[c, c])
        head = E[c, c] - alpha
        # 2 / (v . v) with v = (head, E[c+1:, c]).
        beta = 1.0 / (square - alpha * E[c, c])
        for k in range(c + 1, 3):
            s = head * E[c, k]
            for j in range(c + 1, n):
                s += E[j, c] * E[j, k]
            s *= beta
            E[c, k] -= s * head
            for j in range(c + 1, n):
                E[j, k] -= s * E[j, c]
        for k in range(n):
            s = head * Q[c, k]
            for j in range(c + 1, n):
                s += E[j, c] * Q[j, k]
            s *= beta
            Q[c, k] -= s * head
            for j in range(c + 1, n):
                Q[j, k] -= s * E[j, c]
        E[c, c] = alpha


@compiled(inner=True, fastmath=FAST)
def _add_products(v: Array, count: int, sums: Array) -> None:  # pragma: no cover - compiled
    """Add v v^T over the first ``count`` columns to the upper triangle of ``sums``."""
    for i in range(len(sums)):
        for j in range(i, len(sums)):
            s = 0.0
            for t in range(count):
                s += v[i, t] * v[j, t]
            sums[i, j] += s


@compiled(inner=True)
def reach_of(
    reading: Array, weight: Array, dead_path: Array, extra: Array, value: Array, i: int, reach: Array, w: Array
) -> None:  # pragma: no cover - compiled
    """Fill the distances (n,) measured by the readings of target i, and their weights."""
    for j in range(len(reach)):
        w[j] = weight[j, i]
        d = reading[j, i] + dead_path[j]
        for k in range(len(value)):
            d -= value[k] * extra[k, j, i]
        reach[j] = d


@compiled()
def _reduce_chunks(
    reading: Array, weight: Array, station: Array, dead_path: Array, extra: Array, value: Array,
    position: Array, sums: Array, moved: Array, first: int, last: int,
) -> None:  # pragma: no cover - compiled  # fmt: skip
    """Fill the sums of some chunks for `reduce_targets`, and the squares of the longest first steps, m^2."""
    n, more = len(station), len(value)
    q = 4 * n + more
    reach, w, r, u = np.empty(n), np.empty(n), np.empty(n), np.empty(3)
    e, E, Q = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, n))
    v = np.empty((q + 1, LANES))
    for part in range(first, last):
        filled, furthest = 0, 0.0
        for i in range(part * CHUNK, min((part + 1) * CHUNK, position.shape[1])):
            reach_of(reading, weight, dead_path, extra, value, i, reach, w)
            u[0], u[1], u[2] = position[0, i], position[1, i], position[2, i]
            furthest = max(furthest, _locate(reach, w, station, u, _STEPS, _SHORT))
            position[0, i], position[1, i], position[2, i] = u[0], u[1], u[2]
            reflect(reach, w, station, u, e, r, E, Q)
            for a in range(3, n):
                rest = 0.0
                for k in range(more):
                    v[4 * n + k, filled] = 0.0
                for j in range(n):
                    c = Q[a, j] * w[j]
                    v[4 * j, filled], v[4 * j + 1, filled] = -c * e[j, 0], -c * e[j, 1]
                    v[4 * j + 2, filled], v[4 * j + 3, filled] = -c * e[j, 2], -c
                    rest += Q[a, j] * r[j]
                    for k in range(more):
                        v[4 * n + k, filled] += c * extra[k, j, i]
                v[q, filled] = rest
                filled += 1
                if filled == LANES:
                    _add_products(v, filled, sums[part])
                    filled = 0
        _add_products(v, filled, sums[part])
        moved[part] = furthest * furthest


@compiled(inner=True)
def sight(
    w: Array, station: Array, u: Array, e: Array, distance: Array, D: Array
) -> bool:  # pragma: no cover - compiled
    """Fill directions e (n, 3), distances (n,) and D (3, 3), the inverse of E^T E; return False if there is none."""
    a00, a01, a02, a11, a12, a22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(len(station)):
        x, y, z = u[0] - station[j, 0], u[1] - station[j, 1], u[2] - station[j, 2]
        distance[j] = math.sqrt(x * x + y * y + z * z)
        k = 1.0 / distance[j]
        x, y, z = k * x, k * y, k * z
        e[j, 0], e[j, 1], e[j, 2] = x, y, z
        k = w[j] * w[j]
        a00 += k * x * x
        a01 += k * x * y
        a02 += k * x * z
        a11 += k * y * y
        a12 += k * y * z
        a22 += k * z * z
    # E^T E = R^T R, and D = R^-1 R^-T.
    least = _NO_POSITION * _NO_POSITION * (a00 + a11 + a22)
    if not a00 > least:
        return False
    r00 = math.sqrt(a00)
    r01, r02 = a01 / r00, a02 / r00
    if not a11 - r01 * r01 > least:
        return False
    r11 = math.sqrt(a11 - r01 * r01)
    r12 = (a12 - r01 * r02) / r11
    if not a22 - r02 * r02 - r12 * r12 > least:
        return False
    i00, i11, i22 = 1.0 / r00, 1.0 / r11, 1.0 / math.sqrt(a22 - r02 * r02 - r12 * r12)
    i01, i12 = -i00 * r01 * i11, -i11 * r12 * i22
    i02 = -(i00 * r02 + i01 * r12) * i22
    D[0, 0] = i00 * i00 + i01 * i01 + i02 * i02
    D[0, 1] = i01 * i11 + i02 * i12
    D[0, 2] = i02 * i22
    D[1, 1] = i11 * i11 + i12 * i12
    D[1, 2] = i12 * i22
    D[2, 2] = i22 * i22
    D[1, 0], D[2, 0], D[2, 1] = D[0, 1], D[0, 2], D[1, 2]
    return True


@compiled()
def _settle_chunks(
    reading: Array, weight: Array, station: Array, dead_path: Array, extra: Array, value: Array,
    position: Array, nominal: Array, centre: Array, traces: Array, sums: Array, first: int, last: int,
) -> None:  # pragma: no cover - compiled  # fmt: skip
    """Fill the results of `settle_targets` for some chunks."""
    n = len(station)
    reach, w, u, e = np.empty(n), np.empty(n), np.empty(3), np.empty((n, 3))
    distance, D = np.empty(n), np.empty((3, 3))
    for i in range(first * CHUNK, min(last * CHUNK, position.shape[1])):
        reach_of(reading, weight, dead_path, extra, value, i, reach, w)
        u[0], u[1], u[2] = position[0, i], position[1, i], position[2, i]
        _locate(reach, w, station, u, _LAST_STEPS, _SETTLED)
        position[0, i], position[1, i], position[2, i] = u[0], u[1], u[2]
        traces[i] = math.inf
        if not sight(w, station, u, e, distance, D):
            continue
        traces[i] = D[0, 0] + D[1, 1] + D[2, 2]
        own = sums[i // CHUNK]
        own[0] += 1.0
        for k in range(3):
            own[1 + k] += u[k] - centre[k]
            own[4 + k] += nominal[i, k] - centre[k]
            for h in range(3):
                own[7 + 3 * k + h] += (nominal[i, k] - centre[k]) * (u[h] - centre[h])


def reduce_targets(
    reading: Array, weight: Array, station: Array, dead_path: Array, extra: Array, value: Array,
    position: Array,
) -> tuple[Array, float]:  # fmt: skip
    """Move every target and return the sums (4 n + k + 1, 4 n + k + 1) of its equations, and the longest step, m."""
    q, m = 4 * len(station) + len(value) + 1, position.shape[1]
    sums, moved = np.zeros((chunks(m), q, q)), np.zeros(chunks(m))
    if of_four(station, value):
        in_chunks(reduce_four, m, reading, weight, station, dead_path, position, sums, moved)
    else:
        in_chunks(_reduce_chunks, m, reading, weight, station, dead_path, extra, value, position, sums, moved)
    total = np.triu(sums.sum(axis=0))  # chunks fill the upper triangle
    return total + np.triu(total, 1).T, math.sqrt(moved.max())


def settle_targets(
    reading: Array, weight: Array, station: Array, dead_path: Array, extra: Array, value: Array,
    position: Array, nominal: Array, centre: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Move every target (3, m) to the best fit; return traces (m,) of covariances, m^2, and moments (16,)."""
    m = position.shape[1]
    traces, sums = np.empty(m), np.zeros((chunks(m), 16))
    found = position, nominal, centre, traces, sums
    if of_four(station, value):
        in_chunks(settle_four, m, reading, weight, station, dead_path, *found)
    else:
        in_chunks(_settle_chunks, m, reading, weight, station, dead_path, extra, value, *found)
    return traces, sums.sum(axis=0)


def screen_targets(
    reading: Array, weight: Array, station: Array, dead_path: Array, position: Array, factor: Array, weak: float
) -> tuple[int, float]:
    """Return the number of readings of targets (3, m) that four stations check, and the largest normalised residual.

    The expected residuals include the stations' factor (16, p); readings with a redundancy below ``weak`` are not
    checked.
    """
    m = position.shape[1]
    checked, largest = np.zeros(chunks(m), dtype=np.int64), np.zeros(chunks(m))
    in_chunks(screen_four, m, reading, weight, station, dead_path, position, factor, weak, checked, largest)
    return int(checked.sum()), math.sqrt(largest.max())
