"""Validation of the linear propagation of uncertainty by the Monte Carlo method: JCGM 101, clause 8."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from errormotion.arrays import Array
from errormotion.montecarlo.adaptive import Summary

VALIDATED, NOT_VALIDATED, UNDECIDED = 1, 0, -1
WORDS = {VALIDATED: "validated", NOT_VALIDATED: "not validated", UNDECIDED: "undecided"}
MAX_MISSING = 0.01
"""Fraction of trials without a value above which a quantity is undecided."""


@dataclass(frozen=True)
class Validation:
    """Comparison of the linear interval with the symmetric one of the Monte Carlo method.

    Attributes
    ----------
    low, high : ndarray (k,)
        Distances of the ends, d_low and d_high, 8.1.
    verdict : ndarray (k,)
        ``VALIDATED`` if both are within the tolerance, ``NOT_VALIDATED`` if one is not, ``UNDECIDED`` if the number of
        trials is not sufficient or too many trials have no value.
    """

    low: Array
    high: Array
    verdict: NDArray[np.int8]


def validate_linear(
    value: Array,
    uncertainty: Array,
    summary: Summary,
    *,
    factor: float | None = None,
    floor: float = 0.0,
    short: bool = False,
) -> Validation:
    """Compare the interval ``value`` +- ``factor`` times ``uncertainty`` with that of the trials.

    Parameters
    ----------
    value, uncertainty : ndarray (k,)
        Estimate and standard uncertainty by linear propagation.
    summary : Summary
        Results of the trials.
    factor : float, optional
        Coverage factor; default that of the normal distribution.
    floor : float
        Largest difference that is regarded as a rounding error.
    short : bool
        Compare with the shortest interval instead of the symmetric one.

    Notes
    -----
    The ends of the interval of the trials are known within bounds, which are valid for all quantities simultaneously
    with a probability of 95 %. A quantity is decided if all values within the bounds are inside the tolerance, or all
    outside.
    """
    k = float(ndtri(0.5 + summary.probability / 2)) if factor is None else factor
    ends = np.stack([value - k * uncertainty, value + k * uncertainty])
    seen = summary.shortest if short else summary.symmetric
    distance = np.abs(ends - seen)
    known = np.isfinite(distance).all(axis=0)
    limit = np.maximum(summary.tolerance, floor)
    with np.errstate(invalid="ignore"):
        bounds = np.stack([summary.low_bounds, summary.high_bounds], axis=1) + (seen - summary.symmetric)
        off = bounds - ends
        inside = np.all(np.abs(off) <= limit, axis=(0, 1)) | np.all(distance <= floor, axis=0)
        outside = np.any((off[0] > limit) | (off[1] < -limit), axis=0)
    verdict = np.where(inside, VALIDATED, np.where(outside, NOT_VALIDATED, UNDECIDED))
    verdict[~known | (summary.missing > MAX_MISSING * summary.trials)] = UNDECIDED
    return Validation(distance[0], distance[1], verdict.astype(np.int8))
