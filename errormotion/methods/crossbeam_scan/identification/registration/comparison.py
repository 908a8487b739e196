"""The comparison of the warm blocks with the cold surface: array operations on few blocks, compiled loops on many.

Every row of blocks is computed within one thread, and its sums are its own: the result has the same bits on any number
of threads.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.compiling import in_threads
from errormotion.methods.crossbeam_scan.identification.registration.kernels import FAST, MANY, compiled

COMPILED_FROM = 5000
"""Blocks of the cold scan from which compiled loops are used: fewer take less time than to compile them."""
# A quarter of a block beyond the last centre there are still points behind the surface.
_BEYOND = 0.25


def compare(
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
) -> tuple[Array, Array, Array]:
    """Compare warm blocks with the cold surface: residuals, their weights, and the sums of every row of blocks.

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

    Returns
    -------
    residual : ndarray (block row, block column)
        Z - S(X, Y), m; NaN where there is none.
    weight : ndarray (block row, block column)
        One over the variance of the residual; 0 where the block is not in the sums.
    rows : ndarray (block row, (6 + k) (7 + k) + 3)
        The sums: J^T W J, J^T W r, r^T W r, number of blocks, sum of t (1 - t) along y.
    """
    given = blocks, x, y, pose, normal, centre, bases, surface, spread_of, grid, gate
    if spread_of.size < COMPILED_FROM:
        return _compared(*given)
    residual, weight = np.empty((2, *blocks.shape[1:]))
    rows = np.empty((len(y), (6 + len(bases)) * (7 + len(bases)) + 3))
    in_threads(_compare_rows, len(y), residual.size > MANY, *given, residual, weight, rows)
    return residual, weight, rows


def _compared(
    blocks: Array, x: Array, y: Array, pose: Array, normal: Array, centre: Array, bases: Array, surface: Array,
    spread_of: Array, grid: Array, gate: float,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Do the work of `compare` by array operations."""
    height, slope_x, slope_y, variance = blocks
    warm = np.stack(np.broadcast_arrays(x, y[:, None], height))
    X, Y, Z = points = np.tensordot(pose[:, :3], warm, 1) + pose[:, 3, None, None]
    S, cold, between = _surface_at((X - grid[0]) / grid[1], (Y - grid[2]) / grid[3], variance, surface, spread_of)
    residual = Z - S
    kept = np.abs(residual) < gate
    weight, r = np.where(kept, 1.0 / (variance + cold), 0.0), np.where(kept, residual, 0.0)
    turned = np.tensordot(normal, np.stack([-slope_x, -slope_y, np.ones_like(height)]), 1)
    a, b = turned[:2] / turned[2]
    X, Y, Z = points - centre[:, None, None]
    one = np.ones_like(X)
    moved = np.tensordot(bases, np.stack([X, Y, Z]), 1)
    J = np.stack([a, b, one, Y - b * Z, a * Z - X, b * X - a * Y, *(a * m[0] + b * m[1] + m[2] for m in moved)], axis=1)
    sums = (J * weight[:, None]) @ np.concatenate([J, r[:, None]], axis=1).transpose(0, 2, 1)
    last = (np.sum(each, axis=1, keepdims=True) for each in (weight * r * r, kept, np.where(kept, between, 0.0)))
    return residual, weight, np.hstack([sums[..., :-1].reshape(len(y), -1), sums[..., -1], *last])


def _surface_at(u: Array, v: Array, variance: Array, surface: Array, spread_of: Array) -> tuple[Array, Array, Array]:
    """Return the spline, the cold variance and t (1 - t) at places in nodes; NaN, inf and 0 where nothing is known."""
    n, m = spread_of.shape
    S, cold, between = np.full(u.shape, np.nan), np.full(u.shape, np.inf), np.zeros(u.shape)
    inside = (variance < np.inf) & (u > -_BEYOND) & (v > -_BEYOND) & (u < m - 1 + _BEYOND) & (v < n - 1 + _BEYOND)
    u, v = u[inside], v[inside]
    i, j = np.clip(v.astype(int), 0, n - 2), np.clip(u.astype(int), 0, m - 2)
    t, s = v - i, u - j
    with np.errstate(invalid="ignore"):  # 0 times infinity
        low, high = ((1 - s) * spread_of[k, j] + s * spread_of[k, j + 1] for k in (i, i + 1))
        there = (1 - t) * low + t * high
    along = _weights(s)
    splined = sum(
        wy * sum(wx * surface[i + k, j + h] for h, wx in enumerate(along)) for k, wy in enumerate(_weights(t))
    )
    known = there < np.inf
    S[inside] = np.where(known, splined, np.nan)
    cold[inside] = np.where(known, there, np.inf)
    between[inside] = np.where(known, t * (1.0 - t), 0.0)
    return S, cold, between


def _weights(t: Any) -> tuple[Any, Any, Any, Any]:
    """Return the four cubic B-splines at t in [0, 1) between the second and the third; one t or an array of them."""
    u, sixth = 1.0 - t, 1.0 / 6.0
    first, last = sixth * (u * u * u), sixth * (t * t * t)
    second = 2.0 / 3.0 - t * t * (1.0 - 0.5 * t)
    return first, second, 1.0 - first - second - last, last


_compiled_weights = compiled(inner=True)(_weights)


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
        if not (variance[c] < np.inf and u > -_BEYOND and v > -_BEYOND and u < m - 1 + _BEYOND and v < n - 1 + _BEYOND):
            continue
        # Unsigned: no index from behind.
        i, j = np.uint64(min(max(int(v), 0), n - 2)), np.uint64(min(max(int(u), 0), m - 2))
        t, s = v - i, u - j
        one = np.uint64(1)
        s0, s1 = spread_of[i], spread_of[i + one]
        variance_there = (1 - t) * ((1 - s) * s0[j] + s * s0[j + one]) + t * ((1 - s) * s1[j] + s * s1[j + one])
        if not variance_there < np.inf:
            continue
        w0, w1, w2, w3 = _compiled_weights(s)
        v0, v1, v2, v3 = _compiled_weights(t)
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


def lag_sums(residual: Array, weight: Array, lags: int) -> tuple[Array, Array]:
    """Return sums of products of neighbouring normalised residuals, for half of the neighbours (the others are equal).

    Parameters
    ----------
    residual, weight : ndarray (block row, block column)
        Residuals, m, and one over their variance; 0 where a block does not count.
    lags : int
        How many blocks away neighbours are looked for.

    Returns
    -------
    sums, pairs : ndarray (lags + 1, 2 lags + 1)
        Sums of products and how many there were, for lags along y (0 and more) and x (-lags and more).
    """
    counts = weight > 0
    padded = np.zeros((2, len(weight), weight.shape[1] + 2 * lags), np.float32)
    inside = padded[:, :, lags : padded.shape[2] - lags]
    inside[0], inside[1] = np.sqrt(weight) * np.where(counts, residual, 0.0), counts
    sums = np.empty((2, lags + 1, 2 * lags + 1))
    _add_products(padded[0], padded[1], lags, sums)
    return sums[0], sums[1]


@compiled(fastmath=FAST)
def _add_products(
    r: NDArray[np.float32], known: NDArray[np.float32], lags: int, sums: Array
) -> None:  # pragma: no cover - compiled
    """Do the work of `lag_sums` on residuals and whether they count, with ``lags`` zeros at both ends of each row."""
    by, bx = r.shape
    zero: Any = np.float32(0.0)
    for i in range(lags + 1):
        for j in range(2 * lags + 1):
            total, count = 0.0, 0.0
            for row in range(by - i):
                left, right, here, there = r[row], r[row + i], known[row], known[row + i]
                product, both = zero, zero
                for c in range(bx - 2 * lags):
                    product += left[lags + c] * right[j + c]
                    both += here[lags + c] * there[j + c]
                total += product
                count += both
            sums[0, i, j], sums[1, i, j] = total, count
