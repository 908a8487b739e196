"""Consensus of several estimates by generalised least squares, and a test of each estimate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from errormotion.arrays import Array, filled
from errormotion.compare.normal import Information, Reduced, Solution, short, solve
from errormotion.compare.pairs import ChiSquare
from errormotion.compare.stack import Estimate


@dataclass(frozen=True)
class Consensus:
    """Consensus of several estimates, with tests.

    Attributes
    ----------
    estimate : Estimate
        Generalised least squares.
    fit : ChiSquare
        Chi-square of the residuals.
    without : list of ChiSquare
        For each dataset: decrease of the sum of squares without it, a chi-square with its number of values.
    p : list of float
        For each dataset: probability of such a decrease, corrected for the number of datasets (Holm).
    rest : list of ChiSquare
        For each dataset: chi-square of the residuals of the others.
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

    Values that are exactly zero by definition (a reference state) are not used; they are zero in the result.
    """
    keys = {key: k for k, key in enumerate(dict.fromkeys(key for each in estimates for key in each.source))}
    parts = [Information.of(each, keys) for each in estimates]
    known = np.array([each.known for each in parts])
    count = known.sum(axis=0)
    degrees = int((count - (count > 0)).sum())
    left_degrees = [int((rest - (rest > 0)).sum()) for rest in count - known]
    if not short(parts, len(keys)):
        found = solve(parts, len(keys))
        left = [
            max(solve([part for part in parts if part is not each], len(keys)).square, 0.0) if its else 0.0
            for each, its in zip(parts, left_degrees, strict=True)
        ]
    else:
        reduced = Reduced.of(parts, len(keys))
        found = reduced.solution()
        left = np.maximum(found.square - reduced.falls(), 0.0).tolist()
    fit = ChiSquare(max(found.square, 0.0), degrees)
    rest = [ChiSquare(square, its) for square, its in zip(left, left_degrees, strict=True)]
    without = [ChiSquare(max(fit.value - each.value, 0.0), degrees - each.degrees) for each in rest]
    estimate = _estimate(found, estimates)
    return Consensus(estimate, fit, without, _holm([each.p for each in without]), rest)


def _estimate(found: Solution, estimates: Sequence[Estimate]) -> Estimate:
    value, own, influence = np.where(found.seen, found.value, np.nan), found.own.copy(), found.influence.copy()
    for each in estimates:  # zero by definition in the reference state
        zero = (each.known & (each.variance() == 0) & ~found.seen).any(axis=1)
        value[zero] = np.where(np.isnan(value[zero]), 0.0, value[zero])
        own[zero] = 0.0
        influence[:, zero] = 0.0
    gone = np.isnan(value)
    own[gone[:, :, None] | gone[:, None, :]] = np.nan
    influence[:, gone] = np.nan
    names = tuple(f"consensus, part {k + 1}" for k in range(len(influence)))
    return Estimate("consensus", value, own, influence, names)


def _holm(p: Sequence[float]) -> list[float]:
    """Return probabilities corrected for their number (Holm 1979)."""
    order = np.argsort(p)
    found, largest = np.ones(len(p)), 0.0
    for rank, i in enumerate(order):
        largest = max(largest, min(1.0, (len(p) - rank) * p[i]))
        found[i] = largest
    return found.tolist()


def random_effects(estimates: Sequence[Estimate]) -> tuple[Array, Array, Array]:
    """Return a robust mean with a variance between datasets (DerSimonian and Laird 1986).

    The variance between datasets is estimated for each freedom from all points together.

    Returns
    -------
    value, standard_uncertainty : ndarray, (n, d)
    tau : ndarray, (d,)
        Standard deviation between datasets, m and rad.
    """
    y = np.array([each.value for each in estimates])
    variance = np.array([each.variance() for each in estimates])
    known = np.isfinite(y) & (variance > 0)
    w = np.where(known, 1.0 / np.where(known, variance, 1.0), 0.0)
    total = w.sum(axis=0)
    y = filled(y)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = (w * y).sum(axis=0) / total
    Q = np.nansum((w * (y - filled(mean)) ** 2), axis=0)
    degrees = np.maximum(known.sum(axis=0) - 1, 0)
    c = np.where(total > 0, total - (w**2).sum(axis=0) / np.where(total > 0, total, 1.0), 0.0)
    weight = c.sum(axis=0)
    tau2 = np.maximum((Q - degrees).sum(axis=0), 0.0) / np.where(weight > 0, weight, np.inf)
    w = np.where(known, 1.0 / np.where(known, variance + tau2, 1.0), 0.0)
    total = w.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        value, u = (w * y).sum(axis=0) / total, np.sqrt(1.0 / total)
    return np.where(total > 0, value, np.nan), np.where(total > 0, u, np.nan), np.sqrt(tau2)
