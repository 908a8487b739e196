"""The cold scan as a surface between its blocks: a cubic spline that goes on beyond its edge.

A spline with mirrored edges is wrong by tens of nanometres along them. Here its fourth difference vanishes there
("not a knot"), as if the surface were one polynomial over the last pieces; that is one coefficient beyond the nodes on
every side.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from errormotion.arrays import Array

SWEEPS = 40
_BAND = 4


@dataclass(frozen=True)
class Surface:
    """A cubic spline through heights on an even grid.

    Attributes
    ----------
    coefficients : ndarray (rows + 2, columns + 2)
        B-spline coefficients, m.
    grid : ndarray (4,)
        First node and pitch along x, then along y, m.
    """

    coefficients: Array
    grid: Array

    @classmethod
    def through(cls, height: Array, x: Array, y: Array) -> Surface:
        """Return the surface through heights (row, column) at evenly spaced x and y, at least five of each."""
        grid = np.array([x[0], x[1] - x[0], y[0], y[1] - y[0]])
        return cls(np.ascontiguousarray(_coefficients(_coefficients(height).T).T), grid)


def _coefficients(values: Array) -> Array:
    """Return the B-spline coefficients (n + 2, m) of the columns of values (n, m)."""
    factors, pivots = _factors(len(values))
    right = np.zeros((len(values) + 2, values.shape[1]), order="F")
    right[1:-1] = 6.0 * values
    solution, _ = lapack.dgbtrs(factors, _BAND, _BAND, right, pivots, overwrite_b=True)
    return np.asarray(solution, dtype=float)


@lru_cache(maxsize=16)
def _factors(n: int) -> tuple[Array, NDArray[np.int32]]:
    """Return the banded LU factors of: c[-1] + 4 c[0] + c[1] = 6 z at every node, fourth difference 0 at both ends."""
    band = np.zeros((3 * _BAND + 1, n + 2))

    def put(row: int, column: int, value: float) -> None:
        band[2 * _BAND + row - column, column] = value

    for k, value in enumerate((1.0, -4.0, 6.0, -4.0, 1.0)):
        put(0, k, value)
        put(n + 1, n + 1 - k, value)
    for i in range(1, n + 1):
        for k, value in ((-1, 1.0), (0, 4.0), (1, 1.0)):
            put(i, i + k, value)
    factors, pivots, _ = lapack.dgbtrf(band, _BAND, _BAND)
    return factors, pivots


def repaired(height: Array, slope_x: Array, slope_y: Array, pitch_x: float, pitch_y: float) -> tuple[Array, ...]:
    """Return heights and slopes whose holes (NaN) are filled from around: planes outwards, then as smooth as their rim.

    Parameters
    ----------
    height, slope_x, slope_y : ndarray (row, column)
        Heights, m, and slopes of the blocks; NaN in ``height`` marks a hole.
    pitch_x, pitch_y : float
        Distance of the blocks, m.
    """
    lost = np.argwhere(np.isnan(height))
    if len(lost) == 0:
        return height, slope_x, slope_y
    height, slope_x, slope_y = height.copy(), slope_x.copy(), slope_y.copy()
    _spread(height, slope_x, slope_y, pitch_x, pitch_y)
    _relax(height, lost, SWEEPS)
    return height, slope_x, slope_y


def _spread(height: Array, sx: Array, sy: Array, pitch_x: float, pitch_y: float) -> None:
    """Fill blocks without height (NaN) by the mean of their neighbours' planes, outwards from the known ones."""
    inner = np.asarray(np.isfinite(height))
    if not inner.any():
        return
    maps = np.stack([np.where(inner, values, 0.0) for values in (height, sx, sy, 1.0)])
    maps = np.pad(maps, ((0, 0), (1, 1), (1, 1)))  # the fourth is 1 where a block is known
    i, j = 1 + np.argwhere(~inner).T
    while len(i):
        total = np.zeros((4, len(i)))
        for p in (-1, 0, 1):
            for q in (-1, 0, 1):
                h, gx, gy, known = maps[:, i + p, j + q]
                total += np.stack([h - gx * q * pitch_x - gy * p * pitch_y, gx, gy, known])
        beside = np.asarray(total[3] > 0)
        maps[:, i[beside], j[beside]] = total[:, beside] / total[3, beside]
        i, j = i[~beside], j[~beside]
    for values, found in zip((height, sx, sy), maps[:3, 1:-1, 1:-1], strict=True):
        values[~inner] = found[~inner]


def _relax(height: Array, filled: NDArray[np.int64], sweeps: int) -> None:
    """Bend the filled blocks (n, 2) so that fourth differences vanish along rows and columns (Gauss-Seidel).

    Each depends on the blocks up to two away along its row and column: not on others of its diagonal, and on those of
    the next two as the sweep before has left them. So every third diagonal is changed at once, each a sweep behind the
    one on its left, and the result is that of one block after the other.
    """
    by, bx = height.shape
    i, j = filled.T
    inside = np.stack([(i >= 2) & (i < by - 2), (j >= 2) & (j < bx - 2)])
    third, which = np.divmod(i + j - int(np.min(i + j)), 3)
    turn = which * (int(third.max()) + 1) + third
    order = np.argsort(turn, kind="stable")
    order = order[np.asarray(inside.any(axis=0))[order]]
    turn, inside, node = turn[order], inside[:, order].astype(float), (bx * i + j)[order]
    # Where there are no two neighbours on both sides, what is found along that direction counts 0 times.
    reach = np.array([-2, -1, 1, 2])[:, None]
    around = np.stack([node + (reach * step * use).astype(int) for step, use in zip((bx, 1), inside, strict=True)])
    count, flat, last = 6.0 * inside.sum(axis=0), height.reshape(-1), int(third.max())
    for stage in range(3 * (last + sweeps)):
        first = (stage % 3) * (last + 1)
        lowest, highest = max(stage // 3 - sweeps + 1, 0), min(stage // 3, last)
        part = slice(*np.searchsorted(turn, [first + lowest, first + highest + 1]))
        far, near, near_too, far_too = flat[around[:, :, part]].swapaxes(0, 1)
        bent = inside[:, part] * (4.0 * (near + near_too) - far - far_too)
        flat[node[part]] = (bent[0] + bent[1]) / count[part]
