"""The chapter of a crossbeam campaign: complete, honest about holes, and readable with whatever a dataset lacks."""

import json
import re
from xml.etree import ElementTree

import numpy as np
import pytest
import xarray as xr

from errormotion.datasets import build_errors, provenance
from errormotion.report import write_report
from errormotion.report.crossbeam_view import campaign
from errormotion.twin import VirtualMachine
from errormotion.twin.artefacts import swept

MINUTES = (0, 7, 15, 30, 45, 60, 90, 120, 150, 180)
PLACES = 0.35 + 0.2 * np.arange(8) - 1.05
POSE = ("a", "b", "g", "dx", "dy", "dz")
EXTRAS = (
    *("reason", "scan_time", "registration_u", "predicted_u", "residual_rms", "points_used", "noise_found"),
    *("line_jitter", "condition", "surface", "surface_x", "surface_y", "difference_before", "difference_after"),
    *("smooth_position", "smooth_position_u", "smooth_time", "smooth_time_u", "cold_repeat", "cold_repeat_u"),
    *("moved", "moved_since", "profiler_pose", "pose_u", "lever", "strain"),
)


def campaign_dataset(minutes=MINUTES, places=PLACES, *, holes=(), moved=(), notes=()):
    """A campaign on the virtual gantry: what its crossbeam does, plus noise of the stated size, with every extra.

    ``holes`` are (cycle, artefact, reason, scanned): no value there; ``moved`` are indices of artefacts.
    """
    machine, rng = VirtualMachine("gantry", seed=3), np.random.default_rng(5)
    times, places = 60.0 * np.asarray(minutes, float), np.asarray(places, float)
    shape = (times.size, places.size)
    beam = machine.crossbeam
    by_registration = np.array([0.35e-6, 4e-9, 0.15e-6, 0.15e-6, 0.16e-6, 0.17e-6])
    values = beam.twist(times[:, None], places) + rng.normal(0, 1, (*shape, 6)) * by_registration
    influence = 1e-2 * values[None] * np.array([0.6, 0.8])[:, None, None, None]
    warm = (times > 0)[:, None, None]
    values, sigma = np.where(warm, values, 0.0), np.where(warm, by_registration, 0.0)
    influence = np.where(warm, influence, 0.0)
    reason, scan_time = np.full(shape, "", dtype="U90"), times[:, None] + 1.5 * np.arange(places.size)
    for cycle, artefact, why, scanned in holes:
        values[cycle, artefact], reason[cycle, artefact] = np.nan, why
        scan_time[cycle, artefact] = scan_time[cycle, artefact] if scanned else np.nan
    covariance = np.einsum("...i,ij->...ij", sigma**2, np.eye(6))
    covariance = covariance + np.einsum("s...i,s...j->...ij", influence, influence)
    known = np.isfinite(values[..., 0])
    x, y = np.linspace(-19.5e-3, 19.5e-3, 40), np.linspace(-27e-3, 27e-3, 40)
    surface = np.tile(swept().height(x[None], y[:, None]), (places.size, 1, 1)).astype(np.float32)
    slope_y, slope_x = np.gradient(surface[0], y, x)
    lever = beam.lever
    point = np.stack(np.broadcast_arrays(lever[0] + x[None], y[:, None], lever[2] - 0.17 + surface[0]), axis=-1)
    normal = np.stack([-slope_x, -slope_y, np.ones_like(slope_x)], axis=-1)
    shift = values[..., None, None, :3] + np.cross(values[..., None, None, 3:], point)
    before = ((shift * normal).sum(axis=-1)).astype(np.float32)
    residual = np.where(known[..., None, None], rng.normal(0, 9e-8, before.shape), np.nan).astype(np.float32)
    fine_place, fine_time = np.linspace(places.min(), places.max(), 60), np.linspace(0, times.max(), 60)
    pair = ("time", "position")

    def array(data, dims, units=""):
        return xr.DataArray(data, dims=dims, attrs={"units": units} if units else {})

    def number(scale, spread=0.05):
        return array(np.where(known, scale * (1 + spread * rng.normal(0, 1, shape)), np.nan), pair)

    since = np.full(places.size, np.nan)
    since[list(moved)] = times[len(times) // 2]
    extras = {
        "reason": array(reason, pair),
        "scan_time": array(scan_time, pair, "s"),
        "registration_u": array(np.where(known[..., None], sigma, np.nan), (*pair, "dof")),
        "predicted_u": array(np.where(known[..., None], 0.9 * sigma, np.nan), (*pair, "dof")),
        "residual_rms": number(9e-8),
        "points_used": array(np.where(known, 2_381_000, 0), pair),
        "noise_found": number(5e-7),
        "line_jitter": array(np.where(known[..., None], [5e-7, 2e-6], np.nan), (*pair, "jitter"), "m"),
        "condition": number(30.0),
        "surface": array(surface, ("position", "v", "u"), "m"),
        "surface_x": array(x, ("u",), "m"),
        "surface_y": array(y, ("v",), "m"),
        "difference_before": array(before, (*pair, "v", "u"), "m"),
        "difference_after": array(residual, (*pair, "v", "u"), "m"),
        "smooth_position": array(beam.twist(times[:, None], fine_place), ("time", "place", "dof")),
        "smooth_position_u": array(np.full((times.size, 60, 6), 0.6) * by_registration, ("time", "place", "dof")),
        "smooth_time": array(beam.twist(fine_time[:, None], places), ("moment", "position", "dof")),
        "smooth_time_u": array(np.full((60, places.size, 6), 0.6) * by_registration, ("moment", "position", "dof")),
        "cold_repeat": array(rng.normal(0, 1, (1, places.size, 6)) * by_registration, ("repeat", "position", "dof")),
        "cold_repeat_u": array(np.tile(by_registration, (1, places.size, 1)), ("repeat", "position", "dof")),
        "moved": array(np.isin(np.arange(places.size), moved), ("position",)),
        "moved_since": array(since, ("position",), "s"),
        "profiler_pose": array(beam.pose, ("row", "column")),
        "pose_u": array([1e-4, 1e-5, 1e-4, 5e-6, 5e-6, 2e-6], ("pose_parameter",)),
        "lever": array(lever, ("direction",), "m"),
        "strain": array(np.where(known[..., None], [3e-6, 12e-6, 20e-6], np.nan), (*pair, "direction")),
    }
    instruments = [{"id": "profiler", "driver": "keyence_ljx", "address": "sim://gantry/profiler?seed=3"}]
    errors = build_errors(
        values,
        covariance,
        dims=pair,
        coords={
            "time": ("time", times, {"units": "s"}),
            "y": ("position", places, {"units": "m"}),
            "place": ("place", fine_place, {"units": "m"}),
            "moment": ("moment", fine_time, {"units": "s"}),
            "jitter": ("jitter", ["z", "y"]),
            "direction": ("direction", list("xyz")),
            "pose_parameter": ("pose_parameter", list(POSE)),
        },
        component="Y",
        machine="Gantry 4000",
        frame="carriage",
        functional_point=[0, 0, 0],
        reference="cold state at time 0",
        method="crossbeam_scan",
        method_version="1",
        provenance=provenance.make({"procedure": "scan", "scan_length": 0.056}, None, instruments),
        influence=influence,
        sources=["profiler pose 1", "cold scan 1"],
        source_groups=["profiler pose", "cold scan"],
        extras=extras,
    )
    return errors.assign_attrs(notes=json.dumps(list(notes)))
