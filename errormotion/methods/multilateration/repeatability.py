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

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import ndtri

from errormotion.arrays import Array
from errormotion.estimation.variance import Verdict
from errormotion.methods.multilateration.model import XYZ
from errormotion.plugins import RandomSource, TrialModel, replaced

if TYPE_CHECKING:
    import xarray as xr
    from numpy.typing import NDArray

    from errormotion.estimation.variance import Scatter
    from errormotion.measurement.observed import Solved
    from errormotion.methods.multilateration.drift import Drift

FALSE_ALARM = 1e-3
"""Probability that returns with the stated repeatability are reported as contradicting it."""
NEGLIGIBLE = 1e-6
"""Variance, relative to that of the tracker, that is no cause of its own."""
REPEATABILITY, UNEXPLAINED = "repeatability", "unexplained scatter"


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

    def freedom(self, tracker: float) -> float:
        """Return the degrees of freedom of the variance of a reading, with the noise of the tracker, m."""
        return 2 * ((self.variance + tracker**2) / self.spread) ** 2 if self.spread > 0 else np.inf

    def with_residuals(self, tracker: float, scatter: Scatter) -> Repeatability:
        """Return the repeatability with what the residuals say, if both agree."""
        if not np.isfinite(scatter.freedom) or scatter.verdict is Verdict.MORE or self.spread == 0:
            return self
        total = (self.variance + tracker**2) * scatter.factor
        spread = total * float(np.sqrt(2 / scatter.freedom))
        return Repeatability(max(total - tracker**2, 0.0), spread, (*self.sources, "residuals"))


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
    return _combined(before, used**2 * drift.square / drift.freedom, drift.freedom, tracker, notes)


def from_positions(
    before: Repeatability, target: Array, own: Array, position: NDArray[np.intp], notes: list[str]
) -> Repeatability:
    """Return the repeatability, updated with the positions of returns that all stations read at the same time.

    Targets are (m, 3), m, NaN if unknown, with covariances (m, 3, 3) by their own readings; those with the same number
    in ``position`` (m,) are returns.
    """
    known = np.flatnonzero(np.isfinite(target[:, 0]))
    known = known[np.argsort(position[known], kind="stable")]
    groups = [g for g in np.split(known, np.flatnonzero(np.diff(position[known])) + 1) if len(g) > 1]
    freedom = 3 * sum(len(g) - 1 for g in groups)
    if not freedom:
        return before
    tracker = float(np.sqrt(np.trace(own[np.concatenate(groups)], axis1=1, axis2=2).mean() / 3))
    square = sum(float(np.sum((target[g] - target[g].mean(axis=0)) ** 2)) for g in groups)
    return _combined(before, square / freedom, freedom, tracker, notes)


def shares(before: float, machine: float, tracker: float, solved: Solved) -> dict[str, float]:
    """Return the share of each cause in the variance of a reading.

    Variances by the machine, m^2, are those before the fit and with its residuals; ``tracker`` is a noise, m.
    """
    rest = (tracker**2 + before) * solved.scatter.factor - tracker**2 - machine
    rounding = 0.0 if solved.rounding is None else float(np.median(np.square(solved.rounding.sd)))
    parts = {"stations": tracker**2, REPEATABILITY: machine, UNEXPLAINED: rest, "rounding": rounding}
    kept = {name: part for name, part in parts.items() if part > NEGLIGIBLE * tracker**2}
    return {name: part / sum(kept.values()) for name, part in kept.items()}


def _combined(before: Repeatability, total: float, freedom: int, tracker: float, notes: list[str]) -> Repeatability:
    """Return the weighted mean of the stated repeatability and that of returns, whose variance is ``total``, m^2.

    A note is added if they contradict one another.
    """
    estimated = Repeatability(max(total - tracker**2, 0.0), total * float(np.sqrt(2 / freedom)), ("returns",))
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


def displaced(trial_model: TrialModel, errors: xr.Dataset) -> TrialModel:
    """Return sources with the repeatability of positions that all stations read at the same time."""
    sd = float(errors["repeatability"])

    def act(drawn: xr.Dataset, generator: np.random.Generator) -> xr.Dataset:
        shift = sd * generator.standard_normal((3, drawn.sizes["target"]))
        return replaced(drawn, {name: drawn[name].values + d for name, d in zip(XYZ, shift, strict=True)})

    return replace(trial_model, sources={**trial_model.sources, REPEATABILITY: RandomSource(act=act, own=True)})
