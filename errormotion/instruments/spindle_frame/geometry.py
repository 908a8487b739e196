"""How the five beams stand, as arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from errormotion.instruments.spindle_frame.settings import CHANNELS, FrameSettings

Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class FrameGeometry:
    """The frame as drawn, in machine coordinates.

    A reading d of a channel puts a point of the bar's surface at origin + d direction.

    Attributes
    ----------
    channels : tuple of str
    nominal_origin : ndarray, (channel, 3)
        Start of the measuring range of each beam, m.
    nominal_direction : ndarray, (channel, 3)
        Unit vectors from the sensor to the bar.
    bar_radius : float
        m.
    levels : ndarray, (2,)
        z of L1 and L2, m.
    range : float
        Measuring range, m.
    noise : ndarray, (channel,)
        Standard deviation of a single sample, m.
    expansion : ndarray, (channel, 3)
        Where the origins go per kelvin of the frame, m/K: along the axis that the sensor measures.
    reference_temperature : float
        At which the origins hold, degC.
    """

    channels: tuple[str, ...]
    nominal_origin: Array
    nominal_direction: Array
    bar_radius: float
    levels: Array
    range: float
    noise: Array
    expansion: Array
    reference_temperature: float

    @classmethod
    def of(cls, settings: FrameSettings) -> FrameGeometry:
        """Return the geometry that the settings describe."""
        direction = np.array([settings.direction[name] for name in CHANNELS], dtype=float)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        expansion = np.zeros((len(CHANNELS), 3))
        for channel, name in enumerate(CHANNELS):
            axis = "XYZ".index(name[0])
            expansion[channel, axis] = settings.expansion[axis]
        return cls(
            channels=CHANNELS,
            nominal_origin=np.array([settings.origin[name] for name in CHANNELS], dtype=float),
            nominal_direction=direction,
            bar_radius=settings.bar_radius,
            levels=np.array(settings.levels, dtype=float),
            range=settings.range,
            noise=np.full(len(CHANNELS), settings.noise),
            expansion=expansion,
            reference_temperature=settings.reference_temperature,
        )

    def origins_at(self, temperature: float | Array) -> Array:
        """Return the origins with the frame at a temperature, m, (..., channel, 3).

        The frame's expansion is part of what the sensors read; this is its compensation.
        """
        warming = np.asarray(temperature, dtype=float)[..., None, None] - self.reference_temperature
        return np.asarray(self.nominal_origin + warming * self.expansion)
