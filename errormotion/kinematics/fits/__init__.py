"""Geometric least-squares fits: the shape whose orthogonal distances from the points have the least sum of squares.

>>> from errormotion.kinematics.fits import fit_circle
>>> circle = fit_circle([(1, 7), (2, 6), (5, 8), (7, 7), (9, 5), (3, 7)])
>>> print(f"{circle.radius:.8f} {circle.sum_of_squares:.8f}")
4.71422603 1.22759908

All fits have these keywords: ``robust`` excludes outliers and lists them in ``left_out``; ``sigma`` is the standard
uncertainty of a point perpendicular to the shape, estimated from the residuals by default; ``weights`` are relative,
one over the variance of each point. Points that do not determine the shape raise `errormotion.errors.FitError`, which
states the undetermined parameters.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from errormotion.arrays import Array
from errormotion.errors import FitError
from errormotion.kinematics.fits._axial import Cone, Cylinder
from errormotion.kinematics.fits._robust import outliers
from errormotion.kinematics.fits._shapes import Circle, Circle3D, Line, Plane, Shape, Sphere
from errormotion.kinematics.fits._solver import estimate
from errormotion.kinematics.fits.results import CircleFit, ConeFit, CylinderFit, Fit, LineFit, PlaneFit, SphereFit

__all__ = [
    "CircleFit",
    "ConeFit",
    "CylinderFit",
    "Fit",
    "LineFit",
    "PlaneFit",
    "SphereFit",
    "fit_circle",
    "fit_cone",
    "fit_cylinder",
    "fit_line",
    "fit_plane",
    "fit_sphere",
]


def fit_line(
    points: ArrayLike, robust: bool = False, *, sigma: float | None = None, weights: ArrayLike | None = None
) -> LineFit:
    """Fit a line in 2D or 3D.

    Parameters
    ----------
    points : array_like, (n, 2) or (n, 3)
        At least 2, in any one unit of length.
    robust : bool
        Exclude outliers (up to about 30 % of the points) and list them in ``left_out``.
    sigma : float, optional
        Standard uncertainty of a point perpendicular to the line; default: estimated from the residuals.
    weights : array_like, (n,), optional
        Relative weights, one over the variance.

    Returns
    -------
    LineFit
        Parameters: point, direction. The direction's largest component is positive.

    Raises
    ------
    FitError
        Too few points, points that do not determine the line, or an invalid array.
    """
    p = _points(points, (2, 3))
    return LineFit(**_fit(Line(p.shape[1]), p, robust, sigma, weights))


def fit_plane(
    points: ArrayLike, robust: bool = False, *, sigma: float | None = None, weights: ArrayLike | None = None
) -> PlaneFit:
    """Fit a plane to (n, 3) points, n >= 3; keywords, errors as in `fit_line`.

    Returns
    -------
    PlaneFit
        Parameters: point, normal. The normal's largest component is positive.
    """
    return PlaneFit(**_fit(Plane(), _points(points, (3,)), robust, sigma, weights))


def fit_circle(
    points: ArrayLike, robust: bool = False, *, sigma: float | None = None, weights: ArrayLike | None = None
) -> CircleFit:
    """Fit a circle to (n, 2) or (n, 3) points, n >= 3; keywords, errors as in `fit_line`.

    In 3D the distance has components in the plane of the circle and perpendicular to it.

    Returns
    -------
    CircleFit
        Parameters: centre, radius; in 3D: centre, normal, radius.

    References
    ----------
    W. Gander, G. H. Golub, R. Strebel, Least-squares fitting of circles and ellipses, BIT 34 (1994) 558.
    """
    p = _points(points, (2, 3))
    shape: Shape = Circle() if p.shape[1] == 2 else Circle3D()
    return CircleFit(**_fit(shape, p, robust, sigma, weights))


def fit_sphere(
    points: ArrayLike, robust: bool = False, *, sigma: float | None = None, weights: ArrayLike | None = None
) -> SphereFit:
    """Fit a sphere to (n, 3) points, n >= 4; keywords, errors as in `fit_line`.

    Returns
    -------
    SphereFit
        Parameters: centre, radius.
    """
    return SphereFit(**_fit(Sphere(), _points(points, (3,)), robust, sigma, weights))


def fit_cylinder(
    points: ArrayLike,
    radius: float | None = None,
    robust: bool = False,
    *,
    direction: ArrayLike | None = None,
    sigma: float | None = None,
    weights: ArrayLike | None = None,
) -> CylinderFit:
    """Fit a cylinder of free or known radius to (n, 3) points; keywords, errors as in `fit_line`.

    Parameters
    ----------
    points : array_like, (n, 3)
        At least 5; 4 where the radius is known.
    radius : float, optional
        The known radius, in the unit of the points.
    robust : bool
        Exclude outliers.
    direction : array_like, (3,), optional
        Approximate direction of the axis, within 20 degrees. It selects one of several cylinders through few points.
    sigma, weights
        As in `fit_line`.

    Returns
    -------
    CylinderFit
        Parameters: point, direction and, where it was free, radius.
    """
    if radius is not None and not (np.isfinite(radius) and radius > 0):
        raise FitError(
            f"expected a positive radius in the unit of the points; found {radius}", code="shape.radius.not_positive"
        )
    values = _fit(Cylinder(radius, _direction(direction)), _points(points, (3,)), robust, sigma, weights)
    return CylinderFit(**({"radius": radius} | values))


def fit_cone(
    points: ArrayLike,
    robust: bool = False,
    *,
    direction: ArrayLike | None = None,
    sigma: float | None = None,
    weights: ArrayLike | None = None,
) -> ConeFit:
    """Fit one nappe of a cone to (n, 3) points, n >= 6; keywords, errors as in `fit_cylinder`.

    Returns
    -------
    ConeFit
        Parameters: point, direction, radius, half_angle.
    """
    return ConeFit(**_fit(Cone(_direction(direction)), _points(points, (3,)), robust, sigma, weights))


def _fit(shape: Shape, points: Array, robust: bool, sigma: float | None, weights: ArrayLike | None) -> dict[str, Any]:
    """Return the fields of the result: the common ones, and the shape's parameters by name."""
    if sigma is not None and not (np.isfinite(sigma) and sigma > 0):
        raise FitError(
            f"expected a positive sigma in the unit of the points; found {sigma}", code="shape.sigma.not_positive"
        )
    w = _weights(weights, len(points))
    left_out = outliers(shape, points, w, sigma) if robust else ()
    fitted = estimate(shape, points, w, sigma, left_out)
    values: dict[str, Any] = {
        "parameters": fitted.theta,
        "parameter_names": tuple(name for group in shape.groups for name in group.names),
        "covariance": fitted.covariance,
        "residuals": fitted.residuals,
        "left_out": fitted.left_out,
        "sigma": fitted.sigma,
        "dof": fitted.dof,
    }
    start = 0
    for group in shape.groups:
        part = fitted.theta[start : start + group.size]
        values[group.name] = part if group.size > 1 else float(part[0])
        start += group.size
    return values


def _points(points: ArrayLike, dimensions: tuple[int, ...]) -> Array:
    try:
        p = np.asarray(points, dtype=float)
    except (TypeError, ValueError) as error:
        raise FitError(f"expected points as an array of numbers; {error}", code="shape.points.form") from error
    if p.ndim != 2 or p.shape[1] not in dimensions:
        shapes = " or ".join(f"(n, {d})" for d in dimensions)
        raise FitError(
            f"expected points of shape {shapes}, one row for each point; found {p.shape}", code="shape.points.shape"
        )
    bad = np.flatnonzero(~np.isfinite(p).all(axis=1))
    if bad.size:
        named = ", ".join(str(i) for i in bad[:5]) + (", ..." if bad.size > 5 else "")
        raise FitError(
            f"{bad.size} of {len(p)} points are not finite (rows {named}); remove them first",
            code="shape.points.not_finite",
        )
    return p


def _weights(weights: ArrayLike | None, n: int) -> Array:
    if weights is None:
        return np.ones(n)
    w = np.asarray(weights, dtype=float)
    if w.shape != (n,) or not (np.isfinite(w).all() and (w > 0).all()):
        raise FitError(
            f"expected {n} positive weights, one for each point; remove points of weight 0", code="shape.weights.form"
        )
    return w


def _direction(direction: ArrayLike | None) -> Array | None:
    if direction is None:
        return None
    u = np.asarray(direction, dtype=float)
    if u.shape != (3,) or not np.linalg.norm(u) > 0:
        raise FitError(
            f"expected a direction of three numbers that are not all 0; found {direction}", code="shape.direction.form"
        )
    return np.asarray(u / np.linalg.norm(u))
