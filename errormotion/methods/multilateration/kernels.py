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
MANY = 3000
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
def _directions(
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
def _reach(
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
        _reach(reading, weight, dead_path, extra, value, i, reach, w)
        u[0], u[1], u[2] = target[i, 0], target[i, 1], target[i, 2]
        furthest = max(furthest, _place(reach, w, station, u))
        target[i, 0], target[i, 1], target[i, 2] = u[0], u[1], u[2]
        _directions(reach, w, station, u, e, r, E, Q)
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


@compiled()
def _block(E: Array, D: Array) -> bool:  # pragma: no cover - compiled
    """Fill D (3, 3), the inverse of R^T R, from the reflected E; False where that has no inverse."""
    largest = max(abs(E[0, 0]), abs(E[1, 1]), abs(E[2, 2]))
    if not min(abs(E[0, 0]), abs(E[1, 1]), abs(E[2, 2])) > 1e-7 * largest:
        return False
    i00, i11, i22 = 1.0 / E[0, 0], 1.0 / E[1, 1], 1.0 / E[2, 2]
    i01 = -i00 * E[0, 1] * i11
    i12 = -i11 * E[1, 2] * i22
    i02 = -(i00 * E[0, 2] + i01 * E[1, 2]) * i22
    D[0, 0] = i00 * i00 + i01 * i01 + i02 * i02
    D[0, 1] = i01 * i11 + i02 * i12
    D[0, 2] = i02 * i22
    D[1, 1] = i11 * i11 + i12 * i12
    D[1, 2] = i12 * i22
    D[2, 2] = i22 * i22
    D[1, 0], D[2, 0], D[2, 1] = D[0, 1], D[0, 2], D[1, 2]
    return True


@compiled()
def _response(e: Array, w: Array, D: Array, extra: Array, i: int, F: Array) -> None:  # pragma: no cover - compiled
    """Fill F (3, q): how a target moves by the parameters of the stations, D E^T (-Q)."""
    n = len(e)
    F[:, 4 * n :] = 0.0
    for j in range(n):
        for c in range(3):
            k = w[j] * w[j] * (D[c, 0] * e[j, 0] + D[c, 1] * e[j, 1] + D[c, 2] * e[j, 2])
            F[c, 4 * j], F[c, 4 * j + 1], F[c, 4 * j + 2], F[c, 4 * j + 3] = k * e[j, 0], k * e[j, 1], k * e[j, 2], k
            for p in range(len(extra)):
                F[c, 4 * n + p] -= k * extra[p, j, i]


@compiled()
def _cross(F: Array, c: Array, out: Array) -> None:  # pragma: no cover - compiled
    """Add G^T F (6, q), G = [1, -(c x)], to ``out``."""
    for k in range(F.shape[1]):
        x, y, z = F[0, k], F[1, k], F[2, k]
        out[0, k] += x
        out[1, k] += y
        out[2, k] += z
        out[3, k] += c[1] * z - c[2] * y
        out[4, k] += c[2] * x - c[0] * z
        out[5, k] += c[0] * y - c[1] * x


@compiled()
def _spread_motions(D: Array, c: Array, DG: Array) -> None:  # pragma: no cover - compiled
    """Fill D G (3, 6), G = [1, -(c x)]."""
    for k in range(3):
        DG[k, 0], DG[k, 1], DG[k, 2] = D[k, 0], D[k, 1], D[k, 2]
        DG[k, 3] = D[k, 2] * c[1] - D[k, 1] * c[2]
        DG[k, 4] = D[k, 0] * c[2] - D[k, 2] * c[0]
        DG[k, 5] = D[k, 1] * c[0] - D[k, 0] * c[1]


@compiled()
def _datum_part(
    weight: Array, station: Array, extra: Array, target: Array, centre: Array, part: int, sums: Array
) -> None:  # pragma: no cover - compiled
    n = len(station)
    reach, w, r, c = np.zeros(n), np.empty(n), np.empty(n), np.empty(3)
    e, E, Q, D = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, n)), np.empty((3, 3))
    F, DG = np.empty((3, 4 * n + len(extra))), np.empty((3, 6))
    for i in range(part * CHUNK, min(len(target), (part + 1) * CHUNK)):
        w[:] = weight[:, i]
        _directions(reach, w, station, target[i], e, r, E, Q)
        if not _block(E, D):
            continue
        c[:] = target[i] - centre
        _response(e, w, D, extra, i, F)
        _spread_motions(D, c, DG)
        _cross(F, c, sums[:, 12:])
        _cross(DG, c, sums[:, 6:12])
        for a in range(3):
            sums[a, a] += 1.0
        square = c[0] * c[0] + c[1] * c[1] + c[2] * c[2]
        for a in range(3):
            for b in range(3):
                sums[3 + a, 3 + b] += (square if a == b else 0.0) - c[a] * c[b]


@compiled()
def _datum_alone(
    weight: Array, station: Array, extra: Array, target: Array, centre: Array, sums: Array
) -> None:  # pragma: no cover - compiled
    for part in range(len(sums)):
        _datum_part(weight, station, extra, target, centre, part, sums[part])


@compiled(parallel=True)
def _datum_shared(
    weight: Array, station: Array, extra: Array, target: Array, centre: Array, sums: Array
) -> None:  # pragma: no cover - compiled
    for part in numba.prange(len(sums)):
        _datum_part(weight, station, extra, target, centre, part, sums[part])


def datum_sums(weight: Array, station: Array, extra: Array, target: Array, centre: Array) -> tuple[Array, Array, Array]:
    """Return sums over the targets of G^T G (6, 6), G^T D G (6, 6) and G^T F (6, 4 n + k).

    G are a target's motions with the whole about ``centre``, D its covariance with the stations known, F its motion by
    the stations' parameters.
    """
    sums = np.zeros((chunks(len(target)), 6, 12 + 4 * len(station) + len(extra)))
    work = _datum_shared if len(target) > MANY else _datum_alone
    work(weight, station, extra, target, centre, sums)
    total = sums.sum(axis=0)
    return total[:, :6], total[:, 6:12], total[:, 12:]


@compiled()
def _covariance(
    D: Array, DG: Array, FW: Array, c: Array, H: Array, K: Array, room: Array, out: Array
) -> None:  # pragma: no cover - compiled
    """Fill the covariance (3, 3) of a target in the datum: D + F F^T - D G H G^T - G H G^T D + G K G^T."""
    G = np.zeros((3, 6))
    G[0, 0], G[1, 1], G[2, 2] = 1.0, 1.0, 1.0
    G[0, 4], G[0, 5], G[1, 3], G[1, 5], G[2, 3], G[2, 4] = c[2], -c[1], -c[2], c[0], c[1], -c[0]
    for a in range(3):
        for k in range(6):
            # 1/2 G K - D G H: G times its transpose, and the transpose of that, make both sides of the datum.
            s = 0.0
            for b in range(6):
                s += 0.5 * G[a, b] * K[b, k] - DG[a, b] * H[b, k]
            room[a, k] = s
    for a in range(3):
        for b in range(3):
            s = D[a, b]
            for k in range(FW.shape[1]):
                s += FW[a, k] * FW[b, k]
            for k in range(6):
                s += room[a, k] * G[b, k] + room[b, k] * G[a, k]
            out[a, b] = s


@compiled()
def _examine_part(
    reading: Array, weight: Array, station: Array, dead_path: Array, extra: Array, value: Array,
    target: Array,
    centre: Array, W: Array, shift: Array, H: Array, K: Array, covariance: Array, residual: Array, redundancy: Array,
    part: int,
) -> None:  # pragma: no cover - compiled  # fmt: skip
    n, p = W.shape[0], W.shape[1]
    stations = len(station)
    reach, w, r, c = np.zeros(stations), np.empty(stations), np.empty(stations), np.empty(3)
    e, E, Q, D = np.empty((stations, 3)), np.empty((stations, 3)), np.empty((stations, stations)), np.empty((3, 3))
    F, DG, FW, q = np.empty((3, n)), np.empty((3, 6)), np.empty((3, p)), np.empty((stations, p))
    for i in range(part * CHUNK, min(len(target), (part + 1) * CHUNK)):
        _reach(reading, weight, dead_path, extra, value, i, reach, w)
        _directions(reach, w, station, target[i], e, r, E, Q)
        for j in range(stations):
            residual[j, i] = r[j] / w[j] if w[j] > 0.0 else np.nan
            redundancy[j, i] = np.nan
        if not _block(E, D):
            covariance[i] = np.nan
            continue
        c[:] = target[i] - centre
        _spread_motions(D, c, DG)
        # Readings by the stations' factor, then targets: both sum over the stations.
        for j in range(stations):
            for k in range(p):
                s = e[j, 0] * W[4 * j, k] + e[j, 1] * W[4 * j + 1, k] + e[j, 2] * W[4 * j + 2, k]
                q[j, k] = -w[j] * (s + W[4 * j + 3, k])
                for a in range(len(extra)):
                    q[j, k] += w[j] * extra[a, j, i] * W[4 * stations + a, k]
        FW[:] = 0.0
        for j in range(stations):
            for a in range(3):
                s = -w[j] * (D[a, 0] * e[j, 0] + D[a, 1] * e[j, 1] + D[a, 2] * e[j, 2])
                for k in range(p):
                    FW[a, k] += s * q[j, k]
        # What is left of the readings when the target has taken its part: redundancy 1 - hat matrix.
        for j in range(stations):
            if w[j] == 0.0:
                continue
            alone, taken = 0.0, 0.0
            for a in range(3, stations):
                alone += Q[a, j] * Q[a, j]
            for k in range(p):
                s = q[j, k] + w[j] * (e[j, 0] * FW[0, k] + e[j, 1] * FW[1, k] + e[j, 2] * FW[2, k])
                taken += s * s
            redundancy[j, i] = alone - taken
        # G times the datum's shift, taken off.
        for k in range(p):
            FW[0, k] -= shift[0, k] + shift[4, k] * c[2] - shift[5, k] * c[1]
            FW[1, k] -= shift[1, k] + shift[5, k] * c[0] - shift[3, k] * c[2]
            FW[2, k] -= shift[2, k] + shift[3, k] * c[1] - shift[4, k] * c[0]
        _covariance(D, DG, FW, c, H, K, F, covariance[i])


@compiled()
def _examine_alone(
    reading: Array, weight: Array, station: Array, dead_path: Array, extra: Array, value: Array,
    target: Array,
    centre: Array, W: Array, shift: Array, H: Array, K: Array, covariance: Array, residual: Array, redundancy: Array,
) -> None:  # pragma: no cover - compiled  # fmt: skip
    for part in range((len(target) + CHUNK - 1) // CHUNK):
        _examine_part(
            reading, weight, station, dead_path, extra, value, target, centre, W, shift,
            H, K, covariance, residual, redundancy, part,
        )  # fmt: skip


@compiled(parallel=True)
def _examine_shared(
    reading: Array, weight: Array, station: Array, dead_path: Array, extra: Array, value: Array,
    target: Array,
    centre: Array, W: Array, shift: Array, H: Array, K: Array, covariance: Array, residual: Array, redundancy: Array,
) -> None:  # pragma: no cover - compiled  # fmt: skip
    for part in numba.prange((len(target) + CHUNK - 1) // CHUNK):
        _examine_part(
            reading, weight, station, dead_path, extra, value, target, centre, W, shift,
            H, K, covariance, residual, redundancy, part,
        )  # fmt: skip


def examine(
    reading: Array, weight: Array, station: Array, dead_path: Array, extra: Array, value: Array,
    target: Array,
    centre: Array, W: Array, shift: Array, H: Array, K: Array,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Return covariances (m, 3, 3) of the targets, residuals (n, m), m, and redundancies (n, m) of the readings.

    Parameters
    ----------
    W : ndarray (4 n + k, p)
        Factor of the covariance of the stations' parameters, in any datum.
    shift : ndarray (6, p)
        How the datum's fit to the targets moves with the factor.
    H, K : ndarray (6, 6)
        Inverse of the sum of G^T G; and H (sum of G^T D G) H.
    """
    n, m = reading.shape
    covariance, residual, redundancy = np.empty((m, 3, 3)), np.empty((n, m)), np.empty((n, m))
    work = _examine_shared if m > MANY else _examine_alone
    work(
        reading, weight, station, dead_path, extra, value, target, centre, W, shift, H, K,
        covariance, residual, redundancy,
    )  # fmt: skip
    return covariance, residual, redundancy
