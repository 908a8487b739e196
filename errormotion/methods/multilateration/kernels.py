"""Compiled loops over the targets: each is moved to where its distances put it, then its block is eliminated.

With E (n, 3) the weighted directions from the stations to a target, N the rows that span what is left of them
(N E = 0) and Q the weighted derivatives of the readings by the stations, a target says N Q ds = N r about the stations
and nothing else: n - 3 equations, one with four stations. N comes from Householder reflections, so no digits cancel.

Threads share the targets in chunks. A chunk is summed by one thread and the chunks' sums are added in their order: the
result has the same bits on any number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Function = TypeVar("Function", bound=Callable[..., Any])

CHUNK = 1024
"""Targets that one thread adds up."""
LANES = 128
"""Equations whose products are added up together."""
MANY = 20_000
"""More targets than these are shared out to several threads."""
# Sums of products may be taken in any order (so that they vectorise).
FAST = {"reassoc", "contract", "nsz"}
# A target with its directions this close to a plane is not moved.
_FLAT = 1e-13
# Steps of a target in one pass, and below which length, m, one is the last.
_STEPS = 8
_SHORT = 3e-5


def compiled(**options: Any) -> Callable[[Function], Function]:
    """Compile with numba: cached on disk, without the interpreter's lock."""
    return cast(Callable[[Function], Function], numba.njit(cache=True, nogil=True, error_model="numpy", **options))


@compiled()
def _locate(reach: Array, w: Array, station: Array, u: Array) -> float:  # pragma: no cover - compiled
    """Move a target ``u`` (3,) by one Gauss-Newton step on its distances ``reach`` (n,); return how far it went, m."""
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


@compiled()
def _place(reach: Array, w: Array, station: Array, u: Array) -> float:  # pragma: no cover - compiled
    """Move a target to where its distances put it; return how far the first step took it, m."""
    first = _locate(reach, w, station, u)
    size = first
    for _ in range(_STEPS):
        # The next step goes as the square of this one over the distance.
        if size < _SHORT:
            break
        size = _locate(reach, w, station, u)
    return first


@compiled()
def reflect(
    reach: Array, w: Array, station: Array, u: Array, e: Array, r: Array, E: Array, Q: Array
) -> None:  # pragma: no cover - compiled
    """Fill directions e (n, 3), weighted residuals r (n,), and the reflections' result: E = Q^T R, Q (n, n)."""
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


@compiled(fastmath=FAST)
def _add_products(v: Array, count: int, sums: Array) -> None:  # pragma: no cover - compiled
    """Add v v^T over the first ``count`` columns to the upper triangle of ``sums``."""
    for i in range(len(sums)):
        for j in range(i, len(sums)):
            s = 0.0
            for t in range(count):
                s += v[i, t] * v[j, t]
            sums[i, j] += s


@compiled()
def reach_of(
    reading: Array, weight: Array, dead_path: Array, extra: Array, value: Array, i: int, reach: Array, w: Array
) -> None:  # pragma: no cover - compiled
    """Fill the distances (n,) that target i's readings stand for, and their weights."""
    for j in range(len(reach)):
        w[j] = weight[j, i]
        d = reading[j, i] + dead_path[j]
        for k in range(len(value)):
            d -= value[k] * extra[k, j, i]
        reach[j] = d


@compiled()
def _reduce_chunk(
    reading: Array, weight: Array, station: Array, dead_path: Array, extra: Array, value: Array,
    target: Array, first: int, last: int, sums: Array,
) -> float:  # pragma: no cover - compiled  # fmt: skip
    """Do the work of `reduce_targets` for one chunk."""
    n, more = len(station), len(value)
    q = 4 * n + more
    reach, w, r, u = np.empty(n), np.empty(n), np.empty(n), np.empty(3)
    e, E, Q = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, n))
    v, filled, furthest = np.empty((q + 1, LANES)), 0, 0.0
    for i in range(first, last):
        reach_of(reading, weight, dead_path, extra, value, i, reach, w)
        u[0], u[1], u[2] = target[i, 0], target[i, 1], target[i, 2]
        furthest = max(furthest, _place(reach, w, station, u))
        target[i, 0], target[i, 1], target[i, 2] = u[0], u[1], u[2]
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
                _add_products(v, filled, sums)
                filled = 0
    _add_products(v, filled, sums)
    return furthest


@compiled()
def _reduce_four(
    reading: Array,
    weight: Array,
    station: Array,
    dead_path: Array,
    target: Array,
    first: int,
    last: int,
    sums: Array,
) -> float:  # pragma: no cover - compiled
    """Do the work of `reduce_targets` for one chunk seen by four stations, no further parameters.

    The one row N is the vector of minors of E: four triple products, from two cross products.
    """
    E, w, r, c = np.empty((4, 3)), np.empty(4), np.empty(4), np.empty((2, 3))
    v, filled, furthest = np.empty((17, LANES)), 0, 0.0
    reach, u = np.empty(4), np.empty(3)
    for i in range(first, last):
        for j in range(4):
            w[j], reach[j] = weight[j, i], reading[j, i] + dead_path[j]
        u[0], u[1], u[2] = target[i, 0], target[i, 1], target[i, 2]
        furthest = max(furthest, _place(reach, w, station, u))
        target[i, 0], target[i, 1], target[i, 2] = u[0], u[1], u[2]
        for j in range(4):
            x, y, z = u[0] - station[j, 0], u[1] - station[j, 1], u[2] - station[j, 2]
            distance = math.sqrt(x * x + y * y + z * z)
            k = w[j] / distance
            E[j, 0], E[j, 1], E[j, 2], r[j] = x * k, y * k, z * k, w[j] * (reach[j] - distance)
        for h in range(2):
            a, b = E[2 * h], E[2 * h + 1]
            c[h, 0], c[h, 1] = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2]
            c[h, 2] = a[0] * b[1] - a[1] * b[0]
        n0 = E[1, 0] * c[1, 0] + E[1, 1] * c[1, 1] + E[1, 2] * c[1, 2]
        n1 = -E[0, 0] * c[1, 0] - E[0, 1] * c[1, 1] - E[0, 2] * c[1, 2]
        n2 = E[3, 0] * c[0, 0] + E[3, 1] * c[0, 1] + E[3, 2] * c[0, 2]
        n3 = -E[2, 0] * c[0, 0] - E[2, 1] * c[0, 1] - E[2, 2] * c[0, 2]
        square = n0 * n0 + n1 * n1 + n2 * n2 + n3 * n3
        if square == 0.0:
            continue
        unit = 1.0 / math.sqrt(square)
        for j in range(4):
            n = unit * (n0 if j == 0 else n1 if j == 1 else n2 if j == 2 else n3)
            v[4 * j, filled], v[4 * j + 1, filled] = -n * E[j, 0], -n * E[j, 1]
            v[4 * j + 2, filled], v[4 * j + 3, filled] = -n * E[j, 2], -n * w[j]
        v[16, filled] = unit * (n0 * r[0] + n1 * r[1] + n2 * r[2] + n3 * r[3])
        filled += 1
        if filled == LANES:
            _add_products(v, filled, sums)
            filled = 0
    _add_products(v, filled, sums)
    return furthest


@compiled()
def _reduce_part(
    reading: Array,
    weight: Array,
    station: Array,
    dead_path: Array,
    extra: Array,
    value: Array,
    target: Array,
    part: int,
    sums: Array,
) -> float:  # pragma: no cover - compiled
    first, last = part * CHUNK, min(len(target), (part + 1) * CHUNK)
    if len(station) == 4 and len(value) == 0:
        return _reduce_four(reading, weight, station, dead_path, target, first, last, sums)
    return _reduce_chunk(reading, weight, station, dead_path, extra, value, target, first, last, sums)


@compiled()
def _reduce_alone(
    reading: Array, weight: Array, station: Array, dead_path: Array, extra: Array, value: Array,
    target: Array, sums: Array, moved: Array,
) -> None:  # pragma: no cover - compiled  # fmt: skip
    for part in range(len(sums)):
        moved[part] = _reduce_part(reading, weight, station, dead_path, extra, value, target, part, sums[part])


@compiled(parallel=True)
def _reduce_shared(
    reading: Array, weight: Array, station: Array, dead_path: Array, extra: Array, value: Array,
    target: Array, sums: Array, moved: Array,
) -> None:  # pragma: no cover - compiled  # fmt: skip
    for part in numba.prange(len(sums)):
        moved[part] = _reduce_part(reading, weight, station, dead_path, extra, value, target, part, sums[part])


def chunks(targets: int) -> int:
    """Return into how many chunks so many targets are cut."""
    return (targets + CHUNK - 1) // CHUNK


def reduce_targets(
    reading: Array, weight: Array, station: Array, dead_path: Array, extra: Array, value: Array,
    target: Array,
) -> tuple[Array, float]:  # fmt: skip
    """Move every target and add up what the targets say about the stations.

    Parameters
    ----------
    reading, weight : ndarray (n, m)
        Displacements, m, finite everywhere, and 1 / standard deviation, 1/m; 0 for what does not count.
    station, dead_path : ndarray (n, 3), (n,)
        m.
    extra, value : ndarray (k, n, m), (k,)
        What a unit of each further parameter adds to a reading, and the parameters.
    target : ndarray (m, 3)
        m; changed in place.

    Returns
    -------
    sums : ndarray (4 n + k + 1, 4 n + k + 1)
        V V^T; the columns of V are the equations of the targets, derivatives of the readings by (U, L) of every
        station and by the further parameters, and last the residual.
    moved : float
        Longest first step of a target, m.
    """
    q = 4 * len(station) + len(value) + 1
    sums, moved = np.zeros((chunks(len(target)), q, q)), np.zeros(chunks(len(target)))
    work = _reduce_shared if len(target) > MANY else _reduce_alone
    work(reading, weight, station, dead_path, extra, value, target, sums, moved)
    total = sums.sum(axis=0)
    return total + np.triu(total, 1).T, float(moved.max())
