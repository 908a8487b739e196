"""Linear algebra of covariances that are block diagonal plus low rank; memory and time are linear in the points.

For n points with d freedoms and s sources the covariance is ``V = D + F F'`` with blocks D (n, d, d) and F (n d, s).
By the matrix inversion lemma ``V^-1 = D^-1 - D^-1 F (1 + F' D^-1 F)^-1 F' D^-1`` only matrices of s x s are inverted.
A direction without variance of its own, such as that of the reference state, has no inverse in D: it is left out where
its variance is 0 in F as well, and enters F where it is not. The degrees of freedom are what remains.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from errormotion.arrays import Array

LEAST = 1e-12
"""Share of the largest variance of a freedom below which a direction counts as without variance of its own."""


@dataclass(frozen=True)
class Whitener:
    """A covariance in a form that whitens vectors.

    Attributes
    ----------
    degrees : int
        Directions with variance.
    """

    scale: Array  # (d,)
    root: Array  # (n, d, d): root_i' D_i root_i = projector
    factor: Array  # (k, k) Cholesky factor of 1 + G'G
    G: Array  # (n d, k): whitened influence
    degrees: int

    def product(self, a: Array, b: Array) -> Array:
        """Return ``a' V^-1 b`` for arrays (p, n, d) and (q, n, d); NaN counts as unknown, and has no weight.

        Returns
        -------
        ndarray, (p, q)
        """
        wa, wb = self._white(a), self._white(b)
        ga, gb = (np.linalg.solve(self.factor, self.G.T @ w.T) for w in (wa, wb))
        result: Array = wa @ wb.T - ga.T @ gb
        return result

    def square(self, a: Array) -> float:
        """Return ``a' V^-1 a`` of one array (n, d): a chi-square with `degrees` degrees of freedom."""
        return float(self.product(a[None], a[None])[0, 0])

    def _white(self, a: Array) -> Array:
        filled = np.nan_to_num(np.asarray(a, dtype=float)) / self.scale
        white: Array = np.einsum("nji,pnj->pni", self.root, filled).reshape(len(filled), -1)
        return white


def whitener(own: Array, influence: Array) -> Whitener:
    """Return the whitener of a covariance ``own`` (n, d, d) plus ``influence`` (s, n, d); NaN is unknown.

    Directions with no variance at all carry no weight, so that a value that is known exactly on both sides of a
    difference (the zero of a reference state) is no evidence.
    """
    own, F = np.nan_to_num(own), np.nan_to_num(influence)
    total = np.einsum("nii->ni", own) + (F**2).sum(axis=0)
    scale = np.sqrt(total.max(axis=0, initial=0.0))
    scale = np.where(scale > 0, scale, 1.0)
    D, F = own / np.multiply.outer(scale, scale), F / scale
    power, vectors = np.linalg.eigh(D)
    strong = power > LEAST
    # What has no variance of its own but is moved by sources would be infinitely stiff: LEAST is added to it.
    moved = np.einsum("nji,snj->sni", vectors, F)
    weak = ~strong & ((moved**2).sum(axis=0) > LEAST)
    power = np.where(weak, LEAST, power)
    kept = strong | weak
    root = vectors * np.where(kept, 1 / np.sqrt(np.where(kept, power, 1.0)), 0.0)[:, None, :]
    G = np.einsum("nji,snj->nis", root, F).reshape(D[..., 0].size, len(F))
    inner = np.eye(len(F)) + G.T @ G
    factor = np.linalg.cholesky(inner)
    # Directions that sources alone move: no more of them are free than the sources can reach.
    degrees = int(strong.sum()) + _reached(root, F, weak)
    return Whitener(scale, root, factor, G, degrees)


def _reached(root: Array, F: Array, weak: Array) -> int:
    """Return the rank of the sources over the directions that have no variance of their own."""
    if not weak.any():
        return 0
    rows = np.einsum("nji,snj->nis", root, F)[weak]  # (weak directions, s)
    size = np.linalg.svd(rows, compute_uv=False)
    return int((size > 1e-6 * size.max(initial=0.0)).sum()) if size.size else 0
