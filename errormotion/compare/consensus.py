"""Consensus of several estimates by generalised least squares, and a test of each estimate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from errormotion.arrays import Array
from errormotion.compare.pairs import ChiSquare
from errormotion.compare.stack import Estimate
from errormotion.estimation.between_runs import variance_between
from errormotion.estimation.information import Information, Reduced, Solution, short, solve


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
    keys, parts = information(estimates)
    known = np.array([each.known for each in parts])
    count = known.sum(axis=0)
    degrees = int((count - (count > 0)).sum())
    left_degrees = [int((rest - (rest > 0)).sum()) for rest in count - known]
    if not short(parts, len(keys)):
        solution = solve(parts, len(keys))
        left = [
            max(solve([part for part in parts if part is not each], len(keys)).square, 0.0) if its else 0.0
            for each, its in zip(parts, left_degrees, strict=True)
        ]
    else:
        reduced = Reduced.of(parts, len(keys))
        solution = reduced.solution()
        left = np.maximum(solution.square - reduced.decreases(), 0.0).tolist()
    fit = ChiSquare(max(solution.square, 0.0), degrees)
    rest = [ChiSquare(square, its) for square, its in zip(left, left_degrees, strict=True)]
    without = [ChiSquare(max(fit.value - each.value, 0.0), degrees - each.degrees) for each in rest]
    estimate = _estimate(solution, estimates)
    return Consensus(estimate, fit, without, _holm([each.p for each in without]), rest)


def information(estimates: Sequence[Estimate]) -> tuple[dict[str, int], list[Information]]:
    """Return the number of each source by its key, and the information of each estimate."""
    keys = {key: k for k, key in enumerate(dict.fromkeys(key for each in estimates for key in each.source))}
    columns = [np.array([keys[key] for key in each.source], dtype=np.intp) for each in estimates]
    parts = [Information.of(e.value, e.own, e.influence, c) for e, c in zip(estimates, columns, strict=True)]
    return keys, parts


def _estimate(solution: Solution, estimates: Sequence[Estimate]) -> Estimate:
    value, own, influence = (
        np.where(solution.seen, solution.value, np.nan),
        solution.own.copy(),
        solution.influence.copy(),
    )
    for each in estimates:  # zero by definition in the reference state
        zero = (each.known & (each.variance() == 0) & ~solution.seen).any(axis=1)
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
    adjusted, largest = np.ones(len(p)), 0.0
    for rank, i in enumerate(order):
        largest = max(largest, min(1.0, (len(p) - rank) * p[i]))
        adjusted[i] = largest
    return adjusted.tolist()


def random_effects(estimates: Sequence[Estimate]) -> tuple[Array, Array, Array]:
    """Return a robust mean and its standard uncertainty, (n, d), and the standard deviation between datasets, (d,).

    The variance between datasets is estimated for each freedom from all points together.
    """
    return variance_between(np.array([each.value for each in estimates]), np.array([e.variance() for e in estimates]))
