"""The values of one figure over time, with their stated covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from errormotion.arrays import Array

YEAR = 365.25 * 86400.0
"""Duration of a year, s."""


@dataclass(frozen=True)
class Series:
    """Values of n runs, the oldest first.

    Attributes
    ----------
    time : ndarray, (n,)
        Times since 1970 (UTC), s.
    value, u : ndarray, (n,)
        Values and stated standard uncertainties with all sources, SI.
    influence : ndarray, (s, n)
        Signed effect of one standard uncertainty of each source that several runs share; included in u.
    identities : sequence of str
        Identity of each of these sources.
    runs, names : sequence of str
        Name of the run folder, and name of the figure in this run.
    unit : str
        SI unit.
    versions : sequence of str
        Method and version of each run; empty where unknown.
    """

    time: Array
    value: Array
    u: Array
    influence: Array = field(default_factory=lambda: np.zeros((0, 0)))
    identities: Sequence[str] = ()
    runs: Sequence[str] = ()
    names: Sequence[str] = ()
    unit: str = "m"
    versions: Sequence[str] = ()

    @property
    def size(self) -> int:
        """Number of values."""
        return int(self.value.size)

    @property
    def years(self) -> Array:
        """Times in years since the first run, (n,)."""
        years: Array = (self.time - self.time[:1]) / YEAR
        return years

    @cached_property
    def covariance(self) -> Array:
        """Stated covariance of the values, (n, n); a shared source is fully correlated between runs."""
        F = self.influence if len(self.identities) else np.zeros((0, self.size))
        own = np.maximum(self.u**2 - (F**2).sum(axis=0), (1e-6 * self.u) ** 2)
        V: Array = np.diag(own) + F.T @ F
        return V
