"""Compiled loops that compare the warm blocks with the cold surface.

Every row of blocks is computed within one thread, and its sums are its own: the result has the same bits on any number
of threads.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from errormotion.arrays import Array
from errormotion.methods.crossbeam_scan.identification.registration.kernels import FAST, compiled


@compiled(inner=True)
def _weights(t: float) -> tuple[float, float, float, float]:  # pragma: no cover - compiled
    """Return the four cubic B-splines at t in [0, 1) between the second and the third."""
    u, sixth = 1.0 - t, 1.0 / 6.0
    first, last = sixth * (u * u * u), sixth * (t * t * t)
    second = 2.0 / 3.0 - t * t * (1.0 - 0.5 * t)
    return first, second, 1.0 - first - second - last, last


@compiled(inner=True, fastmath=FAST)
def _row_sums(J: Array, w: Array, r: Array, weighted: Array, total: Array) -> None:  # pragma: no cover - compiled
    """Add up J^T W J, J^T W r and r^T W r of a row; ``w`` is 0 where a block does not count, ``weighted``: scratch."""
    n, m = J.shape
    for k in range(n):
        for c in range(m):
            weighted[c] = w[c] * J[k, c]
        for q in range(k, n):
            s = 0.0
            for c in range(m):
                s += weighted[c] * J[q, c]
            total[n * k + q] = s
            total[n * q + k] = s
        s = 0.0
        for c in range(m):
            s += weighted[c] * r[c]
        total[n * n + k] = s
    s = 0.0
    for c in range(m):
        s += w[c] * r[c] * r[c]
    total[n * n + n] = s


@compiled(inner=True, fastmath=FAST)
def _moved_row(
    height: Array, x: Array, y: float, pose: Array, grid: Array, points: Array
) -> None:  # pragma: no cover - compiled
    """Put a row of blocks into the cold frame: X, Y, Z, and X, Y in nodes of the grid, (5, column)."""
    X, Y, Z, U, V = points[0], points[1], points[2], points[3], points[4]
    ax, ay, az = pose[0, 0], pose[1, 0], pose[2, 0]
    bx, by, bz = pose[0, 1] * y + pose[0, 3], pose[1, 1] * y + pose[1, 3], pose[2, 1] * y + pose[2, 3]
    cx, cy, cz = pose[0, 2], pose[1, 2], pose[2, 2]
    fx, fy, ox, oy = 1.0 / grid[1], 1.0 / grid[3], grid[0], grid[2]
    for c in range(len(x)):
        X[c] = ax * x[c] + bx + cx * height[c]
        Y[c] = ay * x[c] + by + cy * height[c]
        Z[c] = az * x[c] + bz + cz * height[c]
        U[c], V[c] = (X[c] - ox) * fx, (Y[c] - oy) * fy


@compiled(inner=True)
def _surface_row(
    points: Array, variance: Array, surface: Array, spread_of: Array, S: Array, cold: Array, between: Array
) -> None:  # pragma: no cover - compiled
    """Evaluate the spline and the cold variance beneath a row of blocks; NaN where there is no cold surface."""
    n, m = spread_of.shape
    U, V = points[3], points[4]
    for c in range(len(S)):
        u, v = U[c], V[c]
        S[c], cold[c], between[c] = np.nan, np.inf, 0.0
        # A quarter of a block beyond the last centre there are still points behind the surface.
        if not (variance[c] < np.inf and u > -0.25 and v > -0.25 and u < m - 0.75 and v < n - 0.75):
            continue
        # Unsigned: no index from behind.
        i, j = np.uint64(min(max(int(v), 0), n - 2)), np.uint64(min(max(int(u), 0), m - 2))
        t, s = v - i, u - j
        one = np.uint64(1)
        s0, s1 = spread_of[i], spread_of[i + one]
        variance_there = (1 - t) * ((1 - s) * s0[j] + s * s0[j + one]) + t * ((1 - s) * s1[j] + s * s1[j + one])
        if not variance_there < np.inf:
            continue
        w0, w1, w2, w3 = _weights(s)
        v0, v1, v2, v3 = _weights(t)
        two, three = np.uint64(2), np.uint64(3)
        a, b, d, e = surface[i], surface[i + one], surface[i + two], surface[i + three]
        S[c] = (
            v0 * (w0 * a[j] + w1 * a[j + one] + w2 * a[j + two] + w3 * a[j + three])
            + v1 * (w0 * b[j] + w1 * b[j + one] + w2 * b[j + two] + w3 * b[j + three])
            + v2 * (w0 * d[j] + w1 * d[j + one] + w2 * d[j + two] + w3 * d[j + three])
            + v3 * (w0 * e[j] + w1 * e[j + one] + w2 * e[j + two] + w3 * e[j + three])
        )
        cold[c], between[c] = variance_there, t * (1.0 - t)


@compiled(inner=True, fastmath=FAST)
def _jacobian_row(
    points: Array, sx: Array, sy: Array, normal: Array, centre: Array, bases: Array, J: Array
) -> None:  # pragma: no cover - compiled
    """Fill in the derivatives of a row's residuals, (6 + k, column).

    The slopes are those of the warm block's own plane, turned into the cold frame: its noise is not that of r.
    """
    J0, J1, J2, J3, J4, J5 = J[0], J[1], J[2], J[3], J[4], J[5]
    px, py, pz = points[0], points[1], points[2]
    xx, xy, xz = normal[0, 0], normal[0, 1], normal[0, 2]
    yx, yy, yz = normal[1, 0], normal[1, 1], normal[1, 2]
    zx, zy, zz = normal[2, 0], normal[2, 1], normal[2, 2]
    c0, c1, c2 = centre[0], centre[1], centre[2]
    for c in range(len(sx)):
        p, q = sx[c], sy[c]
        f = 1.0 / (zz - zx * p - zy * q)
        a, b = (xz - xx * p - xy * q) * f, (yz - yx * p - yy * q) * f
        X, Y, Z = px[c] - c0, py[c] - c1, pz[c] - c2
        J0[c], J1[c], J2[c] = a, b, 1.0
        J3[c], J4[c], J5[c] = Y - b * Z, a * Z - X, b * X - a * Y
    for e in range(len(bases)):
        G, Je = bases[e], J[6 + e]
        for c in range(len(sx)):
            X, Y, Z = px[c] - centre[0], py[c] - centre[1], pz[c] - centre[2]
            Je[c] = (
                J0[c] * (G[0, 0] * X + G[0, 1] * Y + G[0, 2] * Z)
                + J1[c] * (G[1, 0] * X + G[1, 1] * Y + G[1, 2] * Z)
                + (G[2, 0] * X + G[2, 1] * Y + G[2, 2] * Z)
            )


@compiled()
def accumulate(
    blocks: Array,
    x: Array,
    y: Array,
    pose: Array,
    normal: Array,
    centre: Array,
    bases: Array,
    surface: Array,
    spread_of: Array,
    grid: Array,
    gate: float,
    residual: Array,
    weight: Array,
    rows: Array,
    first: int,
    last: int,
) -> None:  # pragma: no cover - compiled
    """Compare warm blocks with the cold surface: residuals, and the sums of every row of blocks.

    Parameters
    ----------
    blocks : ndarray (4, block row, block column)
        Warm heights (m), slopes along x and y, variances of the heights (m^2; not finite: not used).
    x, y : ndarray
        Centres of the blocks, m.
    pose : ndarray (3, 4)
        Linear part and translation of what takes warm points to the cold frame.
    normal : ndarray (3, 3)
        What takes normals there.
    centre : ndarray (3,)
        Point about which the Jacobian turns, m.
    bases : ndarray (k, 3, 3)
        Displacements of the further parameters per distance from the centre.
    surface : ndarray (n + 2, m + 2)
        B-spline coefficients of the cold surface, one beyond its nodes on every side.
    spread_of : ndarray (n, m)
        Variances of the cold heights, m^2; not finite where the cold scan knows nothing.
    grid : ndarray (4,)
        First node and pitch along x, then along y, m.
    gate : float
        Blocks whose residual is larger than this, m, are left out.
    residual : ndarray (block row, block column)
        Receives Z - S(X, Y), m; NaN where there is none.
    weight : ndarray (block row, block column)
        Receives one over the variance of the residual; 0 where the block is not in the sums.
    rows : ndarray (block row, (6 + k) (7 + k) + 3)
        Receives the sums: J^T W J, J^T W r, r^T W r, number of blocks, sum of t (1 - t) along y.
    first, last : int
        Rows of blocks to compare: from ``first`` to before ``last``.
    """
    bx, size = residual.shape[1], 6 + len(bases)
    J, points, room = np.empty((size, bx)), np.empty((5, bx)), np.empty((4, bx))
    S, cold, between, r = room[0], room[1], room[2], room[3]
    for row in range(first, last):
        variance, w, rest = blocks[3, row], weight[row], residual[row]
        _moved_row(blocks[0, row], x, y[row], pose, grid, points)
        _surface_row(points, variance, surface, spread_of, S, cold, between)
        count, middle, Z = 0.0, 0.0, points[2]
        for c in range(bx):
            rest[c] = Z[c] - S[c]
            kept = abs(rest[c]) < gate
            r[c] = rest[c] if kept else 0.0
            w[c] = 1.0 / (variance[c] + cold[c]) if kept else 0.0
            count += 1.0 if kept else 0.0
            # How far between two cold lines: there the spline averages their noise.
            middle += between[c] if kept else 0.0
        _jacobian_row(points, blocks[1, row], blocks[2, row], normal, centre, bases, J)
        _row_sums(J, w, r, between, rows[row])
        rows[row, size * (size + 1) + 1], rows[row, size * (size + 1) + 2] = count, middle


@compiled(fastmath=FAST)
def lag_sums(
    residual: Array, weight: Array, lags: int, sums: Array, pairs: Array
) -> None:  # pragma: no cover - compiled
    """Add up products of neighbouring normalised residuals, for half of the neighbours (the others are the same).

    Parameters
    ----------
    residual, weight : ndarray (block row, block column)
        Residuals, m, and one over their variance; 0 where a block does not count.
    lags : int
        How many blocks away neighbours are looked for.
    sums, pairs : ndarray (lags + 1, 2 lags + 1)
        Receive sums of products and how many there were, for lags along y (0 and more) and x (-lags and more).
    """
    by, bx = residual.shape
    r, known = np.zeros((by, bx + 2 * lags), np.float32), np.zeros((by, bx + 2 * lags), np.float32)
    for row in range(by):
        for c in range(bx):
            w = weight[row, c]
            r[row, lags + c] = np.sqrt(w) * residual[row, c] if w > 0 else 0.0
            known[row, lags + c] = 1.0 if w > 0 else 0.0
    zero: Any = np.float32(0.0)
    for i in range(lags + 1):
        for j in range(2 * lags + 1):
            total, count = 0.0, 0.0
            for row in range(by - i):
                left, right, here, there = r[row], r[row + i], known[row], known[row + i]
                product, both = zero, zero
                for c in range(bx):
                    product += left[lags + c] * right[j + c]
                    both += here[lags + c] * there[j + c]
                total += product
                count += both
            sums[i, j], pairs[i, j] = total, count
