"""The comparison of the warm blocks with the cold surface: by array operations, or by compiled loops."""

from __future__ import annotations

import numpy as np

from errormotion.arrays import Array
from errormotion.methods.crossbeam_scan.identification.registration.kernels import residuals
from errormotion.methods.crossbeam_scan.identification.registration.kernels.residuals import BEYOND, spline_weights


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
    compiled: bool,
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
    compiled : bool
        Whether compiled loops do it.

    Returns
    -------
    residual : ndarray (block row, block column)
        Z - S(X, Y), m; NaN where there is none.
    weight : ndarray (block row, block column)
        One over the variance of the residual; 0 where the block is not in the sums.
    rows : ndarray (block row, (6 + k) (7 + k) + 3)
        The sums: J^T W J, J^T W r, r^T W r, number of blocks, sum of t (1 - t) along y.
    """
    work = residuals.compare if compiled else _compared
    return work(blocks, x, y, pose, normal, centre, bases, surface, spread_of, grid, gate)


def _compared(
    blocks: Array, x: Array, y: Array, pose: Array, normal: Array, centre: Array, bases: Array, surface: Array,
    spread_of: Array, grid: Array, gate: float,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Do the work of `compare` by array operations."""
    height, slope_x, slope_y, variance = blocks
    X, Y, Z = (pose[k, 0] * x + (pose[k, 1] * y + pose[k, 3])[:, None] + pose[k, 2] * height for k in range(3))
    S, cold, between = _surface_at((X - grid[0]) / grid[1], (Y - grid[2]) / grid[3], variance, surface, spread_of)
    residual = Z - S
    kept = np.abs(residual) < gate
    weight = np.where(kept, 1.0 / (variance + cold), 0.0)
    a, b, c = (normal[k, 2] - normal[k, 0] * slope_x - normal[k, 1] * slope_y for k in range(3))
    a, b = a / c, b / c
    X, Y, Z = X - centre[0], Y - centre[1], Z - centre[2]
    n = 6 + len(bases)
    J = np.empty((len(y), n + 1, len(x)))  # the residuals behind their derivatives
    J[:, 0], J[:, 1], J[:, 2], J[:, n] = a, b, 1.0, np.where(kept, residual, 0.0)
    J[:, 3], J[:, 4], J[:, 5] = Y - b * Z, a * Z - X, b * X - a * Y
    for k, G in enumerate(bases):
        moved = [g[0] * X + g[1] * Y + g[2] * Z for g in G]
        J[:, 6 + k] = a * moved[0] + b * moved[1] + moved[2]
    sums = (J * weight[:, None]) @ J.transpose(0, 2, 1)
    last = sums[:, n, n], np.count_nonzero(kept, axis=1), np.sum(between, axis=1, where=kept)
    return residual, weight, np.hstack([sums[:, :n, :n].reshape(len(y), -1), sums[:, :n, n], np.stack(last, axis=1)])


def _surface_at(u: Array, v: Array, variance: Array, surface: Array, spread_of: Array) -> tuple[Array, Array, Array]:
    """Return the spline, the cold variance and t (1 - t) at places in nodes; NaN, inf and 0 where nothing is known."""
    n, m = spread_of.shape
    inside = (variance < np.inf) & (u > -BEYOND) & (v > -BEYOND) & (u < m - 1 + BEYOND) & (v < n - 1 + BEYOND)
    u, v = np.where(inside, u, 0.0), np.where(inside, v, 0.0)
    i, j = np.clip(v.astype(int), 0, n - 2), np.clip(u.astype(int), 0, m - 2)
    t, s = v - i, u - j
    node, spread_of = i * m + j, spread_of.ravel()
    with np.errstate(invalid="ignore"):  # 0 times infinity
        low, high = ((1 - s) * spread_of.take(k) + s * spread_of.take(k + 1) for k in (node, node + m))
        there = (1 - t) * low + t * high
    first, surface = i * (m + 2) + j, surface.ravel()
    along = spline_weights(s)
    splined = sum(
        wy * sum(wx * surface.take(first + (k * (m + 2) + h)) for h, wx in enumerate(along))
        for k, wy in enumerate(spline_weights(t))
    )
    known = inside & (there < np.inf)
    return np.where(known, splined, np.nan), np.where(known, there, np.inf), np.where(known, t * (1.0 - t), 0.0)


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
    shape = len(weight), weight.shape[1] + 2 * lags
    padded, counts = np.zeros((2, *shape)), weight > 0
    inside = padded[:, :, lags : shape[1] - lags]
    inside[0], inside[1] = np.sqrt(weight) * np.where(counts, residual, 0.0), counts
    # Zeros at both ends of each row: what is j further on in all of the rows is then i rows and j columns away.
    one_after_the_other = padded.reshape(2, -1)
    sums = np.empty((2, lags + 1, 2 * lags + 1))
    for i in range(lags + 1):
        for j in range(-lags, lags + 1):
            away = abs(i * shape[1] + j)
            for k, values in enumerate(one_after_the_other):
                sums[k, i, j + lags] = np.einsum("i,i", values[: values.size - away], values[away:])
    return sums[0], sums[1]
