"""Raw datasets of the virtual machine without any wire: for Monte Carlo, so cheap, with nothing drawn but the noise."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.twin import intersections
from errormotion.twin.frame import FrameGeometry

Beams = tuple[Array, Array, Array | None]

SCHEMA = "errormotion.raw.spindle_drift/1"
#: beam detection: distances from the start of the measuring range, m; steps across the beam, m; samples per rest
DEPTHS = (0.2e-3, 1.0e-3, 1.8e-3)
STEPS = 20e-6 * np.arange(-50, 51)
SAMPLES_PER_REST = 6000

_M = {"units": "m"}
_1 = {"units": "1"}
_XYZ = np.eye(3)


def spindle_drift(
    frame: FrameGeometry,
    t: Array,
    readings: Array,
    noise: float,
    beams: Beams,
    bar_radius: float,
    extras: Mapping[str, Any],
    attrs: Mapping[str, Any],
) -> xr.Dataset:
    """Return a raw dataset of a drift measurement.

    Parameters
    ----------
    frame : FrameGeometry
        Channels and levels.
    t : (n,)
        s.
    readings : (channel, n)
        m, noise included.
    noise : float
        Standard deviation of one reading, m.
    beams : (origin, direction, covariance or None)
        As the lab knows them: (channel, 3), (channel, 3), (channel, 6, 6).
    bar_radius : float
        As the lab knows it, m.
    extras : mapping
        Further variables.
    attrs : mapping
        Further attributes.
    """
    origin, direction, covariance = beams
    variables: dict[str, Any] = {
        "distance": (("channel", "time"), readings, _M),
        "beam_origin": (("channel", "direction"), np.array(origin), _M),
        "beam_direction": (("channel", "direction"), np.array(direction), _1),
        "bar_radius": ((), bar_radius, _M),
        "distance_noise": ((), noise, _M),
        "level": ("height", np.array(frame.levels), _M),
        **extras,
    }
    if covariance is not None:
        variables["beam_covariance"] = (("channel", "p", "p_"), covariance)
    coords = {
        "channel": list(frame.channels),
        "direction": list("xyz"),
        "height": ["L1", "L2"],
        "time": ("time", t, {"units": "s"}),
    }
    return xr.Dataset(variables, coords, {"schema": SCHEMA, **attrs})


def scan_plan(frame: FrameGeometry, sphere_radius: float) -> tuple[Array, Array]:
    """Return commanded centres (channel, profile, step, 3), m, and scan directions (channel, profile, 3).

    Six profiles a channel: at three depths of the range, in both machine directions across the beam.
    """
    centres, directions = [], []
    for origin, beam in zip(frame.nominal_origin, frame.nominal_direction, strict=True):
        across = [axis for axis in _XYZ if abs(axis @ beam) < 0.5]
        scans = np.array([axis for _ in DEPTHS for axis in across])
        ahead = np.repeat(DEPTHS, len(across)) + sphere_radius
        middle = origin + ahead[:, None] * beam
        centres.append(middle[:, None, :] + STEPS[:, None] * scans[:, None, :])
        directions.append(scans)
    return np.array(centres), np.array(directions)


def beam_detection(
    frame: FrameGeometry,
    sphere_radius: float,
    repeatability: float,
    speckle: float,
    rng: np.random.Generator,
    attrs: Mapping[str, Any],
) -> xr.Dataset:
    """Return a raw dataset of a beam detection in the cold state, with one mean reading per rest.

    Parameters
    ----------
    frame : FrameGeometry
        Beams.
    sphere_radius : float
        m.
    repeatability, speckle : float
        Standard deviation of each coordinate of a rest and of what the speckle does to its reading, m.
    rng : Generator
        Of the noise.
    attrs : mapping
        Further attributes.
    """
    centres, scans = scan_plan(frame, sphere_radius)
    there = centres + rng.normal(0, repeatability, centres.shape)
    beams = (frame.true_origin[:, None, None, :], frame.true_direction[:, None, None, :])
    noise = np.hypot(speckle, frame.noise / np.sqrt(SAMPLES_PER_REST))[:, None, None]
    readings = intersections.to_sphere(*beams, there, sphere_radius) + noise * rng.normal(size=centres.shape[:-1])
    readings[~((readings >= 0) & (readings <= frame.range))] = np.nan
    variables = {
        "distance": (("channel", "profile", "step"), readings, _M),
        "sphere_centre": (("channel", "profile", "step", "direction"), centres, _M),
        "sphere_radius": ((), sphere_radius, _M),
        "scan_direction": (("channel", "profile", "direction"), scans, _1),
        "nominal_origin": (("channel", "direction"), np.array(frame.nominal_origin), _M),
        "nominal_direction": (("channel", "direction"), np.array(frame.nominal_direction), _1),
        "distance_noise": ((), float(np.hypot(noise.max(), repeatability)), _M),
    }
    coords = {"channel": list(frame.channels), "direction": list("xyz")}
    return xr.Dataset(variables, coords, {"schema": SCHEMA, **attrs})


def instrument_note(kind: str, seed: int) -> str:
    """Return the attribute ``instruments``: that all of this is simulated."""
    return json.dumps([{"id": "virtual five-sensor frame", "address": f"twin://{kind}?seed={seed}", "simulated": True}])
