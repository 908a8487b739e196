"""The comparison of the warm blocks with the cold surface, row by row."""

from __future__ import annotations

from typing import Any

import numpy as np

from errormotion.arrays import Array
from errormotion.compiling import in_threads
from errormotion.methods.crossbeam_scan.identification.registration import kernels
from errormotion.methods.crossbeam_scan.identification.registration.kernels import FAST, compiled

BEYOND = 0.25
"""A quarter of a block beyond the last centre there are still points behind the surface."""


def compare(
    blocks: Array, x: Array, y: Array, pose: Array, normal: Array, centre: Array, bases: Array, surface: Array,
    spread_of: Array, grid: Array, gate: float,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Return residuals, their weights, and the sums of every row of blocks; see `comparison.compare`."""
    residual, weight = np.empty((2, *blocks.shape[1:]))
    rows = np.empty((len(y), (6 + len(bases)) * (7 + len(bases)) + 3))
    given = blocks, x, y, pose, normal, centre, bases, surface, spread_of, grid, gate
    in_threads(_compare_rows, len(y), residual.size > kernels.MANY, *given, residual, weight, rows)
    return residual, weight, rows


def spline_weights(t: Any) -> tuple[Any, Any, Any, Any]:
    """Return the four cubic B-splines at t in [0, 1) between the second and the third; one t or an array of them."""
    u, sixth = 1.0 - t, 1.0 / 6.0
    first, last = sixth * (u * u * u), sixth * (t * t * t)
    second = 2.0 / 3.0 - t * t * (1.0 - 0.5 * t)
    return first, second, 1.0 - first - second - last, last


_weights = compiled(inner=True)(spline_weights)


@compiled(inline="always")
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


@compiled(inline="always")
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


@compiled(inline="always")
def _surface_row(
    points: Array, variance: Array, surface: Array, spread_of: Array, S: Array, cold: Array, between: Array
) -> None:  # pragma: no cover - compiled
    """Evaluate the spline and the cold variance beneath a row of blocks; NaN where there is no cold surface."""
    n, m = spread_of.shape
    U, V = points[3], points[4]
    for c in range(len(S)):
        u, v = U[c], V[c]
        S[c], cold[c], between[c] = np.nan, np.inf, 0.0
        if not (variance[c] < np.inf and u > -BEYOND and v > -BEYOND and u < m - 1 + BEYOND and v < n - 1 + BEYOND):
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


@compiled(inline="always")
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


@compiled(fastmath=FAST)
def _compare_rows(
    blocks: Array, x: Array, y: Array, pose: Array, normal: Array, centre: Array, bases: Array, surface: Array,
    spread_of: Array, grid: Array, gate: float, residual: Array, weight: Array, rows: Array, first: int, last: int,
) -> None:  # fmt: skip  # pragma: no cover - compiled
    """Do the work of `compare` for the rows of blocks from ``first`` to before ``last``."""
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
