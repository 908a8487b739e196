"""Rounded readings: the step of their scale, and what rounding adds to the uncertainty.

A reading is rounded to a multiple of the step q. With a noise s before rounding that exceeds q / 2, the rounding errors
of repeated readings are independent, and their mean has none of them. With less noise all repeats are rounded alike.
The mean of many repeats of one value mu then deviates from it by

    b(mu) = (q / pi) sum_k (-1)^k exp(-2 pi^2 k^2 s^2 / q^2) sin(2 pi k mu / q) / k,

with the root mean square over mu, all positions of a value between two marks being equally likely,

    b = q / (pi sqrt 2) sqrt(sum_k exp(-4 pi^2 k^2 s^2 / q^2) / k^2),

which is ``q / sqrt(12)`` without noise (GUM F.2.2.1). The scatter of the repeats is ``s^2 + q^2 / 12 - b^2``, since a
reading deviates by the noise and by a rounding error that is independent of it if mu is.

References: Widrow and Kollar, Quantization Noise (2008), chapter 4; JCGM 100:2008, F.2.2.1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.estimation.blocks import Index
from errormotion.estimation.derivatives import column
from errormotion.estimation.problem import Problem

__all__ = ["Rounding", "alike", "common", "noise_before", "rounding", "rounding_of_means", "sentence", "step_of"]

_TERMS = np.arange(1, 60)
_CLOSE = 1e-3
"""Largest deviation of a difference of two readings from a multiple of the step, in steps."""
_DIVISORS = 12
"""Largest ratio of the smallest difference between two readings to the step."""
_ENOUGH = 6
"""Different readings that are no multiples of a step by accident: the probability is ``12 (2e-3)^4``."""
_TIES = 2
"""Equal readings that prove a step: unrounded readings are never equal."""
NOTICEABLE = 0.02
"""Part of a variance from which on rounding is added to it."""
_PRECISION = 16 * float(np.finfo(float).eps)


def step_of(readings: ArrayLike) -> float:
    """Return the step of which all differences of these readings are multiples; 0 if there is none.

    Parameters
    ----------
    readings : array_like
        Any unit; NaN is left out. One scale: readings of one instrument, with one factor.
    """
    y = np.asarray(readings, dtype=float).ravel()
    y = np.sort(y[np.isfinite(y)])
    if y.size < 3:
        return 0.0
    rounding = _PRECISION * float(np.abs(y).max())
    differences = np.diff(y)
    differences = differences[differences > rounding]
    ties = y.size - 1 - differences.size
    if not differences.size or (differences.size + 1 < _ENOUGH and ties < _TIES):
        return 0.0
    smallest = float(differences.min())
    for divisor in range(1, _DIVISORS + 1):
        q = smallest / divisor
        if rounding > _CLOSE * q:
            return 0.0
        # the differences from the first one may add up to many steps; q itself is improved by the largest
        whole = np.rint(differences / q)
        q = float(differences.sum() / whole.sum())
        if np.abs(differences / q - np.rint(differences / q)).max() <= _CLOSE + rounding / q:
            return q
    return 0.0


def common(step: float, noise: ArrayLike) -> Array:
    """Return b, the standard uncertainty by rounding that repeats have in common, for a noise before rounding."""
    s = np.asarray(noise, dtype=float)
    if not step > 0:
        return np.zeros_like(s)
    terms = np.exp(-4 * np.pi**2 * np.square(s[..., None] / step * _TERMS)) / np.square(_TERMS)
    # the terms beyond the last one, which count without noise only: sum over k > K of 1 / k^2 = 1 / K
    rest = np.exp(-4 * np.pi**2 * np.square(s / step * _TERMS[-1])) / _TERMS[-1]
    return np.asarray(np.minimum(step / (np.pi * np.sqrt(2)) * np.sqrt(terms.sum(axis=-1) + rest), step / np.sqrt(12)))


def noise_before(step: float, scatter: float) -> float:
    """Return the noise before rounding of repeated readings with this standard deviation."""
    if not step > 0 or scatter <= 0:
        return max(scatter, 0.0)
    from scipy.optimize import brentq

    def more(s: float) -> float:
        return s**2 + step**2 / 12 - float(common(step, s)) ** 2 - scatter**2

    return float(brentq(more, 0.0, scatter)) if more(0.0) < 0 < more(scatter) else scatter


@dataclass(frozen=True, eq=False)
class Rounding:
    """What rounding adds to the noise of the readings of a problem.

    Attributes
    ----------
    step : float
        The largest step, in the unit of the readings.
    sd : ndarray, (n, r)
        The standard deviations to add. Where m repeats are rounded alike it is b times sqrt(m), so that their mean has
        the variance b^2.
    noise : float
        Typical noise before rounding.
    """

    step: float
    sd: Array
    noise: float


def rounding(problem: Problem, sd: Array, steps: float | Array | None = None) -> Rounding | None:
    """Return what rounding adds to the noise of readings; None if it adds less than 1 % to a standard deviation.

    Parameters
    ----------
    problem : Problem
    sd : ndarray, (n, r)
        Scatter of the readings.
    steps : float or ndarray, (r,), optional
        Steps of the scale, 0 for none; by default they are those of the readings.
    """
    y = column(problem.readings)
    if steps is None:
        steps = np.array([step_of(one) for one in y.T])
    steps = np.broadcast_to(np.asarray(steps, dtype=float), (y.shape[1],))
    if not steps.any():
        return None
    added, before = np.zeros(y.shape), np.full(y.shape[1], np.inf)
    repeats = np.sqrt(alike(problem))
    for k, q in enumerate(steps):
        if q > 0:
            levels, which = np.unique(sd[:, k], return_inverse=True)
            noise = np.array([noise_before(float(q), float(s)) for s in levels])
            added[:, k] = common(float(q), noise)[which] * repeats
            before[k] = np.median(noise[which])
    if not (np.square(added) > NOTICEABLE * np.square(sd)).any():
        return None
    worst = int(np.argmax(steps))
    return Rounding(float(steps[worst]), added, float(before[worst]))


def rounding_of_means(sd: Array, count: Array, step: float) -> Rounding | None:
    """Return what rounding of their readings adds to the noise of means, (n,); None as in `rounding`.

    Parameters
    ----------
    sd, count : ndarray, (n,)
        Standard deviations of the means, and numbers of their readings, which may all be rounded alike.
    step : float
        Of the scale of the readings; 0 for none.
    """
    if not step > 0:
        return None
    noise = noise_before(step, float(np.median(sd * np.sqrt(np.maximum(count, 1)))))
    b = float(common(step, noise))
    return Rounding(step, np.full(sd.shape, b), noise) if b**2 > NOTICEABLE * float(np.median(sd)) ** 2 else None


def sentence(what: str, rounding: Rounding, unit: str = "m") -> str:
    """Return the sentence on rounded readings; ``what`` is its subject."""
    factor, name = {"m": (1e6, "um"), "rad": (1e6, "urad")}.get(unit, (1.0, unit))
    return (
        f"{what[:1].upper()}{what[1:]} are multiples of {rounding.step * factor:.3g} {name}, with a noise of "
        f"{rounding.noise * factor:.3g} {name} before rounding: rounding is a part of the uncertainties."
    )


def alike(problem: Problem) -> Index:
    """Return the number of readings, (n,), with which each shares its rounding error, itself included.

    These are equal readings that see the same unknowns (those without a distribution, such as the errors of a target
    but not the offset of a run) and the same constants.
    """
    seen = [
        table.index2
        for name, table in zip(problem.unknowns._fields, problem.unknowns, strict=True)
        if name and not any(table.component)
    ]
    seen += [constant.index2 for constant in problem.constants]
    y = column(problem.readings)
    keys = np.concatenate([*(rows.astype(float) for rows in seen), np.where(np.isfinite(y), y, 0.0)], axis=1)
    _, which, count = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    found: NDArray[np.intp] = count[which.ravel()]
    return found
