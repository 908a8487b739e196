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
"""Fraction of the largest variance of a freedom below which a direction is treated as one without variance."""
PLAIN = 1e-8
"""Smallest eigenvalue of a block of D, scaled as above, that is factored without its eigenvectors."""


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
    root: Array  # (n, d, r): root_i' D_i root_i = projector; r directions have variance at any point
    bound: Array  # (m, d): directions without variance in D, scaled
    at: NDArray[np.intp]  # (m,) their points
    pinned: Array  # (p, m): S^-1 U'
    carried: Array  # (n r, p): G W
    G: Array  # (n r, k): whitened influence that the bound directions do not determine
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

    def normal(self, effects: Array, a: Array) -> tuple[Array, Array]:
        """Return the normal matrix (p, p) of effects (p, n, d), and their products (p,) with one array (n, d)."""
        both = np.concatenate([effects, a[None]])
        normal = self.product(both, both)
        return normal[:-1, :-1], normal[:-1, -1]

    def square(self, a: Array) -> float:
        """Return ``a' V^-1 a`` of one array (n, d): a chi-square with `degrees` degrees of freedom."""
        one = a[None]
        return float(self.product(one, one)[0, 0])

    def _white(self, a: Array) -> tuple[Array, Array, Array]:
        """Return the whitened parts: residuals, the part that the sources explain, and the determined sources."""
        scaled = filled(a) / self.scale  # (p, n, d)
        pinned = np.einsum("pmd,md->pm", scaled[:, self.at], self.bound) @ self.pinned.T
        # one product of (p, d) and (d, d) at each point
        free = np.swapaxes(np.matmul(np.swapaxes(scaled, 0, 1), self.root), 0, 1).reshape(len(scaled), -1)
        free = free - pinned @ self.carried.T
        return free, (free @ self.G) @ self.factor.T, pinned


def whitener(own: Array, influence: Array) -> Whitener:
    """Return the whitener of a covariance ``own`` (n, d, d) plus ``influence`` (s, n, d); NaN is unknown.

    Directions without any variance have no weight, so that a value that is exact on both sides of a difference (the
    zero of a reference state) has no effect.
    """
    n, d = own.shape[:2]
    total = np.diagonal(own, axis1=1, axis2=2) + np.einsum("sni,sni->ni", influence, influence)
    unknown = np.isnan(total)
    total = np.where(unknown, 0.0, total)
    scale = np.sqrt(total.max(axis=0, initial=0.0))
    scale = np.where(scale > 0, scale, 1.0)
    D = own / np.multiply.outer(scale, scale)
    F = np.divide(np.moveaxis(influence, 0, -1), scale[:, None], order="C")  # (n, d, s), contiguous for BLAS
    if unknown.any():
        D[unknown[:, :, None] | unknown[:, None, :]] = 0.0
        F[unknown] = 0.0
    kept = _directions(D, F)
    if kept.shape[1] < d:
        D, F = kept.T @ D @ kept, kept.T @ F
    root, at, bound, log_blocks = _roots(D)
    G = np.matmul(np.swapaxes(root, 1, 2), F).reshape(n * kept.shape[1], -1)
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
        + log_blocks
        + 2 * float(np.log(size[:rank]).sum() + np.log(np.diag(root_of_inner)).sum())
    )
    degrees = n * kept.shape[1] - len(bound) + rank
    if kept.shape[1] < d:
        root, bound = kept @ root, bound @ kept.T
    return Whitener(scale, root, bound, at, pinned, carried, G, factor, degrees, log_determinant)


def _directions(D: Array, F: Array) -> Array:
    """Return orthonormal columns (d, r) of the directions in which scaled covariances have variance at any point."""
    n, d = D.shape[:2]
    rows = F.transpose(1, 0, 2).reshape(d, -1)
    power, vectors = np.linalg.eigh((D.sum(axis=0) + rows @ rows.T) / max(n, 1))
    weak = vectors[:, power < MIN_VARIANCE]
    if not weak.shape[1] or weak.shape[1] == d:
        return np.eye(d)
    most = np.einsum("ik,nij,jk->nk", weak, D, weak) + np.square(np.einsum("ik,nis->nks", weak, F)).sum(axis=-1)
    return np.eye(d) if most.max() > MIN_VARIANCE else vectors[:, power >= MIN_VARIANCE]


def _roots(D: Array) -> tuple[Array, NDArray[np.intp], Array, float]:
    """Return inverse roots (n, d, d) of scaled blocks, and the directions without variance in them.

    Inverse Cholesky factors take a tenth of the time of eigenvectors. The sum of their squares is the trace of the
    inverse block, and larger than the inverse of its smallest eigenvalue: blocks with a small one have eigenvectors.

    Returns
    -------
    root : ndarray, (n, d, d)
        ``root_i' D_i root_i`` is 1, and 0 in the directions without variance.
    at : ndarray of int, (m,)
        Points of these directions.
    bound : ndarray, (m, d)
        The directions.
    log_determinant : float
        Of all blocks, in the directions with variance.
    """
    root, log_determinant = np.empty_like(D), 0.0
    plain = np.asarray((np.diagonal(D, axis1=1, axis2=2) > PLAIN).all(axis=1))
    try:
        inverse = inverse_of_lower(np.asarray(np.linalg.cholesky(D[plain]), dtype=float))
    except np.linalg.LinAlgError:
        plain[:] = False
    else:
        certain = np.einsum("nij,nij->n", inverse, inverse) < 1 / PLAIN
        plain[plain] = certain
        inverse = inverse[certain]
        root[plain] = np.swapaxes(inverse, 1, 2)
        log_determinant = -2 * float(np.log(np.diagonal(inverse, axis1=1, axis2=2)).sum())
    rest = np.flatnonzero(~plain)
    power, vectors = np.linalg.eigh(D[rest])
    strong = power > MIN_VARIANCE
    root[rest] = vectors * np.where(strong, 1 / np.sqrt(np.where(strong, power, 1.0)), 0.0)[:, None, :]
    weak, column = np.nonzero(~strong)
    return root, rest[weak], vectors[weak, :, column], log_determinant + float(np.log(power[strong]).sum())


def inverse_of_lower(L: Array) -> Array:
    """Return the inverses of lower triangular matrices (n, d, d), row by row: a third of the time of a general one."""
    inverse = np.zeros_like(L)
    reciprocal = 1 / np.diagonal(L, axis1=1, axis2=2)
    for i in range(L.shape[1]):
        inverse[:, i, i] = reciprocal[:, i]
        inverse[:, i, :i] = -reciprocal[:, i, None] * np.matmul(L[:, i, None, :i], inverse[:, :i, :i])[:, 0]
    return inverse


def root_of(covariance: Array, *, unit: Array | None = None, smallest: float = MIN_VARIANCE) -> Array:
    """Return R (n, k) with ``R R' = covariance`` (n, n): columns are independent sources, the largest last.

    Parameters
    ----------
    covariance : ndarray, (n, n)
        Positive semidefinite except for rounding.
    unit : ndarray, (n,), optional
        Units in which the rows are compared, such as m and rad; by default their standard uncertainties.
    smallest : float
        Fraction of the largest variance in these units below which a direction is omitted.
    """
    size = np.sqrt(np.maximum(np.diag(covariance), 0.0)) if unit is None else unit
    scale = np.where(size > 0, size, 1.0)
    power, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    kept = power > smallest * max(power.max(initial=0.0), 1e-300)
    return np.asarray(scale[:, None] * vectors[:, kept] * np.sqrt(power[kept]))
