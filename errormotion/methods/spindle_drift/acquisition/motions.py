"""Steps of the machine: the spindle speeds of a drift, or the positions of the sphere in a beam detection."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.kinematics.beams import across
from errormotion.methods.spindle_drift.schema import CHANNELS
from errormotion.plugins import Step

if TYPE_CHECKING:
    from errormotion.methods.spindle_drift.settings import SpindleDriftSettings


def steps(settings: SpindleDriftSettings, instruments: Mapping[str, Any] | None = None) -> list[Step]:
    """Return every step of the machine.

    Raises
    ------
    MethodError
        The bench's frame does not state its beams, so that the positions of a beam detection are unknown.
    """
    return _speeds(settings) if settings.procedure == "drift" else _scans(settings, instruments or {})


def _speeds(settings: SpindleDriftSettings) -> list[Step]:
    """Return the rests of the axes, each with its spindle speed."""
    events = sorted((e.at, e.spindle_speed) for e in settings.schedule if e.spindle_speed is not None)
    times = [0.0, *(min(at, settings.duration) for at, _ in events), settings.duration]
    speeds = [0.0, *(speed for _, speed in events)]
    return [
        Step("rest", None, math.nan, end - start, speed)
        for (start, end), speed in zip(pairwise(times), speeds, strict=True)
        if end > start or speed
    ]


def _scans(settings: SpindleDriftSettings, instruments: Mapping[str, Any]) -> list[Step]:
    frame = instruments.get("spindle_frame")
    origin, direction = getattr(frame, "origin", None), getattr(frame, "direction", None)
    if not (isinstance(origin, Mapping) and isinstance(direction, Mapping) and set(CHANNELS) <= set(origin)):
        raise MethodError(
            "beam_detection: expected an instrument 'spindle_frame' whose settings state the beams (origin, "
            "direction); without them the positions of the sphere are unknown",
            code="beams.frame.not_stated",
        )
    unit = np.array([direction[name] for name in CHANNELS], np.float64)
    frame_position = np.array(getattr(frame, "machine_position", (0.0, 0.0, 0.0)), np.float64)
    centres, _ = sphere_centres(
        settings,
        np.array([origin[name] for name in CHANNELS], np.float64),
        unit / np.linalg.norm(unit, axis=1, keepdims=True),
    )
    return [
        Step("move", (float(x), float(y), float(z)), math.nan, settings.dwell)
        for x, y, z in (frame_position + centres).reshape(-1, 3)
    ]


def sphere_centres(settings: SpindleDriftSettings, origin: Array, direction: Array) -> tuple[Array, Array]:
    """Return the centres of the sphere (channel, profile, step, 3), m, and the directions of the scans (.., 3)."""
    offsets = np.linspace(-0.5, 0.5, settings.steps) * settings.scan_length
    scans = np.array([[v for _ in settings.depths for v in machine_axes(u)] for u in direction])
    distance = np.repeat(settings.depths, 2) + settings.sphere_radius
    middle = origin[:, None] + distance[:, None] * direction[:, None]
    return middle[:, :, None] + offsets[:, None] * scans[:, :, None], scans


def machine_axes(direction: Array) -> Array:
    """Return the two machine axes perpendicular to a beam; for a beam oblique to all axes, two such vectors."""
    axis = int(np.argmax(np.abs(direction)))
    if abs(direction[axis]) < 0.9:
        return across(direction)
    return np.delete(np.eye(3), axis, axis=0)
