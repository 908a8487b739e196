"""Linear algebra of covariances that are block diagonal plus low rank; memory and time are linear in the points.

For n points with d freedoms and s sources the covariance is ``V = D + F F'`` with blocks D (n, d, d) and F (n d, s).
By the matrix inversion lemma ``V^-1 = D^-1 - D^-1 F (1 + F' D^-1 F)^-1 F' D^-1`` only matrices of s x s are inverted.

A direction without variance in D, such as that of a reference state, has no inverse in D. There the sources must
explain the whole value: with F = (G, H) on the directions with and without variance in D, and the singular values
``H = U S W'``, the sources are ``z = W S^-1 U' h + W0 t`` with ``W0' W = 0``. The square of a vector (g, h) is then
``|S^-1 U' h|^2`` plus that of ``g - G W S^-1 U' h`` with the covariance ``1 + G W0 W0' G'``. This is ``a' V^+ a`` with
the pseudo-inverse for every vector in the range of V. Components outside this range have no weight.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from errormotion.arrays import Array, filled

MIN_VARIANCE = 1e-12
"""Fraction of the largest variance of a freedom below which a direction is treated as one without variance in D."""


@dataclass(frozen=True)
class Whitener:
    """A covariance, prepared for the whitening of vectors.

    Attributes
    ----------
    degrees : int
        Number of directions with variance, the rank of the covariance.
    log_determinant : float
        Logarithm of the determinant of the covariance in these directions.
    """

    scale: Array  # (d,)
    root: Array  # (n, d, d): root_i' D_i root_i = projector
    bound: Array  # (m, d): directions without variance in D, scaled
    at: NDArray[np.intp]  # (m,) their points
    pinned: Array  # (r, m): S^-1 U'
    carried: Array  # (n d, r): G W
    G: Array  # (n d, k): whitened influence that the bound directions do not determine
    factor: Array  # (k, k) inverse Cholesky factor of 1 + G'G
    degrees: int
    log_determinant: float

    def product(self, a: Array, b: Array) -> Array:
        """Return ``a' V^-1 b`` for arrays (p, n, d) and (q, n, d); NaN is unknown, and has no weight.

        Returns
        -------
        ndarray, (p, q)
        """
        first = self._white(a)
        second = first if b is a else self._white(b)
        (free, explained, pinned), (its_free, its_explained, its_pinned) = first, second
        result: Array = free @ its_free.T - explained @ its_explained.T + pinned @ its_pinned.T
        return result

    def square(self, a: Array) -> float:
        """Return ``a' V^-1 a`` of one array (n, d): a chi-square with `degrees` degrees of freedom."""
        one = a[None]
        return float(self.product(one, one)[0, 0])

    def _white(self, a: Array) -> tuple[Array, Array, Array]:
        """Return the whitened parts: residuals, the part that the sources explain, and the determined sources."""
        scaled = filled(a) / self.scale  # (p, n, d)
        pinned = np.einsum("pmd,md->pm", scaled[:, self.at], self.bound) @ self.pinned.T  # (p, r)
        free = np.matmul(scaled[:, :, None, :], self.root)[:, :, 0].reshape(len(scaled), -1)
        free = free - pinned @ self.carried.T
        return free, (free @ self.G) @ self.factor.T, pinned


def whitener(own: Array, influence: Array) -> Whitener:
    """Return the whitener of a covariance ``own`` (n, d, d) plus ``influence`` (s, n, d); NaN is unknown.

    Directions without any variance have no weight, so that a value that is exact on both sides of a difference (the
    zero of a reference state) has no effect.
    """
    own, F = filled(own), filled(influence)
    n, d = own.shape[:2]
    total = np.diagonal(own, axis1=1, axis2=2) + np.square(F).sum(axis=0)
    scale = np.sqrt(total.max(axis=0, initial=0.0))
    scale = np.where(scale > 0, scale, 1.0)
    D = own / np.multiply.outer(scale, scale)
    F = np.moveaxis(F, 0, -1) / scale[:, None]  # (n, d, s)
    power, vectors = np.linalg.eigh(D)
    strong = power > MIN_VARIANCE
    root = vectors * np.where(strong, 1 / np.sqrt(np.where(strong, power, 1.0)), 0.0)[:, None, :]
    G = np.matmul(np.swapaxes(root, 1, 2), F).reshape(n * d, -1)
    at, column = np.nonzero(~strong)
    bound = vectors[at, :, column]
    H = np.matmul(bound[:, None, :], F[at])[:, 0]  # (m, s)
    # Singular values of H by a QR decomposition: no matrix grows with the square of the number of points.
    q, r = np.linalg.qr(H)
    left, size, right = np.linalg.svd(r, full_matrices=True)
    rank = int((size > np.sqrt(MIN_VARIANCE)).sum())
    pinned = (q @ left[:, :rank] / size[:rank]).T
    fixed, rest = right[:rank].T, right[rank:].T
    carried, G = (G @ fixed, G @ rest) if rank else (G[:, :0], G)
    root_of_inner = np.linalg.cholesky(np.eye(G.shape[1]) + G.T @ G)
    factor = linalg.lapack.dtrtri(root_of_inner, lower=1)[0] if len(root_of_inner) else root_of_inner
    log_determinant = (
        2 * float((total > 0).sum(axis=0) @ np.log(scale))
        + float(np.log(power[strong]).sum())
        + 2 * float(np.log(size[:rank]).sum() + np.log(np.diag(root_of_inner)).sum())
    )
    return Whitener(scale, root, bound, at, pinned, carried, G, factor, int(strong.sum()) + rank, log_determinant)
