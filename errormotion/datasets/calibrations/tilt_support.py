"""Support of a calibration: the region of tilts that are surrounded by close calibrated tilts.

The calibrated tilt vectors are joined to triangles (Delaunay), so that the circle through the corners of each is empty.
A triangle is supported unless it is part of a hole:

* across rotations: its circle is wider than ``gap``, half a period of the finest variation; or
* along the inclination: with h the usual step of the inclination (the median over the triangles of the range of
  inclination between corners), no setting is within `REACH` h of the inclination at the middle of the circle, or of
  that half-way between the corners. Settings are searched along the rotation within the width of the triangle, or
  within `REACH` h.

Two rules are needed. Across rotations, a surface that is fitted to few settings has a large uncertainty between them.
Along the inclination, the many settings on both sides of a hole make the uncertainty inside the hole small. The stated
uncertainty is verified by predictions of settings that were left out, and leaving one out makes a hole of two steps.
`REACH` on both sides allows two and a half, since steps are not equal. Both rules search for empty regions: a narrow
triangle between scattered settings is not a hole.

A side is supported with its triangles. It is also supported by itself if it is shorter than ``gap``, no setting is
inside the circle over it, and its ends are at most 2 `REACH` h apart in inclination, so that a single row of settings
is supported. A tilt is supported if it is in a supported triangle or side, or within ``margin`` of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.datasets.calibrations.tilt_mesh import Mesh
from errormotion.kinematics.beams import inclination_rotation

REACH = 1.25
"""Steps of the inclination within which a setting must lie on either side of the middle of an empty region."""

_TURN = 2 * np.pi
_SQUARE = 1e-9
"""Tilt below which the rotation of a setting is undefined."""
_SAME = 1e-6
"""Difference below which angles count as equal, rad."""
_BLOCK = 2**21
"""Number of distances in memory at a time."""


@dataclass(frozen=True)
class Hole:
    """A region between calibrated tilts without support.

    Attributes
    ----------
    inclination : (low, high)
        Of the settings around it, rad; from 0 if it contains the untilted surface.
    rotation : (low, high)
        Of the settings around it, rad, ``low`` in [0, 2 pi); 2 pi apart if it extends over all rotations.
    middle : ndarray (2,)
        The tilt in the hole that is farthest from all settings.
    """

    inclination: tuple[float, float]
    rotation: tuple[float, float]
    middle: Array


class TiltSupport:
    """The region of tilts that the calibrated tilts support.

    Parameters
    ----------
    tilts : ndarray (n, 2)
        Calibrated tilt vectors.
    gap : float
        Largest diameter of an empty circle that counts as surrounded.
    margin : float
        Largest distance of a supported tilt from the joined points.
    """

    def __init__(self, tilts: Array, gap: float, margin: float) -> None:
        self.tilts = np.unique(np.round(np.asarray(tilts, float), 9), axis=0)
        self.gap, self.margin = float(gap), float(margin)

    def holds(self, q: Array) -> NDArray[np.bool_]:
        """Return whether each tilt (..., 2) is supported; false for NaN."""
        points = np.asarray(q, float).reshape(-1, 2)
        held = np.zeros(len(points), dtype=bool)
        finite = np.isfinite(points).all(axis=1)
        which = self._mesh.locate(points[finite])
        held[finite] = (which >= 0) & np.append(self._counts, False)[which]
        rest = np.flatnonzero(finite & ~held)
        step = max(1, _BLOCK // max(len(self._sides), 1))
        for start in range(0, len(rest), step):
            some = rest[start : start + step]
            held[some] = self._distance(points[some]) <= self.margin
        return held.reshape(np.shape(q)[:-1])

    def holes(self) -> list[Hole]:
        """Return the regions without support between calibrated tilts, by inclination and rotation."""
        bare = ~self._counts
        bare[bare] = ~self.holds(self._mesh.corners[bare].mean(axis=1))
        # A row of settings that is supported by itself separates two holes.
        holes = [self._hole(part) for part in self._mesh.parts(bare, self._sides_count)]
        return sorted(holes, key=lambda hole: (np.round(hole.inclination, 3).tolist(), hole.rotation))

    def nearest(self, q: Array, count: int = 3) -> Array:
        """Return the calibrated tilts (count, 2) nearest to one tilt (2,)."""
        return np.asarray(self.tilts[np.argsort(np.hypot(*(self.tilts - q).T), kind="stable")[:count]])

    @cached_property
    def step(self) -> float:
        """The usual step of the inclination between settings, rad."""
        joined = self._mesh.triangles if len(self._mesh.triangles) else self._mesh.sides
        return float(np.median(np.ptp(self._inclination[joined], axis=1))) if len(joined) else 0.0

    @cached_property
    def _reach(self) -> float:
        # Inclinations that differ by less than the margin count as equal.
        return max(REACH * self.step, float(np.arctan(self.margin))) + _SAME

    @cached_property
    def _inclination(self) -> Array:
        return np.asarray(np.arctan(_size(self.tilts)))

    @cached_property
    def _mesh(self) -> Mesh:
        return Mesh.of(self.tilts)

    @cached_property
    def _counts(self) -> NDArray[np.bool_]:
        """Whether each triangle (m,) is supported."""
        mesh = self._mesh
        counts = 2 * mesh.radii <= self.gap
        at = np.arctan(np.hypot(*mesh.middles.T))
        around = self._inclination[mesh.triangles]
        half_way = (around.min(axis=1, initial=np.inf) + around.max(axis=1, initial=-np.inf)) / 2
        for inclination in (at, half_way):
            along = mesh.middles * (np.tan(inclination) / np.maximum(np.tan(at), _SQUARE))[:, None]
            counts[counts] = self._met(along[counts], mesh.corners[counts])
        return counts

    def _met(self, points: Array, corners: Array) -> NDArray[np.bool_]:
        """Return whether a setting with about the inclination of each point (m, 2) is close along the rotation."""
        wide = np.maximum(_way(corners, corners[:, [1, 2, 0]]).max(axis=1, initial=0.0), self._reach)

        def near(some: NDArray[np.int64], settings: Array) -> NDArray[np.bool_]:
            at = points[some, None]
            apart = np.abs(np.arctan(_size(at)) - np.arctan(_size(settings)))
            met: NDArray[np.bool_] = ((apart <= self._reach) & (_way(at, settings) <= wide[some, None])).any(axis=1)
            return met

        met = near(np.arange(len(points)), corners)
        rest = np.flatnonzero(~met)
        step = max(1, _BLOCK // len(self.tilts))
        for start in range(0, len(rest), step):
            some = rest[start : start + step]
            met[some] = near(some, self.tilts[None])
        return met

    @cached_property
    def _sides_count(self) -> NDArray[np.bool_]:
        """Whether each side (s,) is supported."""
        mesh = self._mesh
        ends = self.tilts[mesh.sides]
        short = np.hypot(*(ends[:, 1] - ends[:, 0]).T) <= self.gap
        close = np.ptp(self._inclination[mesh.sides], axis=1) <= 2 * self._reach
        with_triangle = np.bincount(mesh.which[self._counts].ravel(), minlength=len(mesh.sides)) > 0
        return np.asarray(with_triangle | (short & close & mesh.empty))

    @cached_property
    def _sides(self) -> Array:
        """Supported sides (m, 2, 2); each point is a side of length 0."""
        points = np.stack([self.tilts, self.tilts], axis=1)
        return np.concatenate([points, self.tilts[self._mesh.sides[self._sides_count]]])

    def _distance(self, points: Array) -> Array:
        """Return the distance (n,) of points (n, 2) to the nearest side."""
        start, way = self._sides[:, 0], self._sides[:, 1] - self._sides[:, 0]
        to = points[:, None] - start
        square = (way**2).sum(axis=1)
        part = np.clip((to * way).sum(axis=-1) / np.where(square > 0, square, 1.0), 0.0, 1.0)
        return np.asarray(np.sqrt(((to - part[..., None] * way) ** 2).sum(axis=-1)).min(axis=1))

    def _hole(self, part: NDArray[np.int64]) -> Hole:
        """Return the hole of some triangles."""
        mesh = self._mesh
        corners, around = mesh.corners[part], self._inclination[mesh.triangles[part]]
        square = bool(np.isin(mesh.locate(np.zeros((1, 2))), part)[0])
        middle = mesh.middles[part[int(np.argmax(mesh.radii[part]))]]
        low = 0.0 if square else float(around.min())
        return Hole((low, float(around.max())), (0.0, _TURN) if square else _arc(corners), middle)


def _way(one: Array, other: Array) -> Array:
    """Return the distance of tilts (..., 2) from others along the rotation, 2 sqrt(|p| |q|) sin of half the angle."""
    square = ((one - other) ** 2).sum(axis=-1) - (_size(one) - _size(other)) ** 2
    return np.asarray(np.sqrt(np.maximum(square, 0.0)))


def _size(q: Array) -> Array:
    return np.asarray(np.hypot(q[..., 0], q[..., 1]))


def _arc(corners: Array) -> tuple[float, float]:
    """Return the range of rotations of connected triangles (m, 3, 2) that do not contain the untilted surface."""
    middle = inclination_rotation(corners.mean(axis=1))[1]
    off = np.remainder(inclination_rotation(corners)[1] - middle[:, None] + np.pi, _TURN) - np.pi
    off[_size(corners) < _SQUARE] = 0.0
    low, high = middle + off.min(axis=1), middle + off.max(axis=1)
    order = np.argsort(low)
    # Two turns, so that an interval that starts before 0 is one interval.
    low, high = (np.concatenate([ends[order], ends[order] + _TURN]) for ends in (low, high))
    reached = np.maximum.accumulate(high)
    starts = np.flatnonzero(low[1:] > reached[:-1] + _SAME) + 1
    if not len(starts):
        return 0.0, _TURN
    start = float(low[starts[0]])
    length = float(reached[starts[1] - 1] if len(starts) > 1 else reached[-1]) - start
    start = 0.0 if _TURN - start % _TURN < _SAME else start % _TURN
    return start, start + length
