"""Raw data as a test is expected to give them, and the plan of a beam detection."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.kinematics.iso import DOF
from errormotion.methods.spindle_drift.acquisition.motions import machine_axes
from errormotion.methods.spindle_drift.identification.beams import fisher_bound, sphere_reading
from errormotion.methods.spindle_drift.identification.detection import identify_beams
from errormotion.methods.spindle_drift.schema import CHANNELS, PLANNED, SCHEMA

if TYPE_CHECKING:
    from errormotion.methods.spindle_drift.settings import SpindleDriftSettings

_PLANNED = "planned, not measured"
_TYPICAL_DRIFT = np.array([5e-6, 5e-6, 20e-6, 1e-4, 1e-4])  # EX, EY, EZ, m; EA, EB, rad
_OFF_AXIS = 30e-6
"""Distance along X and Y from the axis of the bar to the functional point, whose coordinates are rounded, m."""
_AXES = np.array([0, 0, 1, 1, 2])
"""Direction in which the sensor of each channel is displaced by the expansion of the frame."""
_LATER = 3600.0
"""Time of the planned instant after the reference state, s."""


def expected(settings: SpindleDriftSettings) -> xr.Dataset:
    """Return raw data without noise, for the procedure of the settings.

    A frame is as drawn in ISO 230-3, with readings at mid-range.
    """
    return _expected_beams(settings) if settings.procedure == "beam_detection" else _expected_drift(settings)


def plan_beams(settings: SpindleDriftSettings, method: str, version: str) -> xr.Dataset:
    """Return the identification of the expected beam detection, with values of 0."""
    beams = identify_beams(_expected_beams(settings), settings, method, version)
    kept = beams[[*DOF, "covariance", "beam_index"]].assign({name: 0.0 * beams[name] for name in DOF})
    return kept.assign_attrs(reference=_PLANNED)


def _frame(settings: SpindleDriftSettings) -> tuple[Array, Array]:
    """Return origins and directions (5, 3) of the beams of a frame."""
    p = settings.layout
    near = p.bar_radius + p.standoff
    z1, z2 = p.levels
    origin = np.array([[near, 0, z1], [near, 0, z2], [0, near, z1], [0, near, z2], [0, 0, -p.standoff]])
    return origin, np.array([[-1.0, 0, 0], [-1, 0, 0], [0, -1, 0], [0, -1, 0], [0, 0, 1]])


def _expected_drift(settings: SpindleDriftSettings) -> xr.Dataset:
    """Return the means of the reference state, and of one later instant.

    The beams are those of a detection with the stated steps. The later instant has a typical drift (5 um in X and Y,
    20 um in Z, 0.1 mrad), because the effect of the uncertainty of the beams increases with the drift, and a frame
    that has become warmer, if its expansion is stated.
    """
    p = settings.layout
    origin, direction = _frame(settings)
    covariance = [
        fisher_bound(o, u, _centres(o, u, settings), settings.sphere_radius, p.step_noise)
        for o, u in zip(origin, direction, strict=True)
    ]
    ex, ey, ez, ea, eb = _TYPICAL_DRIFT
    zs = np.array(p.levels)
    still = p.standoff - _OFF_AXIS * np.array([1.0, 1.0, 1.0, 1.0, 0.0])
    # Distances to first order: a displacement of the bar towards the sensor reduces the reading.
    moved = still + np.array([*-(ex + eb * zs), *-(ey - ea * zs), ez])
    start = settings.reference_time or 0.0
    means = max(round((settings.reference_average or 0.0) / settings.average), 1)
    time = np.unique([0.0, *(start + settings.average * np.arange(means)), start + _LATER])
    samples = max(1.0, settings.average * p.rate)
    variables: dict[str, Any] = {
        "distance": (("channel", "time"), np.where(time < time[-1], still[:, None], moved[:, None])),
        "beam_origin": (("channel", "direction"), origin),
        "beam_direction": (("channel", "direction"), direction),
        "beam_covariance": (("channel", "p", "p_"), np.array(covariance)),
        "nominal_origin": (("channel", "direction"), origin),
        "nominal_direction": (("channel", "direction"), direction),
        "bar_radius": p.bar_radius,
        "distance_noise": p.noise / np.sqrt(samples),
        "level": ("height", zs),
    }
    if any(p.frame_expansion):
        warm = np.where(time < time[-1], 20.0, 20.0 + p.frame_warming)
        variables["frame_expansion"] = (("channel", "direction"), np.eye(3)[_AXES] * p.frame_expansion)
        variables["temperature"] = (("time", "sensor"), warm[:, None])
    labels = {**_LABELS, "time": time, "sensor": [settings.frame_temperature]}
    return xr.Dataset(variables, labels, _ATTRS)


def _expected_beams(settings: SpindleDriftSettings) -> xr.Dataset:
    """Return readings of a stepped sphere whose residuals have exactly the stated noise.

    The noise of a detection is that of its residuals. Readings without any would have no uncertainty: pseudo-random
    residuals, without their part that another beam would explain, have the stated sum of squares.
    """
    origin, direction = _frame(settings)
    sign = np.random.default_rng(0)
    centres, scans, readings = [], [], []
    for o, u in zip(origin, direction, strict=True):
        centre = _centres(o, u, settings)
        reading, jacobian = sphere_reading(o, u, centre, settings.sphere_radius)
        seen = np.isfinite(reading)
        J = jacobian[seen]
        noise = sign.choice([-1.0, 1.0], len(J))
        noise -= J @ np.linalg.lstsq(J, noise)[0]
        freedom = len(J) - J.shape[1]
        reading[seen] += settings.layout.step_noise * np.sqrt(freedom / (noise @ noise)) * noise
        centres.append(centre)
        scans.append(np.tile(machine_axes(u), (len(settings.depths), 1)))
        readings.append(reading)
    variables: dict[str, Any] = {
        "distance": (("channel", "profile", "step"), np.array(readings)),
        "sphere_centre": (("channel", "profile", "step", "direction"), np.array(centres)),
        "sphere_radius": settings.sphere_radius,
        "scan_direction": (("channel", "profile", "direction"), np.array(scans)),
        "nominal_origin": (("channel", "direction"), origin),
        "nominal_direction": (("channel", "direction"), direction),
    }
    return xr.Dataset(variables, {key: _LABELS[key] for key in ("channel", "direction")}, _ATTRS)


def _centres(origin: Array, direction: Array, settings: SpindleDriftSettings) -> Array:
    """Return the centres (profile, step, 3) of the sphere: at each depth, scans along both axes across the beam."""
    offsets = np.linspace(-0.5, 0.5, settings.steps) * settings.scan_length
    middle = origin + (np.array(settings.depths) + settings.sphere_radius)[:, None] * direction
    every = middle[:, None, None] + offsets[:, None] * machine_axes(direction)[:, None]
    return np.asarray(every.reshape(-1, settings.steps, 3))


_LABELS = {"channel": list(CHANNELS), "direction": list("xyz"), "height": ["L1", "L2"]}
_ATTRS = {"schema": SCHEMA, "machine": PLANNED}
