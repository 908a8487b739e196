"""Normals of scanned surfaces, computed from the points."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.kinematics.beams import across
from errormotion.kinematics.fits import fit_circle

__all__ = ["Surface", "along_curve", "over_surface", "round_bar"]


Surface = Callable[[Array], Array]
"""Returns the unit normals (n, 3) of a surface at its points (n, 3) in the order of the scan, with any sign."""


def along_curve(axis: ArrayLike, neighbours: int = 7) -> Surface:
    """Return the normals of a curve that is scanned point by point, from a parabola through neighbouring points.

    The normals are perpendicular to ``axis`` (3,): a scan along one line does not determine more, and the tilt along
    the axis is assumed to be 0, as on a cylinder with this axis. More ``neighbours`` reduce noise, and smooth features
    that are smaller than the range of the neighbours.
    """
    a = _unit(axis, "axis")
    _check_neighbours(neighbours, 3)

    def normals(p: Array) -> Array:
        basis = across(a)
        xy = p @ basis.T
        n, k = len(xy), min(neighbours, len(xy))
        _check_points(n, 3)
        first = np.clip(np.arange(n) - k // 2, 0, n - k)
        window = xy[first[:, None] + np.arange(k)] - xy[:, None]
        chord = window[:, -1] - window[:, 0]
        length = np.linalg.norm(chord, axis=1, keepdims=True)
        if (length == 0).any():
            raise MethodError(
                "Expected different points; found neighbours at the same position. Omit repeated points.",
                code="beam.scan.points_repeated",
            )
        tangent = chord / length
        x = np.einsum("nki,ni->nk", window, tangent) / length
        y = (tangent[:, None, 0] * window[..., 1] - tangent[:, None, 1] * window[..., 0]) / length
        slope = _slopes(np.stack([np.ones_like(x), x, x**2], axis=-1), y)[:, 1]
        across_curve = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1) - slope[:, None] * tangent
        result: Array = across_curve @ basis
        return np.asarray(result / np.linalg.norm(result, axis=1, keepdims=True))

    return normals


def over_surface(neighbours: int = 12) -> Surface:
    """Return the normals of a surface from a quadric through the ``neighbours`` nearest points, at least 6."""
    _check_neighbours(neighbours, 6)

    def normals(p: Array) -> Array:
        from scipy.spatial import cKDTree

        _check_points(len(p), 6)
        k = min(neighbours, len(p))
        window = p[cKDTree(p).query(p, k=k)[1]]
        window = window - p[:, None]
        size = np.linalg.norm(window, axis=-1).max(axis=1)
        if (size == 0).any():
            raise MethodError(
                "Expected different points; found neighbours at the same position. Omit repeated points.",
                code="beam.scan.points_repeated",
            )
        window = window / size[:, None, None]
        _, spread, frame = np.linalg.svd(window - window.mean(axis=1, keepdims=True))
        if (spread[:, 1] < 1e-3 * spread[:, 0]).any():
            raise MethodError(
                "Neighbouring points lie on one line, which determines only the tilt along it. Use more neighbours, "
                "space the lines of the scan like the points on them, or state the surface, such as round_bar(axis).",
                code="beam.scan.points_on_line",
            )
        x, y, z = np.moveaxis(np.einsum("nki,nji->nkj", window, frame), -1, 0)
        slope = _slopes(np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1), z)[:, 1:3]
        local = np.concatenate([-slope, np.ones((len(p), 1))], axis=1)
        result = np.einsum("nj,nji->ni", local, frame)
        return np.asarray(result / np.linalg.norm(result, axis=1, keepdims=True))

    return normals


def round_bar(axis: ArrayLike) -> Surface:
    """Return the normals of a cylinder along ``axis`` (3,): from the centre of the circle outwards."""
    a = _unit(axis, "axis")

    def normals(p: Array) -> Array:
        basis = across(a)
        xy = p @ basis.T
        radial: Array = (xy - fit_circle(xy, robust=len(xy) >= 6).centre) @ basis
        return np.asarray(radial / np.linalg.norm(radial, axis=1, keepdims=True))

    return normals


def _slopes(A: Array, y: Array) -> Array:
    """Return the least-squares coefficients (n, c) of n systems (n, k, c), (n, k)."""
    return np.asarray((np.linalg.pinv(A) @ y[..., None])[..., 0])


def _unit(vector: ArrayLike, name: str) -> Array:
    v = np.asarray(vector, float)
    if v.shape != (3,) or not np.linalg.norm(v) > 0:
        raise MethodError(
            f"{name}: expected three numbers that are not all 0; found {v.tolist()}.", code="beam.bar.axis"
        )
    return np.asarray(v / np.linalg.norm(v))


def _check_neighbours(neighbours: int, least: int) -> None:
    if neighbours < least:
        raise MethodError(f"neighbours: expected at least {least}; found {neighbours}.", code="beam.scan.neighbours")


def _check_points(n: int, least: int) -> None:
    if n < least:
        raise MethodError(
            f"Expected {least} points or more to determine normals; found {n}. State the normals, or measure more "
            "points.",
            code="beam.scan.points_too_few",
        )
