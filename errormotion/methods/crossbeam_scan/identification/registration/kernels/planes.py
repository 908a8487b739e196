"""The blocks that a plane through all of their points does not explain, fitted again one after the other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.compiling import in_threads
from errormotion.estimation.robust import NORMAL_MAD
from errormotion.methods.crossbeam_scan.identification.registration import kernels
from errormotion.methods.crossbeam_scan.identification.registration.kernels import FAST, compiled

COLUMNS = 16
"""Points of a block along x, the profile."""
ROWS = 4
"""Points of a block along y, the feed: profiles."""
POINTS = ROWS * COLUMNS
FEWEST = 20
"""A block with fewer valid points carries no information."""
GATE = 4.5
"""Points further from the plane than this many times the scatter are left out."""
LARGE_SCATTER = 4.0
"""A block whose points scatter more than this many times the usual is dropped."""
MOST = 0.6
"""Share of its points that a block fitted from its neighbours' plane keeps; with fewer it starts from medians."""
SQUARED = 4.0
"""Such a block's variance about the plane in units of the usual, at most."""
SPREAD = 0.02
"""Determinant of the normal equations over the product of their diagonal, below which points lie on a line."""


def refit(z: NDArray[np.float32], dx: Array, dy: Array, scale: Array, bad: NDArray[np.bool_], out: Array) -> None:
    """Fit planes to the points near them, for the ``bad`` blocks; ``out`` receives columns of `reduce_blocks`.

    From the neighbours' plane: trimmed wide, then close, then by the plane found. What that does not fit starts from
    medians.
    """
    in_threads(_refit_rows, len(dy), z.size > kernels.MANY, z, dx, dy, scale, bad, out)


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
    z: NDArray[np.float32], r0: int, c0: int, dx: Array, dy: Array, plane: Array, gate: float, out: Array
) -> bool:  # pragma: no cover - compiled
    """Fit a plane to the points of a block within ``gate`` of ``plane`` (height and slopes), which it replaces.

    ``out`` (9,) receives a column of `reduce_blocks`. False where too few points are left for a plane.
    """
    base, sx, sy = plane[0], plane[1], plane[2]
    n, X, XX, x3, Y, YY, y3, XY, xxy, xyy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    S0, S1, S2, SS = 0.0, 0.0, 0.0, 0.0
    for i in range(ROWS):
        y, line = dy[i], z[r0 + i, c0 : c0 + COLUMNS]
        start = base + sy * y
        w0, w1, w2, w3, v0, v1 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(COLUMNS):
            x = dx[j]
            v = np.float64(line[j]) - start - sx * x
            near = abs(v) < gate
            w = 1.0 if near else 0.0
            v = v if near else 0.0
            w0 += w
            w1 += x * w
            w2 += x * x * w
            w3 += x * x * x * w
            v0 += v
            v1 += x * v
            SS += v * v
        n, X, XX, x3 = n + w0, X + w1, XX + w2, x3 + w3
        Y, YY, y3 = Y + y * w0, YY + y * y * w0, y3 + y * y * y * w0
        XY, xxy, xyy = XY + y * w1, xxy + y * w2, xyy + y * y * w1
        S0, S1, S2 = S0 + v0, S1 + v1, S2 + y * v0
    if n < FEWEST:
        return False
    # First row of the inverse of the normal matrix, and its other entries.
    a, b, c = XX * YY - XY * XY, XY * Y - X * YY, X * XY - XX * Y
    determinant = n * a + X * b + Y * c
    d, e, f = n * YY - Y * Y, X * Y - n * XY, n * XX - X * X
    if not determinant > SPREAD * n * XX * YY:
        return False
    m0 = (a * S0 + b * S1 + c * S2) / determinant
    m1 = (b * S0 + d * S1 + e * S2) / determinant
    m2 = (c * S0 + e * S1 + f * S2) / determinant
    plane[0], plane[1], plane[2] = base + m0, sx + m1, sy + m2
    out[0], out[1], out[2] = plane[0], plane[1], plane[2]
    out[3] = max(SS - m0 * S0 - m1 * S1 - m2 * S2, 0.0) / (n - 3)
    out[4] = n
    out[5] = a / determinant
    # What a surface z = dx^2 / 2, dy^2 / 2 or dx dy adds to the height of these points.
    out[6] = 0.5 * (a * XX + b * x3 + c * xxy) / determinant
    out[7] = 0.5 * (a * YY + b * xyy + c * y3) / determinant
    out[8] = (a * XY + b * xxy + c * xyy) / determinant
    return True


@compiled(inline="always")
def _refit_block(
    z: NDArray[np.float32], r0: int, c0: int, dx: Array, dy: Array, scale: float, plane: Array, room: Array, out: Array
) -> None:  # pragma: no cover - compiled
    """Fit a plane to a block's points near it, from ``plane`` if that fits, else from medians.

    ``out`` (9,) receives a column of `reduce_blocks`.
    """
    # From the neighbours' plane: trimmed wide, then close, then by the plane found.
    gate, good, trims = 3.0 * GATE * scale, True, 0
    while good and trims < 3:
        good = _trimmed_plane(z, r0, c0, dx, dy, plane, gate, out)
        gate, trims = GATE * scale, trims + 1
    if good and out[4] > MOST * POINTS and out[3] < SQUARED * scale * scale:
        return
    n, plane[0], plane[1], plane[2], mad = _robust_plane(z, r0, c0, dx, dy, room)
    good, trims = n >= FEWEST and mad < LARGE_SCATTER * scale, 0
    gate = GATE * max(mad, scale)
    while good and trims < 2:
        good = _trimmed_plane(z, r0, c0, dx, dy, plane, gate, out)
        trims += 1
    if not good:
        out[:] = np.nan
        out[4] = 0.0


@compiled(fastmath=FAST)
def _refit_rows(
    z: NDArray[np.float32], dx: Array, dy: Array, scale: Array, bad: NDArray[np.bool_], out: Array,
    first: int, last: int,
) -> None:  # fmt: skip  # pragma: no cover - compiled
    """Do the work of `refit` for the rows of blocks from ``first`` to before ``last``."""
    width = COLUMNS * (dx[1] - dx[0])
    room, fitted, plane = np.empty((2, POINTS)), np.empty(9), np.empty(3)
    for row in range(first, last):
        for column in range(out.shape[2]):
            if not bad[row, column]:
                continue
            # Extrapolated from the blocks on the left; NaN starts from medians.
            left, bend = max(column - 1, 0), 0.0
            if column > 1:
                bend = out[1, row, left] - out[1, row, left - 1]
                bend = bend if bend == bend else 0.0
            plane[1] = out[1, row, left] + bend if column else np.nan
            plane[0] = out[0, row, left] + width * (plane[1] - 0.5 * bend) if column else np.nan
            plane[2] = out[2, row, left] if column else np.nan
            _refit_block(z, row * ROWS, column * COLUMNS, dx, dy[row], scale[row], plane, room, fitted)
            for k in range(9):
                out[k, row, column] = fitted[k]
