"""The radial deviation of a circular path from the errors of its two axes.

The commanded position of the tool is ``R u``, with ``u = (cos a, sin a)`` in the plane of the two axes and the angle
``a`` from the first axis towards the second. The sense is s = +1 counterclockwise and s = -1 clockwise, the feed is V,
and the bar measures ``u . e`` of the error e = (e_1, e_2) of tool relative to workpiece. To first order:

===================  ===========================================  ==========================================
parameter            error of the axes                            radial deviation
===================  ===========================================  ==========================================
``squareness`` q     e_1 = -q R sin a                             -(q R / 2) sin 2a
``scale_mismatch``   e_1 = m_1 R cos a, e_2 = m_2 R sin a         ((m_1 - m_2) R / 2) cos 2a, and a constant
``servo_mismatch``   e_i = -t_i v_i (lag of t_i)                  s (V / 2) (t_1 - t_2) sin 2a
``backlash_1`` b_1   e_1 = -(b_1 / 2) sign v_1                    s (b_1 / 2) cos a sign(sin a)
``backlash_2`` b_2   e_2 = -(b_2 / 2) sign v_2                    -s (b_2 / 2) sin a sign(cos a)
``bow_1`` w_1        e_2 = w_1 cos^2 a                            (w_1 / 4) sin 3a, and sin a
``bow_2`` w_2        e_1 = w_2 sin^2 a                            -(w_2 / 4) cos 3a, and cos a
``spike_1`` p_1      e_1 = p_1 sign(cos a) exp(-f / d)            p_1 abs(cos a) exp(-f / d)
``spike_2`` p_2      e_2 = p_2 sign(sin a) exp(-f / d)            p_2 abs(sin a) exp(-f / d)
===================  ===========================================  ==========================================

f is the angle travelled since the last reversal of the axis, and d the decay of its spike. ``squareness`` is the
rotation of the second axis from the right angle to the first, about the normal of the plane: C0Y in plane XY. A bow is
the straightness error of an axis at the ends of the diameter relative to its middle. The second order is the square of
the error across the bar divided by twice the radius: 1 nm for 17 um at a radius of 150 mm.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.methods.circular_test.schema import READINGS, SCHEMA
from errormotion.methods.circular_test.settings import CircularTestSettings

TAU = 2 * np.pi
DIRECTIONS = ("CCW", "CW")
SENSE = np.array([1.0, -1.0])
PARAMETERS = {
    "squareness": "rad",
    "scale_mismatch": "1",
    "servo_mismatch": "s",
    **dict.fromkeys(("backlash_1", "backlash_2", "bow_1", "bow_2", "spike_1", "spike_2"), "m"),
}
"""Units of the parameters, in their order."""
TYPICAL = {
    "squareness": 30e-6,
    "scale": 10e-6,
    "scale_mismatch": -15e-6,
    "servo_mismatch": 0.2e-3,
    "backlash_1": 1.5e-6,
    "backlash_2": 2e-6,
    "bow_1": 1e-6,
    "bow_2": -1e-6,
    "spike_1": 2e-6,
    "spike_2": 3e-6,
}
"""Errors of a machining centre; ``scale`` is that of both axes."""
OFFSET = np.array([25e-6, -20e-6])
"""Typical set-up error: of the ball on the table from the programmed centre, m."""
WARM, WARMING, DRIFT, EXPANSION, EXPANSION_U, TEMPERATURE_U = 20.6, 2e-4, 1e-9, 11.5e-6, 1e-6, 0.05
"""Typical bar: temperature, degC; its change, K/s; drift, m/s; expansion with uncertainty, 1/K; of temperature, K."""
_SUBDIVISION = 32
"""Angles at which a sector is averaged."""


def basis(angle: Array, sense: Array, radius: float, feed: float, decay: float) -> Array:
    """Return the radial deviation by one unit of each parameter, (..., 9); ``sense`` is +1 or -1 at each angle."""
    sin, cos = np.sin(angle), np.cos(angle)
    first, second = _since_reversal(angle, sense)
    return np.stack(
        [
            -radius / 2 * np.sin(2 * angle),
            radius / 2 * np.cos(2 * angle),
            sense * feed / 2 * np.sin(2 * angle),
            sense / 2 * cos * np.sign(sin),
            -sense / 2 * sin * np.sign(cos),
            np.sin(3 * angle) / 4,
            -np.cos(3 * angle) / 4,
            np.abs(cos) * np.exp(-first / decay),
            np.abs(sin) * np.exp(-second / decay),
        ],
        axis=-1,
    )


def circle(angle: Array) -> Array:
    """Return the radial deviation by a unit of radius and of the offset of the path along both axes, (..., 3)."""
    return np.stack([np.ones_like(angle), np.cos(angle), np.sin(angle)], axis=-1)


def middles(places: int) -> Array:
    """Return the angles in the middle of each sector, rad; reversals lie between sectors."""
    return np.asarray((np.arange(places) + 0.5) * TAU / places)


@lru_cache(maxsize=8)
def over_sectors(places: int, radius: float, feed: float, decay: float) -> Array:
    """Return the means over sectors of circle and parameters, (2, place, 3 + 9); read-only."""
    offsets = (np.arange(_SUBDIVISION) + 0.5) / _SUBDIVISION - 0.5
    angle = np.array([middles(places)[:, None] + offsets * TAU / places] * 2)
    path = basis(angle, np.broadcast_to(SENSE[:, None, None], angle.shape), radius, feed, decay)
    means: Array = np.concatenate([circle(angle), path], axis=-1).mean(axis=2)
    means.flags.writeable = False
    return means


def position(errors: Mapping[str, float], angle: Array, sense: Array, settings: CircularTestSettings) -> Array:
    """Return the position of the tool in the plane, exactly, (..., 2), m.

    ``errors`` are any of `PARAMETERS`, ``scale`` of both axes, and ``lobes``, five of which no parameter describes, m.
    """
    its = dict.fromkeys([*TYPICAL, "lobes"], 0.0) | dict(errors)
    R, V, cos, sin = settings.nominal_radius, settings.feed, np.cos(angle), np.sin(angle)
    spike = [np.exp(-since / settings.spike_decay) for since in _since_reversal(angle, sense)]
    first = (
        (its["scale"] + its["scale_mismatch"]) * R * cos
        - its["squareness"] * R * sin
        + its["servo_mismatch"] * V * sense * sin
        + its["backlash_1"] / 2 * np.sign(sense * sin)
        + its["bow_2"] * sin**2
        + its["spike_1"] * np.sign(cos) * spike[0]
    )
    second = (
        its["scale"] * R * sin
        - its["backlash_2"] / 2 * np.sign(sense * cos)
        + its["bow_1"] * cos**2
        + its["spike_2"] * np.sign(sin) * spike[1]
    )
    r = R + its["lobes"] * np.cos(5 * angle)
    return np.stack([r * cos + first, r * sin + second], axis=-1)


def expected(settings: CircularTestSettings, errors: Mapping[str, float] = TYPICAL) -> xr.Dataset:
    """Return the readings of a test without noise: circles alternately counterclockwise and clockwise."""
    R, V, n, runs = settings.nominal_radius, settings.feed, settings.samples, settings.runs
    phase = np.mod((np.arange(2 * runs) + 0.5) * (np.sqrt(5) - 1) / 2, 1.0).reshape(2, runs, 1)
    travelled = TAU / n * (np.arange(n) + phase)
    sense = np.broadcast_to(SENSE[:, None, None], travelled.shape)
    angle = np.where(sense > 0, travelled, TAU - travelled)
    lap = 2 * np.arange(runs)[None, :, None] + np.arange(2)[:, None, None]
    time = 60.0 + lap * (TAU * R / V + 10.0) + travelled * R / V
    temperature = WARM + WARMING * time.mean(axis=2)
    length = np.linalg.norm(position(errors, angle, sense, settings) - OFFSET, axis=-1)
    length += DRIFT * time - EXPANSION * R * (temperature - 20.0)[:, :, None]
    variables = {
        "length": (READINGS, length, "m"),
        "angle": (READINGS, angle, "rad"),
        "reading_time": (READINGS, time, "s"),
        "temperature": (READINGS[:2], temperature, "degC"),
        "nominal_radius": ((), R, "m"),
        "feed": ((), V, "m/s"),
        "length_noise": ((), settings.length_noise, "m"),
        "length_uncertainty": ((), settings.length_uncertainty, "m"),
        "calibration_temperature": ((), 20.0, "degC"),
        "expansion": ((), EXPANSION, "1/K"),
        "expansion_uncertainty": ((), EXPANSION_U, "1/K"),
        "temperature_uncertainty": ((), TEMPERATURE_U, "K"),
        "centre": (("direction",), np.array(settings.centre), "m"),
        "axis_direction": (("axis", "direction"), np.eye(3)[["XYZ".index(name) for name in settings.plane]], "1"),
    }
    return xr.Dataset(
        {name: (dims, value, {"units": unit}) for name, (dims, value, unit) in variables.items()},
        {"direction_of_travel": list(DIRECTIONS), "direction": list("xyz"), "axis": list(settings.plane)},
        {"schema": SCHEMA, "machine": "expected", "frame": "machine"},
    )


def _since_reversal(angle: Array, sense: Array) -> tuple[Array, Array]:
    """Return the angle travelled since the last reversal of the first and of the second axis, rad; in [0, pi)."""
    return np.mod(sense * angle, np.pi), np.mod(sense * (angle - np.pi / 2), np.pi)
