"""Loops for four stations without further parameters, the usual network, in vector instructions.

With four stations the equation of a target is the vector of minors of its weighted directions E (4, 3): four triple
products, from two cross products. Loops are over a few dozen targets at a time, with a row of an array for each
quantity, so that the compiler vectorises them. The results are those of `general`, for any number of stations.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.methods.multilateration.network.kernels.compiling import CHUNK, EXACT, FAST, LANES, compiled

# As in `vectorised`, with squares of lengths, m^2.
_FLAT = 1e-13
_NO_POSITION = 1e-12
_STEPS = 8
_SHORT = 1e-6
_SETTLED = 1e-14
_LAST_STEPS = 30


@compiled(inner=True, fastmath=FAST)
def _add_products(v: Array, sums: Array) -> None:  # pragma: no cover - compiled
    """Add the upper triangle of v v^T (17, 17), v (17, LANES), to ``sums``: two rows by two at a time."""
    for i in range(0, 16, 2):
        for j in range(i, 16, 2):
            a, b, c, d = 0.0, 0.0, 0.0, 0.0
            for t in range(LANES):
                a += v[i, t] * v[j, t]
                b += v[i, t] * v[j + 1, t]
                c += v[i + 1, t] * v[j, t]
                d += v[i + 1, t] * v[j + 1, t]
            sums[i, j] += a
            sums[i, j + 1] += b
            sums[i + 1, j] += c
            sums[i + 1, j + 1] += d
    for i in range(17):
        a = 0.0
        for t in range(LANES):
            a += v[i, t] * v[16, t]
        sums[i, 16] += a


@compiled(inner=True, forceinline=True)
def _load(
    reading: Array,
    weight: Array,
    dead_path: Array,
    position: Array,
    begin: int,
    count: int,
    R: Array,
    W: Array,
    U: Array,
) -> None:  # pragma: no cover - compiled
    """Fill distances, weights and positions of some targets; the rest of the rows has a weight of 0."""
    end = begin + count
    for j in range(4):
        ws, ds, dead = weight[j, begin:end], reading[j, begin:end], dead_path[j]
        for t in range(count):
            w = ws[t]
            W[j, t] = w
            R[j, t] = ds[t] + dead if w > 0.0 else 0.0
        for t in range(count, LANES):
            W[j, t], R[j, t] = 0.0, 0.0
    for k in range(3):
        us = position[k, begin:end]
        for t in range(count):
            U[k, t] = us[t]
        for t in range(count, LANES):
            U[k, t] = U[k, 0]


@compiled(inner=True, fastmath=EXACT, forceinline=True)
def _move(
    R: Array, W: Array, station: Array, U: Array, size: Array, spread: Array
) -> float:  # pragma: no cover - compiled
    """Move targets U (3, LANES) by a Gauss-Newton step on their distances R; return the square of the longest, m^2.

    Fill the squares of the lengths of the steps, m^2, and the traces of the targets' covariances, m^2, infinite if a
    direction is not determined.
    """
    for t in range(LANES):
        a00, a01, a02, a11, a12, a22, b0, b1, b2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        nearest = math.inf
        for j in range(4):
            x, y, z = U[0, t] - station[j, 0], U[1, t] - station[j, 1], U[2, t] - station[j, 2]
            distance = math.sqrt(x * x + y * y + z * z)
            w = W[j, t]
            k, r = w / distance, w * (R[j, t] - distance)
            nearest = min(nearest, distance)
            x, y, z = x * k, y * k, z * k
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
        c11, c12, c22 = a00 * a22 - a02 * a02, a01 * a02 - a00 * a12, a00 * a11 - a01 * a01
        determinant, trace = a00 * c00 + a01 * c01 + a02 * c02, a00 + a11 + a22
        inverse = 1.0 / determinant if determinant > _FLAT * trace * trace * trace else 0.0
        s0 = (c00 * b0 + c01 * b1 + c02 * b2) * inverse
        s1 = (c01 * b0 + c11 * b1 + c12 * b2) * inverse
        s2 = (c02 * b0 + c12 * b1 + c22 * b2) * inverse
        square = s0 * s0 + s1 * s1 + s2 * s2
        size[t] = square
        share = 0.5 * nearest / math.sqrt(square) if square > 0.25 * nearest * nearest else 1.0
        U[0, t] += share * s0
        U[1, t] += share * s1
        U[2, t] += share * s2
        # The pivots of the triangular factor: those of `examination`.
        least = _NO_POSITION * trace
        whole = (a00 > least) & (c22 > least * a00) & (determinant > least * c22)
        spread[t] = (c00 + c11 + c22) * inverse if whole else math.inf
    far = 0.0
    for t in range(LANES):
        far = max(far, size[t])
    return far


@compiled(inner=True, fastmath=EXACT, forceinline=True)
def _equate(R: Array, W: Array, station: Array, U: Array, v: Array) -> None:  # pragma: no cover - compiled
    """Fill the equations v (17, LANES) of targets: derivatives by (U, L) of each station, and the residual."""
    x0, y0, z0 = station[0, 0], station[0, 1], station[0, 2]
    x1, y1, z1 = station[1, 0], station[1, 1], station[1, 2]
    x2, y2, z2 = station[2, 0], station[2, 1], station[2, 2]
    x3, y3, z3 = station[3, 0], station[3, 1], station[3, 2]
    for t in range(LANES):
        xa, ya, za = U[0, t] - x0, U[1, t] - y0, U[2, t] - z0
        distance, wa = math.sqrt(xa * xa + ya * ya + za * za), W[0, t]
        k, ra = wa / distance, wa * (R[0, t] - distance)
        xa, ya, za = xa * k, ya * k, za * k
        xb, yb, zb = U[0, t] - x1, U[1, t] - y1, U[2, t] - z1
        distance, wb = math.sqrt(xb * xb + yb * yb + zb * zb), W[1, t]
        k, rb = wb / distance, wb * (R[1, t] - distance)
        xb, yb, zb = xb * k, yb * k, zb * k
        xc, yc, zc = U[0, t] - x2, U[1, t] - y2, U[2, t] - z2
        distance, wc = math.sqrt(xc * xc + yc * yc + zc * zc), W[2, t]
        k, rc = wc / distance, wc * (R[2, t] - distance)
        xc, yc, zc = xc * k, yc * k, zc * k
        xd, yd, zd = U[0, t] - x3, U[1, t] - y3, U[2, t] - z3
        distance, wd = math.sqrt(xd * xd + yd * yd + zd * zd), W[3, t]
        k, rd = wd / distance, wd * (R[3, t] - distance)
        xd, yd, zd = xd * k, yd * k, zd * k
        p0, p1, p2 = ya * zb - za * yb, za * xb - xa * zb, xa * yb - ya * xb
        q0, q1, q2 = yc * zd - zc * yd, zc * xd - xc * zd, xc * yd - yc * xd
        na, nb = xb * q0 + yb * q1 + zb * q2, -(xa * q0 + ya * q1 + za * q2)
        nc, nd = xd * p0 + yd * p1 + zd * p2, -(xc * p0 + yc * p1 + zc * p2)
        square = na * na + nb * nb + nc * nc + nd * nd
        unit = -1.0 / math.sqrt(square) if square > 0.0 else 0.0
        na, nb, nc, nd = na * unit, nb * unit, nc * unit, nd * unit
        v[0, t], v[1, t], v[2, t], v[3, t] = na * xa, na * ya, na * za, na * wa
        v[4, t], v[5, t], v[6, t], v[7, t] = nb * xb, nb * yb, nb * zb, nb * wb
        v[8, t], v[9, t], v[10, t], v[11, t] = nc * xc, nc * yc, nc * zc, nc * wc
        v[12, t], v[13, t], v[14, t], v[15, t] = nd * xd, nd * yd, nd * zd, nd * wd
        v[16, t] = -(na * ra + nb * rb + nc * rc + nd * rd)


@compiled(fastmath=EXACT)
def reduce_four(
    reading: Array, weight: Array, station: Array, dead_path: Array, position: Array, sums: Array, moved: Array,
    first: int, last: int,
) -> None:  # pragma: no cover - compiled  # fmt: skip
    """Fill the sums of some chunks for `general.reduce_targets`, and the squares of the longest first steps, m^2."""
    R, W, U = np.empty((4, LANES)), np.empty((4, LANES)), np.empty((3, LANES))
    v, size, spread = np.empty((17, LANES)), np.empty(LANES), np.empty(LANES)
    for begin in range(first * CHUNK, min(last * CHUNK, position.shape[1]), LANES):
        part, count = begin // CHUNK, min(LANES, position.shape[1] - begin)
        _load(reading, weight, dead_path, position, begin, count, R, W, U)
        for step in range(_STEPS):
            far = _move(R, W, station, U, size, spread)
            if step == 0:
                moved[part] = max(moved[part], far)
            if far < _SHORT:
                break
        for k in range(3):
            for t in range(count):
                position[k, begin + t] = U[k, t]
        _equate(R, W, station, U, v)
        _add_products(v, sums[part])


@compiled(fastmath=EXACT)
def settle_four(
    reading: Array, weight: Array, station: Array, dead_path: Array, position: Array, nominal: Array, centre: Array,
    traces: Array, sums: Array, first: int, last: int,
) -> None:  # pragma: no cover - compiled  # fmt: skip
    """Fill the results of `general.settle_targets` for some chunks."""
    R, W, U = np.empty((4, LANES)), np.empty((4, LANES)), np.empty((3, LANES))
    size, spread = np.empty(LANES), np.empty(LANES)
    for begin in range(first * CHUNK, min(last * CHUNK, position.shape[1]), LANES):
        count = min(LANES, position.shape[1] - begin)
        _load(reading, weight, dead_path, position, begin, count, R, W, U)
        for _ in range(_LAST_STEPS):
            if _move(R, W, station, U, size, spread) < _SETTLED:
                break
        for t in range(count):
            traces[begin + t] = spread[t]
        for k in range(3):
            for t in range(count):
                position[k, begin + t] = U[k, t]
        _add_moments(U, nominal, centre, spread, begin, count, sums[begin // CHUNK])


@compiled(inner=True, fastmath=FAST)
def _add_moments(
    U: Array, nominal: Array, centre: Array, spread: Array, begin: int, count: int, sums: Array
) -> None:  # pragma: no cover - compiled
    """Add number, sums and products (16,) of targets with a position and nominal ones about ``centre``."""
    n, sx, sy, sz, sa, sb, sc = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    ax, ay, az, bx, by, bz, cx, cy, cz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    wanted = nominal[begin : begin + count]
    for t in range(count):
        k = 1.0 if spread[t] < math.inf else 0.0
        x, y, z = k * (U[0, t] - centre[0]), k * (U[1, t] - centre[1]), k * (U[2, t] - centre[2])
        a, b, c = wanted[t, 0] - centre[0], wanted[t, 1] - centre[1], wanted[t, 2] - centre[2]
        n += k
        sx += x
        sy += y
        sz += z
        sa += k * a
        sb += k * b
        sc += k * c
        ax += a * x
        ay += a * y
        az += a * z
        bx += b * x
        by += b * y
        bz += b * z
        cx += c * x
        cy += c * y
        cz += c * z
    sums[0] += n
    sums[1] += sx
    sums[2] += sy
    sums[3] += sz
    sums[4] += sa
    sums[5] += sb
    sums[6] += sc
    sums[7] += ax
    sums[8] += ay
    sums[9] += az
    sums[10] += bx
    sums[11] += by
    sums[12] += bz
    sums[13] += cx
    sums[14] += cy
    sums[15] += cz


@compiled(fastmath=EXACT)
def screen_four(
    reading: Array, weight: Array, station: Array, dead_path: Array, position: Array, factor: Array, weak: float,
    checked: NDArray[np.int64], largest: Array, first: int, last: int,
) -> None:  # pragma: no cover - compiled  # fmt: skip
    """Count for some chunks the readings that others check; ``largest`` is the square of the normalised residual.

    With one equation the normalised residuals of all readings of a target are equal.
    """
    R, W, U, v = np.empty((4, LANES)), np.empty((4, LANES)), np.empty((3, LANES)), np.empty((17, LANES))
    taken, part = np.empty(LANES), np.empty(LANES)
    for begin in range(first * CHUNK, min(last * CHUNK, position.shape[1]), LANES):
        chunk, some = begin // CHUNK, min(LANES, position.shape[1] - begin)
        _load(reading, weight, dead_path, position, begin, some, R, W, U)
        _equate(R, W, station, U, v)
        for t in range(LANES):
            taken[t] = 0.0
        for k in range(factor.shape[1]):
            for t in range(LANES):
                part[t] = 0.0
            for a in range(16):
                f = factor[a, k]
                for t in range(LANES):
                    part[t] += v[a, t] * f
            for t in range(LANES):
                taken[t] += part[t] * part[t]
        checks = 0
        for t in range(LANES):
            left = 1.0 - taken[t]
            for j in range(4):
                share = v[4 * j + 3, t] / W[j, t] if W[j, t] > 0.0 else 0.0
                checks += 1 if share * share * left > weak else 0
            # Squares: the root is calculated only of the largest.
            taken[t] = v[16, t] * v[16, t] / left if left > weak else 0.0
        checked[chunk] += checks
        worst = largest[chunk]
        for t in range(LANES):
            worst = taken[t] if taken[t] > worst else worst
        largest[chunk] = worst
