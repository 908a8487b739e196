"""Whether residuals agree with the stated noise, and the factor for its variance if they do not, or if it is unknown.

The weighted sum of squares of the residuals over the true variances has a chi-square distribution with f degrees of
freedom. With the stated variance it is tested in both tails; with a stated variance that itself has f' degrees of
freedom (GUM G.4.2: ``f' = 1/2 (u(s) / s)^-2``) the ratio of both has an F distribution.

The power against a noise that is stated as half of the truth is ``P(chi2_f > q / 4)``, with the quantile q of the test:
83 % for 10 degrees of freedom, 99.8 % for 30, more than 1 - 1e-9 for 100, and 90 % from 13 on. Against twice the truth
it is ``P(chi2_f < 4 q)``: 58 %, 99.9 % and more than 1 - 1e-9.

References: Baarda, A testing procedure for use in geodetic networks (1968), the global model test. JCGM 100:2008
(GUM), annex G. JCGM 101:2008, 6.4.9.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import numpy as np
from scipy.special import chdtr, chdtrc, chdtri, fdtr, fdtrc, fdtri, ndtri, stdtrit

from errormotion.arrays import Array
from errormotion.errors import FitError

__all__ = ["MIN_POWER", "TAIL", "Scatter", "Verdict", "expansion", "power", "variance_factor"]

TAIL = 0.01
"""Probability of an alarm for a correctly stated noise in each of the two tails: 2 % of nominal data have a note."""
MIN_POWER = 0.9
"""Probability with which a noise of half the truth must be found; below, the stated noise counts as unchecked."""
QUANTILE = 0.975
"""Of two-sided intervals of 95 %."""


class Verdict(Enum):
    """What the residuals say about the noise."""

    CONSISTENT = "consistent"
    MORE = "more"
    LESS = "less"
    UNCHECKED = "unchecked"
    ESTIMATED = "estimated"


@dataclass(frozen=True)
class Scatter:
    """The scatter of the readings against their stated noise.

    Attributes
    ----------
    factor : float
        For the stated variance of the readings, and for their part of a covariance only.
    freedom : float
        Degrees of freedom of this variance, for Student's distribution; infinite for a stated one.
    ratio : float
        Standard deviation found over the stated one; NaN without degrees of freedom.
    verdict : Verdict
    note : str
        One sentence for the notes; "" where there is nothing to say.
    """

    factor: float
    freedom: float
    ratio: float
    verdict: Verdict
    note: str

    @property
    def doubtful(self) -> bool:
        """Whether the note doubts the uncertainties: the readings scatter more than these say."""
        return self.verdict is Verdict.MORE and self.factor == 1.0


def variance_factor(
    chi2: float,
    freedom: int,
    *,
    stated: bool = True,
    stated_freedom: float = np.inf,
    increase: bool = True,
    priors: bool = False,
    estimate: Callable[[], tuple[float, float]] | None = None,
    what: str = "the readings",
    size: Callable[[float], str] | None = None,
    cause: str = "",
    tail: float = TAIL,
) -> Scatter:
    """Return the variance factor of readings.

    Parameters
    ----------
    chi2 : float
        Sum of squares of residuals (and priors) over their stated variances.
    freedom : int
        Its degrees of freedom.
    stated : bool
        Whether the noise is stated; otherwise its variance is ``chi2 / freedom`` in units of the weights.
    stated_freedom : float
        Degrees of freedom of the stated variance. If finite, both estimates are combined as long as they agree.
    increase : bool
        Whether the uncertainties follow the residuals if these scatter more than stated.
    priors : bool
        Whether ``chi2`` contains priors, such as adjusted constants. A factor at the end would scale their
        uncertainties, too.
    estimate : callable, optional
        Returns the variance factor of the noise and its degrees of freedom by likelihood
        (`components.noise_variance`). Required with priors where the noise is not stated or may be increased.
    what : str
        The readings, as the subject of the sentence.
    size : callable, optional
        From the factor for the standard deviation to the noise in words, "1.3 um".
    cause : str
        A possible cause or remedy, added where the readings scatter more than stated: "Check the mounting."
    tail : float
        Probability of an alarm in each tail.

    Raises
    ------
    FitError
        The noise is neither stated nor redundant; or priors without ``estimate``.
    """
    if priors and estimate is None and (increase or not stated):
        raise FitError(
            f"the noise of {what} must be an unknown of the fit (components): with priors or adjusted constants a "
            "variance factor would scale their uncertainties as well",
            code="estimation.noise.not_unknown",
        )
    name = what[:1].upper() + what[1:]
    many = f"{freedom} degree{'' if freedom == 1 else 's'} of freedom"
    if not stated:
        return _estimated(chi2, freedom, estimate, what, size, many)
    ratio = float(np.sqrt(chi2 / freedom)) if freedom > 0 else float("nan")
    above, below = _probabilities(chi2, freedom, stated_freedom)
    if freedom > 0 and above < tail:
        factor, found_freedom = 1.0, np.inf
        if increase:
            factor, found_freedom = (chi2 / freedom, float(freedom)) if estimate is None else estimate()
            factor = max(factor, 1.0)
        text = f"{name} scatter {ratio:.3g} times as much as stated, with {many}; " + (
            "the uncertainties are increased accordingly." if increase else "the stated noise is used."
        )
        return Scatter(factor, found_freedom, ratio, Verdict.MORE, f"{text} {cause}".rstrip())
    if freedom > 0 and below < tail:
        text = f"{name} scatter only {ratio:.3g} times as much as stated, with {many}; the stated noise is used."
        return Scatter(1.0, np.inf, ratio, Verdict.LESS, text)
    factor, found_freedom = 1.0, float(np.inf)
    if np.isfinite(stated_freedom):
        # Two independent estimates of one variance.
        found_freedom = stated_freedom + max(freedom, 0)
        factor = (stated_freedom + chi2) / found_freedom if freedom > 0 else 1.0
    found = power(freedom, 2.0, stated_freedom=stated_freedom, tail=tail)
    if found >= MIN_POWER:
        return Scatter(factor, found_freedom, ratio, Verdict.CONSISTENT, "")
    if freedom < 1:
        text = f"No redundancy: the stated noise of {what} cannot be checked."
    else:
        text = (
            f"The stated noise of {what} can hardly be checked, with {many}: twice the noise would be noticed with a "
            f"probability of {100 * found:.0f} %."
        )
    return Scatter(factor, found_freedom, ratio, Verdict.UNCHECKED, text)


def power(freedom: int, ratio: float, *, stated_freedom: float = np.inf, tail: float = TAIL) -> float:
    """Return the probability of noticing that the noise is ``ratio`` times the stated one, above or below 1.

    With ``ratio^2 chi2_f`` against the quantile of chi2_f, in the tail of the ratio; F with a finite
    ``stated_freedom``.
    """
    if freedom < 1:
        return 0.0
    if np.isfinite(stated_freedom):
        if ratio > 1:
            return float(fdtrc(freedom, stated_freedom, fdtri(freedom, stated_freedom, 1 - tail) / ratio**2))
        return float(fdtr(freedom, stated_freedom, fdtri(freedom, stated_freedom, tail) / ratio**2))
    if ratio > 1:
        return float(chdtrc(freedom, chdtri(freedom, tail) / ratio**2))
    return float(chdtr(freedom, chdtri(freedom, 1 - tail) / ratio**2))


def expansion(freedom: float | Array) -> Array:
    """Return the factor for standard uncertainties whose 1.96-fold is the interval of Student's distribution.

    ``t(0.975, f) / z(0.975)`` (GUM G.3.2), at least 1 degree of freedom.
    """
    f = np.maximum(np.asarray(freedom, dtype=float), 1.0)
    z = ndtri(QUANTILE)
    return np.asarray(np.where(np.isfinite(f), stdtrit(np.where(np.isfinite(f), f, 1.0), QUANTILE) / z, 1.0))


def _estimated(
    chi2: float,
    freedom: int,
    estimate: Callable[[], tuple[float, float]] | None,
    what: str,
    size: Callable[[float], str] | None,
    many: str,
) -> Scatter:
    """Return the factor of an unknown noise."""
    if freedom < 1:
        raise FitError(
            f"the noise of {what} is not stated, and there is no redundancy to estimate it. State it, or measure more",
            code="estimation.noise.unknown",
        )
    factor, estimated_freedom = (chi2 / freedom, float(freedom)) if estimate is None else estimate()
    ratio = float(np.sqrt(factor))
    if estimate is not None:
        many = f"{estimated_freedom:.3g} degrees of freedom"
    shown = f": {size(ratio)} from the residuals, with {many}." if size else f", and estimated with {many}."
    return Scatter(factor, estimated_freedom, ratio, Verdict.ESTIMATED, f"The noise of {what} is not stated{shown}")


def _probabilities(chi2: float, freedom: int, stated_freedom: float) -> tuple[float, float]:
    """Return the probabilities of at least, and of at most this sum of squares."""
    if freedom < 1:
        return 1.0, 1.0
    if np.isfinite(stated_freedom):
        F = chi2 / freedom
        return float(fdtrc(freedom, stated_freedom, F)), float(fdtr(freedom, stated_freedom, F))
    return float(chdtrc(freedom, chi2)), float(chdtr(freedom, chi2))
