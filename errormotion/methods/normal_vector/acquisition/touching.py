"""Directions in which a ball is touched."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array

if TYPE_CHECKING:
    from errormotion.methods.normal_vector.settings import NormalVectorSettings


def touch_normals(touches: int, elevation: float = 0.0) -> Array:
    """Return the touches of a ball as unit vectors from its centre, (touches, 3); the probe moves against them.

    All but the last lie around the ball, evenly spaced starting at +X, ``elevation`` (rad) above its equator; the last
    one is on top.
    """
    around = 2 * np.pi * np.arange(touches - 1) / (touches - 1)
    ring = np.stack([np.cos(around), np.sin(around), np.full_like(around, np.tan(elevation))], axis=1)
    ring *= np.cos(elevation)
    return np.concatenate([np.round(ring, 15), [[0.0, 0.0, 1.0]]])


def normals(settings: NormalVectorSettings) -> Array:
    """Return the touch directions of each ball of the settings, (ball, touch, 3)."""
    return np.tile(touch_normals(settings.touches, settings.elevation), (len(settings.balls), 1, 1))


def names(settings: NormalVectorSettings) -> list[str]:
    """Return the names of the balls."""
    return [ball.name or str(i + 1) for i, ball in enumerate(settings.balls)]
