"""Estimates of the same errors on one grid, the input of all statistics of a comparison."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array, products


@dataclass(frozen=True)
class Estimate:
    """One estimate of n points with d freedoms each.

    The covariance is block diagonal plus low rank: ``cov(y_i, y_j) = own_i (where i = j) + sum_s F_si F_sj``. An
    unknown value is NaN, and its rows in ``own`` and ``influence`` are NaN.

    Attributes
    ----------
    name : str
        Name of the dataset.
    value : ndarray, (n, d)
        Values, m and rad.
    own : ndarray, (n, d, d)
        Covariance of contributions that are independent between points.
    influence : ndarray, (s, n, d)
        Effect of one standard uncertainty of each source.
    source : tuple of str
        Key of each source; sources with the same key in two estimates are fully correlated.
    """

    name: str
    value: Array
    own: Array
    influence: Array
    source: tuple[str, ...]

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which values are known, (n, d)."""
        return np.isfinite(self.value)

    def covariance(self) -> Array:
        """Return the total covariance at every point, (n, d, d)."""
        total: Array = self.own + products(self.influence)
        return total

    def variance(self) -> Array:
        """Return the total variance of every value, (n, d)."""
        total: Array = np.diagonal(self.own, axis1=1, axis2=2) + np.einsum(
            "sni,sni->ni", self.influence, self.influence
        )
        return total

    def scaled(self, weight: float) -> Estimate:
        """Return the estimate times a number."""
        return replace(self, value=weight * self.value, own=weight**2 * self.own, influence=weight * self.influence)


def difference(a: Estimate, b: Estimate) -> Estimate:
    """Return a minus b; the effect of a source that both share, by its key, is the difference of its effects."""
    keys = tuple(dict.fromkeys((*a.source, *b.source)))
    return Estimate(
        name=f"{a.name} - {b.name}",
        value=a.value - b.value,
        own=a.own + b.own,
        influence=_gathered_difference(a, b, keys),
        source=keys,
    )


def _gathered_difference(a: Estimate, b: Estimate, keys: Sequence[str]) -> Array:
    nothing = np.where(a.known & b.known, 0.0, np.nan)
    found = np.broadcast_to(nothing, (len(keys), *nothing.shape)).copy()
    row_of = {key: k for k, key in enumerate(keys)}
    for estimate, add in ((a, np.add), (b, np.subtract)):
        for key, row in zip(estimate.source, estimate.influence, strict=True):
            add(found[row_of[key]], row, out=found[row_of[key]])
    return found


def gathered(estimate: Estimate, keys: Sequence[str]) -> Array:
    """Return the influence of sources by key, (key, n, d): 0 for a source that is not in the estimate."""
    rows = dict(zip(estimate.source, estimate.influence, strict=True))
    nothing = np.where(estimate.known, 0.0, np.nan)
    return np.array([rows.get(key, nothing) for key in keys]).reshape(len(keys), *estimate.value.shape)


def shared(estimates: Sequence[Estimate]) -> list[str]:
    """Return the keys of the sources of more than one estimate, in order."""
    seen: dict[str, int] = {}
    for estimate in estimates:
        for key in set(estimate.source):
            seen[key] = seen.get(key, 0) + 1
    return [key for key, count in seen.items() if count > 1]
