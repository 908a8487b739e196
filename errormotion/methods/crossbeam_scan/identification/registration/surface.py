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
from errormotion.methods.crossbeam_scan.identification.registration import kernels

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


@kernels.compiled()
def _spread(height: Array, sx: Array, sy: Array, pitch_x: float, pitch_y: float) -> int:  # pragma: no cover - compiled
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


@kernels.compiled()
def _relax(height: Array, filled: NDArray[np.int64], sweeps: int) -> None:  # pragma: no cover - compiled
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
