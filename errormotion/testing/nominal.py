"""When the stated intervals of a method hold as often as they say, under the conditions that its model assumes.

Over independent seeds, the share of all intervals of 95 % that contain the truth is 95 % within `PART`, and no single
figure contradicts 95 %: the exact binomial test of each, with the probabilities of Holm for as many tests as there are
figures, rejects it at `LEVEL` for none. Values of one seed share sources and are dependent; those of one figure in
different seeds are not.

Reference: Holm, A simple sequentially rejective multiple test procedure, Scand. J. Statist. 6 (1979) 65.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from errormotion.arrays import Array

__all__ = ["LEVEL", "NOMINAL", "PART", "SEEDS", "Verdict", "holm", "verdict"]

NOMINAL = 0.95
"""Share of the intervals that contain the truth."""
PART = 0.02
"""Largest deviation of the share of all intervals."""
LEVEL = 0.01
"""Probability that the test of the single figures rejects correct intervals."""
SEEDS = 500
"""Independent seeds; 200 where one takes more than 10 s."""


@dataclass(frozen=True)
class Verdict:
    """Whether intervals hold the truth as often as stated.

    Attributes
    ----------
    seeds, figures : int
        Number of seeds, and of figures with intervals.
    pooled : float
        Share of all intervals that contain the truth.
    worst : str
        The figure that contradicts most.
    share : float
        Its share.
    probability : float
        Of such a share in at least one of the figures, if all intervals are correct.
    enough : bool
        Whether there are as many seeds as the rule asks for.
    """

    seeds: int
    figures: int
    pooled: float
    worst: str
    share: float
    probability: float
    enough: bool

    @property
    def met(self) -> bool:
        """Whether the rule is met."""
        return self.enough and abs(self.pooled - NOMINAL) <= PART and self.probability >= LEVEL

    def __str__(self) -> str:
        """Return the verdict with its reasons."""
        found = (
            f"{self.pooled:.1%} of {self.figures} figures over {self.seeds} seeds; "
            f"{self.worst} {self.share:.1%} (p = {self.probability:.2g})"
        )
        return f"{found}: {'met' if self.met else 'not met' if self.enough else 'too few seeds'}"


def verdict(held: Array, names: Sequence[str] | None = None, *, seeds: int = SEEDS) -> Verdict:
    """Return whether intervals of 95 % contain the truth as often as they state.

    Parameters
    ----------
    held : ndarray, (seed, figure)
        1 where an interval contains the truth, 0 where it does not, NaN where there is none.
    names : sequence of str, (figure,), optional
    seeds : int
        Number that is required.
    """
    held = np.asarray(held, dtype=float)
    known = np.isfinite(held)
    count = known.sum(axis=0)
    used = np.flatnonzero(count)
    if not used.size:
        raise ValueError("verdict: expected intervals; found none")
    hits = np.where(known, held, 0.0).sum(axis=0).astype(int)
    adjusted = holm(np.array([_probability(int(hits[k]), int(count[k])) for k in used]))
    shares = hits[used] / count[used]
    worst = int(np.lexsort((shares, adjusted))[0])
    return Verdict(
        seeds=len(held),
        figures=used.size,
        pooled=float(hits.sum() / count.sum()),
        worst=names[used[worst]] if names is not None else f"figure {used[worst] + 1}",
        share=float(shares[worst]),
        probability=float(adjusted[worst]),
        enough=len(held) >= seeds,
    )


def holm(probability: Array) -> Array:
    """Return probabilities (n,) that are adjusted for their number by Holm: ``max_(j <= i) (n - j) p_(j)``."""
    order = np.argsort(probability)
    n = len(probability)
    found = np.empty(n)
    found[order] = np.minimum(np.maximum.accumulate((n - np.arange(n)) * probability[order]), 1.0)
    return found


@lru_cache(maxsize=4096)
def _probability(hits: int, count: int) -> float:
    from scipy.stats import binomtest

    return float(binomtest(hits, count, NOMINAL).pvalue)
