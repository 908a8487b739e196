"""Smooth curves as Legendre polynomials whose size and smoothness are not known: orders, prior, and what lies above.

A coefficient of order n has the prior standard deviation ``tau n^-p`` (`errormotion.estimation.evidence`). What the
orders and exponents must be follows from the curves:

* *Exponents.* A curve whose k-th derivative jumps has coefficients that decrease as ``n^-(k + 1/2)``; so have the
  typical curves of a random walk (k = 0: a profile of independent increments, such as a pitch line), of its integral
  (k = 1: rails that were joined or bent at random), and so on. Smooth curves decrease faster than any power; within
  some ten orders they look like p = 3 to 4. The exponents are therefore 1/2 to 4, closer to each other where the curves
  differ more. Their estimates are averaged with the evidence as weight, since the data rarely distinguish neighbours.
* *Orders.* Above the highest order N the variance ``tau^2 sum_(n>N) n^(-2p) P_n(x)^2`` remains. P_n^2 is 1 at the ends
  and ``1 / (2 n + 1)`` on average: for p = 1 and N = 12 the remainder is 0.03 tau inside, and 0.3 tau at the ends. For
  rough curves it is never negligible, so it is a part of the uncertainty (`Interval.rest`), up to order 60. The fit
  needs the orders that the data can determine, about as many as there are positions.
* *Sizes.* Curves of one kind (displacements, rotations) differ in size by a factor of about 1.4 to 1.6, the standard
  deviation of the logarithm. The size of the kind has therefore the weight of some four terms in that of each curve.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.estimation.evidence import Averaged, averaged, posteriors

__all__ = ["ORDERS", "Interval", "estimated", "rest_of"]

ORDERS = 12
"""Highest order that is fitted."""
HIGHEST = 60
"""Highest order that contributes to the uncertainty."""
EXPONENTS = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0)
"""Exponents p of the prior."""
POOLED = 4.0
"""Weight, in terms, of the other curves of the same kind in the size of one."""
REGULARISATION = 1e-13
"""Information of columns without a prior, relative to their own: for columns that the data do not determine."""


@dataclass(frozen=True)
class Interval:
    """The part of an axis over which curves are stated, from ``low`` to ``high``, m; both may be arrays (axis,)."""

    low: float | Array
    high: float | Array

    def scaled(self, position: ArrayLike) -> Array:
        """Return positions scaled to -1 to 1; 0 in an interval without length."""
        q = np.asarray(position, dtype=float)
        length = np.asarray(self.high, dtype=float) - self.low
        half = np.where(length > 0, length / 2, 1.0)
        return np.asarray((q - (np.asarray(self.low) + self.high) / 2) / half)

    def polynomials(self, position: ArrayLike, order: int) -> Array:
        """Return the Legendre polynomials (..., order + 1) at positions (...)."""
        return np.asarray(legendre.legvander(self.scaled(position), order))

    def rest(self, position: ArrayLike, variance: Array) -> Array:
        """Return the variance (...) at positions (...) of the orders above the fitted ones (`rest_of`)."""
        P = legendre.legvander(self.scaled(position), HIGHEST)
        return np.asarray(np.square(P[..., HIGHEST + 1 - len(variance) :]) @ variance)


def estimated(N: Array, b: Array, group: NDArray[np.intp], order: Array, kind: NDArray[np.intp]) -> Averaged:
    """Return the coefficients of curves, and of the columns without a prior, from normal equations.

    Parameters
    ----------
    N, b : ndarray, (column, column), (column,)
    group : ndarray of int, (column,)
        The curve of each coefficient; -1 for a column without a prior.
    order : ndarray, (column,)
    kind : ndarray of int, (group,)
        Curves of one kind have one unit and similar sizes.
    """
    return averaged(
        posteriors(
            N, b, group, order, exponents=EXPONENTS, kind=kind, pooled=POOLED, regularisation=REGULARISATION,
        )
    )  # fmt: skip


def rest_of(found: Averaged, highest: int) -> Array:
    """Return the variances (group, HIGHEST - highest) of the coefficients above the highest fitted order."""
    return found.variance(np.arange(highest + 1, HIGHEST + 1))
