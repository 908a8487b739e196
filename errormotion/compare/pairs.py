"""Differences of two estimates: normalised error at every point, and a joint test of all points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from errormotion.arrays import Array
from errormotion.compare.stack import Estimate, difference
from errormotion.estimation.low_rank import whitener

COVERAGE_FACTOR = 2.0
"""k of the expanded uncertainties in En."""


@dataclass(frozen=True)
class ChiSquare:
    """A sum of squares with its degrees of freedom; ``p`` is the probability of a larger value if both agree."""

    value: float
    degrees: int

    @property
    def p(self) -> float:
        """Probability of a larger value; NaN without degrees of freedom."""
        return float(special.chdtrc(self.degrees, self.value)) if self.degrees else float("nan")


@dataclass(frozen=True)
class Pair:
    """Comparison of two estimates.

    Attributes
    ----------
    a, b : str
        Names.
    difference : Estimate
        a minus b.
    en : ndarray, (n, d)
        Difference divided by its expanded uncertainty (k = 2), with sign; NaN if unknown or exactly zero by definition.
    joint : ChiSquare
        Test of all points and freedoms.
    curve : list of ChiSquare
        Test of all points, for each freedom.
    """

    a: str
    b: str
    difference: Estimate
    en: Array
    joint: ChiSquare
    curve: list[ChiSquare]


def pair(a: Estimate, b: Estimate) -> Pair:
    """Compare two estimates on one grid; the effects of shared sources, by their keys, cancel."""
    d = difference(a, b)
    u = np.sqrt(np.maximum(d.variance(), 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        en = np.where(u > 0, d.value / (COVERAGE_FACTOR * u), np.nan)
    curves = []
    for k in range(d.value.shape[1]):
        one = Estimate(d.name, d.value[:, [k]], d.own[:, [k]][:, :, [k]], d.influence[:, :, [k]], d.source)
        curves.append(agreement(one))
    return Pair(a.name, b.name, d, en, agreement(d), curves)


def agreement(d: Estimate) -> ChiSquare:
    """Return the chi-square of a difference whose expectation is zero."""
    white = whitener(d.own, d.influence)
    return ChiSquare(white.square(d.value), white.degrees)
