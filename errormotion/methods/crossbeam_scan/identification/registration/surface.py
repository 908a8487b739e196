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
    kernels.spread(height, slope_x, slope_y, pitch_x, pitch_y)
    kernels.relax(height, lost, SWEEPS)
    return height, slope_x, slope_y
