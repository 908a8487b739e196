"""Generalised least squares of estimates with common sources: each is reduced to its information once.

All combinations of the estimates (without one of them, for example) are then sums. An estimate consists of n points
with d freedoms each; NaN is unknown. Its covariance is ``D + F F'``. Its sources are nuisance parameters z with
variance 1 beside the errors x:

    x-x: W = D^-1        x-z: W F        z-z: 1 + F' W F        right-hand sides: W y, F' W y

They are summed over the estimates. W is block diagonal. The normal matrix of x is inverted point by point, and the
sources remain: memory and time are linear in the points. If the estimates have more sources than values (many short
estimates), sources of a single estimate are eliminated first, and values and shared sources remain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, cholesky, solve_triangular

from errormotion.arrays import Array, filled

FLOOR = 1e-9
"""Smallest variance of a known value without sources, as a fraction of its total variance."""
MAX_VALUES = 6000
"""Largest number of values (points times freedoms) for which a matrix of all values is formed: 300 MB."""
CONVERGED = 1e-10
"""Residual at which the conjugate gradient iterations end, relative to the right-hand side."""


@dataclass(frozen=True)
class Solution:
    """Errors with their covariance ``own`` (n, d, d) plus ``influence`` (k, n, d), and the sum of squares."""

    value: Array
    own: Array
    influence: Array
    seen: NDArray[np.bool_]
    square: float


@dataclass(frozen=True)
class Information:
    """Information of one dataset: ``W`` (n, d, d), sources ``F`` (n, d, s) in ``columns``, values (n, d)."""

    W: Array
    F: Array
    WF: Array
    inner: Array  # F' W F
    columns: NDArray[np.intp]
    y: Array
    Wy: Array
    known: NDArray[np.bool_]

    @classmethod
    def of(cls, value: Array, own: Array, influence: Array, columns: NDArray[np.intp]) -> Information:
        """Reduce an estimate.

        Parameters
        ----------
        value : ndarray, (n, d)
            NaN is unknown. Values without any variance are exact by definition, and are not used.
        own : ndarray, (n, d, d)
            Covariance that is independent from point to point.
        influence : ndarray, (s, n, d)
            Effect of one standard uncertainty of each source.
        columns : ndarray of int, (s,)
            Number of each source among those of all estimates; sources with the same number are fully correlated.
        """
        W, known = weights(value, own, influence)
        F = np.where(known[..., None], filled(np.moveaxis(influence, 0, -1)), 0.0)
        WF = np.matmul(W, F)
        y = np.where(known, filled(value), 0.0)
        s = F.shape[-1]
        n = F.shape[0] * F.shape[1]  # -1 is undefined without sources
        inner = F.reshape(n, s).T @ WF.reshape(n, s)
        return cls(W, F, WF, inner, columns, y, np.matmul(W, y[..., None])[..., 0], known)

    @property
    def square(self) -> float:
        """Weighted square of the values."""
        return float((self.y * self.Wy).sum())


def weights(value: Array, own: Array, influence: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the inverses of ``own`` over the known values, (n, d, d), and which these are, (n, d).

    A value is known if it is finite and has a variance. One without variance of its own has a small one.
    """
    total = filled(np.diagonal(own, axis1=1, axis2=2) + np.einsum("sni,sni->ni", influence, influence))
    known = np.isfinite(value) & (total > 0)
    return _inverse(filled(own) + FLOOR * total[:, :, None] * np.eye(total.shape[1]), known), known


def solve(parts: Sequence[Information], sources: int) -> Solution:
    """Return the generalised least squares estimate of datasets, by elimination of the values.

    Parameters
    ----------
    parts : sequence of Information
        Of the same n points and d freedoms.
    sources : int
        Number of sources of all of them.
    """
    n, d = parts[0].y.shape
    A, right = np.zeros((n, d, d)), np.zeros((n, d))
    B, M, moved = np.zeros((n, d, sources)), np.eye(sources), np.zeros(sources)
    for each in parts:
        A += each.W
        right += each.Wy
        B[..., each.columns] += each.WF
        M[np.ix_(each.columns, each.columns)] += each.inner
        moved[each.columns] += each.F.reshape(n * d, -1).T @ each.Wy.ravel()
    seen = np.diagonal(A, axis1=1, axis2=2) > 0
    own = _inverse(A, seen)
    AB = np.matmul(own, B)
    inner = M - B.reshape(n * d, -1).T @ AB.reshape(n * d, -1)
    root = np.linalg.cholesky((inner + inner.T) / 2)
    plain = np.matmul(own, right[..., None])[..., 0]
    # z = inner^-1 (F' W y - B' plain)
    gradient = moved - B.reshape(n * d, -1).T @ plain.ravel()
    half = np.linalg.inv(root)
    z = half.T @ (half @ gradient)
    influence = np.moveaxis((AB.reshape(n * d, -1) @ half.T).reshape(n, d, -1), -1, 0)
    square = sum(each.square for each in parts) - float((right * plain).sum()) - float(gradient @ z)
    return Solution(plain - AB @ z, own, influence, seen, square)


def short(parts: Sequence[Information], sources: int) -> bool:
    """Return whether `Reduced` is faster: many datasets of few values. Its memory grows with their square."""
    m, size = len(parts), parts[0].y.size
    rounds = 10  # iterations of the conjugate gradients
    by_sources = m * sources**2 * size * 2
    by_values = size**3 / 3 + sources * size**2 + rounds * m * size**2 * 4
    return m > 2 and size <= MAX_VALUES and by_values < by_sources


@dataclass(frozen=True)
class Reduced:
    """Datasets whose unshared sources are eliminated: values and shared sources remain, (n d + g)."""

    W: Array  # (m, n, d, d)
    U: Array  # (m, n d, p): the information of a dataset is W - U U'
    S: Array  # (m, n d, g): shared sources
    y: Array  # (m, n d)
    factor: Array  # (n d + g, n d + g): Cholesky factor of the normal matrix, lower
    x: Array  # (n d + g,)
    seen: NDArray[np.bool_]  # (n, d)
    square: float

    @classmethod
    def of(cls, parts: Sequence[Information], sources: int) -> Reduced:
        """Reduce the datasets and solve for all of them."""
        n, d = parts[0].y.shape
        count = np.bincount(np.concatenate([each.columns for each in parts]), minlength=sources)
        common = np.flatnonzero(count > 1)
        own = [count[each.columns] == 1 for each in parts]
        U = np.zeros((len(parts), n * d, max(int(mask.sum()) for mask in own)))
        S = np.zeros((len(parts), n * d, len(common)))
        for i, (each, mask) in enumerate(zip(parts, own, strict=True)):
            k = int(mask.sum())
            root = np.linalg.cholesky(np.eye(k) + each.inner[np.ix_(mask, mask)])
            U[i, :, :k] = each.WF[..., mask].reshape(n * d, k) @ np.linalg.inv(root).T
            S[i][:, np.searchsorted(common, each.columns[~mask])] = each.F[..., ~mask].reshape(n * d, -1)
        W, y = np.array([each.W for each in parts]), np.array([each.y.ravel() for each in parts])
        size = n * d
        flat = np.swapaxes(U, 0, 1).reshape(size, -1)
        N = np.zeros((size + len(common),) * 2)
        N[:size, :size] = -flat @ flat.T
        blocks = N[:size, :size].reshape(n, d, n, d)
        blocks[np.arange(n), :, np.arange(n), :] += W.sum(axis=0)
        seen = np.diagonal(W.sum(axis=0), axis1=1, axis2=2) > 0
        unseen = np.flatnonzero(~seen.ravel())
        N[unseen, unseen] = 1.0
        WS = np.stack([_applied(W, U, S[..., k]) for k in range(len(common))], axis=-1) if len(common) else S
        N[:size, size:] = WS.sum(axis=0)
        N[size:, :size] = N[:size, size:].T
        N[size:, size:] = np.eye(len(common)) + np.tensordot(S, WS, axes=((0, 1), (0, 1)))
        factor = cholesky(N, lower=True, overwrite_a=True)
        Wy = _applied(W, U, y)
        right = np.concatenate([Wy.sum(axis=0), np.tensordot(S, Wy, axes=((0, 1), (0, 1)))])
        x = cho_solve((factor, True), right)
        return cls(W, U, S, y, factor, x, seen, float((y * Wy).sum() - right @ x))

    def solution(self) -> Solution:
        """Return the solution with the covariance of the values as a low-rank matrix."""
        n, d = self.seen.shape
        rows = solve_triangular(self.factor, np.eye(len(self.x))[:, : n * d], lower=True)
        influence = rows.reshape(-1, n, d)
        influence[:, ~self.seen] = 0.0
        return Solution(self.x[: n * d].reshape(n, d), np.zeros((n, d, d)), influence, self.seen, self.square)

    def decreases(self) -> Array:
        """Return the decrease of the sum of squares without each dataset, (m,).

        With the residuals r and the information V of a dataset, ``T = (1, S)`` and the normal matrix N of all, the
        decrease is ``r' V r + w' (N - T' V T)^-1 w`` with ``w = T' V r``. The systems are solved together by conjugate
        gradients with N as the preconditioner, which differs from each matrix by the contribution of one dataset.
        """
        residual = self._values(np.broadcast_to(self.x, (len(self.y), len(self.x)))) - self.y
        weighted = _applied(self.W, self.U, residual)
        w = self._gradient(weighted)
        t, r = np.zeros_like(w), w.copy()
        p = z = cho_solve((self.factor, True), r.T).T
        rz = (r * z).sum(axis=1)
        first = rz.copy()
        for _ in range(2 * len(self.x)):
            active = rz > CONVERGED**2 * first
            if not active.any():
                break
            Np = self._product(p)
            step = np.where(active, rz / np.where(active, (p * Np).sum(axis=1), 1.0), 0.0)[:, None]
            t, r = t + step * p, r - step * Np
            z = cho_solve((self.factor, True), r.T).T
            last, rz = rz, (r * z).sum(axis=1)
            p = z + np.where(active, rz / np.where(active, last, 1.0), 0.0)[:, None] * p
        decreases: Array = (residual * weighted).sum(axis=1) + (w * t).sum(axis=1)
        return decreases

    def _values(self, x: Array) -> Array:
        """Return the expected values of each dataset for parameters (m, n d + g)."""
        size = self.y.shape[1]
        values: Array = x[:, :size] + np.matmul(self.S, x[:, size:, None])[..., 0]
        return values

    def _gradient(self, weighted: Array) -> Array:
        return np.concatenate([weighted, np.matmul(np.swapaxes(self.S, 1, 2), weighted[..., None])[..., 0]], axis=1)

    def _product(self, p: Array) -> Array:
        """Return the product of the normal matrix without each dataset and its row of (m, n d + g)."""
        whole = (self.factor @ (self.factor.T @ p.T)).T
        return whole - self._gradient(_applied(self.W, self.U, self._values(p)))


def _applied(W: Array, U: Array, v: Array) -> Array:
    """Return ``(W - U U') v`` of each dataset, (m, n d)."""
    m, n, d = W.shape[:3]
    blocks = np.matmul(W, v.reshape(m, n, d, 1)).reshape(m, n * d)
    inner = np.matmul(v[:, None, :], U)  # (m, 1, p)
    product: Array = blocks - np.matmul(U, np.swapaxes(inner, 1, 2))[..., 0]
    return product


def _inverse(matrices: Array, kept: NDArray[np.bool_]) -> Array:
    """Return the inverses (n, d, d) over the kept rows and columns, otherwise 0."""
    both = kept[:, :, None] & kept[:, None, :]
    scale = np.sqrt(np.where(kept, np.diagonal(matrices, axis1=1, axis2=2), 1.0))
    outer = scale[:, :, None] * scale[:, None, :]
    whole = np.where(both, matrices / outer, np.eye(matrices.shape[1]))
    inverse: Array = np.where(both, np.linalg.inv(whole) / outer, 0.0)
    return inverse
