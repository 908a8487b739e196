"""Lines of sight between tracker and targets: obstacles, and the acceptance angle of the reflector."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.methods.multilateration.settings import Planning

_MARGIN = 1e-9


@dataclass(frozen=True)
class Sight:
    """Lines of sight.

    Attributes
    ----------
    obstacles : ndarray (k, 2, 3)
        Lower and upper corners of boxes, m.
    axis : ndarray (3,) or None
        Direction of the reflector, a unit vector; None: from the middle of the targets to each station.
    acceptance : float
        Largest angle between that direction and the beam, rad.
    nearest : float
        Smallest distance, m.
    middle : ndarray (3,) or None
        Middle of the targets, m; None: their mean.
    """

    obstacles: Array
    axis: Array | None
    acceptance: float
    nearest: float
    middle: Array | None = None

    @classmethod
    def of(cls, planning: Planning) -> Sight:
        """Return the lines of sight of the settings."""
        boxes = np.array([(box.low, box.high) for box in planning.obstacles], np.float64).reshape(-1, 2, 3)
        axis = None
        if planning.reflector_axis is not None:
            axis = np.array(planning.reflector_axis, np.float64)
            axis /= np.linalg.norm(axis)
        return cls(boxes, axis, planning.acceptance, planning.nearest)

    def sees(self, station: ArrayLike, target: ArrayLike) -> NDArray[np.bool_]:
        """Return which targets (m, 3), m, are visible from which stations (n, 3), m, as (n, m)."""
        U, u = np.asarray(station, np.float64), np.asarray(target, np.float64)
        back = U[:, None] - u
        distance = np.linalg.norm(back, axis=-1)
        axis = self.axis
        if axis is None:
            axis = (U - (u.mean(axis=0) if self.middle is None else self.middle))[:, None]
            axis = axis / np.maximum(np.linalg.norm(axis, axis=-1, keepdims=True), _MARGIN)
        along = np.sum(back * axis, axis=-1)
        accepted = along >= np.cos(self.acceptance) * distance - _MARGIN
        free = accepted & (distance >= self.nearest - _MARGIN)
        for low, high in self.obstacles:
            free &= ~blocked(u, back, low, high)
        return np.asarray(free)


def blocked(start: Array, way: Array, low: Array, high: Array) -> NDArray[np.bool_]:
    """Return whether the lines from ``start`` (m, 3) along ``way`` (n, m, 3) intersect a box, (n, m)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (low - start) / way, (high - start) / way
    # Parallel to a face: the whole line is within the extent of the box in that direction, or none of it.
    still = way == 0
    inside = np.broadcast_to((start > low) & (start < high), way.shape)
    enters = np.where(still, np.where(inside, -np.inf, np.inf), np.minimum(first, second))
    leaves = np.where(still, np.where(inside, np.inf, -np.inf), np.maximum(first, second))
    return np.asarray(np.maximum(enters.max(axis=-1), 0.0) < np.minimum(leaves.min(axis=-1), 1.0) - _MARGIN)
