"""From a campaign of scans to the error dataset of the axis."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from errormotion.arrays import Array
from errormotion.datasets import build_errors, provenance
from errormotion.datasets.timing import start_of
from errormotion.errors import MethodError
from errormotion.methods.crossbeam_scan.identification.artefact_check import MOVED, ArtefactCheck, check_artefacts
from errormotion.methods.crossbeam_scan.identification.carriage import Carriage, Rig, carriage
from errormotion.methods.crossbeam_scan.identification.chain import SOURCES, pose_identities
from errormotion.methods.crossbeam_scan.identification.curves import curves
from errormotion.methods.crossbeam_scan.identification.cutting import Scans
from errormotion.methods.crossbeam_scan.identification.registrations import Maps, Registrations, register_all
from errormotion.methods.crossbeam_scan.settings import STRAIN

if TYPE_CHECKING:
    from errormotion.methods.crossbeam_scan.settings import Settings


log = logging.getLogger(__name__)

_METRES = {"units": "m"}
DOMINANCE = 10.0
"""A note is given if the uncertainty of EYY exceeds that of EXY and EZY by this factor."""
_STEPS = ["cut scans", "register", "guide", "chain to carriage", "consistency", "smooth"]  # in the provenance


def identify_scans(raw: xr.Dataset, settings: Settings, method: str, version: str) -> xr.Dataset:
    """Return the errors of the axis over time and position.

    Parameters
    ----------
    raw : Dataset
        Variant "scans" or "scans as recorded"; read scan by scan.
    settings : Settings
    method, version : str
        Of the plugin.

    Raises
    ------
    MethodError
        No scan could be registered; the message states the reasons.
    """
    scans = Scans(raw)
    positions = np.asarray(raw["position"].values, dtype=float)
    if np.any(np.diff(positions) <= 0):
        raise MethodError(f"position: expected increasing positions of the artefacts; found {positions.tolist()} m")
    cold = cold_cycles(raw, scans.cycles)
    # The hash reads all raw data once more, at the same time as the scans are registered.
    with ThreadPoolExecutor(1) as pool:
        origin = pool.submit(provenance.make, settings, raw, None, steps=_STEPS)
        found = register_all(scans, cold, float(raw["height_noise"]), settings)
    rig = rig_of(raw)
    axis = carriage(found, positions, rig, guide=None)
    warm = [c for c in range(scans.cycles) if c not in cold]
    if not warm:
        raise MethodError(f"Expected warm scans after the cold ones; found {scans.cycles} cycles, all of them cold")
    if not np.isfinite(axis.values[warm]).any():
        reasons = sorted({reason for reason in found.reason.ravel() if reason})
        raise MethodError(
            f"None of {len(warm) * positions.size} warm scans could be registered onto its cold scan: "
            + "; ".join(reasons[:3])
        )
    rows = [cold[0], *warm]
    time = cycle_times(found.time, rows, _planned(raw, scans.cycles))
    # The check comes before the guide, which couples neighbours.
    check = check_artefacts(axis, found, settings, positions, time[1:], cold, warm)
    if settings.strain == "guided":
        excluded = check.wrong & (settings.moved == "exclude")
        axis = carriage(found.without(excluded), positions, rig, guide=settings.guide_uncertainty)
    return _dataset(
        raw, settings, method, version, found, axis, rig, check, cold, rows, time, scans.notes, origin.result()
    )


def cold_cycles(raw: xr.Dataset, cycles: int) -> list[int]:
    """Return the cycles before the warm-up: cycle 0, and those whose ``warm_up`` is 0."""
    if "warm_up" not in raw:
        return [0]
    warm_up = np.asarray(raw["warm_up"].values, dtype=float)[:cycles]
    return [0, *(int(c) for c in np.flatnonzero(warm_up == 0) if c > 0)]


def rig_of(raw: xr.Dataset) -> Rig:
    """Return the pose and the lever that a raw dataset states."""
    matrix = np.asarray(raw["profiler_pose"].transpose("row", "column").values, dtype=float)
    if not np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-6) or np.linalg.det(matrix[:3, :3]) < 0:
        raise MethodError("profiler_pose: expected a rotation in its first three rows and columns; found none")

    def known(name: str) -> Array | None:
        return np.asarray(raw[name].values, dtype=float) if name in raw else None

    uncertainty = known("lever_uncertainty")
    return Rig(
        RigidTransform.from_matrix(matrix),
        np.asarray(raw["lever"].values, dtype=float),
        known("pose_covariance"),
        np.zeros(3) if uncertainty is None else uncertainty,
    )


def _dataset(
    raw: xr.Dataset,
    settings: Settings,
    method: str,
    version: str,
    found: Registrations,
    axis: Carriage,
    rig: Rig,
    check: ArtefactCheck,
    cold: list[int],
    rows: list[int],
    time: Array,
    corrected: list[str],
    origin: Mapping[str, Any],
) -> xr.Dataset:
    warm = rows[1:]
    position = np.asarray(raw["position"].values, dtype=float)
    reference = np.asarray(np.isfinite(axis.values[cold][:, :, 0]).any(axis=0))
    values, own, influence = axis.values[rows], axis.covariance[rows], axis.influence[:, rows]
    values[0] = np.where(reference[:, None], 0.0, np.nan)  # whichever cold scan is the reference
    own[0] = np.where(reference[:, None, None], 0.0, np.nan)
    influence[:, 0] = np.where(reference[:, None], 0.0, np.nan)
    reason = found.reason[rows]
    reason[0, reference] = ""
    if settings.moved == "exclude":
        excluded = check.wrong[rows]
        values[excluded], own[excluded], influence[:, excluded] = np.nan, np.nan, np.nan
        reason[excluded] = MOVED
    notes = [*_notes(reason, position, rig), *_strain_notes(settings), *check.notes, *corrected]
    notes += found.notes
    if settings.strain == "free":
        notes += _pitch_note(own)
    for note in notes:
        log.warning(note)
    curve = curves(axis, found, rig, position, time[1:], warm, check.wrong)
    extras, labels = _extras(found, axis, rig, rows, cold, reason, own, curve | check.extras())
    rig_share = influence[: len(SOURCES)]  # `own` contains the noise of the cold scans already
    total = own + np.einsum("stki,stkj->tkij", rig_share, rig_share)
    ds = build_errors(
        values,
        total,
        dims=("time", "position"),
        coords={"time": time, "y": ("position", position, _METRES)} | labels,
        component="Y",
        machine=str(raw.attrs.get("machine", "unknown")),
        frame="carriage, machine directions",
        functional_point=np.zeros(3),
        reference="cold scans of the artefacts, before the warm-up",
        method=method,
        method_version=version,
        measured=raw.attrs,
        provenance=origin,
        influence=influence,
        sources=axis.sources,
        source_groups=axis.source_groups,
        extras=extras,
        start=warm_up_start(raw, found.time, cold),
        source_ids=pose_identities(rig.pose, rig.pose_covariance),
        reference_sources=axis.sources[len(SOURCES) :],
        reference_interval=(0.0, 0.0),
    )
    origin_at = settings.carriage_origin
    frame = {} if origin_at is None else {"frame_origin": np.array(origin_at)}
    return ds.assign_attrs(notes=notes or [""], registration=settings.registration, strain=settings.strain, **frame)


def cycle_times(scan_time: Array, rows: list[int], planned: Array | None = None) -> Array:
    """Return the time of every cycle, s since the start of the warm-up: the mean of its scans; 0 for the cold cycle.

    The time of a cycle without a scan is interpolated between its neighbours, or extrapolated, in proportion to the
    ``planned`` times (cycle,), or in equal steps where they are unknown.
    """
    time = np.array([np.nanmean(scan_time[c]) if np.isfinite(scan_time[c]).any() else np.nan for c in rows])
    first = max(time[0], 0.0) if np.isfinite(time[0]) else 0.0
    time[0] = 0.0
    time[1:] -= first
    plan = np.arange(len(rows), dtype=float) if planned is None else planned[rows]
    known = np.flatnonzero(np.isfinite(time))
    last = known[-1]
    pace = 1.0 if planned is not None else time[last] / max(last, 1)
    after = time[last] + pace * np.maximum(plan - plan[last], 0.0)
    time = np.where(np.isfinite(time), time, np.interp(plan, plan[known], time[known]) + after - time[last])
    if np.any(np.diff(time) <= 0):
        raise MethodError(f"time: expected increasing times of the cycles; found {np.round(time, 1).tolist()} s")
    return time


def warm_up_start(raw: xr.Dataset, scan_time: Array, cold: list[int]) -> str:
    """Return the instant of time 0 in UTC; empty where the raw data do not determine it.

    The attribute ``start`` is the start of the record. The lines of the warm cycles state both the time since the
    start of the warm-up (``line_time``) and the time since the start of the record (``line_clock``). Where the cold
    scans are after time 0 of the raw data, time 0 of the errors is that of the cold scans, see `cycle_times`.
    """
    if "line_clock" not in raw:
        return ""
    warm = np.flatnonzero(~np.isin(np.asarray(raw["cycle_of_line"].values), cold))
    clock, since = (np.asarray(raw[name].values, dtype=float)[warm] for name in ("line_clock", "line_time"))
    offset = (clock - since)[np.isfinite(clock - since)]
    cold_scans = scan_time[cold[0]]
    shift = max(float(np.nanmean(cold_scans)), 0.0) if np.isfinite(cold_scans).any() else 0.0
    return start_of(raw, float(offset[0]) + shift) if offset.size else ""


def _planned(raw: xr.Dataset, cycles: int) -> Array | None:
    """Return the planned time of every cycle, s: ``time`` or else ``warm_up`` of the raw dataset; None if unknown."""
    name = next((name for name in ("time", "warm_up") if name in raw.variables and raw[name].dims == ("cycle",)), None)
    if name is None or raw.sizes["cycle"] < cycles:
        return None
    return np.asarray(raw[name].values, dtype=float)


def _strain_notes(settings: Settings) -> list[str]:
    """Return notes on scale and expansion that are assumed, or not contained in the uncertainty."""
    stated = {
        "the scales of the profiler": settings.scale_uncertainty,
        "the expansion of the artefacts": settings.expansion_uncertainty,
    }
    names = " and ".join(name for name, value in stated.items() if value is None)
    if settings.registration != "height_map":
        return [
            "The uncertainty does not contain scale and expansion between cold and warm, which this registration does "
            "not estimate: 20 um/m of each are usual."
        ]
    if not names:
        return []
    return [
        f"No uncertainty is stated of {names} between cold and warm (scale_uncertainty, expansion_uncertainty): "
        f"{STRAIN * 1e6:g} um/m is assumed, the standard uncertainty."
    ]


def _notes(reason: NDArray[np.object_], position: Array, rig: Rig) -> list[str]:
    notes = []
    lost = np.argwhere((reason[1:] != "") & (reason[1:] != MOVED))
    if len(lost):
        where = sorted({f"{position[k]:g} m" for _, k in lost}, key=lambda text: float(text.split()[0]))
        notes.append(
            f"{len(lost)} of {reason[1:].size} warm scans have no known errors (at {', '.join(where)}); the variable "
            "`reason` states why."
        )
    if rig.pose_covariance is None:
        notes.append("The pose of the profiler is assumed exact: the raw dataset states no pose_covariance.")
    if not rig.lever_uncertainty.any():
        notes.append("The lever is assumed exact: the raw dataset states no lever_uncertainty.")
    return notes


def _pitch_note(own: Array) -> list[str]:
    """Return a note if the pitch, determined by the relief alone, dominates the uncertainty of EYY over the lever."""
    u = np.sqrt(np.nanmedian(np.diagonal(own[1:], axis1=-2, axis2=-1), axis=(0, 1)))
    if not u[1] > DOMINANCE * u[[0, 2]].max():
        return []
    return [
        f"The standard uncertainty of EYY is {u[1] * 1e6:.1f} um: the pitch EAY ({u[3] * 1e6:.1f} urad) is determined "
        "by the relief of the artefacts alone and acts over the lever. Both are correlated: state the errors at the "
        "tool (ds.em.at). Where the carriage follows its guide, strain = 'guided' gives smaller uncertainties."
    ]


def _extras(
    found: Registrations,
    axis: Carriage,
    rig: Rig,
    rows: list[int],
    cold: list[int],
    reason: NDArray[np.object_],
    own: Array,
    further: dict[str, Any],
) -> tuple[dict[str, xr.DataArray], dict[str, Any]]:
    """Return the extra results without coordinates, and their coordinates."""
    two = ("time", "position")
    quality = {name: values[rows] for name, values in found.quality.items()}
    deviation = np.sqrt(np.diagonal(own, axis1=-2, axis2=-1))
    predicted = np.broadcast_to(np.sqrt(np.diagonal(axis.predicted, axis1=-2, axis2=-1)), deviation.shape)
    jitter = np.stack([quality["jitter_z"], quality["jitter_y"]], axis=-1)
    out: dict[str, Any] = {
        "reason": (two, reason.astype(str)),
        "scan_time": (two, found.time[rows], {"units": "s"}),
        "registration_u": ((*two, "dof"), deviation),
        "predicted_u": ((*two, "dof"), predicted),
        "residual_rms": (two, quality["residual_rms"], _METRES),
        "points_used": (two, quality["points_used"].astype(np.int64)),
        "noise_found": (two, quality["noise_found"], _METRES),
        "line_jitter": ((*two, "jitter"), jitter, _METRES),
        "condition": (two, quality["condition"]),
        "strain": ((*two, "direction"), axis.drift[rows]),
        "profiler_pose": (("row", "column"), rig.pose.as_matrix()),
        "lever": ("direction", rig.lever, _METRES),
    }
    if rig.pose_covariance is not None:
        out["pose_u"] = ("pose_parameter", np.sqrt(np.diag(rig.pose_covariance)))
    repeats = [c for c in cold[1:] if np.isfinite(axis.values[c]).any()]
    if repeats:
        out["cold_repeat"] = (("repeat", "position", "dof"), axis.values[repeats])
        u = np.sqrt(np.diagonal(axis.covariance[repeats], axis1=-2, axis2=-1))
        out["cold_repeat_u"] = (("repeat", "position", "dof"), u)
    out |= _map_extras(found.maps, rows) | further
    coords: dict[str, Any] = {name: out.pop(name) for name in ("place", "moment")}
    coords |= {"jitter": ["z", "y"], "direction": list("xyz")}
    if "pose_u" in out:
        coords["pose_parameter"] = ["a", "b", "g", "dx", "dy", "dz"]
    return {name: xr.DataArray(xr.Variable(*parts)) for name, parts in out.items()}, coords


def _map_extras(maps: list[Maps | None], rows: list[int]) -> dict[str, Any]:
    """Return cold surfaces and differences over (time, position, v, u), of the artefacts with maps of equal size."""
    first = next((m for m in maps if m is not None), None)
    if first is None:
        return {}
    shape = first.surface.shape
    surface = np.full((len(maps), *shape), np.nan, dtype=np.float32)
    before, after = (np.full((len(rows), len(maps), *shape), np.nan, dtype=np.float32) for _ in range(2))
    for k, m in enumerate(maps):
        if m is None or m.surface.shape != shape:
            continue
        surface[k] = m.surface
        for t, cycle in enumerate(rows):
            if cycle in m.after:
                before[t, k], after[t, k] = m.before[cycle], m.after[cycle]
    two = ("time", "position", "v", "u")
    return {
        "surface": (("position", "v", "u"), surface, _METRES),
        "surface_x": ("u", first.x, _METRES),
        "surface_y": ("v", first.y, _METRES),
        "difference_before": (two, before, _METRES),
        "difference_after": (two, after, _METRES),
    }
