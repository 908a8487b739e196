"""Least squares of cycles that are coupled only with their neighbours, and with offsets common to all of them.

The normal equations are

    [T  G] [x]   [r]
    [G' D] [d] = [s]

T is block tridiagonal over the cycles, d are the shared offsets. Elimination proceeds along the cycles, so that time
and memory are proportional to their number.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from errormotion.arrays import Array


@dataclass(frozen=True)
class Solved:
    """The solution and its covariance, for unit weights.

    Attributes
    ----------
    x : ndarray (n, p)
        Unknowns of the cycles.
    offset : ndarray (q,)
        Shared offsets.
    own : ndarray (n, p, p)
        Covariance of x of each cycle for known offsets.
    shared : ndarray (n, p, q)
        Effect on x of one standard uncertainty of each of q independent components of the offsets: the covariance of x
        is ``own + shared shared'``.
    """

    x: Array
    offset: Array
    own: Array
    shared: Array


def solve(T: Array, after: Array, G: Array, D: Array, r: Array, s: Array) -> Solved:
    """Solve the normal equations.

    Parameters
    ----------
    T : ndarray (n, p, p)
        Diagonal blocks.
    after : ndarray (n - 1, p, p)
        Blocks that couple each cycle (rows) with the next (columns).
    G : ndarray (n, p, q)
    D : ndarray (q, q)
    r : ndarray (n, p)
    s : ndarray (q,)

    Raises
    ------
    numpy.linalg.LinAlgError
        The equations are singular.
    """
    n = len(T)
    inverse = np.empty_like(T)
    right = np.concatenate([r[:, :, None], G], axis=2)
    back = np.empty_like(after)
    if not after.any():
        inverse[:] = np.linalg.inv(T)
        y = inverse @ right
    else:
        inverse[0] = np.linalg.inv(T[0])
        for k in range(1, n):
            back[k - 1] = inverse[k - 1] @ after[k - 1]
            inverse[k] = np.linalg.inv(T[k] - after[k - 1].T @ back[k - 1])
            right[k] -= back[k - 1].T @ right[k - 1]
        y = inverse @ right
        for k in range(n - 2, -1, -1):
            y[k] -= back[k] @ y[k + 1]
            inverse[k] += back[k] @ inverse[k + 1] @ back[k].T
    z, F = y[:, :, 0], y[:, :, 1:]
    S = D - np.tensordot(G, F, axes=((0, 1), (0, 1)))
    L = np.linalg.cholesky((S + S.T) / 2)
    half = np.linalg.inv(L)
    offset = half.T @ (half @ (s - np.tensordot(G, z, axes=((0, 1), (0, 1)))))
    return Solved(z - F @ offset, offset, (inverse + np.swapaxes(inverse, 1, 2)) / 2, F @ half.T)
