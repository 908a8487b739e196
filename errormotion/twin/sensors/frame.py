"""The measuring frame: five laser triangulation sensors around a bar, nominal and true."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from errormotion.arrays import Array

CHANNELS = ("X1", "X2", "Y1", "Y2", "Z")
RANGE = 2e-3
#: z of the levels L1 and L2, m.
LEVELS = (0.010, 0.050)
#: Expansion of the frame per kelvin at the sensors that measure along X, Y, Z, m/K.
EXPANSION = (2.1e-6, 2.4e-6, 1.3e-6)
#: Relative deviation of the true expansion of a frame from the drawing (one sigma).
EXPANSION_SPREAD = 0.1
#: Rise of a sensor's reading after switching on, m, and its time constant, s: settled after two hours.
WARM_UP = 10.5e-6
WARM_UP_TIME = 1440.0
#: White noise of one sample, m.
NOISE = 0.3e-6


@dataclass(frozen=True)
class FrameGeometry:
    """Five beams; a reading d means a surface point at origin + d direction, in machine coordinates.

    Attributes
    ----------
    channels : tuple of str
        X1, Y1 measure at level L1 of the bar, X2, Y2 at level L2, Z at its end face.
    nominal_origin, nominal_direction : ndarray, (channel, 3)
        The beams of the drawing, m; the origin is the start of the measuring range.
    true_origin, true_direction : ndarray, (channel, 3)
        The beams in the cold state.
    levels : ndarray, (2,)
        z of L1 and L2, m.
    range : float
        Measuring range, m.
    noise : ndarray, (channel,)
        White noise of one sample, m (one sigma).
    warm_up : ndarray, (channel,)
        Rise of the reading after switching on, m.
    warm_up_time : float
        Its time constant, s.
    expansion, true_expansion : ndarray, (channel, 3)
        Displacement of the origins per kelvin of the frame, m/K: in the drawing, and true (deviation 10 %, one sigma).
    """

    channels: tuple[str, ...]
    nominal_origin: Array
    nominal_direction: Array
    true_origin: Array
    true_direction: Array
    levels: Array
    range: float
    noise: Array
    warm_up: Array
    warm_up_time: float
    expansion: Array
    true_expansion: Array

    def origins(self, warming: ArrayLike) -> Array:
        """Return the true origins after a temperature rise of the frame (n,), K; m, shape (channel, n, 3)."""
        rise = np.asarray(warming, dtype=float)
        return np.asarray(self.true_origin[:, None, :] + self.true_expansion[:, None, :] * rise[:, None])

    def warm_up_offset(self, since_on: ArrayLike) -> Array:
        """Return the readings minus their settled values, m (not positive), shape (channel, n)."""
        age = np.asarray(since_on, dtype=float) / self.warm_up_time
        return np.asarray(-self.warm_up[:, None] * np.exp(-age))


def nominal_beams(bar_radius: float) -> tuple[Array, Array]:
    """Return nominal origins, m, and directions, (channel, 3): mid-range on a bar along z that ends at z = 0."""
    standoff = bar_radius + RANGE / 2
    low, high = LEVELS
    origin = [(standoff, 0, low), (standoff, 0, high), (0, standoff, low), (0, standoff, high), (0, 0, -RANGE / 2)]
    direction = [(-1, 0, 0), (-1, 0, 0), (0, -1, 0), (0, -1, 0), (0, 0, 1)]
    return np.array(origin, dtype=float), np.array(direction, dtype=float)


def seeded_frame(rng: np.random.Generator, bar_radius: float) -> FrameGeometry:
    """Return a frame whose beams deviate by about 0.1 mm laterally, 0.03 mm along the beam, and 5 mrad.

    Along the beam the deviation is small, because the sensors are adjusted to mid-range on the machine.
    """
    origin, direction = nominal_beams(bar_radius)
    across = np.clip(rng.normal(0, 0.1e-3, origin.shape), -0.15e-3, 0.15e-3)
    along = rng.uniform(-0.05e-3, 0.05e-3, len(CHANNELS))
    shift = across + (along - np.sum(across * direction, axis=1))[:, None] * direction
    tilted = direction + np.clip(rng.normal(0, 5e-3, origin.shape), -12e-3, 12e-3)
    expansion = np.zeros_like(origin)
    for channel, name in enumerate(CHANNELS):
        axis = "XYZ".index(name[0])
        expansion[channel, axis] = EXPANSION[axis]
    warm_up = WARM_UP * rng.uniform(0.95, 1.05, len(CHANNELS))
    return FrameGeometry(
        channels=CHANNELS,
        nominal_origin=origin,
        nominal_direction=direction,
        true_origin=origin + shift,
        true_direction=tilted / np.linalg.norm(tilted, axis=1, keepdims=True),
        levels=np.array(LEVELS),
        range=RANGE,
        noise=np.full(len(CHANNELS), NOISE),
        warm_up=warm_up,
        warm_up_time=WARM_UP_TIME,
        expansion=expansion,
        true_expansion=expansion * rng.normal(1.0, EXPANSION_SPREAD),
    )
