"""Parts of the targets' uncertainty: their own readings, and sources that all share.

Sources are kept as one array over source, target and freedom, which is what an error dataset holds. It is filled block
by block: nothing else is as large.
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
"""Targets at a time."""
READINGS = "stations"
"""Group of what the tracker's own noise does to all targets through the stations."""
REPEATABILITY = "repeatability"
UNEXPLAINED = "unexplained scatter"


@dataclass(frozen=True)
class Scatter:
    """Standard deviation of a reading by cause, m: root sum of squares is that of the reading.

    Attributes
    ----------
    tracker, machine, unexplained : float
    """

    tracker: float
    machine: float = 0.0
    unexplained: float = 0.0

    @property
    def total(self) -> float:
        """Of all, m."""
        return float(np.sqrt(self.tracker**2 + self.machine**2 + self.unexplained**2))

    @property
    def shares(self) -> dict[str, float]:
        """Share of each group in the variance; only those that have one."""
        parts = {READINGS: self.tracker, REPEATABILITY: self.machine, UNEXPLAINED: self.unexplained}
        return {group: (part / self.total) ** 2 for group, part in parts.items() if part > 0}


@dataclass(frozen=True)
class Parts:
    """Uncertainty of the targets.

    Attributes
    ----------
    own : ndarray (m, 3, 3)
        By a target's own readings, m^2; NaN where it is not known.
    influence : ndarray (source, m, 6)
        What one standard uncertainty of each shared source does, m; rotations NaN.
    names, groups : list of str
        Of the sources.
    stations : int
        Number of the sources that are parts of the stations' covariance; they come first.
    """

    own: Array
    influence: Array
    names: list[str]
    groups: list[str]
    stations: int

    def covariance(self, given: Array, factor: float) -> Array:
        """Return the total covariance (m, 6, 6): ``given`` (m, 3, 3) of the readings times ``factor``, and the rest."""
        C = np.full((len(given), 6, 6), np.nan)
        for part in blocks(len(given)):
            F = self.influence[self.stations :, part, :3]
            C[part, :3, :3] = factor * given[part] + np.einsum("sta,stb->tab", F, F)
        return C


def blocks(count: int) -> Iterator[slice]:
    """Yield slices of so many targets."""
    for first in range(0, count, BLOCK):
        yield slice(first, min(first + BLOCK, count))


def parts(
    network: Network,
    factor: float,
    scatter: Scatter,
    scales: Sequence[tuple[str, str, float]],
    stretched: Array,
    shared: Sequence[Shared],
) -> Parts:
    """Return the parts of the targets' uncertainty.

    Parameters
    ----------
    network : Network
    factor : float
        Standard deviation of a reading over that of the network's weights.
    scatter : Scatter
        What that is made of.
    scales : sequence of (name, group, relative standard uncertainty)
        Of all lengths.
    stretched : ndarray (n, m)
        The lengths, m.
    shared : sequence of Shared
        Further sources.
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
    changes = ([stretched] if scales else []) + [source.change for source in shared]
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
    """Return the network with the independent parts of its stations turned: only the first have to do with drift.

    What the first do is what is not known of the drift, with all that the stations make of it; what the others do
    would be there with the drift known.
    """
    if not len(network.extra):
        return network
    datum = network.datum
    turn = np.linalg.qr(datum.factor[4 * len(network.station) :].T, mode="complete")[0]
    return replace(network, datum=replace(datum, factor=datum.factor @ turn, shift=datum.shift @ turn))


@dataclass(frozen=True)
class Responses:
    """How targets move when readings change, for any of them."""

    network: Network
    changes: Sequence[Array]
    gradient: Array
    shift: Array

    def of(self, part: slice) -> Array:
        """Return the moves (change, t, 3) of some targets, m."""
        alone, (_, F, G) = _alone(self.network, self.changes, part)
        return np.asarray(
            alone
            + np.einsum("tap,cp->cta", F, self.gradient @ self.network.datum.factor)
            - np.einsum("tag,cg->cta", G, self.shift)
        )


def responses(network: Network, changes: Sequence[Array]) -> Responses:
    """Return how targets move by changes (n, m) of the readings, m; first order, in blocks."""
    n, further = len(network.station), len(network.extra)
    gradient, shift = np.zeros((len(changes), 4 * n + further)), np.zeros((len(changes), 6))
    for part in blocks(len(network.target)) if len(changes) else ():
        alone, (_, _, G) = _alone(network, changes, part)
        used = np.isfinite(network.target_covariance[part, 0, 0])
        e = np.nan_to_num(directions(network.target[part], network.stations))
        w2 = np.where(used, network.weight[:, part] ** 2, 0.0)
        for c, change in enumerate(changes):
            rest = w2 * (_seen(network, change, part) - np.einsum("jta,ta->jt", e, alone[c]))
            by_place = -np.einsum("jt,jta->ja", rest, e)
            gradient[c, : 4 * n] += np.concatenate([by_place, -rest.sum(axis=1)[:, None]], axis=1).ravel()
            if further:
                gradient[c, 4 * n :] += np.einsum("kjt,jt->k", network.extra[:, :, part], rest)
        carries = network.carries[part]  # the datum is fitted to these
        shift += np.einsum("tag,cta->cg", G[carries], alone[:, carries])
    return Responses(network, changes, gradient, shift @ network.datum.H.T)


def _seen(network: Network, change: Array, part: slice) -> Array:
    """Return what of a change is in readings that are in use, m."""
    used = np.isfinite(network.target_covariance[part, 0, 0])
    return np.where((network.weight[:, part] > 0) & used, change[:, part], 0.0)


def _alone(network: Network, changes: Sequence[Array], part: slice) -> tuple[Array, tuple[Array, Array, Array]]:
    """Return moves (change, t, 3) of the targets with the stations held, and the network's blocks of them."""
    own, F, G = network.blocks(part)
    e = directions(network.target[part], network.stations)
    w = network.weight[:, part]
    alone = np.empty((len(changes), len(own), 3))
    for c, change in enumerate(changes):
        right = np.einsum("jt,jta->ta", w**2 * _seen(network, change, part), np.nan_to_num(e))
        alone[c] = np.einsum("tab,tb->ta", own, right)
    alone[:, np.isnan(own[:, 0, 0])] = 0.0
    return alone, (own, F, G)
