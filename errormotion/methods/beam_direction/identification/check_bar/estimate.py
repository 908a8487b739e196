"""Fit of a bar to points by least squares, its covariance, and the residuals expected from noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.errors import FitError
from errormotion.kinematics.beams import across
from errormotion.kinematics.fits import fit_circle, fit_cylinder

__all__ = ["FALSE_ALARMS", "Bar", "Judged", "judged", "settled", "start"]


FALSE_ALARMS = 0.01
"""Probability that a correct bar is reported as systematic, or noisier than stated."""
_STEPS = 50
_AT_REST = 1e-12  # m


@dataclass(frozen=True)
class Bar:
    """Position of a bar, and its free parameters."""

    centre: Array
    axis: Array
    radius: float
    tilts: bool
    held: bool

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        tilts = ("tilt_1", "tilt_2") if self.tilts else ()
        return ("across_1", "across_2", *tilts, *(() if self.held else ("radius",)))

    def misses(self, p: Array) -> tuple[Array, Array]:
        """Return the residuals (n,) and the unit vectors (n, 3) from the axis to the points."""
        away = p - self.centre
        away = away - np.outer(away @ self.axis, self.axis)
        rho = np.linalg.norm(away, axis=1)
        return rho - self.radius, away / rho[:, None]

    def jacobian(self, p: Array) -> Array:
        """Return the derivative (n, parameter) of the residuals."""
        _, n = self.misses(p)
        side = n @ across(self.axis).T
        columns = [-side]
        if self.tilts:
            columns.append(-((p - self.centre) @ self.axis)[:, None] * side)
        if not self.held:
            columns.append(np.full((len(p), 1), -1.0))
        return np.concatenate(columns, axis=1)

    def stepped(self, step: Array) -> Bar:
        """Return the bar with its parameters changed by a step (parameter,)."""
        basis = across(self.axis)
        axis = self.axis + step[2:4] @ basis if self.tilts else self.axis
        radius = self.radius if self.held else self.radius + float(step[-1])
        return Bar(self.centre + step[:2] @ basis, axis / np.linalg.norm(axis), radius, self.tilts, self.held)

    def spread(self) -> Array:
        """Return what a step of the parameters makes of centre and axis, (6, parameter)."""
        basis = across(self.axis)
        G = np.zeros((6, len(self.names)))
        G[:3, :2] = basis.T
        if self.tilts:
            G[3:, 2:4] = basis.T
        return G

    def around(self, p: Array) -> NDArray[np.intp]:
        """Return the order of the points about the axis, beginning behind the widest gap."""
        _, n = self.misses(p)
        angle = np.arctan2(*(n @ across(self.axis).T).T)
        order = np.argsort(angle)
        gaps = np.diff(angle[order], append=angle[order[0]] + 2 * np.pi)
        return np.roll(order, -int(np.argmax(gaps)) - 1)


@dataclass(frozen=True)
class Judged:
    """Residuals and uncertainty of a fit."""

    covariance: Array
    common: Array
    M: Array  # residual maker, I - J J^+
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
    way = cylinder.direction if cylinder.direction @ axis > 0 else -cylinder.direction
    return Bar(cylinder.point, way, cylinder.radius, True, False), cylinder.left_out


def settled(p: Array, start: Bar, shape: str, held: float | None) -> Bar:
    """Return the bar with the least sum of squared distances."""
    bar = Bar(start.centre, start.axis, start.radius if held is None else held, shape == "cylinder", held is not None)
    for _ in range(_STEPS):
        step = -np.asarray(np.linalg.lstsq(bar.jacobian(p), bar.misses(p)[0], rcond=None)[0], dtype=float)
        bar = bar.stepped(step)
        if np.abs(step[:2]).max() < _AT_REST:
            break
    else:
        raise FitError("the fit of the bar does not converge. Check the radius and the axis")
    middle = float(((p - bar.centre) @ bar.axis).mean())
    return Bar(bar.centre + middle * bar.axis, bar.axis, bar.radius, bar.tilts, bar.held)


def judged(bar: Bar, p: Array, own: Array, influence: Array, radius_uncertainty: float) -> Judged:
    """Return the covariance of the parameters, and whether the residuals are larger than the noise."""
    from scipy.special import gammaincc

    J = bar.jacobian(p)
    f, n = bar.misses(p)
    inverse = np.linalg.pinv(J)
    M = np.eye(len(p)) - J @ inverse
    variance = np.einsum("ni,nij,nj->n", n, own, n)
    freedoms, square = len(p) - J.shape[1], float(f @ f)
    stated = bool((variance > 0).any())
    expected = float(np.diag(M) @ variance)
    exceeds = False
    if stated and freedoms > 0:
        # The sum of squares of points that are not equally noisy is nearly a chi-square of fewer freedoms.
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
    return Judged(
        covariance=(inverse * variance) @ inverse.T + common,
        common=common,
        M=M,
        rms=float(np.sqrt(square / len(p))),
        explained=float(np.sqrt(expected / len(p))) if stated else np.nan,
        exceeds=exceeds,
    )
