"""How well the machine comes back to a place, and what of the readings' scatter that explains.

One tracker is set up in turn, and the machine comes to every target anew for each station. Visit v of target i misses
the mean place u_i by delta_v, of standard deviation sigma_r in each coordinate, and the reading changes by

    |u_i + delta_v - U_j| - |u_i - U_j| = e_ij . delta_v,   of variance  e' sigma_r^2 1 e = sigma_r^2,

whichever way the beam goes. Visits are independent, so a reading scatters by sigma^2 = sigma_t^2 + sigma_r^2, with the
tracker's sigma_t, and stays white. Where all stations read at one moment, delta is the same for all: it moves the
target, no residual shows it, and its sigma_r^2 is added to the covariance of every target.

What returns differ by tells sigma^2, with f freedoms to a variance of 2 sigma^4 / f. So do the residuals of the
network; both are weighed by their variances.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy import stats

from errormotion.arrays import Array
from errormotion.methods.multilateration.identification.uncertainty import Scatter

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from errormotion.methods.multilateration.identification.drift import Drift
    from errormotion.methods.multilateration.network.network import Network

    Array = Array

FALSE_ALARM = 1e-3
"""Chance at which sound readings are said to contradict what is stated."""


@dataclass(frozen=True)
class Repeatability:
    """Of the machine.

    Attributes
    ----------
    variance : float
        sigma_r^2 of each coordinate, m^2; 0 where nothing is known of it.
    spread : float
        Standard uncertainty of the variance, m^2.
    source : str
        ``settings``, ``returns``, both, ``residuals``, or nothing where it is not known.
    """

    variance: float
    spread: float
    source: str

    @property
    def value(self) -> float:
        """sigma_r, m; NaN where it is not known."""
        return float(np.sqrt(self.variance)) if self.source else float("nan")

    @property
    def uncertainty(self) -> float:
        """Standard uncertainty of sigma_r, m; of the interval's half width where sigma_r is near 0."""
        if not self.source:
            return float("nan")
        low, high = (np.sqrt(max(self.variance + sign * self.spread, 0.0)) for sign in (-1, 1))
        return float(high - low) / 2


def stated(value: float | None, uncertainty: float) -> Repeatability:
    """Return what settings say, m."""
    if value is None:
        return Repeatability(0.0, 0.0, "")
    return Repeatability(value**2, 2 * value * uncertainty + uncertainty**2, "settings")


def from_returns(before: Repeatability, drift: Drift, tracker: float, used: float, notes: list[str]) -> Repeatability:
    """Return the repeatability after returns were seen within set-ups.

    Parameters
    ----------
    before : Repeatability
        As stated.
    drift : Drift
        Whose ``square`` and ``freedom`` are what the returns scatter, whitened with ``used``.
    tracker, used : float
        Standard deviation of a reading, m: the tracker's, and the one that whitened.
    notes : list of str
        Added to.
    """
    if not drift.freedom:
        return before
    total = used**2 * drift.square / drift.freedom
    found = Repeatability(max(total - tracker**2, 0.0), total * float(np.sqrt(2 / drift.freedom)), "returns")
    return _joined(before, found, drift.freedom, tracker, notes)


def from_places(
    before: Repeatability, network: Network, place: NDArray[np.intp], factor: float, notes: list[str]
) -> Repeatability:
    """Return the repeatability after returns were seen by all stations at once: by how much their places differ."""
    known = np.flatnonzero(np.isfinite(network.target[:, 0]))
    known = known[np.argsort(place[known], kind="stable")]
    groups = [g for g in np.split(known, np.flatnonzero(np.diff(place[known])) + 1) if len(g) > 1]
    freedom = 3 * sum(len(g) - 1 for g in groups)
    if not freedom:
        return before
    own = factor**2 * network.blocks(np.concatenate(groups))[0]
    tracker = float(np.sqrt(np.trace(own, axis1=1, axis2=2).mean() / 3))
    square = sum(float(np.sum((network.target[g] - network.target[g].mean(axis=0)) ** 2)) for g in groups)
    total = square / freedom
    found = Repeatability(max(total - tracker**2, 0.0), total * float(np.sqrt(2 / freedom)), "returns")
    return _joined(before, found, freedom, tracker, notes)


def explained(
    before: Repeatability, network: Network, tracker: float, *, raise_it: bool, together: bool
) -> tuple[float, Scatter, Repeatability]:
    """Return by how much the readings' standard deviation is raised, its parts, and the repeatability, residuals seen.

    Parameters
    ----------
    before : Repeatability
        That the network's weights were made of, unless ``together``.
    network : Network
    tracker : float
        Noise of the tracker's readings, m.
    raise_it : bool
        Where readings scatter more than all that is known explains.
    together : bool
        All stations read at one moment: no residual shows repeatability.
    """
    machine = 0.0 if together else before.variance
    told, freedom = tracker**2 + machine, network.freedom
    square = network.sigma0**2
    excess = freedom > 0 and beyond(network, 0.0 if together else before.spread / told)
    if excess and raise_it:
        unexplained = float(np.sqrt(told * (square - 1)))
        return network.sigma0, Scatter(tracker, float(np.sqrt(machine)), unexplained), before
    if together or before.spread == 0 or freedom <= 0 or excess:
        return 1.0, Scatter(tracker, float(np.sqrt(machine))), before
    weight = np.array([(told / before.spread) ** 2, freedom / 2])
    total = max(told * float(weight @ (1.0, square)) / float(weight.sum()), tracker**2)
    found = Repeatability(total - tracker**2, total / float(np.sqrt(weight.sum())), f"{before.source} and residuals")
    return float(np.sqrt(total / told)), Scatter(tracker, float(np.sqrt(found.variance))), found


def beyond(network: Network, relative: float) -> bool:
    """Whether a network scatters more than its noise explains, whose variance is known to ``relative``."""
    freedom = network.freedom
    # The sum of squares over a variance that is known from f' = 2 / relative^2 freedoms itself.
    if relative > 0:
        return bool(network.sigma0**2 > stats.f.ppf(1 - FALSE_ALARM, freedom, max(2 / relative**2, 1.0)))
    return bool(network.sigma0**2 * freedom > stats.chi2.ppf(1 - FALSE_ALARM, freedom))


def _joined(
    before: Repeatability, found: Repeatability, freedom: int, tracker: float, notes: list[str]
) -> Repeatability:
    """Return what two sources tell together; a note where they contradict one another."""
    if not before.source:
        return found
    told = before.variance + tracker**2
    apart = abs(found.variance - before.variance)
    chance = 2 * told**2 / freedom + before.spread**2
    if apart > float(stats.norm.isf(FALSE_ALARM / 2)) * np.sqrt(chance):
        cause = " Is there a drift that is not steady?" if found.variance > before.variance else ""
        notes.append(
            f"Returns show a repeatability of {found.value * 1e6:.2g} um, the settings state "
            f"{before.value * 1e6:.2g} um (repeatability, repeatability_uncertainty).{cause}"
        )
    if before.spread == 0:
        return before
    weight = np.array([before.spread, found.spread]) ** -2.0
    variance = float(weight @ (before.variance, found.variance) / weight.sum())
    return Repeatability(variance, float(weight.sum() ** -0.5), "settings and returns")
