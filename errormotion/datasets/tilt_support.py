"""Where calibrated tilts surround a point closely enough to speak for it.

The calibrated tilt vectors are joined to triangles (Delaunay). A triangle counts if the circle through its corners is
no wider than ``gap``, a side if it is no longer; this is the alpha complex of the points. A tilt is supported when it
lies in the complex or within ``margin`` of it. Wide triangles are holes: there is nothing calibrated inside their
circles.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_FLAT = 1e-9
"""Singular value, relative to the largest, below which points lie on one line."""
_BLOCK = 2**21
"""Distances in memory at a time."""


class TiltSupport:
    """The region of tilts that calibrated ones speak for.

    Parameters
    ----------
    tilts : ndarray (n, 2)
        Calibrated tilt vectors.
    gap : float
        Widest empty circle (its diameter) that counts as surrounded.
    margin : float
        How far beyond the joined points a tilt may lie.
    """

    def __init__(self, tilts: Array, gap: float, margin: float) -> None:
        self.tilts = np.unique(np.round(np.asarray(tilts, float), 9), axis=0)
        self.gap, self.margin = float(gap), float(margin)

    def holds(self, q: Array) -> NDArray[np.bool_]:
        """Return whether each tilt (..., 2) is supported; a NaN is not."""
        points = np.asarray(q, float).reshape(-1, 2)
        held = np.zeros(len(points), dtype=bool)
        finite = np.isfinite(points).all(axis=1)
        held[finite] = self._inside(points[finite])
        rest = np.flatnonzero(finite & ~held)
        step = max(1, _BLOCK // max(len(self._sides), 1))
        for start in range(0, len(rest), step):
            some = rest[start : start + step]
            held[some] = self._distance(points[some]) <= self.margin
        return held.reshape(np.shape(q)[:-1])

    def holes(self) -> Array:
        """Return the middles (m, 2) of the empty circles between calibrated tilts that are too wide, widest first."""
        corners, centres, radii = self._triangles
        wide = radii > self.gap / 2
        middles = np.where(_contains(corners, centres)[:, None], centres, corners.mean(axis=1))
        chosen: list[Array] = []
        for k in np.flatnonzero(wide)[np.argsort(-radii[wide])]:
            if not self.holds(middles[k]) and all(np.hypot(*(middles[k] - other)) > self.gap for other in chosen):
                chosen.append(middles[k])
        return np.array(chosen).reshape(-1, 2)

    def nearest(self, q: Array, count: int = 3) -> Array:
        """Return the calibrated tilts (count, 2) nearest to one tilt (2,)."""
        return np.asarray(self.tilts[np.argsort(np.hypot(*(self.tilts - q).T), kind="stable")[:count]])

    @cached_property
    def _flat(self) -> bool:
        values = np.linalg.svd(self.tilts - self.tilts.mean(axis=0), compute_uv=False)
        return len(self.tilts) < 3 or bool(values[1] <= _FLAT * max(values[0], _FLAT))

    @cached_property
    def _triangles(self) -> tuple[Array, Array, Array]:
        """Corners (m, 3, 2), centres (m, 2) and radii (m,) of the circles of all triangles; none on a line."""
        if self._flat:
            return np.zeros((0, 3, 2)), np.zeros((0, 2)), np.zeros(0)
        from scipy.spatial import Delaunay

        corners = self.tilts[Delaunay(self.tilts).simplices]
        b, c = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        twice = 2 * (b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0])
        bb, cc = (b**2).sum(axis=1), (c**2).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            centre = np.stack([c[:, 1] * bb - b[:, 1] * cc, b[:, 0] * cc - c[:, 0] * bb], axis=1) / twice[:, None]
        radius = np.hypot(*centre.T)
        good = np.isfinite(radius)
        return corners[good], (corners[:, 0] + centre)[good], radius[good]

    @cached_property
    def _small(self) -> Array:
        """Triangles (m, 3, 2) that count."""
        corners, _, radii = self._triangles
        return np.asarray(corners[radii <= self.gap / 2])

    @cached_property
    def _sides(self) -> Array:
        """Sides (m, 2, 2) that count; each point is a side of no length."""
        points = np.stack([self.tilts, self.tilts], axis=1)
        if self._flat:
            along = np.linalg.svd(self.tilts - self.tilts.mean(axis=0))[2][0]
            line = self.tilts[np.argsort(self.tilts @ along)]
            pairs = np.stack([line[:-1], line[1:]], axis=1)
        else:
            corners = self._triangles[0]
            pairs = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
            pairs = np.unique(np.sort(pairs.view(np.complex128)[..., 0], axis=1), axis=0)[..., None].view(np.float64)
        return np.concatenate([points, pairs[np.hypot(*(pairs[:, 1] - pairs[:, 0]).T) <= self.gap]])

    def _inside(self, points: Array) -> NDArray[np.bool_]:
        held = np.zeros(len(points), dtype=bool)
        if len(self._small) == 0:
            return held
        step = max(1, _BLOCK // len(self._small))
        for start in range(0, len(points), step):
            some = slice(start, start + step)
            held[some] = _contains(self._small[None], points[some, None]).any(axis=1)
        return held

    def _distance(self, points: Array) -> Array:
        """Return the distance (n,) of points (n, 2) to the nearest side."""
        start, way = self._sides[:, 0], self._sides[:, 1] - self._sides[:, 0]
        to = points[:, None] - start
        square = (way**2).sum(axis=1)
        part = np.clip((to * way).sum(axis=-1) / np.where(square > 0, square, 1.0), 0.0, 1.0)
        return np.asarray(np.sqrt(((to - part[..., None] * way) ** 2).sum(axis=-1)).min(axis=1))


def _contains(corners: Array, points: Array) -> NDArray[np.bool_]:
    """Return whether triangles (..., 3, 2) contain points (..., 2)."""
    turns = []
    for k in range(3):
        a, b = corners[..., k, :], corners[..., (k + 1) % 3, :]
        turns.append(
            (b[..., 0] - a[..., 0]) * (points[..., 1] - a[..., 1])
            - (b[..., 1] - a[..., 1]) * (points[..., 0] - a[..., 0])
        )
    lowest, highest = np.minimum.reduce(turns), np.maximum.reduce(turns)
    return np.asarray((lowest >= 0) | (highest <= 0))
