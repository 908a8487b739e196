"""Normal equations of local unknowns, coupled along a chain, and of a border that all of them share.

    [T  G] [x]   [a]
    [G' D] [z] = [b]

T is banded over the rows of one table (targets, cycles, instants; without coupling it is block diagonal), z are all
other unknowns. Elimination proceeds along the rows, so that time and memory are proportional to their number; with
``F = T^-1 G`` the border has the normal matrix ``S = D - G' F``. The rows of a band are joined to blocks, which makes T
block tridiagonal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import lapack

from errormotion.arrays import Array
from errormotion.estimation.blocks import Index
from errormotion.estimation.low_rank import inverse_of_lower

__all__ = ["Normal", "SingularError", "factorised"]

SINGULAR = 1e-13
"""Smallest pivot of the border, scaled to a diagonal of 1, that is not regarded as rounding."""


PLAIN = 1e-8
"""Smallest eigenvalue of a border with a diagonal of 1 from which on its Cholesky factor is as good as eigenvectors."""


class SingularError(ValueError):
    """The equations have no unique solution: ``rows`` of the local unknowns, or ``columns`` of the border."""

    def __init__(self, rows: Index, columns: Index) -> None:
        self.rows, self.columns = rows, columns
        super().__init__(f"{rows.size} local rows and {columns.size} columns of the border are undetermined")


@dataclass(frozen=True, eq=False)
class Normal:
    """Factorised normal equations of R local rows with p unknowns each, and of a border of q.

    Attributes
    ----------
    F : ndarray, (R, p, q)
        ``T^-1 G``.
    S : ndarray, (q, q)
        Normal matrix of the border after elimination.
    root : ndarray, (q, r)
        A square root of the covariance of the border, ``S^-1``; within the complement of the gauge.
    """

    F: Array
    S: Array
    root: Array
    _pivots: Array  # (B, s p, s p): inverse pivots P_k^-1 of the blocks of s rows
    _back: Array  # (B - 1, s p, s p): P_k^-1 times the coupling C_k with the next block
    _G: Array
    _gauge: Array  # (q, g)

    @cached_property
    def _inverses(self) -> Array:
        """Diagonal blocks of T^-1, (B, s p, s p)."""
        return _inverses(self._pivots, self._back)

    @cached_property
    def _beside(self) -> Array:
        """Blocks of T^-1 beside the diagonal, (B - 1, s p, s p): -P_k^-1 C_k (T^-1)_(k+1,k+1)."""
        return np.asarray(-(self._back @ self._inverses[1:]))

    @cached_property
    def own(self) -> Array:
        """Covariance of each local row for a known border, (R, p, p)."""
        rows = np.arange(len(self.F))
        return self.local_covariance(rows, rows)

    def local_covariance(self, i: Index, j: Index) -> Array:
        """Return the covariances of the local rows i and j for a known border, (k, p, p); at most a band apart."""
        p = self.F.shape[1]
        s = self._inverses.shape[1] // p if p else 1
        parts = self._inverses.reshape(-1, s, p, s, p)
        block, to = i // s, j // s
        covariance = parts[block, i % s, :, j % s]
        if self._back.any():
            beside = self._beside.reshape(-1, s, p, s, p)
            for k, sign in ((np.flatnonzero(to == block + 1), 1), (np.flatnonzero(to == block - 1), -1)):
                low, inside, outside = (block, i, j) if sign > 0 else (to, j, i)
                one = beside[low[k], inside[k] % s, :, outside[k] % s]
                covariance[k] = one if sign > 0 else np.swapaxes(one, 1, 2)
            covariance[np.abs(to - block) > 1] = np.nan
        else:
            covariance[to != block] = 0.0
        return np.asarray(covariance)

    @property
    def covariance(self) -> Array:
        """Of the border, (q, q)."""
        return np.asarray(self.root @ self.root.T)

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the normal matrix; with a gauge N, of its part that is not 0.

        With any columns W beside the gauge, ``det(W' S W) / det([W N])^2`` is the same. Those of the root R, with
        ``R' S R = 1``, give ``1 / det([R N])^2``. Rows are scaled, since units and sizes of unknowns differ.
        """
        local = -float(np.linalg.slogdet(self._pivots)[1].sum()) if self._pivots.size else 0.0
        whole = np.hstack([self.root, self._gauge])
        size = np.abs(whole).max(axis=1, keepdims=True, initial=0.0)
        return local - 2 * float(np.linalg.slogdet(whole / size)[1] + np.log(size).sum())

    @property
    def shared(self) -> Array:
        """Effect of the r independent parts of the border on each local row, (R, p, r)."""
        return np.asarray(-self.F @ self.root)

    @property
    def coupling(self) -> Array:
        """G, (R, p, q)."""
        return self._G

    @cached_property
    def coupled(self) -> bool:
        """Whether any local row is coupled with the border."""
        return bool(self._G.any())

    @cached_property
    def chained(self) -> bool:
        """Whether any local row is coupled with others."""
        return bool(self._back.any())

    @property
    def pivots(self) -> Array:
        """Inverse blocks of T, (R, p, p), where the local rows are not chained."""
        return self._pivots

    def solve(self, a: Array, b: Array) -> tuple[Array, Array]:
        """Return the solutions (R, p, k) and (q, k) for right sides of the same shapes."""
        y, z = self.eliminated(a, b)
        return (y - self.F @ z if self.coupled else y), z

    def eliminated(self, a: Array, b: Array) -> tuple[Array, Array]:
        """Return ``y = T^-1 a`` (R, p, k), with which ``x = y - F z``, and the solution z (q, k) of the border."""
        y = _swept(self._pivots, self._back, a)
        if self.coupled:
            b = b - np.tensordot(self._G, y, axes=((0, 1), (0, 1)))
        return y, self.root @ (self.root.T @ b)

    def square(self, a: Array, b: Array) -> Array:
        """Return ``(a, b)' C (a, b)`` with the covariance C of all unknowns, (k, k), for (R, p, k) and (q, k)."""
        # a' T^-1 a by the pivots of the elimination, and what the border adds
        right = _forward(self._back, _in_blocks(a, self._pivots))
        k = a.shape[2]
        white = self.root.T @ (b - np.tensordot(self.F, a, axes=((0, 1), (0, 1))))
        inner = right.reshape(-1, k).T @ (self._pivots @ right).reshape(-1, k)
        return np.asarray(inner + white.T @ white)


def factorised(band: Sequence[Array], G: Array, D: Array, gauge: Array | None = None) -> Normal:
    """Factorise normal equations.

    Parameters
    ----------
    band : sequence of ndarray, (R, p, p)
        Coupling of each row with itself, the next, the second next, ...; entries beyond the last row are ignored.
    G : ndarray, (R, p, q)
    D : ndarray, (q, q)
    gauge : ndarray, (q, g), optional
        Changes of the border that no reading sees; the solution has no component along them.

    Raises
    ------
    SingularError
    """
    R, p = G.shape[:2]
    s = max(len(band) - 1, 1)
    blocks = -(-R // s)
    diagonal, after = _superblocks(band, R, p, s, blocks)
    pivots, back = _eliminated(diagonal, after, s, R)
    F = _swept(pivots, back, G)
    S = D - np.tensordot(G, F, axes=((0, 1), (0, 1)))
    S = (S + S.T) / 2
    gauge = np.zeros((len(D), 0)) if gauge is None else gauge
    return Normal(F, S, _root(S, D, gauge), pivots, back, G, gauge)


def _superblocks(band: Sequence[Array], R: int, p: int, s: int, blocks: int) -> tuple[Array, Array]:
    """Return the diagonal blocks (B, s p, s p) of s rows each, and their coupling with the next block."""
    rows = blocks * s
    diagonal = np.zeros((blocks, s, p, s, p))
    after = np.zeros((max(blocks - 1, 0), s, p, s, p))
    filled = [np.concatenate([each, np.zeros((rows - R + s, p, p))])[: rows + s] for each in band]
    if rows > R:
        filled[0][R:rows] = np.eye(p)
    for i in range(s):
        diagonal[:, i, :, i] = filled[0][i:rows:s]
        for d in range(1, len(band)):
            each = filled[d][i:rows:s]
            each = np.where((np.arange(i, rows, s) + d < R)[:, None, None], each, 0.0)
            j = i + d
            if j < s:
                diagonal[:, i, :, j] = each
                diagonal[:, j, :, i] = np.swapaxes(each, 1, 2)
            elif blocks > 1:
                after[:, i, :, j - s] = each[:-1]
    size = s * p
    return diagonal.reshape(blocks, size, size), after.reshape(len(after), size, size)


def _eliminated(diagonal: Array, after: Array, s: int, R: int) -> tuple[Array, Array]:
    """Return the inverse pivots (B, sp, sp), and ``pivot^-1 after`` of each block with a successor.

    The unknowns are scaled first, so that T has a diagonal of 1.
    """
    size = np.diagonal(diagonal, axis1=1, axis2=2)
    scale = 1.0 / np.sqrt(np.where(size > 0, size, 1.0))
    scaled = diagonal * scale[:, :, None] * scale[:, None, :]
    if not after.any():
        inverse, back = _inverted(scaled, s, R), np.zeros_like(after)
    else:
        coupling = after * scale[:-1, :, None] * scale[1:, None, :]
        inverse, back = _chained(scaled, coupling, s, R)
        back = back * scale[:-1, :, None] / scale[1:, None, :]
    return inverse * scale[:, :, None] * scale[:, None, :], back


def _chained(diagonal: Array, after: Array, s: int, R: int) -> tuple[Array, Array]:
    """Return the inverse pivots and their products with the coupling, from the Cholesky factor of the whole band."""
    count, size = diagonal.shape[:2]
    # A column of the band: its part of a diagonal block from the diagonal on, and the coupling below
    columns = np.zeros((count, 3 * size, size))
    columns[:, :size] = diagonal
    columns[:-1, size : 2 * size] = np.swapaxes(after, 1, 2)
    c = np.arange(size)
    below = c[:, None] + np.arange(2 * size)
    band = np.where(below < 2 * size, columns[:, below, c[:, None]], 0.0).reshape(count * size, 2 * size)
    factor, failed = lapack.dpbtrf(band.T, lower=1, overwrite_ab=1)
    L = np.zeros((count, 3 * size, size))
    L[:, below, c[:, None]] = factor.T.reshape(count, size, 2 * size)
    pivots = np.tril(L[:, :size])
    done = (failed - 1) // size if failed > 0 else count
    smallest = np.square(np.diagonal(pivots[:done], axis1=1, axis2=2)).min(axis=1, initial=1.0)
    bad = np.append(np.flatnonzero(smallest <= SINGULAR), np.arange(done, count))
    if bad.size:
        raise _singular(bad[:1], s, R)
    # P_k = L_k L_k', C_k = L_k M_k' with the block M_k of the factor below
    half = inverse_of_lower(pivots)
    return np.swapaxes(half, 1, 2) @ half, np.swapaxes(half[:-1], 1, 2) @ np.swapaxes(L[:-1, size : 2 * size], 1, 2)


def _inverted(matrices: Array, s: int, R: int) -> Array:
    """Return inverses of symmetric matrices with a diagonal of 1; singular ones raise an error."""
    try:
        smallest = np.square(np.diagonal(np.linalg.cholesky(matrices), axis1=1, axis2=2))
    except np.linalg.LinAlgError:
        smallest = np.linalg.eigvalsh(matrices)
    bad = np.flatnonzero(smallest.min(axis=1, initial=1.0) <= SINGULAR)
    if bad.size:
        raise _singular(bad, s, R)
    inverse = np.linalg.inv(matrices)
    return np.asarray((inverse + np.swapaxes(inverse, 1, 2)) / 2)


def _singular(blocks: Index, s: int, R: int) -> SingularError:
    """Return the error that names the rows of blocks of s rows."""
    rows = (blocks[:, None] * s + np.arange(s)).ravel()
    return SingularError(rows[rows < R], np.zeros(0, dtype=int))


def _inverses(pivots: Array, back: Array) -> Array:
    """Return the diagonal blocks of ``T^-1`` by backward recursion, (B, s p, s p)."""
    inverse = pivots.copy()
    if back.any():
        for k in range(len(pivots) - 2, -1, -1):
            # (T^-1)_kk = P_k^-1 + (P_k^-1 C_k) (T^-1)_(k+1,k+1) (P_k^-1 C_k)'
            inverse[k] += back[k] @ inverse[k + 1] @ back[k].T
    return inverse


def _swept(pivots: Array, back: Array, a: Array) -> Array:
    """Return ``T^-1 a`` for (R, p, k)."""
    R, p, k = a.shape
    y = pivots @ _forward(back, _in_blocks(a, pivots))
    if back.any():
        for j in range(len(pivots) - 2, -1, -1):
            y[j] -= back[j] @ y[j + 1]
    return np.asarray(y.reshape(y.shape[0] * y.shape[1] // max(p, 1), p, k)[:R])


def _in_blocks(a: Array, pivots: Array) -> Array:
    """Return right sides (R, p, k) by block, (B, s p, k); 0 beyond the last row."""
    R, p, k = a.shape
    size = pivots.shape[1] if len(pivots) else p
    missing = len(pivots) * size // max(p, 1) - R
    whole = np.concatenate([a, np.zeros((missing, p, k))]) if missing else a
    return whole.reshape(len(pivots), size, k)


def _forward(back: Array, right: Array) -> Array:
    """Return right sides after the elimination of the blocks before each."""
    if not back.any():
        return right
    solution = right.copy()
    for before, after, coupling in zip(solution[:-1], solution[1:], np.swapaxes(back, 1, 2), strict=True):
        after -= coupling @ before
    return solution


def _plain_root(S: Array) -> Array | None:
    """Return a square root of ``S^-1`` by the Cholesky factor L, ``L^-T``; None for a matrix that may be singular.

    The sum of the squares of the inverse factor is the trace of the inverse, larger than 1 over the least eigenvalue.
    """
    try:
        L = np.linalg.cholesky(S)
    except np.linalg.LinAlgError:
        return None
    inverse, failed = lapack.dtrtri(L, lower=1)
    certain = not failed and float(np.vdot(inverse, inverse)) < 1 / PLAIN
    return np.asarray(inverse.T) if certain else None


def _root(S: Array, D: Array, gauge: Array) -> Array:
    """Return a square root of the covariance of the border, without the gauge."""
    q = len(S)
    if not q:
        return np.zeros((0, 0))
    diagonal = np.diagonal(D)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    scaled = S * scale[:, None] * scale
    if not gauge.size and (root := _plain_root(scaled)) is not None:
        return scale[:, None] * root
    Z = np.eye(q)
    if gauge.size:
        # Changes along the gauge, in scaled unknowns; the solution is in their orthogonal complement.
        full, _ = np.linalg.qr(gauge / scale[:, None], mode="complete")
        Z = full[:, gauge.shape[1] :]
    inner = Z.T @ scaled @ Z
    power, vectors = np.linalg.eigh((inner + inner.T) / 2)
    if power.size and power[0] <= SINGULAR * max(power[-1], 1.0):
        lost = Z @ vectors[:, power <= SINGULAR * max(power[-1], 1.0)]
        columns = np.flatnonzero(np.abs(lost).max(axis=1) > 0.1 * np.abs(lost).max())
        raise SingularError(np.zeros(0, dtype=int), columns)
    return np.asarray(scale[:, None] * (Z @ (vectors / np.sqrt(power))))
