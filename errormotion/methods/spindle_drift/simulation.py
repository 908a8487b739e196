"""Raw data of the method, simulated on the virtual machine without instruments: fast enough for Monte Carlo.

They do not follow from the measurement model of the method, so that they test its equation: the bar and the spindle of
the virtual machine, its warm-up and its frame are those of another code.
"""

from __future__ import annotations

import json
from functools import lru_cache
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from errormotion.arrays import Array
from errormotion.datasets import build_errors, provenance
from errormotion.errors import BenchError
from errormotion.methods.spindle_drift.schema import SCHEMA
from errormotion.methods.spindle_drift.settings import SpindleDriftSettings
from errormotion.twin import Event, VirtualMachine, intersections
from errormotion.twin.sensors.frame import FrameGeometry
from errormotion.twin.sensors.sensing import REPEATABILITY, SPECKLE

Beams = tuple[Array, Array, Array | None]

DEPTHS = (0.2e-3, 1.0e-3, 1.8e-3)
"""Readings at which a beam detection scans, m."""
STEPS = 20e-6 * np.arange(-50, 51)
"""Positions of the steps of a scan across the beam, m."""
SAMPLES_PER_REST = 6000
INSTANTS = 24
"""Number of instants of a simulated drift."""
SPEED = 15000.0
"""Spindle speed of a simulated drift without a schedule, 1/min."""
BEAM_SIGMA = np.array([0.5e-6] * 3 + [0.4e-3] * 3)
"""Standard uncertainty of the beams in a simulated drift, typical of a beam detection: m, rad."""

_M = {"units": "m"}
_1 = {"units": "1"}
_XYZ = np.eye(3)


def simulate(settings: SpindleDriftSettings, seed: int) -> tuple[xr.Dataset, xr.Dataset]:
    """Return raw data of the procedure stated in the settings, and the true errors.

    A drift has 24 instants, evenly spaced over ``duration``, and the spindle speeds of ``schedule`` (15000 1/min from
    the start where it is empty). The seed selects the machine and the noise.
    """
    return _simulated_beams(seed) if settings.procedure == "beam_detection" else _simulated_drift(settings, seed)


def truth_of(machine: VirtualMachine, errors: xr.Dataset, clock: float) -> xr.Dataset:
    """Return the true errors of the spindle at the times of a drift with its time 0 at ``clock`` (s)."""
    truth = machine.truth_spindle(errors["time"].values + clock, errors.attrs["functional_point"])
    return truth.assign_coords(time=("time", errors["time"].values, {"units": "s"}))


def _simulated_drift(settings: SpindleDriftSettings, seed: int) -> tuple[xr.Dataset, xr.Dataset]:
    machine = _machine(seed, tuple((e.at, e.spindle_speed) for e in settings.schedule) or ((0.0, SPEED),))
    t = settings.duration / INSTANTS * np.arange(INSTANTS)
    raw = raw_drift(machine, t, seed=seed, beams=calibrated_beams(machine, seed), warm_up=False, radius_error=False)
    return raw, machine.truth_spindle(t)


def _simulated_beams(seed: int) -> tuple[xr.Dataset, xr.Dataset]:
    machine = _machine(seed, ())
    return raw_beam_detection(machine, seed=seed), truth_beams(machine, seed)


@lru_cache(maxsize=256)
def _machine(seed: int, speeds: tuple[tuple[float, float | None], ...]) -> VirtualMachine:
    machine = VirtualMachine("cframe", seed=seed)
    machine.start(tuple(Event(at, speed, None) for at, speed in speeds))
    return machine


def calibrated_beams(machine: VirtualMachine, seed: int) -> Beams:
    """Return the beams of a machine with errors of calibration: origin, direction (5, 3), covariance (5, 6, 6)."""
    rng = np.random.default_rng([seed, 1])
    origin = machine.frame.true_origin + BEAM_SIGMA[:3] * rng.normal(size=(5, 3))
    direction = machine.frame.true_direction.copy()
    covariance = np.zeros((5, 6, 6))
    for i, u in enumerate(machine.frame.true_direction):
        across = np.eye(3) - np.outer(u, u)
        direction[i] += across @ (BEAM_SIGMA[3:] * rng.normal(size=3))
        covariance[i, :3, :3] = np.diag(BEAM_SIGMA[:3] ** 2)
        covariance[i, 3:, 3:] = across * BEAM_SIGMA[3] ** 2
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return origin, direction, covariance


def truth_beams(machine: VirtualMachine, seed: int) -> xr.Dataset:
    """Return the true beams relative to the nominal ones as an error dataset over ``beam``."""
    frame = machine.frame
    turn = np.cross(frame.nominal_direction, frame.true_direction)  # the sine; equal to the angle within 1e-5 at 5 mrad
    return build_errors(
        np.concatenate([frame.true_origin - frame.nominal_origin, turn], axis=1),
        np.zeros((5, 6, 6)),
        dims=("beam",),
        coords={"beam": list(frame.channels)},
        component="beam",
        machine=machine.name,
        frame="machine",
        functional_point=frame.nominal_origin.mean(axis=0),
        reference="nominal beams, each at its own nominal zero point",
        method="twin",
        method_version="1",
        provenance=provenance.make({}, None, None, seed=seed),
    )


def raw_drift(
    machine: VirtualMachine,
    t: ArrayLike,
    *,
    seed: int,
    beams: str | Beams = "true",
    averaged: int = 10000,
    expansion: bool = False,
    warm_up: bool = True,
    radius_error: bool = True,
) -> xr.Dataset:
    """Return a raw dataset of a drift measurement, each sample the mean over whole turns.

    Parameters
    ----------
    machine : VirtualMachine
    t : (n,)
        Times, s, increasing.
    seed : int
        Seed of the noise; the machine does not change.
    beams : {"true", "nominal"} or (origin, direction, covariance)
        The beams that the dataset states: (channel, 3) m, (channel, 3), (channel, 6, 6) or None.
    averaged : int
        Number of samples in each mean: the noise and ``distance_noise`` are those of one sample divided by its root.
    expansion : bool
        Whether the readings include the expansion of the frame; without it they are perfectly compensated.
    warm_up : bool
        Whether the readings include the warm-up of the sensors, which is zero in a warm machine.
    radius_error : bool
        Whether the dataset states the certified radius of the bar instead of the true one.

    Raises
    ------
    BenchError
        Unknown ``beams``.
    """
    t, frame = np.atleast_1d(np.asarray(t, dtype=float)), machine.frame
    noise = float(frame.noise.max()) / np.sqrt(averaged)
    readings = machine.still_readings(t, expansion=expansion, warm_up=warm_up)
    readings = readings + noise * np.random.default_rng(seed).normal(size=readings.shape)
    readings[~((readings >= 0) & (readings <= frame.range))] = np.nan
    known: dict[str, Beams] = {
        "true": (frame.true_origin, frame.true_direction, None),
        "nominal": (frame.nominal_origin, frame.nominal_direction, None),
    }
    if isinstance(beams, str) and beams not in known:
        raise BenchError(
            f"beams: expected 'true', 'nominal' or (origin, direction, covariance); found {beams!r}.",
            code="simulation.beams.form",
        )
    origin, direction, covariance = known[beams] if isinstance(beams, str) else beams
    variables: dict[str, Any] = {
        "distance": (("channel", "time"), readings, _M),
        "beam_origin": (("channel", "direction"), np.array(origin), _M),
        "beam_direction": (("channel", "direction"), np.array(direction), _1),
        "bar_radius": ((), machine.bar_radius if radius_error else machine.bar.radius, _M),
        "distance_noise": ((), noise, _M),
        "level": ("height", np.array(frame.levels), _M),
        "temperature": (("time", "sensor"), machine.temperatures(t), {"units": "degC"}),
        "spindle_speed": ("time", machine.spindle_speed(t), {"units": "1/min"}),
    }
    if covariance is not None:
        variables["beam_covariance"] = (("channel", "p", "p_"), covariance)
    coords = {
        "channel": list(frame.channels),
        "direction": list("xyz"),
        "height": ["L1", "L2"],
        "time": ("time", t, {"units": "s"}),
        "sensor": list(machine.temperature_sensors),
    }
    return xr.Dataset(variables, coords, {"schema": SCHEMA, **_labels(machine)})


def raw_beam_detection(machine: VirtualMachine, *, seed: int) -> xr.Dataset:
    """Return a raw dataset of a beam detection in the cold state, one mean reading per rest of the sphere.

    The seed determines positions and speckle, not the machine.
    """
    frame, radius = machine.frame, machine.sphere_radius
    rng = np.random.default_rng(seed)
    centres, scans = _scan_plan(frame, radius)
    actual = centres + rng.normal(0, REPEATABILITY, centres.shape)
    beams = (frame.true_origin[:, None, None, :], frame.true_direction[:, None, None, :])
    noise = np.hypot(SPECKLE, frame.noise / np.sqrt(SAMPLES_PER_REST))[:, None, None]
    readings = intersections.to_sphere(*beams, actual, radius) + noise * rng.normal(size=centres.shape[:-1])
    readings[~((readings >= 0) & (readings <= frame.range))] = np.nan
    variables = {
        "distance": (("channel", "profile", "step"), readings, _M),
        "sphere_centre": (("channel", "profile", "step", "direction"), centres, _M),
        "sphere_radius": ((), radius, _M),
        "scan_direction": (("channel", "profile", "direction"), scans, _1),
        "nominal_origin": (("channel", "direction"), np.array(frame.nominal_origin), _M),
        "nominal_direction": (("channel", "direction"), np.array(frame.nominal_direction), _1),
        "distance_noise": ((), float(np.hypot(noise.max(), REPEATABILITY)), _M),
    }
    coords = {"channel": list(frame.channels), "direction": list("xyz")}
    return xr.Dataset(variables, coords, {"schema": SCHEMA, **_labels(machine)})


def _scan_plan(frame: FrameGeometry, sphere_radius: float) -> tuple[Array, Array]:
    """Return commanded centres (channel, profile, step, 3), m, and scan directions (channel, profile, 3).

    Each channel has six profiles: at three depths of the range, in both machine directions across the beam.
    """
    centres, directions = [], []
    for origin, beam in zip(frame.nominal_origin, frame.nominal_direction, strict=True):
        across = [axis for axis in _XYZ if abs(axis @ beam) < 0.5]
        scans = np.array([axis for _ in DEPTHS for axis in across])
        distance = np.repeat(DEPTHS, len(across)) + sphere_radius
        middle = origin + distance[:, None] * beam
        centres.append(middle[:, None, :] + STEPS[:, None] * scans[:, None, :])
        directions.append(scans)
    return np.array(centres), np.array(directions)


def _labels(machine: VirtualMachine) -> dict[str, str]:
    """Return the attributes ``machine`` and ``instruments``."""
    address = f"twin://{machine.kind}?seed={machine.seed}"
    note = [{"id": "virtual five-sensor frame", "address": address, "simulated": True}]
    return {"machine": machine.name, "instruments": json.dumps(note)}
