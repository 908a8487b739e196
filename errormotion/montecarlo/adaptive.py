"""Propagation of distributions with an adaptive number of trials: JCGM 101, clauses 7.2 to 7.9.

Trials are computed in blocks by a function ``block(sequence, size)``, such as a textbook model or the identification of
a method. Each block has its own seed, so that its trials do not depend on when and where they are computed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.random import SeedSequence
from numpy.typing import NDArray
from scipy.special import ndtr, stdtrit

from errormotion.arrays import Array
from errormotion.montecarlo.intervals import confidence, min_samples, shortest, standard_errors, symmetric

Block = Callable[[SeedSequence, int], Array]
"""``block(sequence, size)``: ``size`` samples of k quantities (size, k), NaN for a trial without a value."""

MAX_TRIALS = 1_000_000
"""Number of trials after which the adaptive procedure stops in any case."""
STABLE = float(ndtr(2.0))
"""Probability of the quantile of the normal distribution at two standard deviations."""
FALSE_ALARM = 0.05
"""Probability that the end of any interval is outside its bounds because of the finite number of trials."""
MAX_SORTED = 4_000_000
"""Number of samples that are sorted at a time, which limits the memory."""


@dataclass(frozen=True)
class Summary:
    """Results of the trials for k quantities.

    Attributes
    ----------
    trials : int
        Number of trials, M.
    probability : float
        Coverage probability of the intervals.
    digits : int
        Significant decimal digits of a standard uncertainty that are regarded as meaningful.
    mean, uncertainty : ndarray (k,)
        Estimate and standard uncertainty, 7.6.
    symmetric, shortest : ndarray (2, k)
        Ends of the intervals, 7.7.
    standard_error : ndarray (2, k)
        Standard errors of both ends of the symmetric interval, from the finite number of trials.
    low_bounds, high_bounds : ndarray (2, k)
        Bounds of both ends, valid for all quantities simultaneously with a probability of 95 % (Bonferroni).
    tolerance : ndarray (k,)
        Numerical tolerance of the standard uncertainty, 7.9.2.
    missing : ndarray (k,)
        Number of trials without a value.
    stable : ndarray (k,)
        Whether the adaptive procedure found all results stable, 7.9.4; false without the adaptive procedure.
    """

    trials: int
    probability: float
    digits: int
    mean: Array
    uncertainty: Array
    symmetric: Array
    shortest: Array
    standard_error: Array
    low_bounds: Array
    high_bounds: Array
    tolerance: Array
    missing: NDArray[np.int64]
    stable: NDArray[np.bool_]


def numerical_tolerance(uncertainty: Array | float, digits: int) -> Array:
    """Return half a unit of the last meaningful digit of standard uncertainties: JCGM 101, 7.9.2.

    u = c * 10**l with an integer c of ``digits`` digits; the tolerance is 10**l / 2. It is 0 where u is 0.
    """
    u = np.asarray(uncertainty, dtype=float)
    known = np.isfinite(u) & (u > 0)
    exponent = np.floor(np.log10(np.where(known, u, 1.0)))
    c = np.rint(np.where(known, u, 1.0) / 10.0 ** (exponent - digits + 1))
    exponent += c >= 10**digits  # 9.96 is rounded to 10
    return np.where(known, 0.5 * 10.0 ** (exponent - digits + 1), np.where(np.isnan(u), np.nan, 0.0))


def block_size(probability: float, cheap: bool = True) -> int:
    """Return the size of a block: JCGM 101, 7.9.4 b).

    With J = 100 / (1 - p), about a hundred trials of a block are outside the interval. The clause requires at least
    10 000 trials; for a model that takes milliseconds or seconds per trial, J is used.
    """
    J = math.ceil(round(100.0 / (1.0 - probability), 9))
    return max(J, 10_000) if cheap else J


def sequence_of(seed: int, number: int) -> SeedSequence:
    """Return the seed of a block by its number."""
    return SeedSequence(seed, spawn_key=(number,))


def propagate(
    block: Block,
    *,
    trials: int | None = None,
    probability: float = 0.95,
    digits: int = 2,
    seed: int = 0,
    size: int | None = None,
    most: int = MAX_TRIALS,
    floor: float = 0.0,
    enough: Callable[[list[Array]], bool] | None = None,
) -> Summary:
    """Propagate distributions through a model.

    Parameters
    ----------
    block : function
        ``block(sequence, size)`` returns samples (size, k).
    trials : int, optional
        Number of trials; default: adaptive, 7.9.4.
    probability : float
        Coverage probability.
    digits : int
        Meaningful digits of the standard uncertainties.
    seed : int
        Seed of the random numbers.
    size : int, optional
        Size of a block; default :func:`block_size`.
    most : int
        Largest number of trials of the adaptive procedure.
    floor : float
        Smallest tolerance of the standard uncertainty, which allows for rounding errors.
    enough : function, optional
        A further condition for the adaptive procedure to stop, a function of all samples so far.

    Returns
    -------
    Summary
    """
    size = size or block_size(probability)
    kept: list[Array] = []
    stability = Stability(probability, digits, floor)
    for number, count in enumerate(_counts(trials, size, most)):
        kept.append(np.asarray(block(sequence_of(seed, number), count), dtype=float))
        if trials is not None:
            continue
        stability.add(kept[-1])
        if stability.reached() and (enough is None or enough(kept)):
            break
    return summarise(kept, probability, digits, stability.stable() if trials is None else None)


def _counts(trials: int | None, size: int, most: int) -> Iterator[int]:
    left = most if trials is None else trials
    while left > 0:
        yield min(size, left)
        left -= size


class Stability:
    """Test whether the results of equal blocks are stable: JCGM 101, 7.9.4 g) to k).

    By the clause, a result is stable if twice the standard deviation of its mean over the blocks is within the
    tolerance. With two or three blocks this standard deviation is very uncertain, and the procedure would often stop by
    chance. Student's factor for h - 1 degrees of freedom, which is 2 for many blocks, maintains the probability.
    """

    def __init__(self, probability: float, digits: int, floor: float = 0.0) -> None:
        self._probability, self._digits, self._floor = probability, digits, floor
        self._results: list[Array] = []
        self._sums: tuple[Array, Array, Array] | None = None

    def add(self, samples: Array) -> None:
        """Add a block of samples (n, k)."""
        ordered = np.sort(samples, axis=0)  # unknown values come last
        known = np.isfinite(samples)
        n = known.sum(axis=0)
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = np.where(known, samples, 0.0).sum(axis=0) / n
            square = (np.where(known, samples - mean, 0.0) ** 2).sum(axis=0)
            u = np.sqrt(square / (n - 1))
        self._results.append(np.stack([mean, u, *symmetric(ordered, self._probability)]))
        if self._sums is None:
            self._sums = (n.astype(float), mean, square)
        else:
            before, level, spread = self._sums
            total = before + n
            with np.errstate(invalid="ignore", divide="ignore"):
                shift = mean - level
                self._sums = (total, level + shift * n / total, spread + square + shift**2 * before * n / total)

    def stable(self) -> NDArray[np.bool_]:
        """Return which quantities (k,) have stable results; quantities with missing values count as stable."""
        if self._sums is None:
            return np.zeros(0, dtype=bool)
        results, count = np.stack(self._results), len(self._results)
        if count < 2:
            return np.zeros(results.shape[2], dtype=bool)
        n, _, spread = self._sums
        with np.errstate(invalid="ignore", divide="ignore"):
            tolerance = np.maximum(numerical_tolerance(np.sqrt(spread / (n - 1)), self._digits), self._floor)
            s = results.std(axis=0, ddof=1) / np.sqrt(count)
        student = float(stdtrit(count - 1, STABLE))
        return np.asarray(np.all(student * s <= tolerance, axis=0) | np.isnan(results).any(axis=(0, 1)))

    def reached(self) -> bool:
        """Return whether all quantities have stable results."""
        stable = self.stable()
        return bool(stable.size and stable.all())


def summarise(
    blocks: Sequence[Array], probability: float, digits: int, stable: NDArray[np.bool_] | None = None
) -> Summary:
    """Return the results of the samples of all blocks, each (n, k); only some quantities are sorted at a time."""
    trials, k = sum(len(block) for block in blocks), blocks[0].shape[1]
    mean, u, tolerance = (np.full(k, np.nan) for _ in range(3))
    central, short, error, low_bounds, high_bounds = (np.full((2, k), np.nan) for _ in range(5))
    missing = np.zeros(k, dtype=np.int64)
    step = max(1, MAX_SORTED // max(trials, 1))
    for first in range(0, k, step):
        part = slice(first, min(first + step, k))
        ordered = np.concatenate([np.asarray(block[:, part], dtype=float) for block in blocks])
        ordered.sort(axis=0)
        missing[part] = np.isnan(ordered).sum(axis=0)
        for lost in np.unique(missing[part]):
            columns = np.flatnonzero(missing[part] == lost)
            if trials - lost < min_samples(probability):
                continue
            values, at = ordered[: trials - lost, columns], first + columns
            mean[at], u[at] = values.mean(axis=0), values.std(axis=0, ddof=1)
            central[:, at], short[:, at] = symmetric(values, probability), shortest(values, probability)
            error[:, at] = standard_errors(values, probability)
            low_bounds[:, at], high_bounds[:, at] = confidence(values, probability, FALSE_ALARM / (2 * k))
    tolerance = numerical_tolerance(u, digits)
    is_stable = np.zeros(k, dtype=bool) if stable is None else stable
    return Summary(
        trials,
        probability,
        digits,
        mean,
        u,
        central,
        short,
        error,
        low_bounds,
        high_bounds,
        tolerance,
        missing,
        is_stable,
    )
