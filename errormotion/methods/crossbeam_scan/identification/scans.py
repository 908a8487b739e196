"""From a campaign of scans to the error dataset of the axis."""

from __future__ import annotations

import logging
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from errormotion.arrays import Array
from errormotion.datasets import hash_dataset, provenance
from errormotion.datasets.timing import start_of
from errormotion.errors import MethodError
from errormotion.estimation.variance import Verdict
from errormotion.measurement.identification import dataset, solve
from errormotion.measurement.observed import Observed, Solved
from errormotion.methods.crossbeam_scan.identification import chain
from errormotion.methods.crossbeam_scan.identification.artefacts import MOVED, ArtefactCheck, check_artefacts
from errormotion.methods.crossbeam_scan.identification.chain import Rig
from errormotion.methods.crossbeam_scan.identification.curves import curves
from errormotion.methods.crossbeam_scan.identification.cutting import Scans
from errormotion.methods.crossbeam_scan.identification.model import COLD, Campaign
from errormotion.methods.crossbeam_scan.identification.registrations import STRAINS, Maps, Registrations, register_all
from errormotion.methods.crossbeam_scan.settings import HEIGHT, STRAIN

if TYPE_CHECKING:
    from errormotion.measurement import ModelMethod
    from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings


log = logging.getLogger(__name__)

_METRES = {"units": "m"}
DOMINANCE = 10.0
"""A note is given if the uncertainty of EYY exceeds that of EXY and EZY by this factor."""
_STEPS = ["cut scans", "register", "guide", "chain to carriage", "consistency", "smooth"]  # in the provenance


def identify_scans(method: ModelMethod, raw: xr.Dataset, settings: CrossbeamScanSettings) -> xr.Dataset:
    """Return the errors of the axis over time and position.

    Parameters
    ----------
    method : ModelMethod
        The plugin.
    raw : Dataset
        Any variant but "profiler pose"; read scan by scan.
    settings : CrossbeamScanSettings

    Raises
    ------
    MethodError
        No scan could be registered; the message states the reasons.
    """
    # The hash reads all raw data once more, at the same time as the scans are registered.
    with ThreadPoolExecutor(1) as pool:
        digest = pool.submit(hash_dataset, raw)
        observed, evaluated = observe(raw, settings)
    solved = solve(observed)
    origin = provenance.make(settings, raw, None, steps=_STEPS, raw_hash=digest.result())
    extras, labels = evaluated.extras(solved)
    pitch = _pitch_note(evaluated.campaign.of_registrations(solved)) if settings.strain == "free" else []
    complete = replace(
        solved.observed,
        extras=extras,
        coords=dict(observed.coords) | labels,
        notes=[*solved.observed.notes, *pitch],
    )
    errors = dataset(method, replace(solved, observed=complete), raw, method.info, origin)
    for note in errors.em.notes:
        log.warning(note)
    return errors


@dataclass(frozen=True)
class Evaluated:
    """What the scans of a campaign say before the errors are solved.

    Attributes
    ----------
    every : Campaign
        Of all cycles.
    campaign : Campaign
        Of the cycles in ``rows``: the cold reference and the warm ones, without the scans of artefacts that moved.
    rows, cold : list of int
        Cycles; those of ``cold`` after the first are repeats of it.
    time : ndarray, (row,)
        s since the start of the warm-up.
    check : ArtefactCheck
    reason : ndarray of str, (row, artefact)
        Why an error is unknown.
    """

    every: Campaign
    campaign: Campaign
    rows: list[int]
    cold: list[int]
    time: Array
    check: ArtefactCheck
    reason: NDArray[np.object_]

    def extras(self, solved: Solved) -> tuple[dict[str, xr.DataArray], dict[str, Any]]:
        """Return the further results without coordinates, and their coordinates."""
        campaign, registrations, rig = self.campaign, self.campaign.registrations, self.campaign.rig
        two = ("time", "position")
        quality = registrations.quality
        W = chain.from_maps(rig.pose)
        u = _sigma(campaign.of_registrations(solved))
        jitter = np.stack([quality["jitter_z"], quality["jitter_y"]], axis=-1)
        out: dict[str, Any] = {
            "reason": (two, self.reason.astype(str)),
            "scan_time": (two, registrations.time, {"units": "s"}),
            "registration_u": ((*two, "dof"), u),
            "predicted_u": ((*two, "dof"), np.broadcast_to(_sigma(campaign.predicted()), u.shape)),
            "residual_rms": (two, quality["residual_rms"], _METRES),
            "points_used": (two, quality["points_used"].astype(np.int64)),
            "noise_found": (two, quality["noise_found"], _METRES),
            "line_jitter": ((*two, "jitter"), jitter, _METRES),
            "condition": (two, quality["condition"]),
            "strain": ((*two, "direction"), registrations.twist @ W[6:].T),
            "profiler_pose": (("row", "column"), rig.pose.as_matrix()),
            "lever": ("direction", rig.lever, _METRES),
        }
        if rig.pose_covariance is not None:
            out["pose_u"] = ("pose_parameter", np.sqrt(np.diag(rig.pose_covariance)))
        out |= self._repeats() | _map_extras(registrations.maps, self.rows) | self.check.extras()
        twist, covariance, by_cold = campaign.solved_profiler(solved)
        twist = np.where(self.check.wrong[self.rows][..., None], np.nan, twist)  # also where they are kept
        out |= curves(twist, covariance, by_cold, rig, campaign.positions, self.time)
        coords: dict[str, Any] = {name: out.pop(name) for name in ("place", "moment")}
        coords |= {"jitter": ["z", "y"], "direction": list("xyz")}
        if "pose_u" in out:
            coords["pose_parameter"] = ["a", "b", "g", "dx", "dy", "dz"]
        return {name: xr.DataArray(xr.Variable(*parts)) for name, parts in out.items()}, coords

    def _repeats(self) -> dict[str, Any]:
        """Return the errors by repeated cold scans."""
        every = self.every.registrations
        own = np.arange(self.every.shape[0])[:, None] == every.cold  # a reference is 0 by definition
        used = every.of_cycles(self.cold, own)
        seen = np.isfinite(used.twist[1:, :, 0])
        if not (seen | own[self.cold[1:]]).any():
            return {}
        values, u = np.full((*seen.shape, 6), np.nan), np.full((*seen.shape, 6), np.nan)
        if seen.any():
            repeated = replace(self.every, registrations=used)
            solved = solve(repeated.observed(coords={}, reference=""))
            values = solved.relative.errors.value.reshape(*repeated.shape, 6)[1:]
            u = _sigma(repeated.of_registrations(solved))[1:]
        values[own[self.cold[1:]]], u[own[self.cold[1:]]] = 0.0, 0.0
        some = np.isfinite(values).any(axis=(1, 2))
        dims = ("repeat", "position", "dof")
        return {"cold_repeat": (dims, values[some]), "cold_repeat_u": (dims, u[some])}


def observe(raw: xr.Dataset, settings: CrossbeamScanSettings) -> tuple[Observed, Evaluated]:
    """Return what the raw data of scans mean, and what they say besides.

    Raises
    ------
    MethodError
        No scan could be registered; the message states the reasons.
    """
    positions = np.asarray(raw["position"].values, dtype=float)
    if np.any(np.diff(positions) <= 0):
        raise MethodError(
            f"position: expected increasing positions of the artefacts; found {positions.tolist()} m",
            code="scan.positions.not_increasing",
        )
    if measured := "displacement" not in raw:
        scans = Scans(raw)
        cycles, corrected = scans.cycles, scans.notes
        cold = cold_cycles(raw, cycles)
        registrations = register_all(scans, cold, float(raw["height_noise"]), settings)
    else:
        cycles, corrected = raw.sizes["cycle"], list[str]()
        cold = cold_cycles(raw, cycles)
        registrations = Registrations.stated(raw)
    warm = [c for c in range(cycles) if c not in cold]
    if not warm:
        raise MethodError(
            f"Expected warm scans after the cold ones; found {cycles} cycles, all of them cold",
            code="scan.no_warm_scans",
        )
    if not np.isfinite(registrations.twist[warm]).any():
        reasons = sorted({reason for reason in registrations.reason.ravel() if reason})
        raise MethodError(
            f"None of {len(warm) * positions.size} warm scans could be registered onto its cold scan: "
            + "; ".join(reasons[:3]),
            code="registration.none",
        )
    rows = [cold[0], *warm]
    time = cycle_times(registrations.time, rows, _planned(raw, cycles))
    guide = settings.guide_uncertainty if settings.strain == "guided" else None
    strains = np.array([settings.strains()[name] for name in (*STRAINS, "mount")])
    every = Campaign(registrations, positions, rig_of(raw), guide, strains, settings.height_of_artefacts())
    # The check comes before the guide, which couples neighbours.
    check = check_artefacts(every, settings, time[1:], cold, warm)
    excluded = check.wrong & (settings.moved == "exclude")
    campaign = replace(every, registrations=registrations.of_cycles(rows, excluded))
    reason = np.where(excluded, MOVED, registrations.reason)[rows]
    reason[0, registrations.cold >= 0] = ""
    for_frame = {} if settings.carriage_origin is None else {"frame_origin": np.array(settings.carriage_origin)}
    observed = campaign.observed(
        coords={"time": time, "y": ("position", positions, _METRES)},
        reference="cold scans of the artefacts, before the warm-up",
        attributes={
            "start": warm_up_start(raw, registrations.time, cold),
            "reference_interval": (0.0, 0.0),
        },
        attrs={"registration": settings.registration, "strain": settings.strain, **for_frame},
        finish=lambda solved: _finished(solved, measured),
        record=None if measured else campaign.recorded,
        notes=[
            *_notes(reason, positions, campaign.rig),
            *_strain_notes(settings),
            *check.notes,
            *registrations.notes,
            *corrected,
        ],
        doubts=[*check.doubts, *registrations.doubts],
    )
    return observed, Evaluated(every, campaign, rows, cold, time, check, reason)


def _finished(solved: Solved, measured: bool) -> Solved:
    """Return a solution that names the sources of its reference state: cold scans, of those that have an effect.

    Registrations find their noise in their residuals: where they are ``measured``, it is not noted as unchecked.
    """
    names = [source.name for source in solved.relative.errors.sources if source.group == COLD]
    attributes = {**solved.observed.attributes, "reference_sources": names}
    solved = replace(solved, observed=replace(solved.observed, attributes=attributes))
    if solved.scatter.verdict is Verdict.MORE or not measured:
        return solved
    return replace(solved, scatter=replace(solved.scatter, note=""))


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
        raise MethodError(
            "profiler_pose: expected a rotation in its first three rows and columns; found none",
            code="scan.pose.no_rotation",
        )

    def known(name: str) -> Array | None:
        return np.asarray(raw[name].values, dtype=float) if name in raw else None

    uncertainty = known("lever_uncertainty")
    return Rig(
        RigidTransform.from_matrix(matrix),
        np.asarray(raw["lever"].values, dtype=float),
        known("pose_covariance"),
        np.zeros(3) if uncertainty is None else uncertainty,
    )


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
        raise MethodError(
            f"time: expected increasing times of the cycles; found {np.round(time, 1).tolist()} s",
            code="scan.times.not_increasing",
        )
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


def _strain_notes(settings: CrossbeamScanSettings) -> list[str]:
    """Return notes on scales, expansions and height that are assumed."""
    stated = {
        "scale_uncertainty": settings.scale_uncertainty,
        "expansion_uncertainty": settings.expansion_uncertainty,
        "mount_expansion_uncertainty": settings.mount_expansion_uncertainty,
    }
    notes = []
    if names := [name for name, value in stated.items() if value is None]:
        notes.append(
            f"Not stated, and assumed to be {STRAIN * 1e6:g} um/m between cold and warm (standard uncertainty): "
            f"{', '.join(names)}."
        )
    if settings.artefact_height is None and settings.strains()["expansion"] > 0:
        notes.append(
            f"Not stated, and assumed to be {HEIGHT * 1e3:g} mm: the height of the artefacts (artefact_height), by "
            "which their expansion displaces the surfaces."
        )
    return notes


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


def _sigma(covariance: Array) -> Array:
    return np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))


def _pitch_note(covariance: Array) -> list[str]:
    """Return a note if the pitch, determined by the relief alone, dominates the uncertainty of EYY over the lever."""
    u = np.sqrt(np.nanmedian(np.diagonal(covariance[1:], axis1=-2, axis2=-1), axis=(0, 1)))
    if not u[1] > DOMINANCE * u[[0, 2]].max():
        return []
    return [
        f"The standard uncertainty of EYY is {u[1] * 1e6:.1f} um: the pitch EAY ({u[3] * 1e6:.1f} urad) is determined "
        "by the relief of the artefacts alone and acts over the lever. Both are correlated: state the errors at the "
        "tool (ds.em.at). Where the carriage follows its guide, strain = 'guided' gives smaller uncertainties."
    ]


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
