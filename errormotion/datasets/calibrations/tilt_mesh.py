"""Triangles between points in the plane, with their empty circles and their sides (Delaunay)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array

if TYPE_CHECKING:
    from scipy.spatial import Delaunay


_FLAT = 1e-9
"""Singular value, relative to the largest, below which points are on one line."""
_ACUTE = 1e-6
"""Cosine of the angle opposite to a side, above which no other point is in the circle over that side."""


@dataclass(frozen=True)
class Mesh:
    """Triangles and sides that join points. Points on one line have sides and no triangles.

    Attributes
    ----------
    triangles : ndarray (m, 3)
        Indices of the corners.
    neighbours : ndarray (m, 3)
        Triangle beyond the side opposite to each corner; -1: none.
    which : ndarray (m, 3)
        Index of that side.
    corners : ndarray (m, 3, 2)
    middles : ndarray (m, 2)
        Centres of the empty circles through the corners; if such a centre is outside the hull of the points, that of
        the triangle.
    radii : ndarray (m,)
        Of these circles.
    sides : ndarray (s, 2)
        Indices of the ends.
    empty : ndarray (s,)
        Whether no point is inside the circle that has the side as its diameter.
    joined : Delaunay or None
    """

    triangles: NDArray[np.int64]
    neighbours: NDArray[np.int64]
    which: NDArray[np.int64]
    corners: Array
    middles: Array
    radii: Array
    sides: NDArray[np.int64]
    empty: NDArray[np.bool_]
    joined: Delaunay | None

    @classmethod
    def of(cls, points: Array) -> Mesh:
        """Join points (n, 2)."""
        away = points - points.mean(axis=0)
        _, values, axes = np.linalg.svd(away, full_matrices=len(points) == 1)
        if len(points) < 3 or values[1] <= _FLAT * max(values[0], _FLAT):
            order = np.argsort(away @ axes[0])
            none = np.zeros((0, 3), dtype=np.int64)
            sides = np.stack([order[:-1], order[1:]], axis=1)
            corners = np.zeros((0, 3, 2))
            empty = np.ones(len(sides), dtype=bool)
            return cls(none, none, none, corners, corners[:, 0], np.zeros(0), sides, empty, None)
        from scipy.spatial import Delaunay

        joined = Delaunay(points)
        triangles = joined.simplices.astype(np.int64)
        corners = points[triangles]
        centres, radii = _circles(corners)
        inside = np.isfinite(radii)
        inside[inside] = joined.find_simplex(centres[inside]) >= 0
        middles = np.where(inside[:, None], centres, corners.mean(axis=1))
        ends = np.stack([np.sort(np.delete(triangles, k, axis=1), axis=1) for k in range(3)], axis=1)
        sides, which = np.unique(ends.reshape(-1, 2), axis=0, return_inverse=True)
        which = which.reshape(-1, 3)
        blunt = np.bincount(which.ravel(), (_cosines(corners) <= _ACUTE).ravel())
        beyond = joined.neighbors.astype(np.int64)
        return cls(triangles, beyond, which, corners, middles, radii, sides, blunt == 0, joined)

    def locate(self, points: Array) -> NDArray[np.int64]:
        """Return the index of the triangle that contains each point (n, 2); -1: none."""
        if self.joined is None:
            return np.full(len(points), -1)
        return np.asarray(self.joined.find_simplex(points), dtype=np.int64)

    def parts(self, taken: NDArray[np.bool_], parted: NDArray[np.bool_]) -> list[NDArray[np.int64]]:
        """Return groups of connected triangles: of those taken (m,), over sides that are not parted (s,)."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        beyond = self.neighbours
        one, side = np.nonzero((beyond >= 0) & taken[:, None] & taken[beyond] & ~parted[self.which])
        joined = coo_array((np.ones(len(one)), (one, beyond[one, side])), shape=(len(taken), len(taken)))
        _, label = connected_components(joined, directed=False)
        return [np.flatnonzero(taken & (label == k)) for k in np.unique(label[taken])]


def _circles(corners: Array) -> tuple[Array, Array]:
    """Return the centres (m, 2) and radii (m,) of the circles through corners (m, 3, 2); infinite on a line."""
    b, c = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    twice = 2 * (b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0])
    bb, cc = (b**2).sum(axis=1), (c**2).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        centre = np.stack([c[:, 1] * bb - b[:, 1] * cc, b[:, 0] * cc - c[:, 0] * bb], axis=1) / twice[:, None]
    radius = np.hypot(*centre.T)
    return corners[:, 0] + centre, np.where(np.isfinite(radius), radius, np.inf)


def _cosines(corners: Array) -> Array:
    """Return the cosines (m, 3) of the angles at the corners (m, 3, 2)."""
    cosines = np.empty(corners.shape[:2])
    for k in range(3):
        one, other = (corners[:, (k + step) % 3] - corners[:, k] for step in (1, 2))
        cosines[:, k] = (one * other).sum(axis=1) / np.sqrt((one**2).sum(axis=1) * (other**2).sum(axis=1))
    return cosines
