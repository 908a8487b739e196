"""The noise of the readings of a model: its size, the correlation of neighbours, and rounding.

Each of them makes an uncertainty larger, with a sentence, or the uncertainty is refused as unknown.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import chdtr, chdtri

from errormotion.arrays import Array
from errormotion.datasets.plausibility import of_noise
from errormotion.errors import FitError
from errormotion.estimation.blocks import Noise
from errormotion.estimation.checks import resolution
from errormotion.estimation.checks.correlated import autoregressive, correlated
from errormotion.estimation.checks.resolution import Rounding
from errormotion.estimation.checks.slow_noise import sentence, slow_noise
from errormotion.estimation.components import noise_variance
from errormotion.estimation.derivatives import column
from errormotion.estimation.fit import Fit, fit
from errormotion.estimation.problem import Problem
from errormotion.estimation.robust import scale_about_zero
from errormotion.estimation.variance import Scatter, variance_factor
from errormotion.measurement.observed import Observed

__all__ = [
    "Neighbours",
    "beyond_of",
    "estimated_noise",
    "fitted",
    "has_priors",
    "neighbours_of",
    "rounding_of",
    "scaled",
    "scatter_of",
    "searchable",
    "size_of_noise",
    "steps_of",
]

_STEPS = 10
_FALSE_NOTE = 0.01
"""Probability of a note on a correlation of white noise."""
_FEW = 8.0
"""Independent readings below which the size of a correlated noise is hardly known."""
_NOTHING = 0.03
"""Scatter, relative to a stated noise, below which readings are expected ones and say nothing about their noise."""
_COARSE = 0.5
"""Noise in steps of the scale from which rounding is a part of the scatter."""
_LITTLE = 0.5
"""Degrees of freedom."""
_TOO_GOOD = 1e-6
"""Probability of so small residuals of rounded readings below which they are not rounded."""
_DIGITS = 1e-12
"""Scatter that is due to the digits of floating-point numbers, relative to the largest reading."""
_SAME = 1e-6
"""Relative change of the variance of the noise that ends its estimation."""


def scatter_of(observed: Observed, solution: Fit) -> tuple[Scatter, Fit]:
    """Return what the residuals say about the noise, and the fit with it: another one if it was estimated."""
    priors, stated = has_priors(observed.problem), observed.problem.noise.stated
    estimated: list[Fit] = []

    def estimate() -> tuple[float, float]:
        at, factor, freedom = estimated_noise(solution, refresh=observed.refresh, what=observed.what)
        estimated.append(at)
        return factor, freedom

    scatter = variance_factor(
        solution.chi2,
        solution.freedom,
        stated=stated,
        stated_freedom=observed.problem.noise.freedom,
        increase=observed.noise_increases,
        priors=priors,
        estimate=estimate if priors else None,
        what=observed.what,
        cause=observed.noise_cause,
        size=observed.noise_size,
    )
    larger = not stated or scatter.factor > 1.0
    return scatter, estimated[0] if estimated and larger else solution


@dataclass(frozen=True)
class Neighbours:
    """Correlation of the noise of neighbouring readings, its standard uncertainty, and a sentence."""

    phi: float = 0.0
    u: float = 0.0
    note: str = ""
    doubt: str = ""

    def freedom(self, freedom: float) -> float:
        """Return the degrees of freedom of the variance of a mean, which is proportional to (1 + phi) / (1 - phi).

        ``2 / f' = 2 / f + (d log g / d phi)^2 u(phi)^2`` with ``d log g / d phi = 2 / (1 - phi^2)`` (Satterthwaite).
        """
        return 2.0 / (2.0 / freedom + (2.0 * self.u / (1.0 - self.phi**2)) ** 2) if self.u > 0 else freedom


def neighbours_of(observed: Observed, solution: Fit) -> Neighbours:
    """Return the correlation of the noise along the order of the readings, if there is one."""
    if observed.order is None or solution.freedom < 2:
        return Neighbours()
    if observed.correlation is not None:
        return Neighbours(observed.correlation)
    if solution.problem.noise.stated and solution.chi2 < _NOTHING**2 * solution.freedom:
        return Neighbours()
    along = correlated(_of_unknown_noise(observed, solution), observed.order, observed.series)
    if not along.phi > 0:
        return Neighbours()
    note = doubt = ""
    if along.gain > float(chdtri(1, 2 * _FALSE_NOTE)):
        what = f"The noise of neighbouring {observed.what.removeprefix('the ')} is correlated ({along.phi:.2f})"
        if along.independent < _FEW and not observed.problem.noise.stated:
            doubt = (
                f"{what}: they are worth {along.independent:.2g} independent ones. Their noise is hardly known, and "
                "the uncertainties may be too small. State the noise, or measure more of them."
            )
        else:
            note = f"{what}; the uncertainties contain it."
    return Neighbours(along.phi, along.u_phi, note, doubt)


def beyond_of(observed: Observed, solution: Fit) -> Observed:
    """Return a model with the noise of its readings over time that no redundancy shows, and a sentence on it.

    For as many readings as unknowns, with a stated noise, and the time as their order.
    """
    problem, order = observed.problem, observed.order
    if order is None or solution.freedom >= 1 or observed.correlation is not None or not problem.noise.stated:
        return observed
    known = np.flatnonzero(np.isfinite(order))
    ranked = known[np.argsort(order[known], kind="stable")]
    if observed.series is not None or not (np.diff(order[ranked]) > 0).all():
        return observed
    readings = column(problem.readings)
    sd = np.sqrt(np.diagonal(problem.noise.covariance(readings.shape), axis1=1, axis2=2))
    slow = slow_noise(order[ranked], readings[ranked].T, sd[ranked].T, observed.breaks)
    if slow is None:
        return observed
    factor, unit = {"m": (1e6, "um"), "rad": (1e6, "urad")}.get(observed.unit, (1.0, observed.unit))
    said = sentence(slow, ", ".join(f"{each * factor:.2g} {unit}" for each in slow.sd), observed.what)
    larger = replace(observed, problem=scaled(problem, 1.0, np.broadcast_to(slow.sd, readings.shape)))
    if slow.duration > 0:
        return replace(larger, doubts=[*observed.doubts, said])
    return replace(larger, notes=[*observed.notes, said])


def _of_unknown_noise(observed: Observed, solution: Fit) -> Fit:
    """Return the fit with a noise of unknown size: one that is stated wrongly must not look like a correlation.

    Beside priors the size cannot be left open, and is that of the residuals.
    """
    problem = solution.problem
    if not problem.noise.stated:
        return solution
    if has_priors(problem):
        return estimated_noise(solution, refresh=observed.refresh, what=observed.what)[0]
    unknown = replace(problem, noise=replace(problem.noise, stated=False))
    return fit(unknown, refresh=observed.refresh, what=observed.what, start=solution.linear.at)


def fitted(observed: Observed, problem: Problem, before: Fit) -> Fit:
    """Return the fit of a problem with the correlation of its noise, from the solution of a similar one."""
    start = before.linear.at
    if observed.order is not None and observed.correlation:
        problem = autoregressive(problem, observed.order, observed.correlation, observed.series)
    return fit(problem, refresh=observed.refresh, what=observed.what, start=start)


def steps_of(observed: Observed) -> Array:
    """Return the step of the scale of each number of a reading, (r,), stated or as the readings show it; 0 = none.

    Readings that fulfil the equation far better than rounded ones can, such as expected ones, have none.
    """
    problem = observed.problem
    y = column(problem.readings)
    if observed.resolution is not None:
        return np.broadcast_to(np.asarray(observed.resolution, dtype=float), (y.shape[1],))
    steps = np.array([resolution.step_of(one) for one in y.T])
    if not steps.any():
        return steps
    first = fit(problem, refresh=observed.refresh, what=observed.what)
    # Repeats that are rounded alike agree; all other readings have independent rounding errors.
    repeats = float((first.linear.used * (1 - 1 / resolution.alike(problem))[:, None]).sum())
    variance = np.median(np.diagonal(problem.noise.covariance(y.shape), axis1=1, axis2=2), axis=0)
    in_steps = first.chi2 * float((12 * variance[steps > 0] / np.square(steps[steps > 0])).max())
    freedom = first.freedom - repeats
    return np.zeros_like(steps) if freedom > _LITTLE and chdtr(freedom, in_steps) < _TOO_GOOD else steps


def searchable(observed: Observed, problem: Problem) -> Problem:
    """Return the problem with a noise that contains rounding, for the search of outliers.

    Repeats that are rounded alike have no scatter, against which the next mark of the scale would be an outlier.
    """
    steps = np.asarray(observed.resolution)
    if not steps.any():
        return problem
    shape = column(problem.readings).shape
    if problem.noise.stated:
        added = np.broadcast_to(steps / np.sqrt(12), shape)
        variance = np.diagonal(problem.noise.covariance(shape), axis1=1, axis2=2)
        return scaled(problem, 1.0, np.where(variance < np.square(_COARSE * steps), added, 0.0))
    residual = column(fit(problem, refresh=observed.refresh, what=observed.what).residual)
    if residual.shape != shape:
        return problem
    scales = np.array([scale_about_zero(one) for one in residual.T])
    if not (scales < _COARSE * steps).all():
        return problem
    sd = np.broadcast_to(np.hypot(scales, steps / np.sqrt(12)), shape)
    return replace(problem, noise=Noise(sd=sd, stated=True))


def rounding_of(observed: Observed, problem: Problem, factor: float) -> Rounding | None:
    """Return what rounding adds to a noise.

    Raises
    ------
    FitError
        Neither a noise nor a step of the scale is known: the uncertainty would be 0.
    """
    shape = column(problem.readings).shape
    variance = np.diagonal(problem.noise.covariance(shape), axis1=1, axis2=2) * factor
    rounding = resolution.rounding(problem, np.sqrt(variance), observed.resolution)
    smallest = float(np.nanmax(np.abs(column(problem.readings)), initial=0.0)) * _DIGITS
    if rounding is None and not problem.noise.stated and float(variance.max(initial=0.0)) <= smallest**2:
        raise FitError(
            f"{observed.what} do not scatter at all, and do not show the step of their scale: their uncertainty "
            "is unknown. State their noise, or the resolution of the instrument",
            code="readings.noise.unknown",
        )
    return rounding


def size_of_noise(observed: Observed, problem: Problem, factor: float) -> str:
    """Return why the standard deviation of most readings is implausible; "" if it is not, or if it is not known."""
    if not (observed.noise_increases or problem.noise.stated):
        return ""
    variance = np.diagonal(problem.noise.covariance(column(problem.readings).shape), axis1=1, axis2=2)
    return of_noise(float(np.sqrt(np.nanmedian(variance) * factor)), observed.unit, observed.what)


def scaled(problem: Problem, factor: float, added: Array | None = None) -> Problem:
    """Return a problem with the variance of its noise times a factor, and with further standard deviations (n, r)."""
    shape = column(problem.readings).shape
    if added is None or problem.noise.root is None:
        sd = problem.noise.sd
        if sd is None:
            root = np.asarray(problem.noise.root) * np.sqrt(factor)
            return replace(problem, noise=replace(problem.noise, root=root))
        whole = np.broadcast_to(sd[:, None] if np.ndim(sd) == 1 else sd, shape) * np.sqrt(factor)
        whole = whole if added is None else np.hypot(whole, added)
        return replace(problem, noise=replace(problem.noise, sd=whole))
    V = problem.noise.covariance(shape) * factor + np.square(added)[:, :, None] * np.eye(shape[1])
    return replace(problem, noise=replace(problem.noise, root=np.asarray(np.linalg.cholesky(V))))


def has_priors(problem: Problem) -> bool:
    """Return whether the sum of squares contains priors."""
    return bool(problem.adjusted) or any((block.information[block.freed] > 0).any() for block in problem.unknowns)


def estimated_noise(
    current: Fit, *, refresh: Callable[[Problem, Any], Problem] | None = None, what: str = "the readings"
) -> tuple[Fit, float, float]:
    """Return the fit with the noise of its readings by restricted likelihood, its variance factor and freedom.

    Priors keep their standard deviations. The fit is repeated with the noise found, since the estimate is that of the
    problem as linearised at the fit.

    Raises
    ------
    FitError
        The readings have no redundancy.
    """
    problem, size = current.problem, 1.0
    for _ in range(_STEPS):
        factor, freedom = noise_variance(current)
        if not factor > 0:
            break
        size *= float(np.sqrt(factor))
        current = fit(scaled(problem, size**2), refresh=refresh, what=what, start=current.linear.at)
        if abs(factor - 1) < _SAME:
            break
    return current, size**2, freedom
