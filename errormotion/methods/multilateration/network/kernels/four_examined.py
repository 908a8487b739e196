"""Loops of `examination` for four stations without further parameters, in vector instructions (see `four`).

With X = G H G^T and Y = G K G^T the covariance of a target in the datum is D + F F^T - D X - X D + Y.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.methods.multilateration.network.kernels.compiling import CHUNK, EXACT, FAST, LANES, compiled

Flags = NDArray[np.bool_]
# As NO_POSITION in `vectorised`.
_NO_POSITION = 1e-12


@compiled(inner=True, fastmath=EXACT, forceinline=True)
def _sight(
    weight: Array, station: Array, target: Array, centre: Array, begin: int, count: int, W: Array, E: Array, C: Array,
    D: Array,
) -> None:  # pragma: no cover - compiled  # fmt: skip
    """Fill weights (4, LANES), directions (12,), positions about the centre (3,), and D (6,): NaN if there is none."""
    end = begin + count
    for j in range(4):
        ws = weight[j, begin:end]
        for t in range(count):
            W[j, t] = ws[t]
        for t in range(count, LANES):
            W[j, t] = 0.0
    us = target[begin:end]
    for k in range(3):
        for t in range(count):
            C[k, t] = us[t, k]
        for t in range(count, LANES):
            C[k, t] = C[k, 0]
    for t in range(LANES):
        a00, a01, a02, a11, a12, a22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(4):
            x, y, z = C[0, t] - station[j, 0], C[1, t] - station[j, 1], C[2, t] - station[j, 2]
            near = 1.0 / math.sqrt(x * x + y * y + z * z)
            x, y, z = near * x, near * y, near * z
            E[3 * j, t], E[3 * j + 1, t], E[3 * j + 2, t] = x, y, z
            w = W[j, t] * W[j, t]
            a00 += w * x * x
            a01 += w * x * y
            a02 += w * x * z
            a11 += w * y * y
            a12 += w * y * z
            a22 += w * z * z
        # E^T E = R^T R, and D = R^-1 R^-T.
        least = _NO_POSITION * (a00 + a11 + a22)
        i00 = 1.0 / math.sqrt(a00)
        r01, r02 = a01 * i00, a02 * i00
        p11 = a11 - r01 * r01
        i11 = 1.0 / math.sqrt(p11)
        r12 = (a12 - r01 * r02) * i11
        p22 = a22 - r02 * r02 - r12 * r12
        i22 = 1.0 / math.sqrt(p22)
        i01, i12 = -i00 * r01 * i11, -i11 * r12 * i22
        i02 = -(i00 * r02 + i01 * r12) * i22
        whole = (a00 > least) & (p11 > least) & (p22 > least)
        D[0, t] = i00 * i00 + i01 * i01 + i02 * i02 if whole else math.nan
        D[1, t] = i01 * i11 + i02 * i12 if whole else math.nan
        D[2, t] = i02 * i22 if whole else math.nan
        D[3, t] = i11 * i11 + i12 * i12 if whole else math.nan
        D[4, t] = i12 * i22 if whole else math.nan
        D[5, t] = i22 * i22 if whole else math.nan
    for k in range(3):
        for t in range(LANES):
            C[k, t] -= centre[k]


@compiled(fastmath=EXACT)
def datum_four(
    weight: Array, station: Array, target: Array, in_datum: Flags, centre: Array, sums: Array, first: int, last: int
) -> None:  # pragma: no cover - compiled
    """Add the targets of some chunks to the sums (chunk, 6, 28) of `examination.datum_sums`."""
    W, E, C, D = np.empty((4, LANES)), np.empty((12, LANES)), np.empty((3, LANES)), np.empty((6, LANES))
    own, v, P = np.empty(LANES), np.empty((24, LANES)), np.empty((36, LANES))
    for begin in range(first * CHUNK, min(last * CHUNK, len(target)), LANES):
        count = min(LANES, len(target) - begin)
        _sight(weight, station, target, centre, begin, count, W, E, C, D)
        used = in_datum[begin : begin + count]
        for t in range(count):
            own[t] = 1.0 if used[t] and D[0, t] < math.inf else 0.0
        for t in range(count, LANES):
            own[t] = 0.0
        # Targets that are not used are 0 from here on, also if they are NaN.
        for k in range(6):
            for t in range(LANES):
                D[k, t] = D[k, t] if own[t] > 0.0 else 0.0
        for k in range(3):
            for t in range(LANES):
                C[k, t] = C[k, t] if own[t] > 0.0 else 0.0
        for k in range(12):
            for t in range(LANES):
                E[k, t] = E[k, t] if own[t] > 0.0 else 0.0
        for j in range(4):
            for t in range(LANES):
                k, x, y, z = W[j, t] * W[j, t], E[3 * j, t], E[3 * j + 1, t], E[3 * j + 2, t]
                p = k * (D[0, t] * x + D[1, t] * y + D[2, t] * z)
                q = k * (D[1, t] * x + D[3, t] * y + D[4, t] * z)
                r = k * (D[2, t] * x + D[4, t] * y + D[5, t] * z)
                v[6 * j, t], v[6 * j + 1, t], v[6 * j + 2, t] = p, q, r
                v[6 * j + 3, t] = C[1, t] * r - C[2, t] * q
                v[6 * j + 4, t] = C[2, t] * p - C[0, t] * r
                v[6 * j + 5, t] = C[0, t] * q - C[1, t] * p
        for t in range(LANES):
            a, b, c = C[0, t], C[1, t], C[2, t]
            d00, d01, d02, d11, d12, d22 = D[0, t], D[1, t], D[2, t], D[3, t], D[4, t], D[5, t]
            P[0, t], P[1, t], P[2, t] = d00, d01, d02
            P[3, t], P[4, t], P[5, t] = d02 * b - d01 * c, d00 * c - d02 * a, d01 * a - d00 * b
            P[6, t], P[7, t], P[8, t] = d01, d11, d12
            P[9, t], P[10, t], P[11, t] = d12 * b - d11 * c, d01 * c - d12 * a, d11 * a - d01 * b
            P[12, t], P[13, t], P[14, t] = d02, d12, d22
            P[15, t], P[16, t], P[17, t] = d22 * b - d12 * c, d02 * c - d22 * a, d12 * a - d02 * b
        for k in range(6):
            for t in range(LANES):
                x, y, z = P[k, t], P[6 + k, t], P[12 + k, t]
                P[18 + k, t] = C[1, t] * z - C[2, t] * y
                P[24 + k, t] = C[2, t] * x - C[0, t] * z
                P[30 + k, t] = C[0, t] * y - C[1, t] * x
        _add_sums(own, C, E, v, P, sums[begin // CHUNK])


@compiled(inner=True, fastmath=FAST)
def _add_sums(own: Array, C: Array, E: Array, v: Array, P: Array, sums: Array) -> None:  # pragma: no cover - compiled
    """Add sums over the lanes: G^T G, G^T D G and G^T F."""
    n, xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for t in range(LANES):
        x, y, z = C[0, t], C[1, t], C[2, t]
        n += own[t]
        xx += x * x
        xy += x * y
        xz += x * z
        yy += y * y
        yz += y * z
        zz += z * z
    for a in range(3):
        sums[a, a] += n
    sums[3, 3] += yy + zz
    sums[4, 4] += xx + zz
    sums[5, 5] += xx + yy
    sums[3, 4] -= xy
    sums[4, 3] -= xy
    sums[3, 5] -= xz
    sums[5, 3] -= xz
    sums[4, 5] -= yz
    sums[5, 4] -= yz
    for a in range(6):
        for k in range(6):
            s = 0.0
            for t in range(LANES):
                s += P[6 * a + k, t]
            sums[a, 6 + k] += s
    for j in range(4):
        for a in range(6):
            s, x, y, z = 0.0, 0.0, 0.0, 0.0
            for t in range(LANES):
                r = v[6 * j + a, t]
                s += r
                x += r * E[3 * j, t]
                y += r * E[3 * j + 1, t]
                z += r * E[3 * j + 2, t]
            sums[a, 12 + 4 * j] += x
            sums[a, 13 + 4 * j] += y
            sums[a, 14 + 4 * j] += z
            sums[a, 15 + 4 * j] += s


@compiled(inner=True, fastmath=EXACT, forceinline=True)
def _between(H: Array, C: Array, X: Array) -> None:  # pragma: no cover - compiled
    """Fill X (6, LANES): the upper triangle of G H G^T, G = [1, -(c x)], H symmetric."""
    for t in range(LANES):
        a, b, c = C[0, t], C[1, t], C[2, t]
        # Rows of G H: its first three columns, then its last.
        p0, p1, p2 = H[0, 0] + c * H[4, 0] - b * H[5, 0], H[0, 1] + c * H[4, 1] - b * H[5, 1], 0.0
        p2 = H[0, 2] + c * H[4, 2] - b * H[5, 2]
        p3, p4 = H[0, 3] + c * H[4, 3] - b * H[5, 3], H[0, 4] + c * H[4, 4] - b * H[5, 4]
        p5 = H[0, 5] + c * H[4, 5] - b * H[5, 5]
        q1, q2 = H[1, 1] - c * H[3, 1] + a * H[5, 1], H[1, 2] - c * H[3, 2] + a * H[5, 2]
        q3, q4 = H[1, 3] - c * H[3, 3] + a * H[5, 3], H[1, 4] - c * H[3, 4] + a * H[5, 4]
        q5 = H[1, 5] - c * H[3, 5] + a * H[5, 5]
        r2, r3 = H[2, 2] + b * H[3, 2] - a * H[4, 2], H[2, 3] + b * H[3, 3] - a * H[4, 3]
        r4 = H[2, 4] + b * H[3, 4] - a * H[4, 4]
        X[0, t] = p0 + c * p4 - b * p5
        X[1, t] = p1 - c * p3 + a * p5
        X[2, t] = p2 + b * p3 - a * p4
        X[3, t] = q1 - c * q3 + a * q5
        X[4, t] = q2 + b * q3 - a * q4
        X[5, t] = r2 + b * r3 - a * r4


@compiled(fastmath=EXACT)
def examine_four(
    weight: Array, station: Array, target: Array, in_datum: Flags, centre: Array, factor: Array, shift: Array,
    H: Array, K: Array, covariance: Array, redundancy: Array, first: int, last: int,
) -> None:  # pragma: no cover - compiled  # fmt: skip
    """Fill the results of `examination.examine` for some chunks."""
    W, E, C, D = np.empty((4, LANES)), np.empty((12, LANES)), np.empty((3, LANES)), np.empty((6, LANES))
    S, R, X, Y = np.empty((12, LANES)), np.empty((4, LANES)), np.empty((6, LANES)), np.empty((6, LANES))
    V, own = np.empty((6, LANES)), np.empty(LANES)
    for begin in range(first * CHUNK, min(last * CHUNK, len(target)), LANES):
        count = min(LANES, len(target) - begin)
        _sight(weight, station, target, centre, begin, count, W, E, C, D)
        _between(H, C, X)
        _between(K, C, Y)
        for t in range(LANES):
            own[t] = 0.0
        used = in_datum[begin : begin + count]
        for t in range(count):
            own[t] = 1.0 if used[t] else 0.0
        for t in range(LANES):
            d00, d01, d02, d11, d12, d22 = D[0, t], D[1, t], D[2, t], D[3, t], D[4, t], D[5, t]
            x00, x01, x02, x11, x12, x22 = X[0, t], X[1, t], X[2, t], X[3, t], X[4, t], X[5, t]
            k = own[t]
            V[0, t] = d00 + Y[0, t] - 2 * k * (d00 * x00 + d01 * x01 + d02 * x02)
            V[3, t] = d11 + Y[3, t] - 2 * k * (d01 * x01 + d11 * x11 + d12 * x12)
            V[5, t] = d22 + Y[5, t] - 2 * k * (d02 * x02 + d12 * x12 + d22 * x22)
            left, right = d00 * x01 + d01 * x11 + d02 * x12, d01 * x00 + d11 * x01 + d12 * x02
            V[1, t] = d01 + Y[1, t] - k * (left + right)
            left, right = d00 * x02 + d01 * x12 + d02 * x22, d02 * x00 + d12 * x01 + d22 * x02
            V[2, t] = d02 + Y[2, t] - k * (left + right)
            left, right = d01 * x02 + d11 * x12 + d12 * x22, d02 * x01 + d12 * x11 + d22 * x12
            V[4, t] = d12 + Y[4, t] - k * (left + right)
        # Weighted displacement of a target by each reading, and the remaining share of that reading.
        for j in range(4):
            for t in range(LANES):
                x, y, z, w = E[3 * j, t], E[3 * j + 1, t], E[3 * j + 2, t], W[j, t]
                p = w * (D[0, t] * x + D[1, t] * y + D[2, t] * z)
                q = w * (D[1, t] * x + D[3, t] * y + D[4, t] * z)
                r = w * (D[2, t] * x + D[4, t] * y + D[5, t] * z)
                S[3 * j, t], S[3 * j + 1, t], S[3 * j + 2, t] = p, q, r
                R[j, t] = 1.0 - w * (x * p + y * q + z * r)
        for k in range(factor.shape[1]):
            f, g = factor[:, k], shift[:, k]
            for t in range(LANES):
                q0 = W[0, t] * (E[0, t] * f[0] + E[1, t] * f[1] + E[2, t] * f[2] + f[3])
                q1 = W[1, t] * (E[3, t] * f[4] + E[4, t] * f[5] + E[5, t] * f[6] + f[7])
                q2 = W[2, t] * (E[6, t] * f[8] + E[7, t] * f[9] + E[8, t] * f[10] + f[11])
                q3 = W[3, t] * (E[9, t] * f[12] + E[10, t] * f[13] + E[11, t] * f[14] + f[15])
                x = S[0, t] * q0 + S[3, t] * q1 + S[6, t] * q2 + S[9, t] * q3
                y = S[1, t] * q0 + S[4, t] * q1 + S[7, t] * q2 + S[10, t] * q3
                z = S[2, t] * q0 + S[5, t] * q1 + S[8, t] * q2 + S[11, t] * q3
                q0 -= W[0, t] * (E[0, t] * x + E[1, t] * y + E[2, t] * z)
                q1 -= W[1, t] * (E[3, t] * x + E[4, t] * y + E[5, t] * z)
                q2 -= W[2, t] * (E[6, t] * x + E[7, t] * y + E[8, t] * z)
                q3 -= W[3, t] * (E[9, t] * x + E[10, t] * y + E[11, t] * z)
                R[0, t] -= q0 * q0
                R[1, t] -= q1 * q1
                R[2, t] -= q2 * q2
                R[3, t] -= q3 * q3
                a, b, c = C[0, t], C[1, t], C[2, t]
                x -= g[0] + g[4] * c - g[5] * b
                y -= g[1] + g[5] * a - g[3] * c
                z -= g[2] + g[3] * b - g[4] * a
                V[0, t] += x * x
                V[1, t] += x * y
                V[2, t] += x * z
                V[3, t] += y * y
                V[4, t] += y * z
                V[5, t] += z * z
        for j in range(4):
            out = redundancy[j, begin : begin + count]
            for t in range(count):
                out[t] = R[j, t] if W[j, t] > 0.0 else math.nan
        blocks = covariance[begin : begin + count]
        for t in range(count):
            blocks[t, 0, 0], blocks[t, 0, 1], blocks[t, 0, 2] = V[0, t], V[1, t], V[2, t]
            blocks[t, 1, 0], blocks[t, 1, 1], blocks[t, 1, 2] = V[1, t], V[3, t], V[4, t]
            blocks[t, 2, 0], blocks[t, 2, 1], blocks[t, 2, 2] = V[2, t], V[4, t], V[5, t]
