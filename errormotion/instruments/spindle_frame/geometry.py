"""Geometry of the five beams, as arrays."""

from __future__ import annotations

import numpy as np

from errormotion.instruments.spindle_frame.settings import CHANNELS, FrameSettings
from errormotion.plugins.readings import FrameGeometry


def frame_geometry(settings: FrameSettings) -> FrameGeometry:
    """Return the geometry that the settings of a frame describe."""
    direction = np.array([settings.direction[name] for name in CHANNELS], dtype=float)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    expansion = np.zeros((len(CHANNELS), 3))
    for channel, name in enumerate(CHANNELS):
        axis = "XYZ".index(name[0])
        expansion[channel, axis] = settings.expansion[axis]
    return FrameGeometry(
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
