"""Figures of an inclination calibration, for the command line."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from errormotion.methods.beam_direction.identification.inclination.calibrate import (
    InclinationCalibrationSettings,
    calibrate,
    counted,
)
from errormotion.methods.beam_direction.schema import INCLINATION_SCHEMA
from errormotion.plugins import Calibration

if TYPE_CHECKING:
    import xarray as xr


def figures(calibration: xr.Dataset) -> dict[str, Any]:
    """Return the figures of a calibration, in um and mm."""
    ds = calibration
    depth = float(abs(ds["group_depth"]).max())
    return {
        "settings": ds.sizes["setting"],
        "settings_left_out": int(ds["setting_left_out"].sum()),
        "readings": ds.sizes["group"],
        "readings_left_out": int(ds["group_left_out"].sum()),
        "order": int(ds.attrs["order"]),
        "mirror": bool(ds.attrs["mirror"]),
        "depth_mm": depth * 1e3,
        "largest_error_um": float(abs(ds["slope"]).max()) * depth * 1e6,
        "remaining_error_um": float(ds["remaining_error"]) * depth * 1e6,
        "remaining_error_um_interval": [float(end) * depth * 1e6 for end in ds["remaining_error_interval"]],
        "noise_um": float(ds["noise"]) * 1e6,
        "mid_range_mm": float(ds["mid_range"]) * 1e3,
        "mid_range_found_mm": float(ds["mid_range_found"]) * 1e3,
        "mid_range_uncertainty_mm": float(ds["mid_range_uncertainty"]) * 1e3,
        "notes": [note for note in str(ds.attrs.get("notes", "")).split("\n") if note],
    }


def text(calibration: xr.Dataset) -> list[str]:
    """Return the figures of a calibration as lines of text, the first one for its heading."""
    values = figures(calibration)
    symmetry = ", symmetric about the triangulation plane" if values["mirror"] else ""
    low, high = values["remaining_error_um_interval"]
    estimated = ""
    if not math.isnan(mid_range := values["mid_range_found_mm"]):
        estimated = f", from the readings {mid_range:.4f} mm (u = {values['mid_range_uncertainty_mm']:.4f} mm)"
    return [
        f"calibration from {values['readings']} readings at {values['settings']} settings",
        f"order {values['order']}{symmetry}; left out: {counted(values['readings_left_out'], 'reading')}, "
        f"{counted(values['settings_left_out'], 'setting')}",
        f"error at {values['depth_mm']:.3g} mm from mid-range: up to {values['largest_error_um']:.3g} um; "
        f"remaining at settings that were left out: {values['remaining_error_um']:.3g} um rms "
        f"(95 %: {low:.3g} to {high:.3g} um)",
        f"noise {values['noise_um']:.3g} um; mid-range {values['mid_range_mm']:.4g} mm{estimated}",
        *(f"note: {note}" for note in values["notes"]),
    ]


def _make(raw: xr.Dataset, settings: InclinationCalibrationSettings) -> xr.Dataset:
    return calibrate(raw, settings).dataset


CALIBRATIONS = {INCLINATION_SCHEMA: Calibration(InclinationCalibrationSettings, _make, figures, text)}
"""The calibrations of the method, by the schema of their readings."""
