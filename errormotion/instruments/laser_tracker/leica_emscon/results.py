"""Values of packets as readings, in SI units."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from errormotion.instruments.laser_tracker.leica_emscon import statuses
from errormotion.plugins.readings import Environment, Measurement

MILLIBAR = 100.0  # Pa


def environment(values: Mapping[str, Any]) -> Environment:
    """Return the conditions of the air."""
    return Environment(float(values["temperature"]), MILLIBAR * float(values["pressure"]), float(values["humidity"]))


def polar_position(values: Mapping[str, Any]) -> tuple[float, float, float]:
    """Return azimuth, zenith angle (rad) and distance (m) of a single measurement."""
    azimuth, zenith, distance = (float(values[f"val{k}"]) for k in (1, 2, 3))
    return azimuth, zenith, distance


def measurement(values: Mapping[str, Any], refraction: float, dead_path: int) -> Measurement:
    """Return a single measurement."""
    azimuth, zenith, distance = polar_position(values)
    spread = [float(values[f"std{k}"]) for k in (3, 1, 2)]
    return Measurement(
        distance,
        (azimuth, zenith),
        (spread[0], spread[1], spread[2]),
        environment(values),
        refraction,
        valid=True,
        dead_path=dead_path,
    )


def is_near(found: Measurement, goal: tuple[float, float, float], radius: float) -> bool:
    """Whether a measurement points to within ``radius`` (m) of a position in polar coordinates."""
    angle = math.hypot(
        found.angles[1] - goal[1],
        math.remainder(found.angles[0] - goal[0], math.tau) * math.sin(goal[1]),
    )
    return angle * goal[2] <= radius


def reason(status: int) -> str:
    """Return the reason of a missing measurement."""
    return f"status {status}: {statuses.result_text(status)}"
