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

    The number of samples below a quantile is binomial: the samples one standard deviation of it to either side
    enclose twice the standard error, whatever the distribution.
    """
    count = len(ordered)
    low, q = _ranks(count, probability)
    share = (1.0 - probability) / 2.0
    step = max(1, round(float(np.sqrt(count * share * (1.0 - share)))))
    found = []
    for rank in (low, low + q):
        below, above = max(rank - step, 0), min(rank + step, count - 1)
        found.append((ordered[above] - ordered[below]) / 2.0 * (2 * step / max(above - below, 1)))
    return found[0], found[1]


def fewest(probability: float) -> int:
    """Return the fewest samples that have an interval with samples on both sides of it."""
    return int(np.ceil(round(2.0 / (1.0 - probability), 9)))


def _ranks(count: int, probability: float) -> tuple[int, int]:
    """Return the index of the low end, and how many samples further the high end is."""
    inside = probability * count
    q = min(int(np.floor(inside + 0.5)), count - 1)
    rank = (count - q) / 2.0
    return max(int(rank if rank.is_integer() else np.floor((count - q + 1) / 2.0)) - 1, 0), q
