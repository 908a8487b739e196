"""``errormotion calibrate``: readings of a point sensor against an interferometer become a calibration."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from errormotion import datasets
from errormotion.cli.output import show, show_json
from errormotion.cli.progress import Bars
from errormotion.cli.settings import read_settings
from errormotion.datasets.calibrations.inclination import InclinationCalibration
from errormotion.datasets.storage import reading
from errormotion.errors import DatasetError
from errormotion.methods.beam_direction.identification.inclination.calibrate import SCHEMA, Settings, calibrate


def run(data: Path, out: Path, assignments: list[str], settings_file: Path | None, as_json: bool) -> None:
    """Make a calibration and write it; never over a file that is there.

    Raises
    ------
    DatasetError
        The data cannot be read or are of another kind, or the file is there already.
    MethodError
        The readings do not make a calibration.
    """
    if out.suffix != ".nc":
        raise DatasetError(f"{out}: expected a name that ends in .nc (NetCDF-4 file)")
    if out.exists():
        raise DatasetError(f"{out}: exists already, and a result is never overwritten; give another name to --out")
    settings = read_settings(Settings, settings_file, assignments)
    with Bars(as_json) as bars, reading(data), datasets.load(data) as raw:
        bars.stage("calibrating")
        if raw.attrs.get("schema") != SCHEMA:
            raise DatasetError(f"{data}: expected schema {SCHEMA}; found {raw.attrs.get('schema', 'none')}")
        calibration = calibrate(raw, settings)
    calibration.save(out)
    answer = told(calibration)
    if as_json:
        show_json({"ok": True, "calibration": str(out), **answer})
        return
    show(f"{out}: calibration from {answer['readings']} readings at {answer['settings']} settings")
    even = ", the same on both sides of the plane of triangulation" if answer["mirror"] else ""
    show(f"  order {answer['order']}{even}; left out: {_left_out(answer)}")
    low, high = answer["remaining_error_um_interval"]
    show(
        f"  error at {answer['depth_mm']:.3g} mm from mid range: up to {answer['largest_error_um']:.3g} um; "
        f"remaining at settings that were left out: {answer['remaining_error_um']:.3g} um rms "
        f"(95 %: {low:.3g} to {high:.3g} um)"
    )
    show(f"  noise {answer['noise_um']:.3g} um; mid range {answer['mid_range_mm']:.4g} mm{_found(answer)}")
    for note in answer["notes"]:
        show(f"  note: {note}")


def told(calibration: InclinationCalibration) -> dict[str, Any]:
    """Return what a person wants to know of a calibration, in field units."""
    ds = calibration.dataset
    depth = float(abs(ds["group_depth"]).max())
    found = {name: float(ds[f"mid_range_{name}"]) * 1e3 for name in ("found", "uncertainty")}
    return {
        "settings": ds.sizes["setting"],
        "settings_left_out": int(ds["setting_left_out"].sum()),
        "readings": ds.sizes["group"],
        "readings_left_out": int(ds["group_left_out"].sum()),
        "order": calibration.order,
        "mirror": bool(ds.attrs["mirror"]),
        "depth_mm": depth * 1e3,
        "largest_error_um": float(abs(ds["slope"]).max()) * depth * 1e6,
        "remaining_error_um": float(ds["remaining_error"]) * depth * 1e6,
        "remaining_error_um_interval": [float(end) * depth * 1e6 for end in ds["remaining_error_interval"]],
        "noise_um": float(ds["noise"]) * 1e6,
        "mid_range_mm": calibration.mid_range * 1e3,
        **{f"mid_range_{name}_mm": value for name, value in found.items()},
        "notes": [note for note in str(ds.attrs.get("notes", "")).split("\n") if note],
    }


def _left_out(answer: dict[str, Any]) -> str:
    counts = {what: answer[f"{what}s_left_out"] for what in ("reading", "setting")}
    return ", ".join(f"{count} {what}{'' if count == 1 else 's'}" for what, count in counts.items())


def _found(answer: dict[str, Any]) -> str:
    if math.isnan(answer["mid_range_found_mm"]):
        return ""
    return f", by the readings {answer['mid_range_found_mm']:.4f} (u = {answer['mid_range_uncertainty_mm']:.4f}) mm"
