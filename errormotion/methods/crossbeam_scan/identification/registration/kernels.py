"""Compiled loops over the points of a scan, which reduce them to blocks.

Threads share the rows of blocks, and every block is computed within one thread: the result has the same bits on any
number of threads.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import NORMAL_MAD, Array
from errormotion.compiling import Compiler, in_threads

COLUMNS = 16
"""Points of a block along x, the profile."""
ROWS = 4
"""Points of a block along y, the feed: profiles."""
POINTS = ROWS * COLUMNS
FEWEST = 20
"""A block with fewer valid points carries no information."""
MANY = 10000
"""More points or blocks than these are shared by several threads."""

# Sums may be taken in any order (so that they vectorise), but NaN stays NaN.
FAST = {"reassoc", "contract", "nsz", "arcp"}
_GATE = 4.5
# Scatter of a good block, in units of the usual: 61 degrees of freedom scatter by 0.18, curvature adds some 0.2.
_LIMIT = 2.0
_BAD_BLOCK = 4.0
# Blocks of a row that determine its scale: a few at first, more if these differ from the usual scale.
_FEW_OF_ROW, _OF_ROW = 6, 16
_OFF = 1.3


compiled = Compiler("the registration of scans", seconds=4, error_model="numpy")


@compiled(inner=True)
def _median(values: Array) -> float:  # pragma: no cover - compiled
    """Return the upper median of the values (n,), which are put in another order (Hoare's selection)."""
    k, low, high = len(values) // 2, 0, len(values) - 1
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


@compiled(inner=True)
def _robust_plane(
    z: NDArray[np.float32], r0: int, c0: int, dx: Array, dy: Array, room: Array
) -> tuple[int, float, float, float, float]:  # pragma: no cover - compiled
    """Return points, height, both slopes and scale of a block by medians, robust against a quarter of outliers.

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
    sx = _median(room[0, :n]) / (dx[half_c] - dx[0])
    n = 0
    for i in range(half_r):
        for j in range(COLUMNS):
            d = np.float64(z[r0 + i + half_r, c0 + j]) - np.float64(z[r0 + i, c0 + j])
            if d == d:
                room[0, n] = d / (dy[i + half_r] - dy[i])
                n += 1
    if n < FEWEST // 4:
        return 0, np.nan, np.nan, np.nan, np.nan
    sy = _median(room[0, :n])
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
    height = _median(room[0, :n])
    n = 0
    for k in range(POINTS):
        if room[1, k] == room[1, k]:
            room[0, n] = abs(room[1, k] - height)
            n += 1
    return n, height, sx, sy, NORMAL_MAD * _median(room[0, :n])


@compiled(inner=True, fastmath=FAST)
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

    ``out`` (9,) receives a column of `reduce_blocks`. False where too few points are left for a plane.
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


@compiled(inline="always")
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
    """Fit a plane to a block's points near it, from ``plane`` if that fits, else from medians.

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


@compiled(inline="always")
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


@compiled(inline="always")
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
    """Return the scale of a row of blocks: a line with a common deviation is not an outlier of single blocks.

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
        own = _median(scales[:found]) if found > 0 else scale
        if not own > _OFF * scale:
            return scale
    return own


def reduce_blocks(z: NDArray[np.float32], dx: Array, dy: Array, usual: float) -> Array:
    """Return a height map reduced to blocks; blocks that a plane does not explain are fitted robustly.

    Parameters
    ----------
    z : ndarray (row, column), float32
        Heights, m; NaN where there is none.
    dx : ndarray (16,)
        Positions of a block's points about its centre, m.
    dy : ndarray (block row, 4)
        Positions of its profiles about its centre, m.
    usual : float
        Scatter of the points about the plane of a good block, m.

    Returns
    -------
    ndarray (9, block row, block column)
        Height at the centre, both slopes, variance about the plane, points used, variance of the height in units of a
        point's variance, response of the height to dx^2/2, dy^2/2, dx dy. NaN where a block is dropped.
    """
    mean = dy.mean(axis=1, keepdims=True)
    centred, Sxx = dy - mean, ROWS * float(dx @ dx)
    Syy = COLUMNS * np.sum(centred**2, axis=1, keepdims=True)
    # Response of the height at the nominal centre to dy^2/2, for the profiles where they are.
    qy = np.sum((1.0 / ROWS - mean * COLUMNS * centred / Syy) * 0.5 * dy**2, axis=1, keepdims=True)
    of_row = np.hstack([mean, Syy, 1.0 / POINTS + mean**2 / Syy, qy])
    out = np.empty((9, len(dy), z.shape[1] // COLUMNS))
    single = (each.astype(np.float32) for each in (dx, dy, centred))
    in_threads(_reduce_rows, len(dy), z.size > MANY, z, dx, dy, *single, of_row, Sxx, usual, out)
    return out


@compiled(fastmath=FAST)
def _reduce_rows(
    z: NDArray[np.float32], dx: Array, dy: Array, dx4: NDArray[np.float32], dy4: NDArray[np.float32],
    centred4: NDArray[np.float32], of_row: Array, Sxx: float, usual: float, out: Array, first: int, last: int,
) -> None:  # fmt: skip  # pragma: no cover - compiled
    """Do the work of `reduce_blocks` for the rows of blocks from ``first`` to before ``last``."""
    bx, pitch, qx = out.shape[2], dx[1] - dx[0], 0.5 * Sxx / POINTS
    room, fitted, plane = np.empty((2, POINTS)), np.empty(9), np.empty(3)
    sums = np.empty((4, bx), np.float32)
    for row in range(first, last):
        mean_y, Syy, gain, qy = of_row[row, 0], of_row[row, 1], of_row[row, 2], of_row[row, 3]
        r0 = row * ROWS
        _block_sums(z, r0, dx4, centred4[row], sums)
        scale = _row_scale(z, r0, dx, dy[row], sums, Sxx, Syy, usual, room)
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
                # Extrapolated from the blocks on the left; NaN starts from medians.
                left, bend = max(column - 1, 0), 0.0
                if column > 1:
                    bend = out[1, row, left] - out[1, row, left - 1]
                    bend = bend if bend == bend else 0.0
                plane[1] = out[1, row, left] + bend if column else np.nan
                plane[0] = out[0, row, left] + COLUMNS * pitch * (plane[1] - 0.5 * bend) if column else np.nan
                plane[2] = out[2, row, left] if column else np.nan
                _refit(z, r0, c0, dx, dy[row], dx4, dy4[row], scale, plane, room, fitted)
                for k in range(9):
                    out[k, row, column] = fitted[k]
