"""Raw data of the method, simulated on the virtual machine without instruments, fast enough for Monte Carlo.

Planes of the sine gauge, the check bar, and readings against an interferometer.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from errormotion.arrays import Array
from errormotion.errors import BenchError
from errormotion.kinematics.beams import beam_errors, tilt_vector
from errormotion.methods.beam_direction.schema import INCLINATION_SCHEMA, SCHEMA
from errormotion.methods.beam_direction.settings import BeamDirectionSettings
from errormotion.twin import VirtualMachine, kernels, truth
from errormotion.twin.artefacts.planes import CheckBar, Target
from errormotion.twin.sensors.point_sensor import RECEIVER, PointSensor
from errormotion.twin.sensors.stage_sensor import NOISE, TEXTURE

PLANES = tuple((np.radians(20.0), np.radians(rotation)) for rotation in (0.0, 90.0, 180.0))
"""Default faces of the sine gauge: inclination and rotation, rad."""
ALPHAS = np.radians(np.arange(-45.0, 46.0, 5.0))
BETAS = np.radians([*range(0, 11, 2), 90, *range(170, 181, 2)])
DEPTHS = 1e-3 * np.arange(-10.0, 11.0)
"""Inclinations and rotations, rad, and depths, m, of a typical calibration: about 5000 groups."""
USED_RANGE = 0.8
"""Share of the measuring range that a stroke uses."""
READING_TIME, SETTING_TIME = 1.0, 60.0
"""Interval of the readings, and duration of the setting of the gauge, s."""
REFERENCE_NOISE = 20e-9
"""Standard deviation of the interferometer, m."""

_BAR_STREAM = 3
_M, _1, _RAD = {"units": "m"}, {"units": "1"}, {"units": "rad"}


def simulate(settings: BeamDirectionSettings, seed: int) -> tuple[xr.Dataset, xr.Dataset]:
    """Return readings with speckle on the planes of the settings, and the true errors of the beam.

    The readings have no inclination error. The seed selects the machine and the noise.
    """
    machine = VirtualMachine("cframe", seed=seed)
    planes = [(face.inclination, face.rotation) for face in settings.planes]
    return raw(machine, planes, seed=seed, speckle=True, inclination_error=False), truth_beam(machine)


@dataclass(frozen=True)
class _Readings:
    """Readings of one sensor, with the effects that they include."""

    sensor: PointSensor
    seed: int
    inclination_error: bool
    speckle: bool
    sensors_on_for: float

    def at(self, target: Target, stage: Array, start: float, part: int) -> Array:
        """Return one reading at each stage position (n, 3), m, the first at the time ``start``, s."""
        sensor = self.sensor
        since_on = self.sensors_on_for + start + READING_TIME * np.arange(len(stage))
        reading = sensor.still(target, stage, inclination_error=self.inclination_error)
        reading = reading + sensor.warm_up_offset(since_on)
        if self.speckle:
            reading = reading + sensor.speckles((self.seed, TEXTURE, part), stage)
        return reading + sensor.noise * kernels.normals(kernels.stream_key(self.seed, NOISE, part), 0, len(stage))


def truth_beam(machine: VirtualMachine, sensor: PointSensor | None = None, beam: str = "beam") -> xr.Dataset:
    """Return the true errors of the sensor's beam as an error dataset over ``beam``.

    Shift of the zero point, and smallest rotation from the nominal to the true direction, with ``beam_origin``,
    ``beam_direction``, ``nominal_origin``, ``nominal_direction`` (beam, direction).
    """
    sensor = sensor or machine.point_sensor
    vectors = {
        "nominal_origin": (sensor.nominal_origin, _M),
        "nominal_direction": (sensor.nominal_direction, _1),
        "beam_origin": (sensor.true_origin, _M),
        "beam_direction": (sensor.true_direction, _1),
    }
    p0, u0, p, u = (value[None] for value, _ in vectors.values())
    twist, _ = beam_errors(p0, u0, p, u, np.zeros((1, 6, 6)))
    origin = truth.Origin(machine.name, machine.kind, machine.seed, machine.state.schedule.events)
    ds = truth.dataset(twist, "beam", {"beam": [beam]}, "beam", sensor.nominal_origin, "nominal beam", origin)
    extras = {name: (("beam", "direction"), value[None], unit) for name, (value, unit) in vectors.items()}
    return ds.assign(extras).assign_coords(direction=list("xyz"))


def strokes(
    machine: VirtualMachine,
    inclination: float,
    rotation: float,
    *,
    sensor: PointSensor | None = None,
    count: int = 20,
    half_length: float = 20e-3,
) -> Array:
    """Return stage positions on three strokes along X, Y and Z about ``machine.home()``, m, shape (3 count, 3).

    Their length is limited by four fifths of the sensor's range at a face of the sine gauge, and by twice
    ``half_length``.
    """
    sensor = sensor or machine.point_sensor
    normal = machine.sine_gauge.nominal_normal(inclination, rotation)
    facing = -float(normal @ sensor.nominal_direction)
    depth = USED_RANGE * (sensor.range[1] - sensor.range[0]) / 2
    change = np.abs(normal) / max(facing, 1e-3)  # of the reading with the stage
    half = np.minimum(half_length, depth / np.maximum(change, 1e-6))
    steps = np.linspace(-1.0, 1.0, count)
    return np.asarray(machine.home(sensor) + np.concatenate([np.outer(steps, line) for line in np.diag(half)]))


def raw(
    machine: VirtualMachine,
    planes: Sequence[tuple[float, float]] = PLANES,
    stage: ArrayLike | None = None,
    *,
    seed: int,
    inclination_error: bool = True,
    speckle: bool = False,
    check_bar: bool = False,
    sensor: PointSensor | None = None,
    count: int = 20,
    half_length: float = 20e-3,
) -> xr.Dataset:
    """Return a raw dataset of a beam calibration on planes; NaN for missing readings.

    Parameters
    ----------
    machine : VirtualMachine
    planes : sequence of (inclination, rotation)
        Settings of the sine gauge, rad.
    stage : (n, 3) or (plane, n, 3), optional
        Stage positions, m; default three strokes along X, Y and Z.
    seed : int
        Seed of the noise and of the setting of the gauge; the machine does not change. The true faces are
        ``sine_gauge.plane(inclination, rotation, seed)``.
    inclination_error, speckle : bool
        Whether the readings include the error caused by the inclination of the surface, and speckle; the dataset
        states the latter.
    check_bar : bool
        Whether the check bar is measured as well, see `raw_check_bar`.
    sensor : PointSensor, optional
        Default ``machine.point_sensor``.
    count, half_length
        Readings on each stroke, and half its longest length, m.

    Raises
    ------
    BenchError
        Stage positions of another shape.
    """
    sensor = sensor or machine.point_sensor
    if stage is None:
        positions = np.array(
            [strokes(machine, *plane, sensor=sensor, count=count, half_length=half_length) for plane in planes]
        )
    else:
        stage = np.asarray(stage, dtype=float)
        if stage.ndim not in (2, 3) or stage.shape[-1] != 3 or (stage.ndim == 3 and len(stage) != len(planes)):
            raise BenchError(
                f"Expected stage positions (reading, 3), or (plane, reading, 3) for {len(planes)} planes; found "
                f"{stage.shape}.",
                code="simulation.stage.shape",
            )
        positions = np.broadcast_to(stage, (len(planes), *stage.shape[-2:])).copy()
    reader = _Readings(sensor, seed, inclination_error, speckle, machine.sensors_on_for)
    duration = SETTING_TIME + READING_TIME * positions.shape[1]
    faces = [machine.sine_gauge.face(*plane, setting=seed) for plane in planes]
    readings = [reader.at(face, positions[i], i * duration, i) for i, face in enumerate(faces)]
    normals = [machine.sine_gauge.nominal_normal(*plane) for plane in planes]
    ds = _stated(machine, sensor, speckle).assign(
        distance=(("plane", "reading"), np.array(readings), _M),
        stage=(("plane", "reading", "direction"), positions, _M),
        nominal_normal=(("plane", "direction"), np.array(normals), _1),
        plane_point=(("plane", "direction"), np.tile(machine.sine_gauge.pivot, (len(planes), 1)), _M),
        plane_point_uncertainty=((), machine.sine_gauge.point_uncertainty, _M),
    )
    if not check_bar:
        return ds
    bar = raw_check_bar(
        machine,
        seed=seed,
        inclination_error=inclination_error,
        speckle=speckle,
        sensor=sensor,
        start=len(planes) * duration,
    )
    return ds.assign({name: bar[name] for name in ("bar_distance", "bar_stage", "bar_radius", "bar_axis")})


def raw_check_bar(
    machine: VirtualMachine,
    *,
    seed: int,
    inclination_error: bool = True,
    speckle: bool = False,
    sensor: PointSensor | None = None,
    bar: CheckBar | None = None,
    count: int = 20,
    half_width: float = 17e-3,
    start: float = 0.0,
) -> xr.Dataset:
    """Return readings across the check bar: ``bar_distance``, ``bar_stage``, ``bar_radius``, ``bar_axis``.

    The stage moves across the bar and across the nominal beam; the readings are near mid-range.

    Parameters
    ----------
    machine : VirtualMachine
    seed : int
        Seed of the noise.
    inclination_error, speckle, sensor
        See `raw`.
    bar : CheckBar, optional
        Default ``machine.check_bar``.
    count : int
        Number of readings.
    half_width : float
        Distance of the outer readings from the middle, m.
    start : float
        Time of the first reading, s.
    """
    sensor, bar = sensor or machine.point_sensor, bar or machine.check_bar
    reader = _Readings(sensor, seed, inclination_error, speckle, machine.sensors_on_for)
    positions = _bar_stage(sensor, bar, count, half_width)
    return _stated(machine, sensor, speckle).assign(
        bar_distance=("bar_reading", reader.at(bar, positions, start, -_BAR_STREAM), _M),
        bar_stage=(("bar_reading", "direction"), positions, _M),
        bar_radius=((), bar.certified_radius, _M),
        bar_axis=("direction", bar.nominal_axis, _1),
    )


def raw_inclination(
    machine: VirtualMachine,
    alphas: ArrayLike = ALPHAS,
    betas: ArrayLike = BETAS,
    depths: ArrayLike = DEPTHS,
    *,
    seed: int,
    speckle: bool = False,
    sensor: PointSensor | None = None,
) -> xr.Dataset:
    """Return readings against an interferometer over ``group``; NaN for missing readings.

    Every combination of inclination, rotation and depth is one group.

    Parameters
    ----------
    machine : VirtualMachine
    alphas, betas : (k,), (m,)
        Inclinations (negative: tilted in the opposite direction) and rotations, rad.
    depths : (n,)
        From mid-range, m.
    seed : int
        Seed of the noise.
    speckle : bool
        Whether each reading has its own speckle.
    sensor : PointSensor, optional
        Default ``machine.point_sensor``.
    """
    sensor = sensor or machine.point_sensor
    parts = np.meshgrid(*(np.asarray(part, dtype=float) for part in (alphas, betas, depths)), indexing="ij")
    alpha, beta, depth = (part.ravel() for part in parts)
    rng = np.random.default_rng(seed)
    noise = float(np.hypot(sensor.noise, sensor.speckle if speckle else 0.0))
    reading = sensor.mid_range + depth * (1 + sensor.slope(tilt_vector(alpha, beta)))
    reading = reading + noise * rng.normal(size=depth.size)
    half_range = (sensor.range[1] - sensor.range[0]) / 2
    reading[np.abs(depth) > half_range * (1 + 1e-9)] = np.nan
    reference = sensor.mid_range + depth + REFERENCE_NOISE * rng.normal(size=depth.size)
    variables: Mapping[str, Any] = {
        "reading": ("group", reading, _M),
        "reference": ("group", reference, _M),
        "inclination": ("group", alpha, _RAD),
        "rotation": ("group", beta, _RAD),
        "receiver_rotation": ((), np.pi, _RAD),
        "reading_noise": ((), float(np.hypot(noise, REFERENCE_NOISE)), _M),
        "mid_range": ((), sensor.mid_range, _M),
    }
    return xr.Dataset(variables, attrs={"schema": INCLINATION_SCHEMA, **_labels(machine)})


def _stated(machine: VirtualMachine, sensor: PointSensor, speckle: bool) -> xr.Dataset:
    """Return the part of a raw dataset that describes the sensor."""
    variables: dict[str, Any] = {
        "nominal_origin": ("direction", sensor.nominal_origin, _M),
        "nominal_direction": ("direction", sensor.nominal_direction, _1),
        "triangulation_normal": ("direction", sensor.nominal_triangulation_normal, _1),
        "distance_noise": ((), sensor.noise, _M),
        "mid_range": ((), sensor.mid_range, _M),
        "reading_range": ("limit", np.array(sensor.range), _M),
    }
    if speckle:
        variables["speckle"] = ((), sensor.speckle, _M)
        variables["speckle_length"] = ((), sensor.speckle_length, _M)
    attrs = {"schema": SCHEMA, "receiver": RECEIVER, **_labels(machine)}
    return xr.Dataset(variables, {"direction": list("xyz")}, attrs)


def _labels(machine: VirtualMachine) -> dict[str, str]:
    address = f"twin://{machine.kind}?seed={machine.seed}"
    note = [{"id": "virtual point sensor", "address": address, "simulated": True}]
    return {"machine": machine.name, "instruments": json.dumps(note)}


def _bar_stage(sensor: PointSensor, bar: CheckBar, count: int, half_width: float) -> Array:
    """Return stage positions on a stroke across a bar and across the nominal beam, m, shape (count, 3)."""
    if not 0 < half_width < bar.certified_radius:
        raise BenchError(
            f"half_width: expected a positive length below the radius of the bar, {bar.certified_radius * 1e3:g} mm; "
            f"found {half_width * 1e3:g} mm.",
            code="simulation.bar.half_width",
        )
    u, axis = sensor.nominal_direction, bar.nominal_axis
    towards = u - (u @ axis) * axis
    if not np.linalg.norm(towards) > 0.1:
        raise BenchError("Expected a beam across the bar; found one parallel to it.", code="simulation.bar.parallel")
    towards = towards / np.linalg.norm(towards)
    sag = bar.certified_radius - np.sqrt(bar.certified_radius**2 - half_width**2)
    nearest = bar.point - bar.certified_radius * towards
    middle = nearest - sensor.nominal_origin - (sensor.mid_range - sag / 2) * u
    return np.asarray(middle + np.linspace(-half_width, half_width, count)[:, None] * np.cross(axis, towards))
