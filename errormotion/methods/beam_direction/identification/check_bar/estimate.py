"""Fit of a bar to points by least squares, its covariance, and the residuals expected from noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.errors import FitError
from errormotion.kinematics.beams import across
from errormotion.kinematics.fits import fit_circle, fit_cylinder

__all__ = ["FALSE_ALARMS", "Bar", "Evaluation", "evaluate", "fit", "start"]


FALSE_ALARMS = 0.01
"""Probability that a correct bar is reported as systematic, or noisier than stated."""
_MAX_STEPS = 50
_CONVERGED = 1e-12  # m


@dataclass(frozen=True)
class Bar:
    """Position of a bar, and its free parameters: the axis if ``tilts``, the radius unless ``fixed_radius``."""

    centre: Array
    axis: Array
    radius: float
    tilts: bool
    fixed_radius: bool

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        tilts = ("tilt_1", "tilt_2") if self.tilts else ()
        return ("across_1", "across_2", *tilts, *(() if self.fixed_radius else ("radius",)))

    def residuals(self, p: Array) -> tuple[Array, Array]:
        """Return the residuals (n,) and the unit vectors (n, 3) from the axis to the points."""
        radial = p - self.centre
        radial = radial - np.outer(radial @ self.axis, self.axis)
        rho = np.linalg.norm(radial, axis=1)
        return rho - self.radius, radial / rho[:, None]

    def jacobian(self, p: Array) -> Array:
        """Return the derivative (n, parameter) of the residuals."""
        _, n = self.residuals(p)
        side = n @ across(self.axis).T
        columns = [-side]
        if self.tilts:
            columns.append(-((p - self.centre) @ self.axis)[:, None] * side)
        if not self.fixed_radius:
            columns.append(np.full((len(p), 1), -1.0))
        return np.concatenate(columns, axis=1)

    def stepped(self, step: Array) -> Bar:
        """Return the bar with its parameters changed by a step (parameter,)."""
        basis = across(self.axis)
        axis = self.axis + step[2:4] @ basis if self.tilts else self.axis
        radius = self.radius if self.fixed_radius else self.radius + float(step[-1])
        return Bar(self.centre + step[:2] @ basis, axis / np.linalg.norm(axis), radius, self.tilts, self.fixed_radius)

    def centre_and_axis_jacobian(self) -> Array:
        """Return the derivative (6, parameter) of centre and axis."""
        basis = across(self.axis)
        G = np.zeros((6, len(self.names)))
        G[:3, :2] = basis.T
        if self.tilts:
            G[3:, 2:4] = basis.T
        return G

    def around(self, p: Array) -> NDArray[np.intp]:
        """Return the order of the points about the axis, starting after the widest gap."""
        _, n = self.residuals(p)
        angle = np.arctan2(*(n @ across(self.axis).T).T)
        order = np.argsort(angle)
        gaps = np.diff(angle[order], append=angle[order[0]] + 2 * np.pi)
        return np.roll(order, -int(np.argmax(gaps)) - 1)


@dataclass(frozen=True)
class Evaluation:
    """Residuals and uncertainty of a fit."""

    covariance: Array
    common: Array
    M: Array  # residual projection, I - J J^+
    rms: float
    explained: float
    exceeds: bool


def start(p: Array, own: Array, axis: Array, shape: str, robust: bool) -> tuple[Bar, tuple[int, ...]]:
    """Return a bar near the best one, and the indices of the outliers.

    The radius is free here, so that a wrong radius does not cause outliers.
    """
    sigma = float(np.sqrt(np.median(np.trace(own, axis1=1, axis2=2)))) if len(p) else 0.0
    floor = {"sigma": sigma} if sigma > 0 else {}
    if shape == "circle":
        basis = across(axis)
        circle = fit_circle(p @ basis.T, robust, **floor)
        height = float((p @ axis).mean())
        return Bar(circle.centre @ basis + height * axis, axis, circle.radius, False, False), circle.left_out
    cylinder = fit_cylinder(p, None, robust, direction=axis, **floor)
    direction = cylinder.direction if cylinder.direction @ axis > 0 else -cylinder.direction
    return Bar(cylinder.point, direction, cylinder.radius, True, False), cylinder.left_out


def fit(p: Array, start: Bar, shape: str, radius: float | None) -> Bar:
    """Return the bar with the least sum of squared distances; ``radius`` None: free."""
    fixed = radius is not None
    bar = Bar(start.centre, start.axis, start.radius if radius is None else radius, shape == "cylinder", fixed)
    for _ in range(_MAX_STEPS):
        step = -np.asarray(np.linalg.lstsq(bar.jacobian(p), bar.residuals(p)[0], rcond=None)[0], dtype=float)
        bar = bar.stepped(step)
        if np.abs(step[:2]).max() < _CONVERGED:
            break
    else:
        raise FitError(
            "the fit of the bar does not converge. Check the radius and the axis", code="beam.bar.not_converged"
        )
    middle = float(((p - bar.centre) @ bar.axis).mean())
    return Bar(bar.centre + middle * bar.axis, bar.axis, bar.radius, bar.tilts, bar.fixed_radius)


def evaluate(bar: Bar, p: Array, own: Array, influence: Array, radius_uncertainty: float) -> Evaluation:
    """Return the covariance of the parameters, and whether the residuals exceed the noise."""
    from scipy.special import gammaincc

    J = bar.jacobian(p)
    f, n = bar.residuals(p)
    inverse = np.linalg.pinv(J)
    M = np.eye(len(p)) - J @ inverse
    variance = np.einsum("ni,nij,nj->n", n, own, n)
    freedoms, square = len(p) - J.shape[1], float(f @ f)
    stated = bool((variance > 0).any())
    expected = float(np.diag(M) @ variance)
    exceeds = False
    if stated and freedoms > 0:
        # With unequal noise the sum of squares is approximately chi-square with fewer degrees of freedom.
        half = expected**2 / float(2 * np.einsum("ij,j,ji,i->", M, variance, M, variance))
        exceeds = bool(gammaincc(half, half * square / expected) < FALSE_ALARMS)
    if not stated:
        variance = np.full(len(p), square / freedoms if freedoms else np.nan)
    elif exceeds:
        variance = variance * square / expected
    effects = np.einsum("ni,sni->sn", n, influence)
    if radius_uncertainty > 0:
        effects = np.concatenate([effects, np.full((1, len(p)), -radius_uncertainty)])
    steps = effects @ inverse.T
    common = steps.T @ steps
    return Evaluation(
        covariance=(inverse * variance) @ inverse.T + common,
        common=common,
        M=M,
        rms=float(np.sqrt(square / len(p))),
        explained=float(np.sqrt(expected / len(p))) if stated else np.nan,
        exceeds=exceeds,
    )
