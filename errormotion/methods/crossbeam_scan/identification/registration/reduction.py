"""The points of a scan reduced to blocks.

A block whose points lie on the plane through all of them is done with its sums. The others, with missing or wrong
points, are fitted again, from the plane of the block on their left or by medians: by compiled loops, or by array
operations in waves, first all blocks that have both neighbours on their left, then those on the right of these.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.estimation.robust import NORMAL_MAD
from errormotion.methods.crossbeam_scan.identification.registration.kernels import planes
from errormotion.methods.crossbeam_scan.identification.registration.kernels.planes import (
    COLUMNS,
    FEWEST,
    GATE,
    LARGE_SCATTER,
    MOST,
    POINTS,
    ROWS,
    SPREAD,
    SQUARED,
)

# Scatter of a good block, in units of the usual: 61 degrees of freedom scatter by 0.18, curvature adds some 0.2.
_LIMIT = 2.0
# Blocks of a row that determine its scale: a few at first, more if these differ from the usual scale.
_FEW_OF_ROW, _OF_ROW = 6, 16
_OFF = 1.3
# Points and blocks that are worked on at a time: they stay in the processor's cache, and BLAS starts no threads.
_CHUNK, _TOGETHER = 100_000, 1000


def reduce_blocks(z: NDArray[np.float32], dx: Array, dy: Array, usual: float, compiled: bool) -> Array:
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
    compiled : bool
        Whether compiled loops fit what the plane through all points does not explain.

    Returns
    -------
    ndarray (9, block row, block column)
        Height at the centre, both slopes, variance about the plane, points used, variance of the height in units of a
        point's variance, response of the height to dx^2/2, dy^2/2, dx dy. NaN where a block is dropped.
    """
    mean_y = dy.mean(axis=1, keepdims=True)
    centred, Sxx = dy - mean_y, ROWS * float(dx @ dx)
    Syy = COLUMNS * np.sum(centred**2, axis=1, keepdims=True)
    blocks = blocks_of(z, len(dy))
    base, (S0, S1, S2, SS) = _sums(blocks, dx, centred)
    mean, sx, sy = S0 / POINTS, S1 / Sxx, S2 / Syy
    rest = SS - mean * S0 - sx * S1 - sy * S2
    out = np.empty((9, *rest.shape))
    out[0] = base + mean - sy * mean_y
    out[1], out[2], out[3], out[4] = sx, sy, np.maximum(rest, 0.0) / (POINTS - 3), POINTS
    out[5], out[6] = 1.0 / POINTS + mean_y**2 / Syy, 0.5 * Sxx / POINTS
    # Response of the height at the nominal centre to dy^2/2, for the profiles where they are.
    out[7] = np.sum((1.0 / ROWS - mean_y * COLUMNS * centred / Syy) * 0.5 * dy**2, axis=1, keepdims=True)
    out[8] = 0.0
    scale = _row_scales(blocks, dx, dy, rest, usual)
    bad = ~(rest < _LIMIT * (POINTS - 3) * scale[:, None] ** 2)
    if bad.any() and compiled:
        planes.refit(z, dx, dy, scale, bad, out)
    elif bad.any():
        _refit(blocks, dx, dy, scale, bad, out)
    return out


def blocks_of(z: NDArray[np.float32], rows: int) -> NDArray[np.float32]:
    """Return a view of the blocks of a height map, (block row, profile, block column, point)."""
    columns = z.shape[1] // COLUMNS
    return z[: rows * ROWS, : columns * COLUMNS].reshape(rows, ROWS, columns, COLUMNS)


def _sums(blocks: NDArray[np.float32], dx: Array, dy: Array) -> tuple[Array, Array]:
    """Return a height of every block (block row, block column), and the sums of v, dx v, dy v and v^2 about it."""
    by, _, bx, _ = blocks.shape
    base, sums = blocks[:, 1, :, 7].astype(float), np.empty((4, by, bx))
    along, rows = np.stack([np.ones(COLUMNS), dx], axis=1), max(1, _CHUNK // (bx * POINTS))
    for first in range(0, by, rows):
        part = slice(first, first + rows)
        v = blocks[part].astype(float)
        v -= base[part, None, :, None]
        lines = (v.reshape(-1, COLUMNS) @ along).reshape(-1, ROWS, bx, 2)
        sums[:2, part] = lines.sum(axis=1).transpose(2, 0, 1)
        sums[2, part] = np.einsum("rl,rlc->rc", dy[part], lines[..., 0])
        v *= v
        sums[3, part] = v.sum(axis=1).sum(axis=2)
    return base, sums


def _row_scales(blocks: NDArray[np.float32], dx: Array, dy: Array, rest: Array, usual: float) -> Array:
    """Return the scale of every row of blocks: a line with a common deviation is not an outlier of single blocks.

    Where a quarter of the blocks scatters too much, the median of what some of them scatter by robustly, if that is
    more than ``usual`` by what a few blocks leave open.
    """
    columns, scale = blocks.shape[2], np.full(len(blocks), usual)
    bad = ~(rest < _LIMIT * (POINTS - 3) * usual**2)
    rows = np.flatnonzero(4 * np.count_nonzero(bad, axis=1) >= columns)
    own = scale
    for looked_at in (_FEW_OF_ROW, _OF_ROW):
        if not len(rows):
            return scale
        step = max(1, columns // looked_at)
        some = blocks[rows, :, step // 2 :: step].swapaxes(1, 2)
        mad = robust_planes(some.reshape(-1, ROWS, COLUMNS), dx, np.repeat(dy[rows], some.shape[1], axis=0))[3]
        own = medians(mad.reshape(len(rows), -1), 1)
        off = own > _OFF * usual
        rows, own = rows[off], own[off]
    scale[rows] = own
    return scale


def _refit(blocks: NDArray[np.float32], dx: Array, dy: Array, scale: Array, bad: NDArray[np.bool_], out: Array) -> None:
    """Do the work of `planes.refit` by array operations."""
    waves = _waves(bad)
    row, column = np.nonzero(bad)
    order = np.argsort(waves[row, column], kind="stable")
    row, column = row[order], column[order]
    ends = np.cumsum(np.bincount(waves[row, column])[1:])
    for first, last in zip([0, *ends[:-1]], ends, strict=True):
        for start in range(first, last, _TOGETHER):
            i, j = (each[start : min(start + _TOGETHER, last)] for each in (row, column))
            z = blocks[i, :, j].transpose(1, 2, 0).astype(float, order="C")
            out[:, i, j] = _fitted(z, dx, dy[i].T, scale[i], _extrapolated(out, i, j, dx))


def _waves(bad: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return when a block can be fitted, which takes both blocks on its left: 1 and more; 0 where it is not ``bad``."""
    waves = np.zeros((bad.shape[1] + 2, len(bad)), dtype=np.int64)
    for column, of_column in enumerate(bad.T):
        waves[column + 2] = np.where(of_column, 1 + np.maximum(waves[column], waves[column + 1]), 0)
    return waves[2:].T


def _extrapolated(out: Array, row: NDArray[np.int64], column: NDArray[np.int64], dx: Array) -> Array:
    """Return height and slopes (3, block) of blocks by their neighbours on the left; NaN where there is none."""
    height, sx, sy = np.where(column > 0, out[:3, row, column - 1], np.nan)
    bend = np.where(column > 1, sx - out[1, row, column - 2], 0.0)
    bend[np.isnan(bend)] = 0.0
    slope = sx + bend
    return np.stack([height + COLUMNS * (dx[1] - dx[0]) * (slope - 0.5 * bend), slope, sy])


def _fitted(z: Array, dx: Array, dy: Array, scale: Array, plane: Array) -> Array:
    """Return the columns of `reduce_blocks` (9, block) of blocks, from ``plane`` (3, block) where that fits.

    Heights ``z`` (profile, point, block) and ``dy`` (profile, block): operations on many blocks are fast along these.
    """
    gate = GATE * scale
    good, out = _trimmed(z, dx, dy, plane, (3.0 * gate, gate, gate))
    with np.errstate(invalid="ignore"):
        good &= (out[4] > MOST * POINTS) & (out[3] < SQUARED * scale**2)
    if good.all():
        return out
    left = np.flatnonzero(~good)
    out[:, left], out[4, left] = np.nan, 0.0
    z, dy, scale = z[..., left], dy[:, left], scale[left]
    *robust, mad = robust_planes(z.transpose(2, 0, 1), dx, dy.T)
    close = np.flatnonzero(mad < LARGE_SCATTER * scale)
    gate = GATE * np.maximum(mad, scale)[close]
    good, fitted_plane = _trimmed(z[..., close], dx, dy[:, close], np.stack(robust)[:, close], (gate, gate))
    out[:, left[close[good]]] = fitted_plane[:, good]
    return out


def _trimmed(z: Array, dx: Array, dy: Array, plane: Array, gates: tuple[Array, ...]) -> tuple[NDArray[np.bool_], Array]:
    """Fit planes to the points within each of the ``gates`` of the plane before, beginning with ``plane`` (3, block).

    Returns
    -------
    good : ndarray of bool, (block,)
        Which blocks have points enough for a plane every time.
    found : ndarray (9, block)
        Their columns of `reduce_blocks`.
    """
    good = np.ones(z.shape[2], dtype=bool)
    trimmed = plane
    with np.errstate(invalid="ignore", divide="ignore"):
        for gate in gates:
            enough, trimmed = _trimmed_planes(z, dx, dy, trimmed[:3], gate)
            good &= enough
    return good, trimmed


def _trimmed_planes(z: Array, dx: Array, dy: Array, plane: Array, gate: Array) -> tuple[NDArray[np.bool_], Array]:
    """Do one step of `_trimmed`."""
    base, sx, sy = plane
    v = z - (base + sy * dy)[:, None, :]
    v -= dx[:, None] * sx
    near = np.abs(v) < gate
    v = np.where(near, v, 0.0)
    powers = dx ** np.arange(4)[:, None]
    # Sums over the points of a profile, and of the products of powers of x (first index) and y over all points.
    lines = powers @ near.astype(float)
    sums = np.einsum("lpb,qlb->pqb", lines, np.stack([np.ones_like(dy), dy, dy * dy, dy * dy * dy]))
    n, X, Y, XX, XY, YY = sums[0, 0], sums[1, 0], sums[0, 1], sums[2, 0], sums[1, 1], sums[0, 2]
    values = powers[:2] @ v
    (S0, S1), S2 = values.sum(axis=0), np.einsum("lb,lb->b", values[:, 0], dy)
    SS = np.einsum("lcb,lcb->b", v, v)
    # First row of the inverse of the normal matrix, and its other entries.
    a, b, c = XX * YY - XY * XY, XY * Y - X * YY, X * XY - XX * Y
    determinant = n * a + X * b + Y * c
    enough = (n >= FEWEST) & (determinant > SPREAD * n * XX * YY)
    d, e, f = n * YY - Y * Y, X * Y - n * XY, n * XX - X * X
    m0 = (a * S0 + b * S1 + c * S2) / determinant
    m1 = (b * S0 + d * S1 + e * S2) / determinant
    m2 = (c * S0 + e * S1 + f * S2) / determinant
    variance = np.maximum(SS - m0 * S0 - m1 * S1 - m2 * S2, 0.0) / (n - 3)
    # What a surface z = dx^2 / 2, dy^2 / 2 or dx dy adds to the height of these points.
    of_xx = 0.5 * (a * XX + b * sums[3, 0] + c * sums[2, 1]) / determinant
    of_yy = 0.5 * (a * YY + b * sums[1, 2] + c * sums[0, 3]) / determinant
    of_xy = (a * XY + b * sums[2, 1] + c * sums[1, 2]) / determinant
    return enough, np.stack([base + m0, sx + m1, sy + m2, variance, n, a / determinant, of_xx, of_yy, of_xy])


def robust_planes(z: NDArray[np.floating], dx: Array, dy: Array) -> tuple[Array, Array, Array, Array]:
    """Return height, both slopes and scale of blocks by medians, robust against a quarter of outliers.

    Parameters
    ----------
    z : ndarray (block, 4, 16)
        Heights, m; NaN where there is none.
    dx, dy : ndarray (16,), (block, 4)
        Positions about the centres, m.

    Returns
    -------
    height, slope_x, slope_y, scale : ndarray (block,)
        NaN where a block has too few points.
    """
    half_r, half_c, heights = ROWS // 2, COLUMNS // 2, np.asarray(z, dtype=float)
    sx = medians(heights[:, :, half_c:] - heights[:, :, :half_c], FEWEST // 4) / (dx[half_c] - dx[0])
    run = (dy[:, half_r:] - dy[:, :half_r])[:, :, None]
    sy = medians((heights[:, half_r:] - heights[:, :half_r]) / run, FEWEST // 4)
    rest = heights - sx[:, None, None] * dx - sy[:, None, None] * dy[:, :, None]
    height = medians(rest, FEWEST)
    return height, sx, sy, NORMAL_MAD * medians(np.abs(rest - height[:, None, None]), FEWEST)


def medians(values: Array, fewest: int) -> Array:
    """Return the upper median of each block's finite values (block, ...); NaN where there are fewer than this."""
    ordered = np.sort(values.reshape(len(values), -1), axis=1)  # NaN come last
    count = np.isfinite(ordered).sum(axis=1)
    middle = ordered[np.arange(len(ordered)), np.minimum(count // 2, ordered.shape[1] - 1)]
    return np.where(count < max(fewest, 1), np.nan, middle)
