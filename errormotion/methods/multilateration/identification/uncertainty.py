"""Parts of the targets' uncertainty: their readings, and sources that all targets share.

The effects of the sources are one array over source, target and freedom, as in an error dataset.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array
from errormotion.methods.multilateration.network.model import AIR, DRIFT, SCALES, STATIONS, TRACKER

if TYPE_CHECKING:
    from errormotion.methods.multilateration.network.network import Network

READINGS = STATIONS
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
    covariance : ndarray (m, 6, 6)
        Total, m^2.
    names, groups : list of str
        Of the sources.
    """

    own: Array
    influence: Array
    covariance: Array
    names: list[str]
    groups: list[str]


def parts(network: Network, factor: float, scatter: Scatter) -> Parts:
    """Return the parts of the targets' uncertainty.

    Parameters
    ----------
    network : Network
    factor : float
        Ratio of the standard deviation of a reading to that of the network's weights. The drift follows from readings
        as well.
    scatter : Scatter
        Parts of this standard deviation.
    """
    found = network.moved.errors.sources[: len(network.errors.sources)]
    readings = [each for each in found if each.group == READINGS]
    shares = scatter.shares
    names, groups, effects = [], [], []
    for group, share in shares.items():
        names += [f"{READINGS}.{i}" if len(shares) == 1 else f"{READINGS}.{i} {group}" for i in range(len(readings))]
        groups += [group] * len(readings)
        effects += [(each.effect, factor * np.sqrt(share)) for each in readings]
    for each in found:
        if each.group != READINGS:
            names.append(each.name if each.group != DRIFT else f"{READINGS}.{len(names)} drift")
            groups.append(each.group)
            effects.append((each.effect, factor if each.group == DRIFT else 1.0))
    influence = np.full((len(names), len(network.nominal), 6), np.nan)
    for k, (effect, size) in enumerate(effects):
        np.multiply(effect, size, out=influence[k, :, :3])
    influence[:, ~network.determined] = np.nan
    covariance = np.full((len(network.nominal), 6, 6), np.nan)
    covariance[:, :3, :3] = factor**2 * network.target_covariance
    for k, group in enumerate(groups):
        if group in (AIR, TRACKER, SCALES):
            F = influence[k, :, :3]
            covariance[:, :3, :3] += F[:, :, None] * F[:, None]
    return Parts(factor**2 * network.errors.own, influence, covariance, names, groups)
