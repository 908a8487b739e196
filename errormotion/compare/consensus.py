"""Consensus of several estimates by generalised least squares, and which of them does not fit.

The covariance of all estimates is ``V = D + F F'`` (D block diagonal, F the sources); the design X repeats the errors
for each estimate. The normal matrix is ``A - B M^-1 B'`` with ``A = X' D^-1 X``, which is block diagonal,
``B = X' D^-1 F`` and ``M = 1 + F' D^-1 F``. Its inverse ``A^-1 + A^-1 B (M - B' A^-1 B)^-1 B' A^-1`` has the same form
as the covariance of an estimate. Memory and time are linear in the points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.compare.pairs import ChiSquare
from errormotion.compare.stack import Estimate, gathered

FLOOR = 1e-9
"""Variance of its own that every known value gets at least, as a share of its total variance."""


@dataclass(frozen=True)
class Consensus:
    """What several estimates say together.

    Attributes
    ----------
    estimate : Estimate
        Generalised least squares.
    fit : ChiSquare
        Of the residuals.
    without : list of ChiSquare
        For each dataset: how much the sum of squares falls without it, a chi-square of its own number of values.
    p : list of float
        For each dataset: probability of such a fall, corrected for the number of datasets (Holm).
    rest : list of ChiSquare
        For each dataset: of the residuals of the others without it.
    """

    estimate: Estimate
    fit: ChiSquare
    without: list[ChiSquare]
    p: list[float]
    rest: list[ChiSquare]

    @property
    def birge(self) -> float:
        """Birge ratio: root of the sum of squares over its degrees of freedom; 1 for estimates that agree."""
        return float(np.sqrt(self.fit.value / self.fit.degrees)) if self.fit.degrees else float("nan")


def consensus(estimates: Sequence[Estimate]) -> Consensus:
    """Return the consensus of estimates on one grid, with a test of each of them.

    Values that are exactly zero by definition (a reference state) take no part; they stay zero in the result.
    """
    estimate, fit = _solved(estimates)
    without, left = [], []
    for i in range(len(estimates)):
        rest = [each for k, each in enumerate(estimates) if k != i]
        less = _solved(rest)[1] if rest else ChiSquare(0.0, 0)
        degrees = fit.degrees - less.degrees
        left.append(less)
        without.append(ChiSquare(max(fit.value - less.value, 0.0), degrees))
    return Consensus(estimate, fit, without, _holm([each.p for each in without]), left)


def _solved(estimates: Sequence[Estimate]) -> tuple[Estimate, ChiSquare]:
    keys = tuple(dict.fromkeys(key for each in estimates for key in each.source))
    n, d = estimates[0].value.shape
    A, weighted = np.zeros((n, d, d)), np.zeros((n, d))
    B, M, moved = np.zeros((n, d, len(keys))), np.eye(len(keys)), np.zeros(len(keys))
    square, count = 0.0, 0
    for each in estimates:
        inverse, known = information(each)
        F = np.moveaxis(np.nan_to_num(gathered(each, keys)), 0, -1)  # (n, d, s)
        y = np.where(known, np.nan_to_num(each.value), 0.0)
        weight = np.einsum("nij,nj->ni", inverse, y)
        A += inverse
        weighted += weight
        IF = np.einsum("nij,njs->nis", inverse, F)
        B += IF
        M += np.einsum("nis,nit->st", F, IF)
        moved += np.einsum("nis,ni->s", F, weight)
        square += float((y * weight).sum())
        count += int(known.sum())
    seen = np.diagonal(A, axis1=1, axis2=2) > 0
    own = _inverse(A, seen)
    AB = np.einsum("nij,njs->nis", own, B)
    inner = M - np.einsum("nis,nit->st", B, AB)
    root = np.linalg.cholesky((inner + inner.T) / 2) if len(keys) else np.zeros((0, 0))
    plain = np.einsum("nij,nj->ni", own, weighted)
    # Sources as nuisance parameters: z = inner^-1 (F'D^-1 y - B' plain)
    gradient = moved - np.einsum("nis,ni->s", B, plain)
    z = np.linalg.solve(root.T, np.linalg.solve(root, gradient)) if len(keys) else np.zeros(0)
    value = plain - AB @ z
    influence = np.linalg.solve(root, AB.reshape(n * d, len(keys)).T).reshape(len(keys), n, d)
    q = square - float((weighted * plain).sum()) - float(gradient @ z)
    value = np.where(seen, value, np.nan)
    unknown = ~seen
    for each in estimates:  # the zero of the reference state
        zero = each.known & (np.diagonal(each.covariance(), axis1=1, axis2=2) == 0) & unknown
        value[zero] = 0.0
        own[zero.any(axis=1)] = 0.0
        influence[:, zero.any(axis=1)] = 0.0
    gone = np.isnan(value)
    own[gone[:, :, None] | gone[:, None, :]] = np.nan
    influence[:, gone] = np.nan
    names = tuple(f"consensus, part {k + 1}" for k in range(len(keys)))
    return Estimate("consensus", value, own, influence, names), ChiSquare(max(q, 0.0), count - int(seen.sum()))


def information(each: Estimate) -> tuple[Array, NDArray[np.bool_]]:
    """Return the inverse of the own covariance (n, d, d), 0 where unknown, and which values count."""
    total = np.diagonal(each.covariance(), axis1=1, axis2=2)
    known = each.known & (np.nan_to_num(total) > 0)
    d = each.value.shape[1]
    own = np.nan_to_num(each.own) + FLOOR * np.nan_to_num(total)[:, :, None] * np.eye(d)
    return _inverse(own, known), known


def _inverse(matrices: Array, kept: NDArray[np.bool_]) -> Array:
    """Return the inverses (n, d, d) over the kept rows and columns, 0 elsewhere."""
    both = kept[:, :, None] & kept[:, None, :]
    scale = np.sqrt(np.where(kept, np.diagonal(matrices, axis1=1, axis2=2), 1.0))
    outer = scale[:, :, None] * scale[:, None, :]
    filled = np.where(both, matrices / outer, np.eye(matrices.shape[1]))
    found: Array = np.where(both, np.linalg.inv(filled) / outer, 0.0)
    return found


def _holm(p: Sequence[float]) -> list[float]:
    """Return probabilities corrected for their number (Holm 1979)."""
    order = np.argsort(p)
    found, largest = np.ones(len(p)), 0.0
    for rank, i in enumerate(order):
        largest = max(largest, min(1.0, (len(p) - rank) * p[i]))
        found[i] = largest
    return found.tolist()


def random_effects(estimates: Sequence[Estimate]) -> tuple[Array, Array, Array]:
    """Return the robust alternative: a mean with a variance between datasets (DerSimonian and Laird 1986).

    The variance between datasets is estimated for each freedom from all points together.

    Returns
    -------
    value, standard_uncertainty : ndarray, (n, d)
    tau : ndarray, (d,)
        Standard deviation between datasets, m and rad.
    """
    y = np.array([each.value for each in estimates])
    variance = np.array([np.diagonal(each.covariance(), axis1=1, axis2=2) for each in estimates])
    known = np.isfinite(y) & (variance > 0)
    w = np.where(known, 1.0 / np.where(known, variance, 1.0), 0.0)
    total = w.sum(axis=0)
    y = np.nan_to_num(y)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = (w * y).sum(axis=0) / total
    Q = np.nansum((w * (y - np.nan_to_num(mean)) ** 2), axis=0)
    degrees = np.maximum(known.sum(axis=0) - 1, 0)
    c = np.where(total > 0, total - (w**2).sum(axis=0) / np.where(total > 0, total, 1.0), 0.0)
    weight = c.sum(axis=0)
    tau2 = np.maximum((Q - degrees).sum(axis=0), 0.0) / np.where(weight > 0, weight, np.inf)
    w = np.where(known, 1.0 / np.where(known, variance + tau2, 1.0), 0.0)
    total = w.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        value, u = (w * y).sum(axis=0) / total, np.sqrt(1.0 / total)
    return np.where(total > 0, value, np.nan), np.where(total > 0, u, np.nan), np.sqrt(tau2)
