"""Parts of the targets' uncertainty: their readings, and sources that all targets share.

The effects of the sources are one array over source, target and freedom, as in an error dataset. It is filled in
blocks, so that no other array is as large.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array
from errormotion.methods.multilateration.network.model import directions

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from errormotion.methods.multilateration.identification.expansion import Shared
    from errormotion.methods.multilateration.network.network import Network

BLOCK = 16384
"""Number of targets that are computed at a time."""
READINGS = "stations"
"""Group of the sources by which the noise of the tracker acts on all targets through the stations."""
REPEATABILITY = "repeatability"
UNEXPLAINED = "unexplained scatter"


@dataclass(frozen=True)
class Scatter:
    """Standard deviation of a reading by cause, m; the total is the root sum of squares.

    Attributes
    ----------
    tracker, machine, unexplained : float
    """

    tracker: float
    machine: float = 0.0
    unexplained: float = 0.0

    @property
    def total(self) -> float:
        """Standard deviation of the reading, m."""
        return float(np.sqrt(self.tracker**2 + self.machine**2 + self.unexplained**2))

    @property
    def shares(self) -> dict[str, float]:
        """Share of each group in the variance, of groups that contribute."""
        parts = {READINGS: self.tracker, REPEATABILITY: self.machine, UNEXPLAINED: self.unexplained}
        return {group: (part / self.total) ** 2 for group, part in parts.items() if part > 0}


@dataclass(frozen=True)
class Parts:
    """Uncertainty of the targets.

    Attributes
    ----------
    own : ndarray (m, 3, 3)
        Independent part, by the readings of the target, m^2; NaN if unknown.
    influence : ndarray (source, m, 6)
        Effect of one standard uncertainty of each shared source, m; rotations NaN.
    names, groups : list of str
        Of the sources.
    stations : int
        Number of the sources, the first ones, that are parts of the stations' covariance.
    """

    own: Array
    influence: Array
    names: list[str]
    groups: list[str]
    stations: int

    def covariance(self, by_readings: Array, factor: float) -> Array:
        """Return the total covariance (m, 6, 6): that by readings (m, 3, 3) times ``factor``, and by other sources."""
        C = np.full((len(by_readings), 6, 6), np.nan)
        for part in blocks(len(by_readings)):
            F = self.influence[self.stations :, part, :3]
            C[part, :3, :3] = factor * by_readings[part] + np.einsum("sta,stb->tab", F, F)
        return C


def blocks(count: int) -> Iterator[slice]:
    """Yield the blocks of a number of targets."""
    for first in range(0, count, BLOCK):
        yield slice(first, min(first + BLOCK, count))


def parts(
    network: Network,
    factor: float,
    scatter: Scatter,
    scales: Sequence[tuple[str, str, float]],
    lengths: Array,
    shared: Sequence[Shared],
) -> Parts:
    """Return the parts of the targets' uncertainty.

    Parameters
    ----------
    network : Network
    factor : float
        Ratio of the standard deviation of a reading to that of the network's weights.
    scatter : Scatter
        Parts of this standard deviation.
    scales : sequence of (name, group, relative standard uncertainty)
        Of all lengths.
    lengths : ndarray (n, m)
        m.
    shared : sequence of Shared
        Additional sources.
    """
    network, k = _drift_first(network), len(network.extra)
    m, p = len(network.target), network.datum.factor.shape[1] - k
    shares = scatter.shares
    names = [f"{READINGS}.{i}" if len(shares) == 1 else f"{READINGS}.{i} {group}" for group in shares for i in range(p)]
    names += [f"{READINGS}.{i} drift" for i in range(k)]
    groups = [group for group in shares for _ in range(p)] + ["drift"] * k
    first = len(names)
    names += [name for name, _, _ in scales] + [source.name for source in shared]
    groups += [group for _, group, _ in scales] + [source.group for source in shared]
    own, influence = np.empty((m, 3, 3)), np.full((len(names), m, 6), np.nan)
    changes = ([lengths] if scales else []) + [source.change for source in shared]
    moved = responses(network, changes)
    for part in blocks(m):
        D, F, _ = network.blocks(part)
        own[part] = factor**2 * D
        for number, share in enumerate(shares.values()):
            rows = slice(number * p, (number + 1) * p)
            influence[rows, part, :3] = factor * np.sqrt(share) * F[..., k:].transpose(2, 0, 1)
        influence[first - k : first, part, :3] = factor * F[..., :k].transpose(2, 0, 1)
        if changes:
            effect = moved.of(part)
            for i, (_, _, relative) in enumerate(scales):
                influence[first + i, part, :3] = relative * effect[0]
            influence[first + len(scales) :, part, :3] = effect[bool(scales) :]
    influence[:, np.isnan(own[:, 0, 0])] = np.nan
    return Parts(own, influence, names, groups, first)


def _drift_first(network: Network) -> Network:
    """Return the network with the independent parts of its stations rotated, so that only the first depend on drift.

    The first parts are the uncertainty of the drift with its effect on the stations; the others are the uncertainty
    with known drift.
    """
    if not len(network.extra):
        return network
    datum = network.datum
    rotation = np.linalg.qr(datum.factor[4 * len(network.station) :].T, mode="complete")[0]
    return replace(network, datum=replace(datum, factor=datum.factor @ rotation, shift=datum.shift @ rotation))


@dataclass(frozen=True)
class Responses:
    """Displacements of targets by changes of the readings."""

    network: Network
    changes: Sequence[Array]
    gradient: Array
    shift: Array

    def of(self, part: slice) -> Array:
        """Return the displacements (change, t, 3) of some targets, m."""
        alone, (_, F, G) = _alone(self.network, self.changes, part)
        return np.asarray(
            alone
            + np.einsum("tap,cp->cta", F, self.gradient @ self.network.datum.factor)
            - np.einsum("tag,cg->cta", G, self.shift)
        )


def responses(network: Network, changes: Sequence[Array]) -> Responses:
    """Return the displacements of targets by changes (n, m) of the readings, m, to first order, in blocks."""
    n, further = len(network.station), len(network.extra)
    gradient, shift = np.zeros((len(changes), 4 * n + further)), np.zeros((len(changes), 6))
    for part in blocks(len(network.target)) if len(changes) else ():
        alone, (_, _, G) = _alone(network, changes, part)
        used = np.isfinite(network.target_covariance[part, 0, 0])
        e = np.nan_to_num(directions(network.target[part], network.stations))
        w2 = np.where(used, network.weight[:, part] ** 2, 0.0)
        for c, change in enumerate(changes):
            rest = w2 * (_used(network, change, part) - np.einsum("jta,ta->jt", e, alone[c]))
            by_place = -np.einsum("jt,jta->ja", rest, e)
            gradient[c, : 4 * n] += np.concatenate([by_place, -rest.sum(axis=1)[:, None]], axis=1).ravel()
            if further:
                gradient[c, 4 * n :] += np.einsum("kjt,jt->k", network.extra[:, :, part], rest)
        carries = network.in_datum[part]  # targets to which the datum is fitted
        shift += np.einsum("tag,cta->cg", G[carries], alone[:, carries])
    return Responses(network, changes, gradient, shift @ network.datum.H.T)


def _used(network: Network, change: Array, part: slice) -> Array:
    """Return a change of the readings, m; 0 for readings that are not used."""
    used = np.isfinite(network.target_covariance[part, 0, 0])
    return np.where((network.weight[:, part] > 0) & used, change[:, part], 0.0)


def _alone(network: Network, changes: Sequence[Array], part: slice) -> tuple[Array, tuple[Array, Array, Array]]:
    """Return displacements (change, t, 3) of the targets with fixed stations, and the network's blocks of them."""
    own, F, G = network.blocks(part)
    e = directions(network.target[part], network.stations)
    w = network.weight[:, part]
    alone = np.empty((len(changes), len(own), 3))
    for c, change in enumerate(changes):
        right = np.einsum("jt,jta->ta", w**2 * _used(network, change, part), np.nan_to_num(e))
        alone[c] = np.einsum("tab,tb->ta", own, right)
    alone[:, np.isnan(own[:, 0, 0])] = 0.0
    return alone, (own, F, G)
