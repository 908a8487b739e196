"""Expected uncertainty of a planned measurement."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from errormotion.datasets import build_errors, provenance
from errormotion.kinematics.beams import beam_errors
from errormotion.methods.spindle_drift.acquisition.motions import machine_axes
from errormotion.methods.spindle_drift.identification.beams import fisher_bound
from errormotion.methods.spindle_drift.identification.drift import identify_drift
from errormotion.methods.spindle_drift.schema import CHANNELS, SCHEMA

if TYPE_CHECKING:
    from errormotion.methods.spindle_drift.settings import Settings

_PLANNED = "planned, not measured"
_TYPICAL_DRIFT = np.array([5e-6, 5e-6, 20e-6, 1e-4, 1e-4])  # EX, EY, EZ, m; EA, EB, rad


def plan(settings: Settings, method: str, version: str) -> xr.Dataset:
    """Return an error dataset of zeros with the expected covariance, for the procedure of the settings."""
    part = _plan_beams if settings.procedure == "beam_detection" else _plan_drift
    return part(settings, method, version)


def _frame(settings: Settings) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return origins, directions (5, 3) and bounds (5, 6, 6) of the beams of a frame as drawn in ISO 230-3."""
    p = settings.layout
    near = p.bar_radius + p.standoff
    z1, z2 = p.levels
    origin = np.array([[near, 0, z1], [near, 0, z2], [0, near, z1], [0, near, z2], [0, 0, -p.standoff]])
    direction = np.array([[-1.0, 0, 0], [-1, 0, 0], [0, -1, 0], [0, -1, 0], [0, 0, 1]])
    bounds = [
        fisher_bound(o, u, _centres(o, u, settings), settings.sphere_radius, p.step_noise)
        for o, u in zip(origin, direction, strict=True)
    ]
    return origin, direction, np.array(bounds)


def _plan_beams(settings: Settings, method: str, version: str) -> xr.Dataset:
    origin, direction, bounds = _frame(settings)
    errors, covariance = beam_errors(origin, direction, origin, direction, bounds)
    return build_errors(
        errors,
        covariance,
        dims=("beam",),
        coords={"beam": list(CHANNELS)},
        component="beam",
        machine="plan",
        frame="machine",
        functional_point=origin.mean(axis=0),
        reference=_PLANNED,
        method=method,
        method_version=version,
        provenance=provenance.make(settings, None, None),
    )


def _plan_drift(settings: Settings, method: str, version: str) -> xr.Dataset:
    """Plan a drift: the reference state and one later instant.

    A bar of the stated radius is in a frame as drawn in ISO 230-3, with readings at mid-range; the beams are those of a
    detection with the stated steps. The later instant has a typical drift (5 um in X and Y, 20 um in Z, 0.1 mrad),
    because the effect of the uncertainty of the beams increases with the drift.
    """
    p = settings.layout
    origin, direction, covariance = _frame(settings)
    ex, ey, ez, ea, eb = _TYPICAL_DRIFT
    zs = np.array(p.levels)
    still = np.full(5, p.standoff)
    # Distances to first order: a displacement of the bar towards the sensor reduces the reading.
    moved = still + np.array([*-(ex + eb * zs), *-(ey - ea * zs), ez])
    samples = max(1.0, settings.average * p.rate)
    xyz = list("xyz")
    raw = xr.Dataset(
        {
            "distance": (("channel", "time"), np.stack([still, moved], axis=1)),
            "beam_origin": (("channel", "direction"), origin),
            "beam_direction": (("channel", "direction"), direction),
            "beam_covariance": (("channel", "p", "p_"), covariance),
            "nominal_origin": (("channel", "direction"), origin),
            "nominal_direction": (("channel", "direction"), direction),
            "bar_radius": p.bar_radius,
            "distance_noise": p.noise / np.sqrt(samples),
            "level": ("height", zs),
        },
        coords={"channel": list(CHANNELS), "direction": xyz, "time": [0.0, 3600.0]},
        attrs={"schema": SCHEMA, "machine": "plan"},
    )
    expected = identify_drift(raw, settings.model_copy(update={"running_end": None}), method, version)
    for name in ("EX", "EY", "EZ", "EA", "EB"):
        expected[name] = expected[name] * 0.0
    kept = ["EX", "EY", "EZ", "EA", "EB", "EC", "covariance", "influence"]
    return expected[kept].assign_attrs(reference=_PLANNED)


def _centres(origin: np.ndarray, direction: np.ndarray, settings: Settings) -> np.ndarray:
    offsets = np.linspace(-0.5, 0.5, settings.steps) * settings.scan_length
    middle = origin + (np.array(settings.depths) + settings.sphere_radius)[:, None] * direction
    return np.asarray(middle[:, None, None] + offsets[:, None] * machine_axes(direction)[:, None])
