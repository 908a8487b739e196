"""Simulated scans of a virtual gantry, and the true errors behind them.

The machine, its crossbeam, the artefacts and the line profiler are those of `errormotion.twin`.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform

from errormotion.arrays import Array
from errormotion.datasets import build_errors, provenance
from errormotion.errors import BenchError
from errormotion.kinematics.iso import DOF
from errormotion.kinematics.poses import displacement
from errormotion.methods.crossbeam_scan.identification.profiler_pose.pose_errors import stated_pose
from errormotion.methods.crossbeam_scan.schema import SCHEMA
from errormotion.methods.crossbeam_scan.settings import PoseSettings
from errormotion.twin import VirtualMachine, truth
from errormotion.twin.artefacts.pieces import Artefact, circular_pocket, swept
from errormotion.twin.sensors.profiler import Profiler

if TYPE_CHECKING:
    from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings

POSITIONS = (-0.5, 0.0, 0.5)
"""Positions of the axis over the artefacts where the settings state none, m."""
_SCAN, _PHASE = 1, 2
_LEVER, _STRAIN = 2, 3


def simulate(settings: CrossbeamScanSettings, seed: int) -> tuple[xr.Dataset, xr.Dataset]:
    """Return the raw dataset of a campaign or of a pocket with these settings, and the true errors.

    The size of a scan follows from ``scan_length``, ``line_pitch`` and ``layout``. There is one cold pass. The stated
    lever has an error drawn from ``lever_uncertainty``; scales and expansions are drawn from the settings.

    Raises
    ------
    BenchError
        An artefact is outside the travel of the virtual gantry.
    """
    machine = VirtualMachine("gantry", seed=seed)
    profiler = Profiler(settings.layout.points, settings.layout.width / settings.layout.points)
    feed = settings.line_pitch
    if settings.procedure == "profiler_pose":
        profiles = round(settings.pocket_scan_length / feed)
        raw = raw_pocket(
            machine, seed=seed, lifts=settings.pocket_lifts, profiler=profiler, profiles=profiles, feed=feed
        )
        return raw, truth_pose(machine, stated_pose(settings.profiler_pose or PoseSettings()))
    times, positions = (0.0, *settings.warm_up), settings.positions or POSITIONS
    profiles = round(settings.scan_length / feed)
    raw = raw_scans(machine, times, positions, seed=seed, profiler=profiler, profiles=profiles, feed=feed)
    raw = strained(raw, settings, np.random.default_rng([seed, _STRAIN]))
    raw["lever"] = raw["lever"] + np.random.default_rng([seed, _LEVER]).normal(0, settings.lever_uncertainty)
    raw["lever"].attrs["units"] = "m"
    raw["lever_uncertainty"] = ("direction", np.array(settings.lever_uncertainty), {"units": "m"})
    return raw, truth_axis(machine, times, positions)


def strained(raw: xr.Dataset, settings: CrossbeamScanSettings, generator: np.random.Generator) -> xr.Dataset:
    """Return scans with scales of the profiler, and expansions of its mount and of artefacts, as settings state them.

    Scales and mount are one draw for each warm cycle, the expansion one for each scan. An artefact expands about the
    middle of its foot: a surface with the heights z(x, y) that is (1 + e) times as large has (1 + e) z - e (x dz/dx +
    y dz/dy), and stands higher by e times its height.
    """
    u = settings.strains()
    height = raw["height"].values.copy()
    x, up = raw["x"].values, np.linalg.inv(raw["profiler_pose"].values)[2, 3]  # of the tool frame over the profiler
    for cycle in range(1, len(height)):
        along, across, mount = generator.normal(size=3) * [u["scale_x"], u["scale_z"], u["mount"]]
        for k, z in enumerate(height[cycle]):
            y, e = raw["y"].values[cycle, k], generator.normal() * u["expansion"]
            picture = (across + e) * z - (along + e) * x * np.gradient(z, x, axis=1)
            picture -= e * y[:, None] * np.gradient(z, y, axis=0)
            z += np.nan_to_num(picture).astype(np.float32) + np.float32(e * settings.height_of_artefacts() + mount * up)
    return raw.assign(height=(raw["height"].dims, height, raw["height"].attrs))


def truth_of(machine: VirtualMachine, errors: xr.Dataset, clock: float) -> xr.Dataset:  # noqa: ARG001 - the interface
    """Return the true errors at the times of the scans of an error dataset; the warm-up starts at its time 0."""
    true = truth_axis(machine, errors["time"].values, errors["y"].values)
    twist = machine.crossbeam.twist(errors["scan_time"].values, errors["y"].values)  # at the time of each scan
    return true.assign({name: (("time", "position"), twist[..., k], true[name].attrs) for k, name in enumerate(DOF)})


def truth_axis(machine: VirtualMachine, times: ArrayLike, positions: ArrayLike) -> xr.Dataset:
    """Return the thermal errors of the gantry's Y axis as an error dataset over ``time`` and ``position``.

    The warm-up starts at time 0. The errors are those of the carriage at its origin, relative to the cold state.

    Parameters
    ----------
    machine : VirtualMachine
        Of kind "gantry".
    times : (n,)
        s, increasing.
    positions : (m,)
        Of the axis, m.

    Raises
    ------
    BenchError
        The machine has no crossbeam.
    """
    _need_crossbeam(machine)
    t, y = _vector(times), _vector(positions)
    twist = machine.crossbeam.twist(t[:, None], y)
    origin = truth.Origin(machine.name, machine.kind, machine.seed, machine.state.schedule.events)
    coords = {"time": t, "y": ("position", y, {"units": "m"})}
    where = ("time", "position"), coords, "Y", np.zeros(3), "cold state at time 0", origin
    return truth.dataset(twist, *where, frame="carriage")


def truth_pose(machine: VirtualMachine, nominal: RigidTransform) -> xr.Dataset:
    """Return the true pose of the profiler relative to a nominal pose, as an error dataset over ``beam``."""
    true = RigidTransform.from_matrix(machine.crossbeam.pose)
    return build_errors(
        displacement(true * nominal.inv(), nominal.translation)[None],
        np.zeros((1, 6, 6)),
        dims=("beam",),
        coords={"beam": ["profiler"]},
        component="beam",
        machine=machine.name,
        frame="tool",
        functional_point=nominal.translation,
        reference="nominal pose of the profiler",
        method="twin",
        method_version="1",
        provenance=provenance.make({}, None, None, seed=machine.seed),
    )


def raw_scans(
    machine: VirtualMachine,
    times: ArrayLike,
    positions: ArrayLike,
    *,
    seed: int,
    artefact: Artefact | None = None,
    profiler: Profiler | None = None,
    profiles: int = 800,
    feed: float = 70e-6,
    motion: str = "axis",
    pose: ArrayLike | None = None,
) -> xr.Dataset:
    """Return a raw dataset of scans of artefacts along the crossbeam, heights as float32.

    The sampling phase of each scan is random: y of its middle is off by up to half a feed.

    Parameters
    ----------
    machine : VirtualMachine
        Of kind "gantry".
    times : (cycle,)
        Time of each cycle, s; the first is the cold one and the reference. A cycle takes no time.
    positions : (artefact,)
        Of the Y axis over the middle of each artefact, m.
    seed : int
        Seed of noise and sampling phase only; machine and artefacts do not depend on it.
    artefact : Artefact, optional
        The artefact at every position, slightly misaligned; by default the swept free form.
    profiler : Profiler, optional
        By default an LJ-X8000A with all its disturbances.
    profiles : int
        Number of lines of a scan.
    feed : float
        Distance of two lines, m.
    motion : {"axis", "rigid"}
        "axis": the carriage has at each line the error of the axis there, as in the truth. "rigid": over the whole scan
        it has the error at the middle, which a registration can determine exactly.
    pose : (4, 4), optional
        Profiler pose that the dataset states; by default the true one.

    Raises
    ------
    BenchError
        The machine has no crossbeam, a position is out of travel, or an argument is out of range.
    """
    _need_crossbeam(machine)
    if motion not in ("axis", "rigid"):
        raise BenchError(f"The motion of a scan is 'axis' or 'rigid'; found {motion!r}.", code="simulation.scan.motion")
    if profiles < 2 or not feed > 0:
        raise BenchError(
            f"A scan needs at least two lines and a feed above 0; found {profiles}, {feed} m.",
            code="simulation.scan.size",
        )
    beam, t, position = machine.crossbeam, _vector(times), _vector(positions)
    reach = profiles * feed / 2
    if position.min() - reach < beam.travel[0] or position.max() + reach > beam.travel[1]:
        raise BenchError(
            f"The axis travels from {beam.travel[0]} to {beam.travel[1]} m; the scans reach from "
            f"{position.min() - reach:.3f} to {position.max() + reach:.3f} m.",
            code="simulation.scan.outside_travel",
        )
    artefact, profiler = artefact or swept(), profiler or Profiler()
    shape = (t.size, position.size, profiles)
    height = np.empty((*shape, profiler.points), dtype=np.float32)
    y = np.empty(shape)
    artefact_poses = [beam.artefact_pose(machine.seed, middle) for middle in position]
    phase = np.random.default_rng([abs(seed), int(seed < 0), _PHASE]).uniform(-0.5, 0.5, shape[:2])
    index = np.arange(profiles) - (profiles - 1) / 2
    for cycle, k in np.ndindex(shape[:2]):
        middle = float(position[k])
        y[cycle, k] = (index + phase[cycle, k]) * feed
        carriage = beam.carriage(float(t[cycle]), middle + y[cycle, k], middle, motion)
        key = (machine.seed, seed, _SCAN, cycle, k)
        height[cycle, k] = profiler.scan(artefact, beam.lines(carriage, artefact_poses[k]), key=key)
    metres = {"units": "m"}
    return xr.Dataset(
        {
            "height": (("cycle", "artefact", "profile", "point"), height, metres),
            "x": ("point", profiler.x, metres),
            "y": (("cycle", "artefact", "profile"), y, metres),
            "time": ("cycle", t, {"units": "s"}),
            "position": ("artefact", position, metres),
            "profiler_pose": (("row", "column"), beam.pose if pose is None else np.asarray(pose, dtype=float)),
            "lever": ("direction", beam.lever, metres),
            "height_noise": ((), profiler.disturbances.noise, metres),
        },
        {"direction": list("xyz")},
        _attributes(machine),
    )


def raw_pocket(
    machine: VirtualMachine,
    *,
    seed: int,
    lifts: ArrayLike = (0.166, 0.182),
    profiler: Profiler | None = None,
    profiles: int = 400,
    feed: float = 70e-6,
) -> xr.Dataset:
    """Return a raw dataset of scans of a circular pocket that the cold gantry has cut, heights as float32.

    Parameters
    ----------
    machine : VirtualMachine
        Of kind "gantry".
    seed : int
        Seed of the noise only.
    lifts : (scan,)
        Height of the spindle above its position when the pocket was cut, m.
    profiler : Profiler, optional
        By default an LJ-X8000A with all its disturbances.
    profiles : int
        Number of lines of a scan.
    feed : float
        Distance of two lines, m.

    Raises
    ------
    BenchError
        The machine has no crossbeam.
    """
    _need_crossbeam(machine)
    profiler, pocket, lift = profiler or Profiler(), circular_pocket(), _vector(lifts)
    stage = np.zeros((lift.size, profiles, 3))
    stage[..., 1], stage[..., 2] = (np.arange(profiles) - (profiles - 1) / 2) * feed, lift[:, None]
    poses = np.tile(machine.crossbeam.pose, (*stage.shape[:2], 1, 1))
    poses[..., :3, 3] += stage
    height = [profiler.scan(pocket, poses[k], key=(machine.seed, seed, k)) for k in range(lift.size)]
    metres = {"units": "m"}
    return xr.Dataset(
        {
            "height": (("scan", "profile", "point"), np.array(height).astype(np.float32), metres),
            "x": ("point", profiler.x, metres),
            "stage": (("scan", "profile", "direction"), stage, metres),
            "pocket_centre": ("direction", np.zeros(3), metres),
            "pocket_radius": ((), float(pocket.parameters[2]), metres),
        },
        {"direction": list("xyz")},
        _attributes(machine),
    )


def _need_crossbeam(machine: VirtualMachine) -> None:
    if machine.kind != "gantry":
        raise BenchError(
            f"Only the virtual machine 'gantry' has a crossbeam; this one is '{machine.kind}'.",
            code="simulation.machine.no_crossbeam",
        )


def _attributes(machine: VirtualMachine) -> dict[str, str]:
    note = {"id": "virtual line profiler", "address": f"twin://gantry?seed={machine.seed}", "simulated": True}
    return {"schema": SCHEMA, "machine": machine.name, "instruments": json.dumps([note])}


def _vector(values: ArrayLike) -> Array:
    return np.atleast_1d(np.asarray(values, dtype=float))
