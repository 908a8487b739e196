"""What to expect before anything is measured."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from errormotion.methods.spindle_drift.beams import fisher_bound
from errormotion.methods.spindle_drift.uncertainty import CHANNELS

if TYPE_CHECKING:
    from errormotion.methods.spindle_drift.method import SpindleDrift
    from errormotion.methods.spindle_drift.settings import Settings

_TWIST = np.array([5e-6, 5e-6, 20e-6, 1e-4, 1e-4])


def plan(method: SpindleDrift, settings: Settings) -> xr.Dataset:
    """Return an error dataset of zeros with the covariance to expect, reference state and one later instant.

    A bar of the stated radius stands in a frame as drawn in ISO 230-3, its readings mid-range; the beams come from a
    detection with the stated steps. The later instant has drifted by a typical amount (5 um sideways, 20 um in Z,
    0.1 mrad), since what the beams' uncertainty does grows with the drift.
    """
    p = settings.layout
    r = p.bar_radius
    near = r + p.standoff
    z1, z2 = p.levels
    origin = np.array([[near, 0, z1], [near, 0, z2], [0, near, z1], [0, near, z2], [0, 0, -p.standoff]])
    direction = np.array([[-1.0, 0, 0], [-1, 0, 0], [0, -1, 0], [0, -1, 0], [0, 0, 1]])
    covariance = np.zeros((5, 6, 6))
    for i in range(5):
        covariance[i] = fisher_bound(
            origin[i], direction[i], _centres(origin[i], direction[i], settings), settings.sphere_radius, p.step_noise
        )
    ex, ey, ez, ea, eb = _TWIST
    zs = np.array([z1, z2])
    still = np.full(5, p.standoff)
    # Distances to first order: the bar comes nearer by its displacement along the beam's way back.
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
            "bar_radius": r,
            "distance_noise": p.noise / np.sqrt(samples),
            "level": ("height", zs),
        },
        coords={"channel": list(CHANNELS), "direction": xyz, "time": [0.0, 3600.0]},
        attrs={"schema": method.needs.raw_schema, "machine": "plan"},
    )
    expected = method.identify(raw, settings.model_copy(update={"running_end": None}))
    for name in ("EX", "EY", "EZ", "EA", "EB"):
        expected[name] = expected[name] * 0.0
    kept = ["EX", "EY", "EZ", "EA", "EB", "EC", "covariance", "influence"]
    return expected[kept].assign_attrs(reference="planned, not measured")


def _centres(origin: np.ndarray, direction: np.ndarray, settings: Settings) -> np.ndarray:
    offsets = np.linspace(-0.5, 0.5, settings.steps) * settings.scan_length
    axis = int(np.argmax(np.abs(direction)))
    scans = np.delete(np.eye(3), axis, axis=0)
    middle = origin + (np.array(settings.depths) + settings.sphere_radius)[:, None] * direction
    return np.asarray(middle[:, None, None] + offsets[:, None] * scans[:, None])
