"""The formulas of ISO 230-2:2014, for readings ``x`` (..., approach, run, target); approaches are forward, backward.

Unknown readings are NaN. A value that depends on an unknown one is NaN; extremes are those of the known values. A
figure of both directions is NaN if one of them was not measured.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from errormotion.arrays import Array

FIGURES = (
    *("A", "A_forward", "A_backward", "E", "E_forward", "E_backward"),
    *("R", "R_forward", "R_backward", "M", "B", "B_mean"),
)
MEANINGS = {
    "A": "bidirectional accuracy",
    "A_forward": "unidirectional accuracy, forward",
    "A_backward": "unidirectional accuracy, backward",
    "E": "bidirectional systematic error",
    "E_forward": "unidirectional systematic error, forward",
    "E_backward": "unidirectional systematic error, backward",
    "R": "bidirectional repeatability",
    "R_forward": "unidirectional repeatability, forward",
    "R_backward": "unidirectional repeatability, backward",
    "M": "mean bidirectional positioning error",
    "B": "reversal error",
    "B_mean": "mean reversal error",
}


@dataclass(frozen=True)
class Statistics:
    """Statistics of the standard at each target; ``mean`` and ``s`` are (..., approach, target).

    Attributes
    ----------
    mean, s : ndarray
        Mean unidirectional deviation, and estimator of the unidirectional standard deviation.
    """

    mean: Array
    s: Array

    @property
    def bidirectional(self) -> Array:
        """Mean bidirectional deviation, (..., target)."""
        return np.asarray(self.mean.mean(axis=-2))

    @property
    def reversal(self) -> Array:
        """Reversal error at each target: mean forward minus mean backward, (..., target)."""
        return np.asarray(self.mean[..., 0, :] - self.mean[..., 1, :])

    @property
    def unidirectional_repeatability(self) -> Array:
        """Four estimators of the standard deviation, (..., approach, target)."""
        return 4.0 * self.s

    @property
    def repeatability(self) -> Array:
        """Bidirectional repeatability at each target, (..., target)."""
        both = 2.0 * self.s.sum(axis=-2) + np.abs(self.reversal)
        return np.asarray(np.maximum(both, self.unidirectional_repeatability.max(axis=-2)))


def statistics(x: Array) -> Statistics:
    """Return mean and estimator of the standard deviation over the runs; NaN for s of one reading."""
    known = np.isfinite(x)
    n = known.sum(axis=-2)
    if known.all():
        mean = x.mean(axis=-2)
        square = ((x - mean[..., None, :]) ** 2).sum(axis=-2)
    else:
        mean = np.where(n > 0, np.where(known, x, 0.0).sum(axis=-2) / np.maximum(n, 1), np.nan)
        square = np.where(known, (x - mean[..., None, :]) ** 2, 0.0).sum(axis=-2)
    s = np.where(n > 1, np.sqrt(square / np.maximum(n - 1, 1)), np.nan)
    return Statistics(np.asarray(mean), np.asarray(s))


def figures(computed: Statistics) -> Array:
    """Return the figures of the axis in the order of ``FIGURES``, (..., figure).

    Clauses 3 and 4 of ISO 230-2:2014: ``A = max(mean + 2 s) - min(mean - 2 s)``, ``E = max(mean) - min(mean)`` over one
    or both directions, ``R`` the largest repeatability, ``M`` the range of the mean bidirectional deviations, ``B`` the
    largest reversal error, ``B_mean`` its mean over the targets, with its sign.
    """
    upper, lower = (
        _largest(computed.mean + 2.0 * computed.s),
        _smallest(computed.mean - 2.0 * computed.s),
    )  # (..., approach)
    highest, lowest = _largest(computed.mean), _smallest(computed.mean)
    one, systematic = upper - lower, highest - lowest
    repeatability, reversal = _largest(computed.unidirectional_repeatability), computed.reversal
    both_known = np.isfinite(systematic).all(axis=-1)

    def both(high: Array, low: Array) -> Array:
        return np.where(both_known, high.max(axis=-1) - low.min(axis=-1), np.nan)

    columns = [
        both(upper, lower),
        one[..., 0],
        one[..., 1],
        both(highest, lowest),
        systematic[..., 0],
        systematic[..., 1],
        _largest(computed.repeatability),
        repeatability[..., 0],
        repeatability[..., 1],
        _largest(computed.bidirectional) - _smallest(computed.bidirectional),
        _largest(np.abs(reversal)),
        _mean(reversal),
    ]
    return np.stack(columns, axis=-1)


def _largest(values: Array) -> Array:
    return np.asarray(np.fmax.reduce(values, axis=-1))  # NaN if all values are unknown


def _smallest(values: Array) -> Array:
    return -_largest(-values)


def _mean(values: Array) -> Array:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.asarray(np.nanmean(values, axis=-1))
