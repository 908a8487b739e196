"""What the kit needs to know of the built-in plugins beyond what they say themselves."""

from __future__ import annotations

import atexit
import math
import shutil
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from scipy.spatial.transform import RigidTransform

from errormotion.datasets import build_errors, provenance
from errormotion.kinematics.poses import displacement
from errormotion.plugins import Group, InstrumentSubject, MethodSubject
from errormotion.twin import Event, VirtualMachine
from errormotion.twin.profiler import Profiler

#: 100 minutes at 15000 /min, one instant every 250 s: enough for the thermal drift to build up.
TIMES = 250.0 * np.arange(24)
SCHEDULE = (Event(0.0, 15000.0, None),)
#: Beam calibration in the simulated drift data: 0.5 um and 0.4 mrad, as a beam detection attains them.
BEAM_SIGMA = np.array([0.5e-6] * 3 + [0.4e-3] * 3)


def builtin_subjects(
    group: Group, plugin_id: str, cls: Any
) -> tuple[MethodSubject, ...] | tuple[InstrumentSubject, ...]:
    """Return the subjects of a built-in plugin; none where the kit needs no help, or knows none."""
    if (group, plugin_id) == ("methods", "spindle_drift"):
        return spindle_drift(cls)
    if (group, plugin_id) == ("methods", "crossbeam_scan"):
        return crossbeam_scan(cls)
    if (group, plugin_id) == ("methods", "beam_direction"):
        return (beam_direction(cls),)
    if (group, plugin_id) == ("methods", "multilateration"):
        return (multilateration(cls),)
    if (group, plugin_id) == ("methods", "normal_vector"):
        return (normal_vector(cls),)
    if (group, plugin_id) == ("instruments", "profile_files"):
        return (InstrumentSubject(cls, str(scan_file())),)
    if (group, plugin_id) == ("instruments", "mtconnect"):
        return (mtconnect(cls),)
    if (group, plugin_id) in (("instruments", "controller_probe"), ("instruments", "virtual_controller")):
        return (on_virtual_machine(cls),)
    if (group, plugin_id) == ("instruments", "dprnt"):
        return (InstrumentSubject(cls, "sim://cframe/printer", faults=()),)  # they show in lines, and nobody prints
    if (group, plugin_id) == ("instruments", "tracker_table"):
        return (InstrumentSubject(cls, str(length_table())),)
    return ()


def on_virtual_machine(cls: Any) -> InstrumentSubject:
    """Return what moves the virtual machine; what is wrong with it shows when it moves, not when it is read."""
    machine = ("alarm", "estop", "no_trip", "tripped")
    return InstrumentSubject(cls, "sim://cframe/controller", harmless=("split", *machine))


def mtconnect(cls: Any) -> InstrumentSubject:
    """Return ``mtconnect``: what harms its observations does not harm its state, where an alarm is a word."""
    return InstrumentSubject(cls, "sim://cframe/mtconnect", harmless=("split", "overrun", "jump", "restart", "alarm"))


def own_folder() -> Path:
    """Return a new folder that lasts as long as this process."""
    folder = Path(tempfile.mkdtemp(prefix="errormotion-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@cache
def length_table() -> Path:
    """Return a table of lengths from three stations to five targets; one beam was broken."""
    lines = [f"S{k},{i},{1500 + 100 * k + 7 * i:.4f},20.{i},1013.2,45" for k in range(3) for i in range(5)]
    lines[7] = "S1,2,,20.2,1013.2,45"
    path = own_folder() / "lengths.csv"
    path.write_text(
        "\n".join(["station,target,length [mm],temperature [degC],pressure [hPa],humidity [%]", *lines]) + "\n",
        encoding="utf-8",
    )
    return path


@cache
def scan_file() -> Path:
    """Return a scan of 350 profiles as a file that lasts as long as this process; three heights are unknown."""
    folder = own_folder()
    x, y = 12.5e-6 * np.arange(60), 25e-6 * np.arange(350)
    heights = 1e-3 * np.sin(np.add.outer(700.0 * y, 5000.0 * x))
    heights[10:13, 7] = np.nan
    scan = xr.Dataset(
        {"height": (("profile", "point"), heights, {"units": "m"})},
        {"x": ("point", x, {"units": "m"}), "y": ("profile", y, {"units": "m"})},
    )
    scan.to_netcdf(folder / "scan.nc", engine="h5netcdf")
    return folder / "scan.nc"


def spindle_drift(cls: Any) -> tuple[MethodSubject, ...]:
    """Return the two procedures of ``spindle_drift``: the drift itself, and the detection of its beams.

    Its levels are heights on z, and a beam along an axis has no rotation about itself: both procedures are tried in
    frames turned about z, the beams by a quarter turn. The numbers of seeds keep the whole kit under a minute.
    """
    drift = MethodSubject(
        cls,
        drift_record,
        name="drift",
        settings={"functional_point": (0.0, 0.0, 0.0)},
        setting_vectors={"functional_point": "point"},
        raw_vectors={
            "beam_origin": "point",
            "beam_direction": "direction",
            "beam_covariance": "covariance",
            "level": "z",
        },
        optional=("beam_covariance", "temperature", "spindle_speed"),
        measured=("distance",),
        motion=((0.0, 0.0, 0.5), (0.1, -0.2, 0.05)),
        seeds=120,
    )
    beams = MethodSubject(
        cls,
        beam_detection,
        name="beam_detection",
        settings={"procedure": "beam_detection"},
        raw_vectors={
            "sphere_centre": "point",
            "scan_direction": "direction",
            "nominal_origin": "point",
            "nominal_direction": "direction",
        },
        optional=("distance_noise",),
        measured=("distance",),
        motion=((0.0, 0.0, math.pi / 2), (0.1, -0.2, 0.05)),
        seeds=60,
    )
    return drift, beams


def crossbeam_scan(cls: Any) -> tuple[MethodSubject, ...]:
    """Return the two procedures of ``crossbeam_scan``: scans of three artefacts, and the profiler's own pose.

    The axis is Y of every frame, so the frame is turned about Y, and the pocket's not at all.
    """
    scans = MethodSubject(
        cls,
        crossbeam_scans,
        name="scan",
        settings={"positions": SCANNED},
        raw_vectors={"profiler_pose": "pose", "lever": "direction"},
        optional=("lever_uncertainty",),
        measured=("height",),
        motion=((0.0, 0.3, 0.0), (0.0, 0.0, 0.0)),
        seeds=40,
    )
    pose = MethodSubject(
        cls,
        pocket_scans,
        name="profiler_pose",
        settings={"procedure": "profiler_pose", "profiler_pose": {"dz": NOMINAL_LIFT}},
        raw_vectors={},
        optional=("pocket_radius_uncertainty",),
        measured=("height",),
        motion=((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        seeds=40,
    )
    return scans, pose


def beam_direction(cls: Any) -> MethodSubject:
    """Return ``beam_direction`` on four planes of a sine gauge, with the triangulation plane as well known as it is."""
    return MethodSubject(
        cls,
        planes_of_gauge,
        settings={
            "layout": {
                "nominal_direction": (np.sin(np.radians(20)), 0.0, -np.cos(np.radians(20))),
                "nominal_origin": (0.05, 0.0, -0.08),
                "pivot": (0.1, 0.05, 0.12),
            }
        },
        raw_vectors={
            "stage": "direction",
            "nominal_direction": "direction",
            "nominal_origin": "point",
            "nominal_normal": "direction",
            "triangulation_normal": "direction",
            "plane_point": "point",
        },
        optional=(
            *("nominal_origin", "nominal_normal", "triangulation_normal", "mid_range", "reading_range"),
            *("speckle", "plane_point", "plane_point_uncertainty"),
        ),
        measured=("distance",),
        seeds=150,
    )


#: Where the artefacts of the simulated scans stand along Y, and where the profiler hangs by its drawing, m.
SCANNED = (-0.5, 0.0, 0.5)
NOMINAL_LIFT = -0.17


def crossbeam_scans(seed: int) -> tuple[xr.Dataset, xr.Dataset]:
    """Return scans of three artefacts, cold, after half an hour and after two; and the true errors of the axis.

    A quarter of the points of a real profiler, twice as far apart, on half the width; with all that is wrong with it.
    """
    virtual, times = VirtualMachine("gantry", seed=seed), [0.0, 1800.0, 7200.0]
    raw = virtual.raw_crossbeam_scan(times, SCANNED, seed=seed, profiler=Profiler(800, 25e-6), profiles=400, feed=70e-6)
    raw["lever"] = raw["lever"] + np.random.default_rng([seed, 2]).normal(0, 1e-3, 3)
    raw["lever"].attrs["units"] = "m"
    raw["lever_uncertainty"] = ("direction", np.full(3, 1e-3), {"units": "m"})
    return raw, virtual.truth_crossbeam(times, SCANNED)


def pocket_scans(seed: int) -> tuple[xr.Dataset, xr.Dataset]:
    """Return scans of a pocket, and how the profiler truly hangs off its drawing."""
    virtual = VirtualMachine("gantry", seed=seed)
    nominal = RigidTransform.from_translation([0.0, 0.0, NOMINAL_LIFT])
    true = RigidTransform.from_matrix(virtual.crossbeam.pose)
    truth = build_errors(
        displacement(true * nominal.inv(), nominal.translation)[None],
        np.zeros((1, 6, 6)),
        dims=("beam",),
        coords={"beam": ["profiler"]},
        component="beam",
        machine=virtual.name,
        frame="tool",
        functional_point=nominal.translation,
        reference="nominal pose of the profiler",
        method="twin",
        method_version="1",
        provenance=provenance.make({}, None, None, seed=seed),
    )
    return virtual.raw_pocket_scan(seed=seed), truth


def planes_of_gauge(seed: int) -> tuple[xr.Dataset, xr.Dataset]:
    """Return readings with speckle on four planes of a sine gauge, and how the beam truly lies off its drawing."""
    virtual = VirtualMachine("cframe", seed=seed)
    planes = [(math.radians(20.0), math.radians(rotation)) for rotation in (0.0, 90.0, 180.0, 270.0)]
    raw = virtual.raw_beam_direction(planes, seed=seed, speckle=True, inclination_error=False)
    return raw, virtual.truth_beam()


def multilateration(cls: Any) -> MethodSubject:
    """Return ``multilateration`` with one tracker at four places in turn, some beams broken, and 48 targets."""
    return MethodSubject(
        cls,
        tracker_readings,
        settings={"scale_uncertainty": TRACKER_SCALE, "planning": {"minimise": "mean"}},
        raw_vectors={"target_nominal": "point", "station_nominal": "point", "reflector": "point"},
        optional=("station_nominal", "reflector", "reading_time"),
        measured=("displacement",),
        seeds=100,
        compiles=True,
    )


#: Relative error of the tracker's lengths, one sigma.
TRACKER_SCALE = 0.5e-6


def tracker_readings(seed: int) -> tuple[xr.Dataset, xr.Dataset]:
    """Return distances of a reflector from four places, and the true errors less the motion that they do not see."""
    virtual = VirtualMachine("cframe", seed=seed)
    position = virtual.target_grid((4, 4, 3))
    scale = TRACKER_SCALE * np.random.default_rng([seed, 3]).normal()
    raw = virtual.raw_multilateration(position, seed=seed, scale=scale, missing=0.02)
    return raw, virtual.truth_multilateration(position)


def normal_vector(cls: Any) -> MethodSubject:
    """Return ``normal_vector`` on a machine whose table moves in X and Y, so that the frame is turned about Z alone.

    A gantry shows all six freedoms, but single precision at 4 m is as coarse as its touches.
    """
    balls = tuple({"centre": place} for place in ((-0.24, -0.2, 0.06), (0.24, -0.19, 0.23), (0.23, 0.2, 0.09)))
    return MethodSubject(
        cls,
        touched_balls,
        settings={"tool_axes": "Z", "functional_point": PROBED, "balls": balls},
        setting_vectors={"functional_point": "point"},
        raw_vectors={"touch": "point", "approach": "direction", "ball_nominal": "point"},
        optional=(
            *("touch_time", "touch_flag", "approach", "ball_radius", "ball_nominal", "touch_noise"),
            *("temperature", "spindle_speed", "feed"),
        ),
        measured=("touch",),
        motion=((0.0, 0.0, 0.5), (0.1, -0.2, 0.05)),
        seeds=120,
    )


#: Where the error of the probing machine is stated, m.
PROBED = (0.0, 0.0, 0.15)


def touched_balls(seed: int) -> tuple[xr.Dataset, xr.Dataset]:
    """Return the touches of four balls, cold and six times while the spindle warms up, and the true error.

    A cycle takes two minutes; its mean state is that of its middle.
    """
    virtual = VirtualMachine("cframe", seed=seed)
    virtual.start((Event(120.0, 12000.0, None),))
    raw = virtual.raw_normal_vector(600.0 * np.arange(7), seed=seed, cycle=120.0)
    truth = virtual.truth_probing(60.0 + 20.0 * np.arange(190), PROBED)
    for name in truth.data_vars:
        if truth[name].dims == ("time",):
            truth[name] = (truth[name] - truth[name][0]).assign_attrs(truth[name].attrs)
    return raw, truth


@cache
def machine(seed: int) -> VirtualMachine:
    """Return a virtual machine that has run through the schedule."""
    virtual = VirtualMachine("cframe", seed=seed)
    virtual.start(SCHEDULE)
    return virtual


def drift_record(seed: int) -> tuple[xr.Dataset, xr.Dataset]:
    """Return a drift record, its beams known as well as a calibration knows them, and the spindle's true drift."""
    virtual = machine(seed)
    rng = np.random.default_rng([seed, 1])
    origin = virtual.frame.true_origin + BEAM_SIGMA[:3] * rng.normal(size=(5, 3))
    direction = virtual.frame.true_direction.copy()
    covariance = np.zeros((5, 6, 6))
    for i, u in enumerate(virtual.frame.true_direction):
        across = np.eye(3) - np.outer(u, u)
        direction[i] += across @ (BEAM_SIGMA[3:] * rng.normal(size=3))
        covariance[i, :3, :3] = np.diag(BEAM_SIGMA[:3] ** 2)
        covariance[i, 3:, 3:] = across * BEAM_SIGMA[3] ** 2
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    beams = (origin, direction, covariance)
    raw = virtual.raw_spindle_drift(TIMES, seed=seed, beams=beams, warm_up=False, radius_error=False)
    return raw, virtual.truth_spindle(TIMES)


def beam_detection(seed: int) -> tuple[xr.Dataset, xr.Dataset]:
    """Return the readings of a stepped sphere, and the true beams relative to the nominal ones."""
    virtual = machine(seed)
    frame = virtual.frame
    turn = np.cross(frame.nominal_direction, frame.true_direction)  # the sine; the angle to 1e-5 at 5 mrad
    truth = build_errors(
        np.concatenate([frame.true_origin - frame.nominal_origin, turn], axis=1),
        np.zeros((5, 6, 6)),
        dims=("beam",),
        coords={"beam": list(frame.channels)},
        component="beam",
        machine=virtual.name,
        frame="machine",
        functional_point=frame.nominal_origin.mean(axis=0),
        reference="nominal beams, each at its own nominal zero point",
        method="twin",
        method_version="1",
        provenance=provenance.make({}, None, None, seed=seed),
    )
    return virtual.raw_beam_detection(seed=seed), truth
