"""Compiled loops over the targets of a solution: covariances in the datum, and redundancies.

The equations are those of `network`, the arguments of the public functions those of `vectorised`. Chunks of targets and
their order are those of `general`.
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
from errormotion.methods.multilateration.network.kernels.four_examined import Flags, datum_four, examine_four
from errormotion.methods.multilateration.network.kernels.general import sight


@compiled(inner=True)
def _add_motions(F: Array, c: Array, out: Array) -> None:  # pragma: no cover - compiled
    """Add G^T F (6, q), G = [1, -(c x)], to ``out``."""
    for k in range(F.shape[1]):
        x, y, z = F[0, k], F[1, k], F[2, k]
        out[0, k] += x
        out[1, k] += y
        out[2, k] += z
        out[3, k] += c[1] * z - c[2] * y
        out[4, k] += c[2] * x - c[0] * z
        out[5, k] += c[0] * y - c[1] * x


@compiled(inner=True)
def _add_response(
    e: Array, w: Array, D: Array, c: Array, extra: Array, i: int, v: Array, out: Array
) -> None:  # pragma: no cover - compiled
    """Add G^T F (6, q) to ``out``: F = D E^T (-Q), the displacement by the stations' parameters; v (6,) is scratch."""
    n = len(e)
    for j in range(n):
        for a in range(3):
            v[a] = w[j] * w[j] * (D[a, 0] * e[j, 0] + D[a, 1] * e[j, 1] + D[a, 2] * e[j, 2])
        v[3], v[4], v[5] = c[1] * v[2] - c[2] * v[1], c[2] * v[0] - c[0] * v[2], c[0] * v[1] - c[1] * v[0]
        for a in range(6):
            out[a, 4 * j] += v[a] * e[j, 0]
            out[a, 4 * j + 1] += v[a] * e[j, 1]
            out[a, 4 * j + 2] += v[a] * e[j, 2]
            out[a, 4 * j + 3] += v[a]
            for p in range(len(extra)):
                out[a, 4 * n + p] -= v[a] * extra[p, j, i]


@compiled(inner=True)
def _spread_motions(D: Array, c: Array, DG: Array) -> None:  # pragma: no cover - compiled
    """Fill D G (3, 6), G = [1, -(c x)]."""
    for k in range(3):
        DG[k, 0], DG[k, 1], DG[k, 2] = D[k, 0], D[k, 1], D[k, 2]
        DG[k, 3] = D[k, 2] * c[1] - D[k, 1] * c[2]
        DG[k, 4] = D[k, 0] * c[2] - D[k, 2] * c[0]
        DG[k, 5] = D[k, 1] * c[0] - D[k, 0] * c[1]


@compiled()
def _datum_chunks(
    weight: Array, station: Array, extra: Array, target: Array, in_datum: Flags, centre: Array, sums: Array, first: int,
    last: int,
) -> None:  # pragma: no cover - compiled  # fmt: skip
    """Fill the sums of `datum_sums` for some chunks."""
    n = len(station)
    w, c, e, distance, D = np.empty(n), np.empty(3), np.empty((n, 3)), np.empty(n), np.empty((3, 3))
    v, DG = np.empty(6), np.empty((3, 6))
    for i in range(first * CHUNK, min(last * CHUNK, len(target))):
        for j in range(n):
            w[j] = weight[j, i]
        if not in_datum[i] or not sight(w, station, target[i], e, distance, D):
            continue
        own = sums[i // CHUNK]
        for k in range(3):
            c[k] = target[i, k] - centre[k]
        _add_response(e, w, D, c, extra, i, v, own[:, 12:])
        _spread_motions(D, c, DG)
        _add_motions(DG, c, own[:, 6:12])
        for a in range(3):
            own[a, a] += 1.0
        square = c[0] * c[0] + c[1] * c[1] + c[2] * c[2]
        for a in range(3):
            for b in range(3):
                own[3 + a, 3 + b] += (square if a == b else 0.0) - c[a] * c[b]


def datum_sums(
    weight: Array, station: Array, extra: Array, target: Array, in_datum: Flags, centre: Array
) -> tuple[Array, Array, Array]:
    """Return sums over the targets that define the datum: G^T G (6, 6), G^T D G (6, 6) and G^T F (6, 4 n + k)."""
    sums = np.zeros((chunks(len(target)), 6, 12 + 4 * len(station) + len(extra)))
    weight = np.ascontiguousarray(weight)  # for another memory layout the loops would be compiled again
    if of_four(station, extra):
        in_chunks(datum_four, len(target), weight, station, target, in_datum, centre, sums)
    else:
        in_chunks(_datum_chunks, len(target), weight, station, extra, target, in_datum, centre, sums)
    total = sums.sum(axis=0)
    return total[:, :6], total[:, 6:12], total[:, 12:]


@compiled(inner=True, fastmath=FAST)
def _covariance(
    D: Array, DG: Array, FW: Array, G: Array, H: Array, K: Array, room: Array, out: Array
) -> None:  # pragma: no cover - compiled
    """Fill the covariance (3, 3) of a target in the datum: D + F F^T - D G H G^T - G H G^T D + G K G^T."""
    for a in range(3):
        for k in range(6):
            # (1/2 G K - D G H) G^T and its transpose are the terms of the datum.
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


@compiled(fastmath=FAST)
def _examine_chunks(
    weight: Array, station: Array, extra: Array, target: Array, in_datum: Flags,
    centre: Array, W: Array, shift: Array, H: Array, K: Array, covariance: Array, redundancy: Array,
    first: int, last: int,
) -> None:  # pragma: no cover - compiled  # fmt: skip
    """Fill the results of `examine` for some chunks."""
    stations, p = len(station), W.shape[1]
    w, distance, c = np.empty(stations), np.empty(stations), np.empty(3)
    e, D, FW, q = np.empty((stations, 3)), np.empty((3, 3)), np.empty((3, p)), np.empty((stations, p))
    DG, G, room = np.empty((3, 6)), np.zeros((3, 6)), np.empty((3, 6))
    for i in range(first * CHUNK, min(last * CHUNK, len(target))):
        for j in range(stations):
            w[j], redundancy[j, i] = weight[j, i], np.nan
        if not sight(w, station, target[i], e, distance, D):
            covariance[i] = np.nan
            continue
        for k in range(3):
            c[k] = target[i, k] - centre[k]
        if in_datum[i]:
            _spread_motions(D, c, DG)
        else:
            DG[:] = 0.0
        # Readings by the stations' factor, then targets: both sum over the stations.
        for j in range(stations):
            for k in range(p):
                s = e[j, 0] * W[4 * j, k] + e[j, 1] * W[4 * j + 1, k] + e[j, 2] * W[4 * j + 2, k]
                q[j, k] = -w[j] * (s + W[4 * j + 3, k])
                for a in range(len(extra)):
                    q[j, k] += w[j] * extra[a, j, i] * W[4 * stations + a, k]
        for a in range(3):
            for k in range(p):
                FW[a, k] = 0.0
        for j in range(stations):
            x, y, z = e[j, 0], e[j, 1], e[j, 2]
            hat = 0.0
            for a in range(3):
                s = -w[j] * (D[a, 0] * x + D[a, 1] * y + D[a, 2] * z)
                hat -= w[j] * e[j, a] * s
                for k in range(p):
                    FW[a, k] += s * q[j, k]
            redundancy[j, i] = 1.0 - hat
        # Redundancy: after the share of the target, that of the stations.
        for j in range(stations):
            taken = 0.0
            for k in range(p):
                s = q[j, k] + w[j] * (e[j, 0] * FW[0, k] + e[j, 1] * FW[1, k] + e[j, 2] * FW[2, k])
                taken += s * s
            redundancy[j, i] = redundancy[j, i] - taken if w[j] > 0.0 else np.nan
        # Minus G times the shift of the datum.
        for k in range(p):
            FW[0, k] -= shift[0, k] + shift[4, k] * c[2] - shift[5, k] * c[1]
            FW[1, k] -= shift[1, k] + shift[5, k] * c[0] - shift[3, k] * c[2]
            FW[2, k] -= shift[2, k] + shift[3, k] * c[1] - shift[4, k] * c[0]
        G[0, 0], G[1, 1], G[2, 2] = 1.0, 1.0, 1.0
        G[0, 4], G[0, 5], G[1, 3], G[1, 5], G[2, 3], G[2, 4] = c[2], -c[1], -c[2], c[0], c[1], -c[0]
        _covariance(D, DG, FW, G, H, K, room, covariance[i])


def examine(
    weight: Array, station: Array, extra: Array, target: Array, in_datum: Flags,
    centre: Array, W: Array, shift: Array, H: Array, K: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Return covariances (m, 3, 3) of the targets, m^2, and redundancies (n, m) of the readings."""
    n, m = weight.shape
    covariance, redundancy = np.empty((m, 3, 3)), np.empty((n, m))
    found = target, in_datum, centre, W, shift, H, K, covariance, redundancy
    weight = np.ascontiguousarray(weight)
    if of_four(station, extra):
        in_chunks(examine_four, m, weight, station, *found)
    else:
        in_chunks(_examine_chunks, m, weight, station, extra, *found)
    return covariance, redundancy


@compiled()
def residuals(
    reading: Array, station: Array, dead_path: Array, extra: Array, value: Array, target: Array
) -> Array:  # pragma: no cover - compiled
    """Return readings (n, m) minus the model at stations and targets (m, 3), m."""
    left = np.empty(reading.shape)
    for j in range(len(station)):
        x, y, z, d, out = station[j, 0], station[j, 1], station[j, 2], reading[j], left[j]
        for i in range(len(target)):
            a, b, c = target[i, 0] - x, target[i, 1] - y, target[i, 2] - z
            out[i] = d[i] + dead_path[j] - math.sqrt(a * a + b * b + c * c)
        for k in range(len(value)):
            for i in range(len(target)):
                out[i] -= value[k] * extra[k, j, i]
    return left
