"""Measurements with the point sensor on the stage: planes of the sine gauge, the check bar, an interferometer.

All without any wire: for Monte Carlo, so cheap, with nothing drawn but the noise and how the gauge is set.
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
from errormotion.twin import kernels, truth
from errormotion.twin.planes import CheckBar, SineGauge, Target, seeded_check_bar
from errormotion.twin.point_sensor import PointSensor, seeded_point_sensor

SCHEMA = "errormotion.raw.beam_direction/1"
INCLINATION_SCHEMA = "errormotion.raw.inclination/1"

#: where the faces of the sine gauge, and where the axis of the check bar, m
PIVOT, BAR_PLACE = (0.10, 0.05, 0.12), (-0.10, 0.05, 0.10)
#: faces of the sine gauge where none are named: inclination and rotation, rad
PLANES = tuple((np.radians(20.0), np.radians(rotation)) for rotation in (0.0, 90.0, 180.0))
#: a calibration as it is usually made: about 5000 groups; rad, rad, m
ALPHAS = np.radians(np.arange(-45.0, 46.0, 5.0))
BETAS = np.radians([*range(0, 11, 2), 90, *range(170, 181, 2)])
DEPTHS = 1e-3 * np.arange(-10.0, 11.0)
#: share of the range that a stroke uses
_USED_RANGE = 0.8
#: s from reading to reading, and for setting the gauge anew
READING_TIME, SETTING_TIME = 1.0, 60.0
#: of the interferometer, m (one sigma)
REFERENCE_NOISE = 20e-9

_NOISE, _TEXTURE, _BAR = 1, 2, 3
_M, _1, _RAD = {"units": "m"}, {"units": "1"}, {"units": "rad"}


@dataclass(frozen=True)
class _Looking:
    """How readings are made: by which sensor, and with what in them."""

    sensor: PointSensor
    seed: int
    inclination_error: bool
    speckle: bool
    sensors_on_for: float

    def read(self, target: Target, stage: Array, begin: float, part: int) -> Array:
        """Return one reading at each stage place (n, 3), m, from ``begin`` (s) on."""
        sensor = self.sensor
        since_on = self.sensors_on_for + begin + READING_TIME * np.arange(len(stage))
        reading = sensor.still(target, stage, inclination_error=self.inclination_error)
        reading = reading + sensor.warm_up_offset(since_on)
        if self.speckle:
            reading = reading + sensor.speckles((self.seed, _TEXTURE, part), stage)
        return reading + sensor.noise * kernels.normals(kernels.stream_key(self.seed, _NOISE, part), 0, len(stage))


class BeamMeasurements:
    """What a machine with a point sensor on its stage can measure.

    Attributes
    ----------
    point_sensor : PointSensor
        A seeded individual. Its nominal beam leans by 20 deg from -Z towards +X.
    sine_gauge : SineGauge
        On a turntable.
    check_bar : CheckBar
        Along Y.
    """

    name: str
    kind: str
    seed: int
    sensors_on_for: float
    point_sensor: PointSensor
    sine_gauge: SineGauge
    check_bar: CheckBar

    def _origin(self) -> truth.Origin:
        raise NotImplementedError

    def _set_up_point_sensor(self, rng: np.random.Generator) -> None:
        """Mount the sensor, and lay gauge and bar on the table."""
        self.point_sensor = seeded_point_sensor(rng)
        self.sine_gauge = SineGauge(self.seed, np.array(PIVOT))
        self.check_bar = seeded_check_bar(rng, np.array(BAR_PLACE))

    def truth_beam(self, sensor: PointSensor | None = None, beam: str = "beam") -> xr.Dataset:
        """Return what the sensor's beam is, minus what it is meant to be, as an error dataset over ``beam``.

        Shift of the zero point, and smallest rotation from the nominal to the true direction; with ``beam_origin``,
        ``beam_direction``, ``nominal_origin``, ``nominal_direction`` (beam, direction).
        """
        sensor = sensor or self.point_sensor
        vectors = {
            "nominal_origin": (sensor.nominal_origin, _M),
            "nominal_direction": (sensor.nominal_direction, _1),
            "beam_origin": (sensor.true_origin, _M),
            "beam_direction": (sensor.true_direction, _1),
        }
        p0, u0, p, u = (value[None] for value, _ in vectors.values())
        twist, _ = beam_errors(p0, u0, p, u, np.zeros((1, 6, 6)))
        what = "beam", sensor.nominal_origin, "nominal beam", self._origin()
        ds = truth.dataset(twist, "beam", {"beam": [beam]}, *what)
        extras = {name: (("beam", "direction"), value[None], unit) for name, (value, unit) in vectors.items()}
        return ds.assign(extras).assign_coords(direction=list("xyz"))

    def home(self, sensor: PointSensor | None = None) -> Array:
        """Return the place of the stage, m, (3,), at which the nominal beam has the gauge's pivot at mid-range."""
        sensor = sensor or self.point_sensor
        return np.asarray(self.sine_gauge.pivot - sensor.nominal_origin - sensor.mid_range * sensor.nominal_direction)

    def strokes(
        self,
        inclination: float,
        rotation: float,
        *,
        sensor: PointSensor | None = None,
        count: int = 20,
        half_length: float = 20e-3,
    ) -> Array:
        """Return places of the stage on three strokes along X, Y and Z about `home`, m, shape (3 count, 3).

        Each is as long as four fifths of the sensor's range allow at a face of the sine gauge, but no longer than
        twice ``half_length``.
        """
        sensor = sensor or self.point_sensor
        normal = self.sine_gauge.nominal_normal(inclination, rotation)
        facing = -float(normal @ sensor.nominal_direction)
        depth = _USED_RANGE * (sensor.range[1] - sensor.range[0]) / 2
        change = np.abs(normal) / max(facing, 1e-3)  # of the reading with the stage
        half = np.minimum(half_length, depth / np.maximum(change, 1e-6))
        steps = np.linspace(-1.0, 1.0, count)
        return np.asarray(self.home(sensor) + np.concatenate([np.outer(steps, line) for line in np.diag(half)]))

    def point_readings(
        self,
        t: ArrayLike,
        stage: ArrayLike,
        target: Target,
        *,
        sensor: PointSensor | None = None,
        first: int = 0,
        key: tuple[int, ...] = (),
        beyond: bool = False,
    ) -> Array:
        """Return what the point sensor reads, with all that is wrong with it.

        Parameters
        ----------
        t : (n,)
            Times of the world's clock, s.
        stage : (n, 3) or (3,)
            Where the stage is then, m.
        target : Plane or CheckBar
            What it looks at.
        sensor : PointSensor, optional
            ``point_sensor`` where not given.
        first : int
            Number of the first reading: the same number, the same noise.
        key : tuple of int
            Another sensor, another noise; another target, another texture.
        beyond : bool
            Whether out of range reads as minus or plus infinity, and not as NaN.

        Returns
        -------
        ndarray, (n,)
            m; NaN out of range, and where the beam misses.
        """
        sensor = sensor or self.point_sensor
        times = np.atleast_1d(np.asarray(t, dtype=float))
        places = np.atleast_2d(np.asarray(stage, dtype=float))
        still = sensor.still(target, places, beyond=beyond) + sensor.speckles((self.seed, _TEXTURE, *key), places)
        noise = sensor.noise * kernels.normals(kernels.stream_key(self.seed, _NOISE, *key), first, times.size)
        return np.asarray(still + sensor.warm_up_offset(self.sensors_on_for + times) + noise)

    def raw_beam_direction(
        self,
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
        """Return a raw dataset of a beam calibration on planes.

        Parameters
        ----------
        planes : sequence of (inclination, rotation)
            Of the sine gauge, rad.
        stage : (n, 3) or (plane, n, 3), optional
            Places of the stage, m; `strokes` where not given.
        seed : int
            Of the noise, and of how the gauge is set; the machine stays the same. The true faces are
            ``sine_gauge.plane(inclination, rotation, seed)``.
        inclination_error, speckle : bool
            Whether the readings hold the error by the surface's tilt, and speckle; the dataset states the latter.
        check_bar : bool
            Whether the check bar is measured as well, see `raw_check_bar`.
        sensor : PointSensor, optional
            ``point_sensor`` where not given.
        count, half_length
            See `strokes`.

        Returns
        -------
        Dataset
            NaN where there is no reading.
        """
        sensor = sensor or self.point_sensor
        if stage is None:
            each = [self.strokes(*plane, sensor=sensor, count=count, half_length=half_length) for plane in planes]
            places = np.array(each)
        else:
            given = np.asarray(stage, dtype=float)
            if given.ndim not in (2, 3) or given.shape[-1] != 3 or (given.ndim == 3 and len(given) != len(planes)):
                raise BenchError(
                    f"The stage's places are (reading, 3) or (plane, reading, 3) for {len(planes)} planes; found "
                    f"{given.shape}."
                )
            places = np.broadcast_to(given, (len(planes), *given.shape[-2:])).copy()
        looking = _Looking(sensor, seed, inclination_error, speckle, self.sensors_on_for)
        duration = SETTING_TIME + READING_TIME * places.shape[1]
        faces = [self.sine_gauge.face(*plane, setting=seed) for plane in planes]
        readings = [looking.read(face, places[i], i * duration, i) for i, face in enumerate(faces)]
        normals = [self.sine_gauge.nominal_normal(*plane) for plane in planes]
        ds = self._stated(sensor, speckle).assign(
            distance=(("plane", "reading"), np.array(readings), _M),
            stage=(("plane", "reading", "direction"), places, _M),
            nominal_normal=(("plane", "direction"), np.array(normals), _1),
            plane_point=(("plane", "direction"), np.tile(self.sine_gauge.pivot, (len(planes), 1)), _M),
            plane_point_uncertainty=((), self.sine_gauge.point_uncertainty, _M),
        )
        if not check_bar:
            return ds
        bar = self.raw_check_bar(
            seed=seed, inclination_error=inclination_error, speckle=speckle, sensor=sensor, begin=len(planes) * duration
        )
        return ds.assign({name: bar[name] for name in ("bar_distance", "bar_stage", "bar_radius", "bar_axis")})

    def raw_check_bar(
        self,
        *,
        seed: int,
        inclination_error: bool = True,
        speckle: bool = False,
        sensor: PointSensor | None = None,
        bar: CheckBar | None = None,
        count: int = 20,
        half_width: float = 17e-3,
        begin: float = 0.0,
    ) -> xr.Dataset:
        """Return readings across the check bar: ``bar_distance``, ``bar_stage``, ``bar_radius``, ``bar_axis``.

        The stage moves across the bar and across the nominal beam, so that the readings lie about mid-range.

        Parameters
        ----------
        seed : int
            Of the noise alone.
        inclination_error, speckle, sensor
            See `raw_beam_direction`.
        bar : CheckBar, optional
            ``check_bar`` where not given.
        count : int
            Readings.
        half_width : float
            How far the outer ones are off the middle, m.
        begin : float
            Time of the first one, s.
        """
        sensor, bar = sensor or self.point_sensor, bar or self.check_bar
        looking = _Looking(sensor, seed, inclination_error, speckle, self.sensors_on_for)
        places = bar_stage(sensor, bar, count, half_width)
        return self._stated(sensor, speckle).assign(
            bar_distance=("bar_reading", looking.read(bar, places, begin, -_BAR), _M),
            bar_stage=(("bar_reading", "direction"), places, _M),
            bar_radius=((), bar.certified_radius, _M),
            bar_axis=("direction", bar.nominal_axis, _1),
        )

    def raw_inclination(
        self,
        alphas: ArrayLike = ALPHAS,
        betas: ArrayLike = BETAS,
        depths: ArrayLike = DEPTHS,
        *,
        seed: int,
        speckle: bool = False,
        sensor: PointSensor | None = None,
    ) -> xr.Dataset:
        """Return readings against an interferometer, for every inclination, rotation and depth.

        Parameters
        ----------
        alphas, betas : (k,), (m,)
            Inclinations (negative: the tilt turned by half a turn) and rotations, rad.
        depths : (n,)
            From mid-range, m.
        seed : int
            Of the noise alone.
        speckle : bool
            Whether each reading has a speckle of its own.
        sensor : PointSensor, optional
            ``point_sensor`` where not given.

        Returns
        -------
        Dataset
            Over ``group``; NaN where the sensor sees nothing.
        """
        sensor = sensor or self.point_sensor
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
            "reading_noise": ((), float(np.hypot(noise, REFERENCE_NOISE)), _M),
            "mid_range": ((), sensor.mid_range, _M),
        }
        return xr.Dataset(variables, attrs={"schema": INCLINATION_SCHEMA, **self._labels()})

    def _stated(self, sensor: PointSensor, speckle: bool) -> xr.Dataset:
        """Return what a raw dataset says about the sensor."""
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
        return xr.Dataset(variables, {"direction": list("xyz")}, {"schema": SCHEMA, **self._labels()})

    def _labels(self) -> dict[str, str]:
        address = f"twin://{self.kind}?seed={self.seed}"
        note = [{"id": "virtual point sensor", "address": address, "simulated": True}]
        return {"machine": self.name, "instruments": json.dumps(note)}


def bar_stage(sensor: PointSensor, bar: CheckBar, count: int, half_width: float) -> Array:
    """Return places of the stage on a stroke over a bar, across it and across the nominal beam, m, shape (count, 3)."""
    if not 0 < half_width < bar.certified_radius:
        raise BenchError(
            f"A stroke over a bar keeps within its radius of {bar.certified_radius * 1e3:g} mm; found "
            f"{half_width * 1e3:g} mm."
        )
    u, axis = sensor.nominal_direction, bar.nominal_axis
    towards = u - (u @ axis) * axis
    if not np.linalg.norm(towards) > 0.1:
        raise BenchError("The beam looks along the bar; expected a beam across it.")
    towards = towards / np.linalg.norm(towards)
    sag = bar.certified_radius - np.sqrt(bar.certified_radius**2 - half_width**2)
    nearest = bar.point - bar.certified_radius * towards
    middle = nearest - sensor.nominal_origin - (sensor.mid_range - sag / 2) * u
    return np.asarray(middle + np.linspace(-half_width, half_width, count)[:, None] * np.cross(axis, towards))
