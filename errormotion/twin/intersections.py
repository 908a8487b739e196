"""Intersections of a beam with cylinder, plane and sphere: exact distances along the beam, over leading axes."""

from __future__ import annotations

import numpy as np

from errormotion.arrays import Array


def _dot(a: Array, b: Array) -> Array:
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def _near_root(square: Array, half: Array, constant: Array) -> Array:
    """Return the smaller root of square d^2 + 2 half d + constant = 0; NaN where there is none."""
    inside = half * half - square * constant
    with np.errstate(invalid="ignore"):
        return (-half - np.sqrt(inside)) / square


def to_cylinder(origin: Array, direction: Array, point: Array, axis: Array, radius: float) -> Array:
    """Return the distance to the near side of a cylinder.

    Parameters
    ----------
    origin, direction : (..., 3)
        Beam, m; unit direction.
    point, axis : (..., 3)
        A point on the axis of the cylinder, m, and its unit direction.
    radius : float
        m.

    Returns
    -------
    ndarray
        m; NaN where the beam misses.
    """
    u = direction - _dot(direction, axis)[..., None] * axis
    w = origin - point
    w = w - _dot(w, axis)[..., None] * axis
    return _near_root(_dot(u, u), _dot(u, w), _dot(w, w) - radius**2)


def to_plane(origin: Array, direction: Array, point: Array, normal: Array) -> Array:
    """Return the distance to the plane through a point, m; arguments as for the cylinder."""
    return _dot(point - origin, normal) / _dot(direction, normal)


def to_sphere(origin: Array, direction: Array, centre: Array, radius: float) -> Array:
    """Return the distance to the near side of a sphere, m; NaN where the beam misses."""
    w = origin - centre
    return _near_root(np.asarray(1.0), _dot(direction, w), _dot(w, w) - radius**2)
