"""Effects that a model does not contain: their information reduced by the fit, their size, and the gain by each.

An effect that is missing in the model adds ``D a`` to the residuals. With the whitened derivatives D, the residuals r
of the fit and its hat matrix H,

    N = D' (1 - H) D,    u = D' r,    a = N^-1 u,    gain = u' N^-1 u;

the gain is the decrease of the sum of squares if a is estimated as well. It is exact for a linear model.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.estimation.blocks import Index
from errormotion.estimation.fit import Fit

__all__ = ["MIN_REDUNDANCY", "SINGULAR", "At", "Numbers", "information", "reduced", "solved", "swept"]

MIN_REDUNDANCY = 1e-3
"""Redundancy of a number below which an error would not be seen."""
SINGULAR = 1e-9
"""Smallest eigenvalue of information, relative to the largest one, that is not regarded as rounding."""

At = tuple[int, int]
"""Reading and number; 0 for a whole reading."""


def information(fit: Fit, design: Array, rows: Index | None = None) -> tuple[Array, Array]:
    """Return ``u`` (k,) and ``N`` (k, k) of effects on the residuals that the model does not contain.

    Parameters
    ----------
    fit : Fit
    design : ndarray, (n, m, k)
        Derivatives of the residuals.
    rows : ndarray of int, optional
        The readings of ``design``, all others being unaffected.
    """
    linear = fit.linear
    white = linear.whitener if rows is None else linear.whitener[rows]
    return reduced(fit, white @ design, rows)


class Numbers:
    """The numbers of a fit, or its whole readings, as possible errors.

    Attributes
    ----------
    k : int
        Unknowns of each: 1, or m for whole readings.
    gain : ndarray, (n, m) or (n, 1)
    tested : ndarray of bool, same shape
        Whether an error would change the residuals.
    redundancy : ndarray, same shape
        Part of the information on an error that the fit leaves; the smallest one of a whole reading.
    """

    gain: Array
    tested: NDArray[np.bool_]
    redundancy: Array

    def __init__(self, fit: Fit, whole: bool) -> None:
        linear = fit.linear
        used, r = linear.used, linear.residual
        m = used.shape[1]
        self.whole, self.k, self.W = whole, m if whole else 1, linear.whitener
        both = used[:, :, None] & used[:, None, :]
        rest = np.where(both, np.eye(m) - fit.hat, 0.0)
        if whole:
            # An error of a reading changes its whitened numbers: D = 1.
            values, vectors = np.linalg.eigh(rest)
            kept = values > MIN_REDUNDANCY
            along = np.einsum("nij,ni->nj", vectors, r)
            self.gain = np.sum(along**2 * kept / np.where(kept, values, 1.0), axis=1, keepdims=True)
            self.tested = np.any(kept, axis=1, keepdims=True)
            values[:, :m] = np.where(np.arange(m) < m - used.sum(axis=1)[:, None], 1.0, values)
            self.redundancy = np.where(self.tested, values.min(axis=1, keepdims=True), 0.0)
            return
        u = np.einsum("nij,ni->nj", self.W, r)
        N = np.einsum("nij,nik,nkj->nj", self.W, rest, self.W)
        alone = np.einsum("nij,nij->nj", self.W, self.W)
        self.redundancy = np.where(used, N / np.where(used, alone, 1.0), 0.0)
        self.tested = np.asarray(self.redundancy > MIN_REDUNDANCY)
        self.gain = np.where(self.tested, u**2 / np.where(self.tested, N, 1.0), 0.0)

    def columns(self, where: Sequence[At]) -> tuple[Array, Index]:
        """Return the whitened derivatives by these numbers, (rows, m, k each), and the readings that are the rows."""
        rows = np.unique(np.array([i for i, _ in where], dtype=np.intp))
        m = self.W.shape[1]
        columns = np.zeros((rows.size, m, len(where) * self.k))
        for j, (i, number) in enumerate(where):
            row = int(np.searchsorted(rows, i))
            if self.whole:
                columns[row, :, j * self.k : (j + 1) * self.k] = np.eye(m)
            else:
                columns[row, :, j] = self.W[i, :, number]
        return columns, rows

    def root(self, at: At) -> Array:
        """Return the inverse of the whitener of a reading, (m, m); 0 for missing numbers."""
        return np.linalg.pinv(self.W[at[0]])

    def weight(self, at: At) -> float:
        """Return the information of a number if nothing else were unknown."""
        return 1.0 if self.whole else float(np.sum(np.square(self.W[at[0], :, at[1]])))


def reduced(fit: Fit, white: Array, rows: Index | None = None) -> tuple[Array, Array]:
    """Return u and N of whitened derivatives (n, m, k)."""
    linear = fit.linear
    r = linear.residual if rows is None else linear.residual[rows]
    a, b = linear.gradient(white, rows)
    flat = white.reshape(-1, white.shape[2])
    # D' D - D' J C J' D
    N = flat.T @ flat - fit.normal.square(a, b)
    return flat.T @ r.ravel(), (N + N.T) / 2


def solved(u: Array, N: Array, floor: float | Array = 0.0) -> tuple[Array, Array, Array]:
    """Return effects ``N^-1 u``, their gains and the numbers of their determined unknowns.

    Parameters
    ----------
    u, N : ndarray, (..., k) and (..., k, k)
    floor : float or ndarray, (...)
        Less information counts as none.
    """
    values, vectors = np.linalg.eigh(N)
    least = np.maximum(SINGULAR * values[..., -1], np.maximum(floor, 1e-300))
    kept = values > least[..., None]
    along = np.einsum("...ij,...i->...j", vectors, u)
    inside = np.where(kept, along / np.where(kept, values, 1.0), 0.0)
    return np.einsum("...ij,...j->...i", vectors, inside), np.sum(inside * along, axis=-1), kept.sum(axis=-1)


def swept(u: Array, N: Array, part: slice) -> tuple[Array, Array]:
    """Return u and N of all effects after the effect ``part`` is estimated as well."""
    values, vectors = np.linalg.eigh(N[part, part])
    kept = values > SINGULAR * max(float(values[-1]), 1e-300)
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
    gone = N[:, part] @ inverse
    return u - gone @ u[part], N - gone @ N[part]
