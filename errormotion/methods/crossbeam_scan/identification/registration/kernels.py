"""Compiled loops over the points, which reduce them to blocks, and over the blocks, which fill and sharpen them.

Threads share them by rows of blocks, and every block is computed within one thread: the result has the same bits on any
number of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array

Function = TypeVar("Function", bound=Callable[..., Any])

COLUMNS = 16
"""Points of a block along x, the profile."""
ROWS = 4
"""Points of a block along y, the feed: profiles."""
POINTS = ROWS * COLUMNS
FEWEST = 20
"""A block with fewer valid points says nothing."""

# Sums may be taken in any order (so that they vectorise), but NaN stays NaN.
FAST = {"reassoc", "contract", "nsz", "arcp"}
_GATE = 4.5
# Scatter of a good block, in units of the usual: 61 degrees of freedom scatter by 0.18, curvature adds some 0.2.
_LIMIT = 2.0
_BAD_BLOCK = 4.0
# Blocks of a row that tell its scale: a few at first, and more where these say that it is another one.
_FEW_OF_ROW, _OF_ROW = 6, 16
_OFF = 1.3


def compiled(**options: Any) -> Callable[[Function], Function]:
    """Compile with numba: cached on disk, without the interpreter's lock."""
    return cast(Callable[[Function], Function], numba.njit(cache=True, nogil=True, error_model="numpy", **options))


@compiled()
def _median(values: Array, n: int) -> float:  # pragma: no cover - compiled
    """Return the upper median of the first n values, which are put in another order (Hoare's selection)."""
    k, low, high = n // 2, 0, n - 1
    while low < high:
        pivot = values[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if j < k:
            low = i
        if k < i:
            high = j
    return float(values[k])


@compiled()
def _robust_plane(
    z: NDArray[np.float32], r0: int, c0: int, dx: Array, dy: Array, room: Array
) -> tuple[int, float, float, float, float]:  # pragma: no cover - compiled
    """Return points, height, both slopes and scale of a block by medians, which a quarter of wrong points cannot bend.

    ``room`` (2, 64): scratch.
    """
    half_c, half_r = COLUMNS // 2, ROWS // 2
    n = 0
    for i in range(ROWS):
        for j in range(half_c):
            d = np.float64(z[r0 + i, c0 + j + half_c]) - np.float64(z[r0 + i, c0 + j])
            if d == d:
                room[0, n] = d
                n += 1
    if n < FEWEST // 4:
        return 0, np.nan, np.nan, np.nan, np.nan
    sx = _median(room[0], n) / (dx[half_c] - dx[0])
    n = 0
    for i in range(half_r):
        for j in range(COLUMNS):
            d = np.float64(z[r0 + i + half_r, c0 + j]) - np.float64(z[r0 + i, c0 + j])
            if d == d:
                room[0, n] = d / (dy[i + half_r] - dy[i])
                n += 1
    if n < FEWEST // 4:
        return 0, np.nan, np.nan, np.nan, np.nan
    sy = _median(room[0], n)
    n = 0
    for i in range(ROWS):
        for j in range(COLUMNS):
            v = np.float64(z[r0 + i, c0 + j]) - sx * dx[j] - sy * dy[i]
            room[1, i * COLUMNS + j] = v
            if v == v:
                room[0, n] = v
                n += 1
    if n < FEWEST:
        return n, np.nan, np.nan, np.nan, np.nan
    height = _median(room[0], n)
    n = 0
    for k in range(POINTS):
        if room[1, k] == room[1, k]:
            room[0, n] = abs(room[1, k] - height)
            n += 1
    return n, height, sx, sy, 1.4826 * _median(room[0], n)


@compiled()
def block_scales(z: NDArray[np.float32], dx: Array, dy: Array, step: int) -> Array:  # pragma: no cover - compiled
    """Return the robust scale (m) of every ``step``-th block, NaN where it has too few points."""
    by, bx = z.shape[0] // ROWS, z.shape[1] // COLUMNS
    room = np.empty((2, POINTS))
    scales = np.full((by * bx + step - 1) // step, np.nan)
    for k in range(scales.size):
        row, column = (k * step) // bx, (k * step) % bx
        scales[k] = _robust_plane(z, row * ROWS, column * COLUMNS, dx, dy[row], room)[4]
    return scales


@compiled(fastmath=FAST)
def _trimmed_plane(
    z: NDArray[np.float32],
    r0: int,
    c0: int,
    dx: NDArray[np.float32],
    dy: NDArray[np.float32],
    plane: Array,
    gate: float,
    out: Array,
) -> bool:  # pragma: no cover - compiled
    """Fit a plane to the points of a block within ``gate`` of ``plane`` (height and slopes), which it replaces.

    ``out`` (9,) receives a column of `reduce_blocks`. False where too few points are left to bear a plane.
    """
    base, sx, sy, g = np.float32(plane[0]), np.float32(plane[1]), np.float32(plane[2]), np.float32(gate)
    one, zero = np.float32(1.0), np.float32(0.0)
    k, x1, x2, x3, y1, y2, y3 = zero, zero, zero, zero, zero, zero, zero
    xy, xxy, xyy, S0, S1, S2, SS = zero, zero, zero, zero, zero, zero, zero
    p0, p1, p2, p3 = sy * dy[0], sy * dy[1], sy * dy[2], sy * dy[3]
    d0, d1, d2, d3 = dy[0], dy[1], dy[2], dy[3]
    for j in range(COLUMNS):
        x = dx[j]
        v0, v1 = z[r0, c0 + j] - base - sx * x - p0, z[r0 + 1, c0 + j] - base - sx * x - p1
        v2, v3 = z[r0 + 2, c0 + j] - base - sx * x - p2, z[r0 + 3, c0 + j] - base - sx * x - p3
        w0, w1 = (one if abs(v0) < g else zero), (one if abs(v1) < g else zero)
        w2, w3 = (one if abs(v2) < g else zero), (one if abs(v3) < g else zero)
        v0, v1 = (v0 if abs(v0) < g else zero), (v1 if abs(v1) < g else zero)
        v2, v3 = (v2 if abs(v2) < g else zero), (v3 if abs(v3) < g else zero)
        w, v = (w0 + w1) + (w2 + w3), (v0 + v1) + (v2 + v3)
        wy = (w0 * d0 + w1 * d1) + (w2 * d2 + w3 * d3)
        wyy = (w0 * d0 * d0 + w1 * d1 * d1) + (w2 * d2 * d2 + w3 * d3 * d3)
        k += w
        x1 += x * w
        x2 += x * x * w
        x3 += x * x * x * w
        y1 += wy
        y2 += wyy
        y3 += (w0 * d0 * d0 * d0 + w1 * d1 * d1 * d1) + (w2 * d2 * d2 * d2 + w3 * d3 * d3 * d3)
        xy += x * wy
        xxy += x * x * wy
        xyy += x * wyy
        S0 += v
        S1 += x * v
        S2 += (v0 * d0 + v1 * d1) + (v2 * d2 + v3 * d3)
        SS += (v0 * v0 + v1 * v1) + (v2 * v2 + v3 * v3)
    n, X, Y = np.float64(k), np.float64(x1), np.float64(y1)
    XX, XY, YY = np.float64(x2), np.float64(xy), np.float64(y2)
    if n < FEWEST:
        return False
    # First row of the inverse of the normal matrix, and its other entries.
    a, b, c = XX * YY - XY * XY, XY * Y - X * YY, X * XY - XX * Y
    determinant = n * a + X * b + Y * c
    d, e, f = n * YY - Y * Y, X * Y - n * XY, n * XX - X * X
    if not determinant > 0.02 * n * XX * YY:
        return False
    m0 = (a * S0 + b * S1 + c * S2) / determinant
    m1 = (b * S0 + d * S1 + e * S2) / determinant
    m2 = (c * S0 + e * S1 + f * S2) / determinant
    plane[0], plane[1], plane[2] = np.float64(base) + m0, np.float64(sx) + m1, np.float64(sy) + m2
    out[0], out[1], out[2] = plane[0], plane[1], plane[2]
    out[3] = max(np.float64(SS) - m0 * S0 - m1 * S1 - m2 * S2, 0.0) / (n - 3)
    out[4] = n
    out[5] = a / determinant
    # What a surface z = dx^2 / 2, dy^2 / 2 or dx dy adds to the height of these points.
    out[6] = 0.5 * (a * XX + b * x3 + c * xxy) / determinant
    out[7] = 0.5 * (a * YY + b * xyy + c * y3) / determinant
    out[8] = (a * XY + b * xxy + c * xyy) / determinant
    return True


@compiled()
def _refit(
    z: NDArray[np.float32],
    r0: int,
    c0: int,
    dx: Array,
    dy: Array,
    dx4: NDArray[np.float32],
    dy4: NDArray[np.float32],
    scale: float,
    plane: Array,
    room: Array,
    out: Array,
) -> None:  # pragma: no cover - compiled
    """Fit a plane to a block's points near it, from ``plane`` if that holds, else from medians.

    ``out`` (9,) receives a column of `reduce_blocks`.
    """
    gate = _GATE * scale
    # From the neighbours' plane: trimmed wide, then close, then by the plane found.
    good = _trimmed_plane(z, r0, c0, dx4, dy4, plane, 3.0 * gate, out)
    good = good and _trimmed_plane(z, r0, c0, dx4, dy4, plane, gate, out)
    good = good and _trimmed_plane(z, r0, c0, dx4, dy4, plane, gate, out)
    if good and out[4] > 0.6 * POINTS and out[3] < 4.0 * scale * scale:
        return
    n, plane[0], plane[1], plane[2], mad = _robust_plane(z, r0, c0, dx, dy, room)
    if n >= FEWEST and mad < _BAD_BLOCK * scale:
        gate = _GATE * max(mad, scale)
        good = _trimmed_plane(z, r0, c0, dx4, dy4, plane, gate, out)
        if good and _trimmed_plane(z, r0, c0, dx4, dy4, plane, gate, out):
            return
    out[:] = np.nan
    out[4] = 0.0


@compiled(fastmath=FAST)
def _block_sums(
    z: NDArray[np.float32], r0: int, dx: NDArray[np.float32], dy: NDArray[np.float32], sums: NDArray[np.float32]
) -> None:  # pragma: no cover - compiled
    """Add up v, dx v, dy v and v^2 of every block of four profiles, v counted from a point of the block: (4, block).

    Every profile is an array of its own: the loop over 16 points then becomes one over the lanes of a register. Small
    differences from one point keep 1e-7 of themselves in single precision.
    """
    z0, z1, z2, z3 = z[r0], z[r0 + 1], z[r0 + 2], z[r0 + 3]
    d0, d1, d2, d3, zero = dy[0], dy[1], dy[2], dy[3], np.float32(0.0)
    for column in range(sums.shape[1]):
        c0 = column * COLUMNS
        base = z1[c0 + 7]
        S0, S1, S2, SS = zero, zero, zero, zero
        for j in range(COLUMNS):
            v0, v1 = z0[c0 + j] - base, z1[c0 + j] - base
            v2, v3 = z2[c0 + j] - base, z3[c0 + j] - base
            s = (v0 + v1) + (v2 + v3)
            S0 += s
            S1 += dx[j] * s
            S2 += (d0 * v0 + d1 * v1) + (d2 * v2 + d3 * v3)
            SS += (v0 * v0 + v1 * v1) + (v2 * v2 + v3 * v3)
        sums[0, column], sums[1, column], sums[2, column], sums[3, column] = S0, S1, S2, SS


@compiled()
def _row_scale(
    z: NDArray[np.float32],
    r0: int,
    dx: Array,
    dy: Array,
    sums: NDArray[np.float32],
    Sxx: float,
    Syy: float,
    scale: float,
    room: Array,
) -> float:  # pragma: no cover - compiled
    """Return the scale of a row of blocks: a line that is off as a whole is no outlier in some of its blocks.

    Where a quarter of the blocks scatters too much, the median of what some of them scatter by robustly, if that is
    more than ``scale`` by what a few blocks leave open.
    """
    blocks = sums.shape[1]
    limit, bad = _LIMIT * scale * scale * (POINTS - 3), 0
    for column in range(blocks):
        S0, S1, S2 = np.float64(sums[0, column]), np.float64(sums[1, column]), np.float64(sums[2, column])
        if not np.float64(sums[3, column]) - S0 * S0 / POINTS - S1 * S1 / Sxx - S2 * S2 / Syy < limit:
            bad += 1
    if 4 * bad < blocks:
        return scale
    scales, own = np.empty(blocks), scale
    for looked_at in (_FEW_OF_ROW, _OF_ROW):
        step, found = max(1, blocks // looked_at), 0
        for column in range(step // 2, blocks, step):
            mad = _robust_plane(z, r0, column * COLUMNS, dx, dy, room)[4]
            if mad == mad:
                scales[found] = mad
                found += 1
        own = _median(scales, found) if found > 0 else scale
        if not own > _OFF * scale:
            return scale
    return own


@compiled(fastmath=FAST)
def _reduce_row(
    z: NDArray[np.float32], row: int, dx: Array, y: Array, scale: float, out: Array
) -> None:  # pragma: no cover - compiled
    """Do the work of `reduce_blocks` for one row of blocks, whose profiles are at ``y`` (4,) about its centre."""
    bx = out.shape[2]
    Sxx = ROWS * np.sum(dx * dx)
    qx = 0.5 * np.sum(dx * dx) / COLUMNS
    limit = _LIMIT * scale * scale * (POINTS - 3)
    dx4, pitch = dx.astype(np.float32), dx[1] - dx[0]
    room = np.empty((2, POINTS))
    fitted, plane = np.empty(9), np.empty(3)
    mean_y = np.sum(y) / ROWS
    Syy = COLUMNS * np.sum((y - mean_y) ** 2)
    # Response of the height at the nominal centre to dy^2/2, for the profiles where they are.
    qy = 0.0
    for i in range(ROWS):
        qy += (1.0 / ROWS - mean_y * COLUMNS * (y[i] - mean_y) / Syy) * 0.5 * y[i] * y[i]
    gain = 1.0 / POINTS + mean_y * mean_y / Syy
    y4, dy4 = (y - mean_y).astype(np.float32), y.astype(np.float32)
    r0 = row * ROWS
    sums = np.empty((4, bx), np.float32)
    _block_sums(z, r0, dx4, y4, sums)
    scale = _row_scale(z, r0, dx, y, sums, Sxx, Syy, scale, room)
    limit = _LIMIT * scale * scale * (POINTS - 3)
    for column in range(bx):
        c0 = column * COLUMNS
        base = z[r0 + 1, c0 + 7]
        S0, S1, S2, SS = sums[0, column], sums[1, column], sums[2, column], sums[3, column]
        mean, sx, sy = np.float64(S0) / POINTS, np.float64(S1) / Sxx, np.float64(S2) / Syy
        rest = np.float64(SS) - mean * S0 - sx * S1 - sy * S2
        if rest < limit:
            out[0, row, column] = np.float64(base) + mean - sy * mean_y
            out[1, row, column] = sx
            out[2, row, column] = sy
            out[3, row, column] = max(rest, 0.0) / (POINTS - 3)
            out[4, row, column] = POINTS
            out[5, row, column] = gain
            out[6, row, column] = qx
            out[7, row, column] = qy
            out[8, row, column] = 0.0
        else:
            # Where the blocks on the left lead to: NaN leads nowhere, and medians start.
            left, bend = max(column - 1, 0), 0.0
            if column > 1:
                bend = out[1, row, left] - out[1, row, left - 1]
                bend = bend if bend == bend else 0.0
            plane[1] = out[1, row, left] + bend if column else np.nan
            plane[0] = out[0, row, left] + COLUMNS * pitch * (plane[1] - 0.5 * bend) if column else np.nan
            plane[2] = out[2, row, left] if column else np.nan
            _refit(z, r0, c0, dx, y, dx4, dy4, scale, plane, room, fitted)
            for k in range(9):
                out[k, row, column] = fitted[k]


@compiled(parallel=True, fastmath=FAST)
def reduce_blocks(
    z: NDArray[np.float32], dx: Array, dy: Array, scale: float, out: Array
) -> None:  # pragma: no cover - compiled
    """Reduce a height map to blocks in one pass; blocks that a plane does not explain are fitted again, robustly.

    Parameters
    ----------
    z : ndarray (row, column), float32
        Heights, m; NaN where there is none.
    dx : ndarray (16,)
        Places of a block's points about its centre, m.
    dy : ndarray (block row, 4)
        Places of its profiles about its centre, m.
    scale : float
        Scatter of the points about the plane of a good block, m.
    out : ndarray (9, block row, block column)
        Receives height at the centre, both slopes, variance about the plane, points used, variance of the height in
        units of a point's variance, response of the height to dx^2/2, dy^2/2, dx dy. NaN where a block says nothing.
    """
    for row in numba.prange(out.shape[1]):
        _reduce_row(z, row, dx, dy[row], scale, out)


@compiled(fastmath=FAST)
def sharpen(
    maps: Array, pitch_x: float, pitch_y: float, bends: Array, height: Array, scatter: Array
) -> None:  # pragma: no cover - compiled
    """Take out what curvature adds to the blocks' means and to the scatter of their points.

    Second differences go on as straight lines at both ends.

    Parameters
    ----------
    maps : ndarray (9, block row, block column)
        Columns of `reduce_blocks`, holes in means and slopes filled; no points where a block says nothing.
    pitch_x, pitch_y : float
        Distance of the blocks, m.
    bends : ndarray (3,)
        Variance about its plane of a block with z = dx^2 / 2, dy^2 / 2, dx dy.
    height, scatter : ndarray (block row, block column)
        Receive heights of the surface, m, and variances, m^2, that are noise.
    """
    by, bx = height.shape
    for row in range(by):
        # Coefficients of the second difference along y over four rows.
        if row == 0:
            k0, k1, k2, k3, a, b, c, d = 0, 1, 2, 3, 2.0, -5.0, 4.0, -1.0
        elif row == by - 1:
            k0, k1, k2, k3, a, b, c, d = by - 1, by - 2, by - 3, by - 4, 2.0, -5.0, 4.0, -1.0
        else:
            k0, k1, k2, k3, a, b, c, d = row - 1, row, row + 1, row, 1.0, -2.0, 1.0, 0.0
        m0, m1, m2, m3, z = maps[0, k0], maps[0, k1], maps[0, k2], maps[0, k3], maps[0, row]
        low, high = max(row - 1, 0), min(row + 1, by - 1)
        s0, s1, step = maps[1, low], maps[1, high], 1.0 / ((high - low) * pitch_y)
        qx, qy, qxy, points, found = maps[6, row], maps[7, row], maps[8, row], maps[4, row], maps[3, row]
        along = np.empty(bx)
        for j in range(1, bx - 1):
            along[j] = z[j - 1] - 2.0 * z[j] + z[j + 1]
        along[0], along[bx - 1] = 2.0 * along[1] - along[2], 2.0 * along[bx - 2] - along[bx - 3]
        fx, fy = 1.0 / pitch_x**2, 1.0 / pitch_y**2
        out, rest = height[row], scatter[row]
        for j in range(bx):
            zxx, zyy = fx * along[j], fy * (a * m0[j] + b * m1[j] + c * m2[j] + d * m3[j])
            zxy = step * (s1[j] - s0[j])
            out[j] = z[j] - (qx[j] * zxx + qy[j] * zyy + qxy[j] * zxy if points[j] > 0 else 0.0)
            rest[j] = found[j] - (zxx * zxx * bends[0] + zyy * zyy * bends[1] + zxy * zxy * bends[2])


@compiled()
def spread(height: Array, sx: Array, sy: Array, pitch_x: float, pitch_y: float) -> int:  # pragma: no cover - compiled
    """Fill blocks without height (NaN) from their neighbours' planes, outwards from the known, then smooth the filled.

    Returns
    -------
    int
        How many were filled.
    """
    by, bx = height.shape
    lost = np.argwhere(np.isnan(height))
    if len(lost) == 0 or len(lost) == by * bx:
        return len(lost)
    known = ~np.isnan(height)
    waiting, left = lost, len(lost)
    while left > 0:
        order = np.empty((left, 2), np.int64)
        filled = np.empty((left, 3))
        n, rest = 0, 0
        for k in range(left):
            i, j = waiting[k, 0], waiting[k, 1]
            count, h, gx, gy = 0, 0.0, 0.0, 0.0
            for p in range(max(i - 1, 0), min(i + 2, by)):
                for q in range(max(j - 1, 0), min(j + 2, bx)):
                    if known[p, q]:
                        h += height[p, q] + sx[p, q] * (j - q) * pitch_x + sy[p, q] * (i - p) * pitch_y
                        gx += sx[p, q]
                        gy += sy[p, q]
                        count += 1
            if count:
                order[n, 0], order[n, 1] = i, j
                filled[n, 0], filled[n, 1], filled[n, 2] = h / count, gx / count, gy / count
                n += 1
            else:
                waiting[rest, 0], waiting[rest, 1] = i, j
                rest += 1
        for k in range(n):
            i, j = order[k, 0], order[k, 1]
            height[i, j], sx[i, j], sy[i, j] = filled[k, 0], filled[k, 1], filled[k, 2]
            known[i, j] = True
        left = rest
    return len(lost)


@compiled()
def relax(height: Array, filled: NDArray[np.int64], sweeps: int) -> None:  # pragma: no cover - compiled
    """Bend the filled blocks so that fourth differences vanish along rows and columns (Gauss-Seidel)."""
    by, bx = height.shape
    for _ in range(sweeps):
        for k in range(len(filled)):
            i, j = filled[k, 0], filled[k, 1]
            total, count = 0.0, 0
            if 2 <= i < by - 2:
                total += 4.0 * (height[i - 1, j] + height[i + 1, j]) - height[i - 2, j] - height[i + 2, j]
                count += 6
            if 2 <= j < bx - 2:
                total += 4.0 * (height[i, j - 1] + height[i, j + 1]) - height[i, j - 2] - height[i, j + 2]
                count += 6
            if count:
                height[i, j] = total / count
