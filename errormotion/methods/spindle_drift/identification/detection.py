"""Error dataset of the five beams from the readings of a stepped sphere."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets import build_errors, provenance
from errormotion.datasets.certificates import certified
from errormotion.datasets.timing import start_of
from errormotion.errors import MethodError
from errormotion.kinematics.beams import beam_errors, error_jacobian
from errormotion.methods.spindle_drift.identification.beams import (
    RADIUS_OF_SPHERE,
    SCALES,
    Beam,
    circles_and_line,
    likelihood_fit,
)
from errormotion.methods.spindle_drift.identification.segmentation import scan_seconds, segment_steps
from errormotion.methods.spindle_drift.settings import TrialSettings

if TYPE_CHECKING:
    from errormotion.methods.spindle_drift.settings import SpindleDriftSettings


log = logging.getLogger(__name__)


def identify_beams(raw: xr.Dataset, settings: SpindleDriftSettings, method: str, version: str) -> xr.Dataset:
    """Return an error dataset of component ``beam``: each beam minus its nominal beam.

    The errors of a beam are stated at its zero point; see `beam_errors` for their definition.

    Raises
    ------
    MethodError
        Readings that do not determine a beam; the message names the beam.
    """
    notes: list[str] = []
    measured = raw
    if "scan" in raw.variables:
        raw = segmented(raw, settings, notes)
    names = [str(name) for name in raw["channel"].values]
    radius = float(raw["sphere_radius"])
    distance = raw["distance"].transpose("channel", "profile", "step").values.astype(np.float64)
    centre = raw["sphere_centre"].transpose("channel", "profile", "step", "direction").values
    scan = raw["scan_direction"].transpose("channel", "profile", "direction").values
    origin0 = np.asarray(raw["nominal_origin"].transpose("channel", "direction").values, np.float64)
    direction0 = np.asarray(raw["nominal_direction"].transpose("channel", "direction").values, np.float64)
    direction0 = direction0 / np.linalg.norm(direction0, axis=1, keepdims=True)
    radius_u, scale_u = (
        float(raw[each]) if each in raw else 0.0 for each in ("sphere_radius_uncertainty", "position_scale_uncertainty")
    )
    middle = np.nanmean(centre, axis=(0, 1, 2))
    beams: list[Beam] = []
    paper_origin, paper_direction = np.full_like(origin0, np.nan), np.full_like(origin0, np.nan)
    for i, name in enumerate(names):
        beam = likelihood_fit(
            distance[i],
            centre[i],
            radius,
            origin0[i],
            direction0[i],
            name,
            radius_uncertainty=radius_u,
            scale_uncertainty=scale_u,
            middle=middle,
        )
        beams.append(beam)
        if not isinstance(settings, TrialSettings):
            clean = distance[i].copy()
            clean[tuple(beam.left_out.T)] = np.nan
            paper_origin[i], paper_direction[i] = circles_and_line(clean, centre[i], scan[i], radius, direction0[i])
        missing = int(np.isnan(distance[i]).sum())
        if missing:
            notes.append(f"{name}: {missing} of {distance[i].size} readings are missing (NaN).")
        if len(beam.left_out):
            outliers = ", ".join(f"profile {p} step {s}" for p, s in beam.left_out[:5])
            notes.append(f"{name}: {len(beam.left_out)} readings are outliers and were ignored: {outliers}.")
        notes += [f"{name}: {note}" for note in beam.notes]
    directions = np.array([b.direction for b in beams])
    errors, covariance = beam_errors(
        origin0,
        direction0,
        np.array([b.origin for b in beams]),
        directions,
        np.array([b.covariance for b in beams]),
    )
    sources = list(beams[0].influence)
    chart = error_jacobian(direction0, directions)
    effects = [np.einsum("bij,bj->bi", chart, np.array([b.influence[one] for b in beams])) for one in sources]
    for note in notes:
        log.warning(note)
    parameters = ["px", "py", "pz", "ux", "uy", "uz"]

    def vectors(values: Array, unit: str) -> xr.DataArray:
        return xr.DataArray(values, dims=("beam", "direction"), attrs={"units": unit})

    extras = {
        "beam_origin": vectors(np.array([b.origin for b in beams]), "m"),
        "beam_direction": vectors(np.array([b.direction for b in beams]), "1"),
        "nominal_origin": vectors(origin0, "m"),
        "nominal_direction": vectors(direction0, "1"),
        "paper_origin": vectors(paper_origin, "m"),
        "paper_direction": vectors(paper_direction, "1"),
        "beam_covariance": xr.DataArray(
            np.array([b.covariance for b in beams]),
            dims=("beam", "p", "p_"),
            attrs={"units": "SI: m for p, 1 for u"},
        ),
        "residual": xr.DataArray(
            np.array([b.residual for b in beams]),
            dims=("beam", "profile", "step"),
            attrs={"units": "m"},
        ),
        "noise": xr.DataArray(np.array([b.noise for b in beams]), dims="beam", attrs={"units": "m"}),
        "left_out": xr.DataArray(np.array([len(b.left_out) for b in beams]), dims="beam"),
    }
    ds = build_errors(
        errors,
        covariance,
        dims=("beam",),
        coords={"beam": names, "direction": list("xyz"), "p": parameters, "p_": parameters},
        component="beam",
        machine=str(raw.attrs.get("machine", "unknown")),
        frame=str(raw.attrs.get("frame", "machine")),
        functional_point=origin0.mean(axis=0),
        reference="nominal beams; each beam's errors are stated at its own nominal zero point (nominal_origin)",
        method=method,
        method_version=version,
        measured=measured.attrs,
        start=start_of(measured),
        provenance=provenance.make(settings, measured, None, steps=["ray-sphere likelihood fit", "circles and line"]),
        influence=np.array(effects) if sources else None,
        sources=sources or None,
        source_groups=[RADIUS_OF_SPHERE if one == RADIUS_OF_SPHERE else SCALES for one in sources] or None,
        source_ids=certified(measured.attrs, {RADIUS_OF_SPHERE: ("sphere", "radius")} if radius_u > 0 else {}),
        extras=extras,
    )
    return ds.assign_attrs(notes=notes or [""])


def segmented(raw: xr.Dataset, settings: SpindleDriftSettings, notes: list[str]) -> xr.Dataset:
    """Return a beam detection with the mean reading of every step, from one as recorded.

    Of a repeated scan the last attempt is used. A scan whose steps are not found is NaN; ``notes`` state the reason.
    """
    centre = raw["sphere_centre"].transpose("channel", "profile", "step", "direction")
    channels, profiles, steps = centre.shape[:3]
    rate, dwell = float(raw.attrs["sample_rate"]), float(raw.attrs.get("dwell", settings.dwell))
    length = round(scan_seconds(steps, dwell) * rate)
    scan = raw["scan"].values
    attempt = raw["attempt"].values if "attempt" in raw else np.zeros(scan.size, np.int16)
    means = np.full((channels, profiles, steps), np.nan)
    for number in range(channels * profiles):
        channel, profile = divmod(number, profiles)
        scan_name = f"{raw['channel'].values[channel]}, profile {profile}"
        samples = np.flatnonzero(scan == number)
        if samples.size == 0:
            notes.append(f"{scan_name}: not recorded.")
            continue
        samples = samples[attempt[samples] == attempt[samples].max()][:length]
        record = raw["record"].isel(sample=slice(int(samples[0]), int(samples[-1]) + 1)).values.astype(np.float64)
        try:
            means[channel, profile] = segment_steps(record, rate, steps, dwell, settings.step_average).mean
        except MethodError as error:
            notes.append(f"{scan_name}: {error}")
    return raw.drop_dims("sample").assign(distance=(("channel", "profile", "step"), means, {"units": "m"}))
