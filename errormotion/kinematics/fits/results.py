"""Results of fits: the parameters of the shape by name, their covariance, and the residuals of the points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from errormotion.arrays import Array

__all__ = ["CircleFit", "ConeFit", "CylinderFit", "Fit", "LineFit", "PlaneFit", "SphereFit"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Fit:
    """Base of all results; lengths are in the unit of the points, angles in rad.

    Attributes
    ----------
    parameters : ndarray, (k,)
        All parameters, in the order of `parameter_names`.
    parameter_names : tuple of str
        Such as ``("centre_x", "centre_y", "radius")``. A direction has three parameters and two freedoms.
    covariance : ndarray, (k, k)
        Of `parameters`: ``sigma^2 (J^T W J)^-1`` of the free steps, transformed to the parameters. The length of a
        direction and the position of a point along its line are fixed and have no variance: the rank is the number of
        freedoms. NaN if `sigma` is NaN.
    residuals : ndarray, (n,)
        Orthogonal distances of all points, including the excluded ones. Positive outside of a round shape and on the
        side of a plane's normal; never negative for a line or circle in 3D, whose distance has no sign.
    left_out : tuple of int
        Indices of the points that a robust fit excluded.
    sigma : float
        Standard uncertainty of a point perpendicular to the shape (weight 1), stated or estimated; NaN if there is no
        degree of freedom to estimate it.
    dof : int
        Degrees of freedom: components of residuals minus freedoms of the shape.
    """

    parameters: Array
    parameter_names: tuple[str, ...]
    covariance: Array
    residuals: Array
    left_out: tuple[int, ...]
    sigma: float
    dof: int

    @property
    def sum_of_squares(self) -> float:
        """Sum of the squared residuals of the points that were used."""
        used = np.delete(self.residuals, list(self.left_out))
        return float(used @ used)

    @property
    def rms(self) -> float:
        """Root mean square residual of the points that were used."""
        return float(np.sqrt(self.sum_of_squares / (len(self.residuals) - len(self.left_out))))

    @property
    def standard_uncertainty(self) -> dict[str, float]:
        """Standard uncertainty of every parameter by name."""
        return dict(zip(self.parameter_names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


@dataclass(frozen=True, eq=False, kw_only=True)
class LineFit(Fit):
    """A line: the point nearest to the points' centroid, (d,), and the unit direction, (d,)."""

    point: Array
    direction: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class PlaneFit(Fit):
    """A plane: the point nearest to the points' centroid, (3,), and the unit normal, (3,)."""

    point: Array
    normal: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class CircleFit(Fit):
    """A circle: centre, (d,), radius, and in 3D the unit normal, (3,)."""

    centre: Array
    radius: float
    normal: Array | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class SphereFit(Fit):
    """A sphere: centre, (3,), and radius."""

    centre: Array
    radius: float


@dataclass(frozen=True, eq=False, kw_only=True)
class CylinderFit(Fit):
    """A cylinder: the axis's point nearest to the points' centroid, (3,), unit direction, (3,), radius.

    A known radius is stated here, but is not among the `parameters`.
    """

    point: Array
    direction: Array
    radius: float


@dataclass(frozen=True, eq=False, kw_only=True)
class ConeFit(Fit):
    """A cone: the axis's point nearest to the points' centroid, (3,), unit direction towards the opening, (3,).

    ``radius`` is the radius of the cone at ``point``, ``half_angle`` the angle between axis and surface, rad.
    """

    point: Array
    direction: Array
    radius: float
    half_angle: float

    @property
    def apex(self) -> Array:
        """The apex, (3,); infinitely far away for a cylinder."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self.point - self.direction * (self.radius / np.tan(self.half_angle)))
