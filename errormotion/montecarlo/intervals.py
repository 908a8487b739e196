"""Coverage intervals and standard errors of samples: JCGM 101, clause 7.7."""

from __future__ import annotations

import numpy as np

from errormotion.arrays import Array


def symmetric(ordered: Array, probability: float) -> tuple[Array, Array]:
    """Return the ends of the probabilistically symmetric interval of ordered samples (M, k): JCGM 101, 7.7.2."""
    low, q = _ranks(len(ordered), probability)
    return ordered[low], ordered[low + q]


def shortest(ordered: Array, probability: float) -> tuple[Array, Array]:
    """Return the ends of the shortest interval of ordered samples (M, k): JCGM 101, 7.7.4."""
    _, q = _ranks(len(ordered), probability)
    first = np.argmin(ordered[q:] - ordered[:-q], axis=0)
    columns = np.arange(ordered.shape[1])
    return ordered[first, columns], ordered[first + q, columns]


def standard_errors(ordered: Array, probability: float) -> tuple[Array, Array]:
    """Return the standard errors of both ends of the symmetric interval of ordered samples (M, k).

    The number of samples below a quantile has a binomial distribution. The samples at one standard deviation of this
    number on both sides enclose twice the standard error, for any distribution of the samples.
    """
    count = len(ordered)
    low, q = _ranks(count, probability)
    tail = (1.0 - probability) / 2.0
    step = max(1, round(float(np.sqrt(count * tail * (1.0 - tail)))))
    errors = []
    for rank in (low, low + q):
        below, above = max(rank - step, 0), min(rank + step, count - 1)
        errors.append((ordered[above] - ordered[below]) / 2.0 * (2 * step / max(above - below, 1)))
    return errors[0], errors[1]


def confidence(ordered: Array, probability: float, alarm: float) -> tuple[Array, Array]:
    """Return bounds (2, k) of the low and the high end of the symmetric interval, from ordered samples (M, k).

    Each end is outside its bounds with a probability of at most ``alarm``, for any distribution of the samples, since
    the number of samples below a quantile has a binomial distribution. With too few samples bounds are infinite.
    """
    from scipy.stats import binom

    count, tail = len(ordered), (1.0 - probability) / 2.0
    beyond = np.full((1, ordered.shape[1]), np.inf)
    padded = np.concatenate([-beyond, ordered, beyond])  # sample number r, counted from 1, is row r
    bounds = []
    for q in (tail, 1.0 - tail):
        low, high = (int(binom.ppf(p, count, q)) for p in (alarm / 2, 1.0 - alarm / 2))
        bounds.append(np.stack([padded[low], padded[min(high + 1, count + 1)]]))
    return bounds[0], bounds[1]


def min_samples(probability: float) -> int:
    """Return the smallest number of samples with which samples are outside both ends of the interval."""
    return int(np.ceil(round(2.0 / (1.0 - probability), 9)))


def _ranks(count: int, probability: float) -> tuple[int, int]:
    """Return the index of the low end, and the number of samples from there to the high end."""
    inside = probability * count
    q = min(int(np.floor(inside + 0.5)), count - 1)
    rank = (count - q) / 2.0
    return max(int(rank if rank.is_integer() else np.floor((count - q + 1) / 2.0)) - 1, 0), q
