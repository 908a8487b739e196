"""The chapter of a calibration of the profiler's pose from scans of a pocket."""

from __future__ import annotations

import math

import numpy as np
import xarray as xr
from scipy.spatial.transform import Rotation

from errormotion.arrays import Array
from errormotion.report import provenance, quality
from errormotion.report.document import Block, Cell, Part, Section, Source, Table, Text, estimate
from errormotion.report.fields import field, remarks
from errormotion.report.text import fixed, integer

#: Parameter of the pose: its name, what it is; mrad for angles and mm for shifts.
PARAMETERS = {
    "a": "rotation about x",
    "b": "rotation about y",
    "g": "rotation about z",
    "dx": "shift in x",
    "dy": "shift in y",
    "dz": "shift in z, lift included",
}
CONVENTION = "T · Rx(a) · Ry(b) · Rz(g)"


def part(source: Source, _key: str) -> Part:
    """Return the chapter of one calibration, which has no figures."""
    errors = source.errors
    pose, sigma = matrix(errors), uncertainty(errors)
    nothing: list[Block] = [Text("The pose could not be determined.", "warning")]
    return Part(
        "Pose of the line profiler",
        [],
        [f"The pose of the profiler's frame in the tool frame, {CONVENTION}, from scans of a circular pocket."],
        [
            Section("pose", "Pose", nothing if pose is None else [table(pose, sigma, []), *_correlation(errors)]),
            Section("quality", "Quality", [*(Text(note, "warning") for note in remarks(errors)), *_quality(source)]),
            Section("provenance", "Provenance", provenance.blocks(source)),
        ],
    )


def matrix(errors: xr.Dataset) -> Array | None:
    """Return the pose (4, 4) of the profiler in the tool frame; None where it is unknown or invalid."""
    if "profiler_pose" not in errors or set(errors["profiler_pose"].dims) != {"row", "column"}:
        return None
    pose = field(errors, "profiler_pose", "row", "column")
    if pose.shape != (4, 4) or not np.isfinite(pose).all() or abs(np.linalg.det(pose[:3, :3]) - 1) > 1e-3:
        return None
    return pose


def uncertainty(errors: xr.Dataset) -> Array:
    """Return the standard uncertainties of the parameters, (6,), rad and m; NaN where not stated."""
    if "pose_covariance" in errors and errors["pose_covariance"].shape == (6, 6):
        variance = np.diag(np.asarray(errors["pose_covariance"].values, float))
        return np.asarray(np.sqrt(np.where(variance >= 0, variance, np.nan)))
    if "pose_u" not in errors or errors["pose_u"].shape != (6,):
        return np.full(6, np.nan)
    sigma = np.asarray(errors["pose_u"].values, float)
    labels = errors["pose_parameter"].values.astype(str) if "pose_parameter" in errors.coords else list(PARAMETERS)
    by_name = dict(zip(labels, sigma, strict=True))
    return np.array([by_name.get(name, math.nan) for name in PARAMETERS])


def cells_of(pose: Array, sigma: Array) -> list[Cell]:
    """Return the six parameters of a pose (4, 4) in mrad and mm with their expanded uncertainties."""
    values = [*Rotation.from_matrix(pose[:3, :3]).as_euler("XYZ"), *pose[:3, 3]]
    cells = []
    for value, u in zip(values, sigma, strict=True):
        cell = estimate(1e3 * value, 2e3 * u, digits=5)
        if not cell.uncertainty:
            exact = "no uncertainty is stated: the pose is taken as exact"
            cell = Cell(fixed(1e3 * value, 3, signed=True), reason=exact)
        cells.append(cell)
    return cells


def table(pose: Array, sigma: Array, more: list[list[Cell | str]]) -> Table:
    """Return the table of a pose, and further rows (name, unit, value)."""
    rows: list[list[Cell | str]] = [
        [f"{name}, {what}", _unit(i), cell]
        for i, ((name, what), cell) in enumerate(zip(PARAMETERS.items(), cells_of(pose, sigma), strict=True))
    ]
    lever = ", and the lever from the carriage to the tool frame" if more else ""
    return Table(
        f"Pose of the profiler in the tool frame, {CONVENTION}{lever}. After ±: expanded uncertainty, k = 2.",
        ["parameter", "unit", "value"],
        [*rows, *more],
    )


def _unit(index: int) -> str:
    return "mrad" if index < 3 else "mm"


def _correlation(errors: xr.Dataset) -> list[Block]:
    if "pose_covariance" not in errors or errors["pose_covariance"].shape != (6, 6):
        return []
    C = np.asarray(errors["pose_covariance"].values, float)
    sigma = uncertainty(errors)
    scale = np.outer(sigma, sigma)
    if not (np.isfinite(scale).all() and (scale > 0).all()):
        return []
    names = list(PARAMETERS)
    rows: list[list[Cell | str]] = [
        [name, *(fixed(value, 2) for value in row)] for name, row in zip(names, C / scale, strict=True)
    ]
    return [Table("Correlation of the parameters.", ["", *names], rows)]


def _quality(source: Source) -> list[Block]:
    errors = source.errors
    words = []
    if "lines_used" in errors.attrs:
        words.append(f"{integer(float(np.sum(errors.attrs['lines_used'])))} lines crossed the edge")
    if "edge_scatter" in errors:
        scatter = 1e6 * np.asarray(errors["edge_scatter"].values, float)
        words.append("scatter of the edge " + ", ".join(f"{fixed(value, 2)} µm" for value in scatter))
    if "pocket_radius_found" in errors:
        words.append(f"radius found {fixed(1e3 * float(errors['pocket_radius_found']), 4)} mm")
    found: list[Block] = [Text(f"Of the pocket: {'; '.join(words)}.")] if words else []
    counted = quality.counts(errors, source.raw)
    if counted:
        found.append(Text("Counted during the measurement: " + ", ".join(f"{n} {c}" for n, c in counted.items()) + "."))
    return found
