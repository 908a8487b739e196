"""Repeatability of the machine, and its contribution to the scatter of the readings.

One tracker is set up at the stations in turn, and the machine moves to every target again for each station. Visit v to
target i deviates from the mean position u_i by delta_v, of standard deviation sigma_r in each coordinate, and the
reading changes by

    |u_i + delta_v - U_j| - |u_i - U_j| = e_ij . delta_v,   of variance  e' sigma_r^2 1 e = sigma_r^2,

for any direction of the beam. Visits are independent, so that a reading has the variance sigma_t^2 + sigma_r^2, with
the tracker's sigma_t, and readings are uncorrelated. If all stations are read at the same time, delta is common to all:
it displaces the target without any effect on residuals, and sigma_r^2 is added to the covariance of every target.

The differences of returns, with f degrees of freedom, estimate sigma^2 with a variance of 2 sigma^4 / f. The residuals
of the network estimate it as well; both are weighted by their variances.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtri, fdtri, ndtri

from errormotion.methods.multilateration.identification.uncertainty import Scatter

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from errormotion.methods.multilateration.identification.drift import Drift
    from errormotion.methods.multilateration.network.network import Network

FALSE_ALARM = 1e-3
"""Probability that readings with the stated repeatability are reported as contradicting it."""


@dataclass(frozen=True)
class Repeatability:
    """Repeatability of the machine.

    Attributes
    ----------
    variance : float
        sigma_r^2 of each coordinate, m^2; 0 if unknown.
    spread : float
        Standard uncertainty of the variance, m^2.
    sources : tuple of str
        Among ``settings``, ``returns`` and ``residuals``; empty if it is unknown.
    """

    variance: float
    spread: float
    sources: tuple[str, ...] = ()

    @property
    def source(self) -> str:
        """Sources as text."""
        return " and ".join(self.sources)

    @property
    def value(self) -> float:
        """sigma_r, m; NaN if unknown."""
        return float(np.sqrt(self.variance)) if self.sources else float("nan")

    @property
    def uncertainty(self) -> float:
        """Standard uncertainty of sigma_r, m, as the half width of its interval."""
        if not self.sources:
            return float("nan")
        low, high = (np.sqrt(max(self.variance + sign * self.spread, 0.0)) for sign in (-1, 1))
        return float(high - low) / 2


def stated(value: float | None, uncertainty: float) -> Repeatability:
    """Return the repeatability of the settings, m."""
    if value is None:
        return Repeatability(0.0, 0.0)
    return Repeatability(value**2, 2 * value * uncertainty + uncertainty**2, ("settings",))


def from_returns(before: Repeatability, drift: Drift, tracker: float, used: float, notes: list[str]) -> Repeatability:
    """Return the repeatability, updated with the returns within set-ups.

    Parameters
    ----------
    before : Repeatability
        The stated one.
    drift : Drift
        ``square`` and ``freedom`` are those of the returns, whitened with ``used``.
    tracker, used : float
        Standard deviation of a reading, m: of the tracker, and that used for whitening.
    notes : list of str
        To which remarks are appended.
    """
    if not drift.freedom:
        return before
    total = used**2 * drift.square / drift.freedom
    estimated = Repeatability(max(total - tracker**2, 0.0), total * float(np.sqrt(2 / drift.freedom)), ("returns",))
    return _combined(before, estimated, drift.freedom, tracker, notes)


def from_positions(
    before: Repeatability, network: Network, position: NDArray[np.intp], factor: float, notes: list[str]
) -> Repeatability:
    """Return the repeatability, updated with the positions of returns that all stations read at the same time."""
    known = np.flatnonzero(np.isfinite(network.target[:, 0]))
    known = known[np.argsort(position[known], kind="stable")]
    groups = [g for g in np.split(known, np.flatnonzero(np.diff(position[known])) + 1) if len(g) > 1]
    freedom = 3 * sum(len(g) - 1 for g in groups)
    if not freedom:
        return before
    own = factor**2 * network.fit.normal.own[np.concatenate(groups)]
    tracker = float(np.sqrt(np.trace(own, axis1=1, axis2=2).mean() / 3))
    square = sum(float(np.sum((network.target[g] - network.target[g].mean(axis=0)) ** 2)) for g in groups)
    total = square / freedom
    estimated = Repeatability(max(total - tracker**2, 0.0), total * float(np.sqrt(2 / freedom)), ("returns",))
    return _combined(before, estimated, freedom, tracker, notes)


def explained(
    before: Repeatability, network: Network, tracker: float, *, increase: bool, together: bool
) -> tuple[float, Scatter, Repeatability]:
    """Return the factor for the readings' standard deviation, its parts, and the repeatability with the residuals.

    Parameters
    ----------
    before : Repeatability
        Contained in the network's weights, unless ``together``.
    network : Network
    tracker : float
        Noise of the tracker's readings, m.
    increase : bool
        Whether to increase the standard deviation if the readings scatter more than expected.
    together : bool
        Whether all stations are read at the same time, so that residuals do not depend on the repeatability.
    """
    machine = 0.0 if together else before.variance
    variance, freedom = tracker**2 + machine, network.freedom
    square = network.sigma0**2
    excess = freedom > 0 and exceeds(network, 0.0 if together else before.spread / variance)
    if excess and increase:
        unexplained = float(np.sqrt(variance * (square - 1)))
        return network.sigma0, Scatter(tracker, float(np.sqrt(machine)), unexplained), before
    if together or before.spread == 0 or freedom <= 0 or excess:
        return 1.0, Scatter(tracker, float(np.sqrt(machine))), before
    weight = np.array([(variance / before.spread) ** 2, freedom / 2])
    total = max(variance * float(weight @ (1.0, square)) / float(weight.sum()), tracker**2)
    updated = Repeatability(total - tracker**2, total / float(np.sqrt(weight.sum())), (*before.sources, "residuals"))
    return float(np.sqrt(total / variance)), Scatter(tracker, float(np.sqrt(updated.variance))), updated


def exceeds(network: Network, relative: float) -> bool:
    """Return whether the scatter of a network exceeds its noise, whose variance has the uncertainty ``relative``."""
    freedom = network.freedom
    # The variance of the noise has f' = 2 / relative^2 degrees of freedom.
    if relative > 0:
        return bool(network.sigma0**2 > fdtri(freedom, max(2 / relative**2, 1.0), 1 - FALSE_ALARM))
    return bool(network.sigma0**2 * freedom > chdtri(freedom, FALSE_ALARM))


def _combined(
    before: Repeatability, estimated: Repeatability, freedom: int, tracker: float, notes: list[str]
) -> Repeatability:
    """Return the weighted mean of stated and estimated repeatability, with a note if they contradict one another."""
    if not before.sources:
        return estimated
    variance_of_reading = before.variance + tracker**2
    difference = abs(estimated.variance - before.variance)
    variance_of_difference = 2 * variance_of_reading**2 / freedom + before.spread**2
    if difference > -float(ndtri(FALSE_ALARM / 2)) * np.sqrt(variance_of_difference):
        cause = " Possible cause: a drift that is not linear." if estimated.variance > before.variance else ""
        notes.append(
            f"The repeatability from returns is {estimated.value * 1e6:.2g} um, that of the settings "
            f"{before.value * 1e6:.2g} um (repeatability, repeatability_uncertainty).{cause}"
        )
    if before.spread == 0:
        return before
    weight = np.array([before.spread, estimated.spread]) ** -2.0
    variance = float(weight @ (before.variance, estimated.variance) / weight.sum())
    return Repeatability(variance, float(weight.sum() ** -0.5), ("settings", "returns"))
