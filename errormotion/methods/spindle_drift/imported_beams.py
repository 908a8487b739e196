"""Uncertainty of the beams of an imported drift record, whose map states one standard uncertainty or none."""

from __future__ import annotations

import json

import numpy as np
import xarray as xr

from errormotion.methods.spindle_drift.settings import SpindleDriftSettings

ORIGIN = float(SpindleDriftSettings.model_fields["nominal_origin_uncertainty"].default)
DIRECTION = float(SpindleDriftSettings.model_fields["nominal_direction_uncertainty"].default)
ASSUMED = (
    f"The map states no uncertainty of the beams: {1e3 * ORIGIN:g} mm and {1e3 * DIRECTION:g} mrad are assumed, as for "
    "a frame that was not calibrated."
)


def with_beam_covariance(raw: xr.Dataset) -> xr.Dataset:
    """Return a dataset with the covariance of its beams.

    It is equal in each coordinate of the origin, and across the beam in the direction. The standard uncertainties are
    those of ``beam_origin_uncertainty`` and ``beam_direction_uncertainty``; without them, those of nominal beams.
    """
    if "beam_covariance" in raw or "beam_direction" not in raw:
        return raw
    count = raw.sizes["channel"]
    origin, across = np.full(count, ORIGIN), np.full(count, DIRECTION)
    stated = {"beam_origin_uncertainty": origin, "beam_direction_uncertainty": across}
    for name, values in stated.items():
        if name in raw:
            values[:] = raw[name].values
    unknown = [name for name in stated if name not in raw]
    u = raw["beam_direction"].transpose("channel", "direction").values
    C = np.zeros((count, 6, 6))
    C[:, :3, :3] = origin[:, None, None] ** 2 * np.eye(3)
    C[:, 3:, 3:] = across[:, None, None] ** 2 * (np.eye(3) - u[:, :, None] * u[:, None, :])
    found = raw.drop_vars([name for name in stated if name in raw])
    found["beam_covariance"] = (("channel", "p", "p_"), C)
    if not unknown:
        return found
    notes = [*json.loads(raw.attrs.get("import_notes", "[]")), ASSUMED]
    return found.assign_attrs(beam_uncertainty="assumed", import_notes=json.dumps(notes))
