"""Geometry of an R-test: where the spheres are at each angle, what the sensors see of them, and what this determines.

The table carries the workpiece. A positive command moves the tool in the positive direction relative to the workpiece
(ISO 841), so that the table turns by ``-q`` in the machine's frame, ``R(q) = rotation by -q``. With its error motion
``(E, W)`` at a point of the axis, tool side relative to workpiece side, and its own offset ``o`` on the table, a sphere
at ``p`` from this point is displaced relative to the nest by

    d(q) = R(q) o - E(q) - W(q) x R(q) p.

A rigid displacement ``(t, w)`` of all spheres with the table has the same effect as the error motion
``(-R t, -R w)``: readings determine the error motion but for once-per-revolution terms of this form.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.kinematics.chains import parse_chain
from errormotion.kinematics.iso import DOF, ROTARY_AXES, direction_of, location_names
from errormotion.methods.r_test.schema import READINGS, SCHEMA
from errormotion.methods.r_test.settings import RTestSettings

ON_AXIS = 0.1e-3
"""Distance from the axis up to which a rotation has no effect, m: 100 urad displace such a sphere by 10 nm."""
FEWEST_ANGLES = 4
_LEVER = 0.1
"""m; converts a rotation to a displacement where both are compared."""
_NULL = 1e-6
"""Largest part of an undetermined motion in a determined freedom (square of the ratio)."""
LOCATION = np.array([20e-6, -15e-6, 10e-6, 40e-6, -30e-6, 20e-6])
"""Typical displacement and rotation of the line of an axis, m and rad."""
MOTION = np.array([2e-6, 2e-6, 1e-6, 8e-6, 8e-6, 15e-6])
"""Typical amplitude of error motions with two periods a revolution, m and rad."""
OFFSET = 40e-6
"""Typical offset of a sphere on the table, m."""


@dataclass(frozen=True, eq=False)
class Layout:
    """One test as arrays.

    Attributes
    ----------
    axis : str
        A, B or C.
    angle : ndarray, (n,)
        Commanded, rad, increasing.
    place : ndarray, (sphere, 3)
        Nominal centres at angle 0, from ``origin``, m.
    origin : ndarray, (3,)
        The functional point on the axis, m: the stated one, or that at the height of a single sphere.
    sensor : ndarray, (sensor, 3)
        Unit vectors.
    reading : ndarray, (n, sphere, sensor)
        m; NaN = none.
    """

    axis: str
    angle: Array
    place: Array
    origin: Array
    sensor: Array
    reading: Array

    @classmethod
    def of(cls, raw: xr.Dataset) -> Layout:
        """Return the layout of raw data.

        Raises
        ------
        MethodError
            The axis is not stated or does not carry the workpiece, or angles or directions are not usable.
        """
        axis = str(raw.attrs.get("axis", ""))
        if axis not in ROTARY_AXES:
            raise MethodError(
                f"Attribute 'axis' of the raw data: expected A, B or C; found '{axis}'.", code="raw.axis.unknown"
            )
        if (chain := str(raw.attrs.get("chain", ""))) and parse_chain(chain).get(axis, True):
            raise MethodError(
                f"Axis {axis} of the chain {chain} does not carry the workpiece; expected the axis of a table.",
                code="rotary.axis.no_workpiece",
            )
        angle = raw["angle"].values.astype(float)
        if angle.size < FEWEST_ANGLES or not (np.diff(angle) > 0).all():
            raise MethodError(
                f"angle: expected at least {FEWEST_ANGLES} angles that increase; found {angle.size}. Sort the readings "
                "by the angle, and identify each direction of rotation separately.",
                code="rotary.angles.form",
            )
        vectors = {
            name: raw[name].transpose(..., "direction").values.astype(float)
            for name in ("sphere_position", "sensor_direction", "axis_point")
        }
        sensor, origin = vectors["sensor_direction"], vectors["axis_point"]
        length = np.linalg.norm(sensor, axis=1)
        if np.abs(length - 1).max() > 1e-3:
            raise MethodError(
                f"sensor_direction: expected unit vectors; found one of length "
                f"{length[np.argmax(abs(length - 1))]:.4g}",
                code="sensor.direction.form",
            )
        place = vectors["sphere_position"] - origin
        if len(place) == 1:
            height = place[0] * np.eye(3)[direction_of(axis)]
            place, origin = place - height, origin + height
        reading = raw["displacement"].transpose(*READINGS).values.astype(float)
        return cls(axis, angle, place, origin, sensor / length[:, None], reading)

    @cached_property
    def along(self) -> int:
        """Coordinate of the axis: 0 X, 1 Y, 2 Z."""
        return direction_of(self.axis)

    @cached_property
    def turn(self) -> Array:
        """``R(q)``, (n, 3, 3)."""
        return Rotation.from_rotvec(-self.angle[:, None] * np.eye(3)[self.along]).as_matrix()

    def degrees(self, at: int) -> str:
        """Return an angle as text."""
        return f"{np.degrees(self.angle[at]):.6g} deg"

    def name_of(self, index: NDArray[np.intp]) -> str:
        """Return what a reading is, by its number."""
        angle, sphere, sensor = np.unravel_index(index[0], self.reading.shape)
        return f"the reading of sensor {sensor + 1} of sphere {sphere + 1} at {self.degrees(int(angle))}"

    def displacement(self, motion: Array, offset: Array) -> Array:
        """Return the displacements (n, sphere, 3) for error motions (n, 6) and offsets of the spheres (sphere, 3)."""
        lever = np.einsum("aij,sj->asi", self.turn, self.place)
        turned = np.einsum("aij,sj->asi", self.turn, offset)
        return np.asarray(turned - motion[:, None, :3] - np.cross(motion[:, None, 3:], lever))

    def offset(self) -> Array:
        """Return the offsets of the spheres across the axis, (sphere, 3), by a circle through the readings of each."""
        n, count, sensors = self.reading.shape
        design = np.concatenate([np.einsum("kj,aji->aki", self.sensor, self.turn),
                                 np.broadcast_to(self.sensor, (n, sensors, 3))], axis=2)  # fmt: skip
        offset = np.zeros((count, 3))
        for sphere in range(count):
            there = np.isfinite(self.reading[:, sphere])
            offset[sphere] = np.linalg.lstsq(design[there], self.reading[:, sphere][there], rcond=None)[0][:3]
        offset[:, self.along] = 0.0
        return offset

    @cached_property
    def determined(self) -> NDArray[np.bool_]:
        """Which of the freedoms `seen` each angle determines, (n, 6); none where another one has an effect as well."""
        return self._by_angle & ~(self._by_angle & ~self.seen).any(axis=1, keepdims=True)

    @cached_property
    def _by_angle(self) -> NDArray[np.bool_]:
        """Which freedoms the readings at each angle determine, (n, 6); none if one of them is mixed with others.

        From the motions that no reading at this angle sees: a freedom is determined if it is no part of them, and
        undetermined if it is one of them.
        """
        place = self.place.copy()
        across = np.arange(3) != self.along
        place[np.linalg.norm(place[:, across], axis=1) <= ON_AXIS] *= ~across
        lever = np.einsum("aij,sj->asi", self.turn, place)
        # u . (E + W x r) = u . E + (r x u) . W
        moment = np.cross(lever[:, :, None], self.sensor) / _LEVER
        rows = np.concatenate([np.broadcast_to(self.sensor, moment.shape), moment], axis=3)
        rows = np.where(np.isfinite(self.reading)[..., None], rows, 0.0).reshape(len(self.angle), -1, 6)
        power, vectors = np.linalg.eigh(np.swapaxes(rows, 1, 2) @ rows)
        null = np.square(vectors) @ (power <= _NULL * np.maximum(power[:, -1:], _NULL))[..., None]
        seen, mixed = null[..., 0] < _NULL, (null[..., 0] >= _NULL) & (null[..., 0] <= 1 - _NULL)
        return np.asarray(seen & ~mixed.any(axis=1, keepdims=True))

    @cached_property
    def seen(self) -> NDArray[np.bool_]:
        """Which freedoms are determined at most angles, (6,).

        Raises
        ------
        MethodError
            None is.
        """
        patterns, count = np.unique(self._by_angle, axis=0, return_counts=True)
        pattern = patterns[np.argmax(count)]
        if not pattern.any():
            raise MethodError(
                f"No freedom of axis {self.axis} follows from the readings: one sphere off the axis shows EX, EY and "
                "EZ mixed with the rotations times its distance, two spheres show no rotation about the line through "
                "them, and fewer than three sensors, or sensors in one plane, no displacement across them. Measure "
                "three spheres that are not on a line with three or more sensors; or one sphere within "
                f"{1e3 * ON_AXIS:g} mm of the axis, which shows EX, EY and EZ.",
                code="rotary.freedoms.none",
            )
        return np.asarray(pattern)

    @cached_property
    def gauge(self) -> tuple[Array, Array]:
        """Rigid displacements of all spheres with the table, and the error motions that they imitate.

        Returns
        -------
        offset : ndarray, (g, sphere, 3)
        motion : ndarray, (g, n, 6)
        """
        unit = np.eye(3)
        kept = [k for k in range(6) if self._rigid(k).any() and self.seen[np.abs(self._rigid(k)).max(axis=0) > 0].all()]
        offset = [np.tile(unit[k], (len(self.place), 1)) if k < 3 else np.cross(unit[k - 3], self.place) for k in kept]
        return np.array(offset), np.array([self._rigid(k) for k in kept])

    def _rigid(self, k: int) -> Array:
        """Return the error motion (n, 6) that a displacement (k < 3) or rotation of the table imitates."""
        column = np.where(np.abs(self.turn[:, :, k % 3]) > 1e-15, self.turn[:, :, k % 3], 0.0)
        none = np.zeros_like(column)
        return np.concatenate([column, none] if k < 3 else [none, column], axis=1)

    @property
    def locations(self) -> dict[str, int]:
        """Freedom of each location error by its name, such as EX0C: 0."""
        return {name: DOF.index(dof) for dof, name in location_names(self.axis).items()}


def expected(settings: RTestSettings) -> xr.Dataset:
    """Return the readings without noise of a test with errors of typical size."""
    k = direction_of(settings.axis)
    angle = np.arange(settings.angles) * 2 * np.pi / settings.angles
    circle = np.arange(settings.spheres) * 2 * np.pi / settings.spheres
    place = np.zeros((settings.spheres, 3))
    if settings.spheres > 1:
        place[:, (k + 1) % 3] = settings.radius * np.cos(circle)
        place[:, (k + 2) % 3] = settings.radius * np.sin(circle)
    place[:, k] = settings.height
    about = Rotation.from_rotvec(np.arange(3)[:, None] * 2 * np.pi / 3 * np.array([0.0, 0.0, 1.0]))
    sensor = about.apply([np.sin(settings.inclination), 0.0, np.cos(settings.inclination)])
    layout = Layout(settings.axis, angle, place, np.zeros(3), sensor, np.zeros((angle.size, settings.spheres, 3)))
    phase = np.arange(6)
    motion = MOTION * np.cos(2 * angle[:, None] + phase) + MOTION / 4 * np.cos(7 * angle[:, None] + 2 * phase)
    offset = OFFSET * np.cos(2.0 + np.arange(place.size)).reshape(place.shape)
    d = layout.displacement(motion - LOCATION, offset)
    m = {"units": "m"}
    return xr.Dataset(
        {
            "displacement": (("angle", "sphere", "sensor"), np.einsum("asi,ki->ask", d, sensor), m),
            "sphere_position": (("sphere", "direction"), place, m),
            "sensor_direction": (("sensor", "direction"), sensor, {"units": "1"}),
            "axis_point": (("direction",), np.zeros(3), m),
            "displacement_noise": ((), settings.noise, m),
            "sensor_direction_uncertainty": ((), settings.direction_uncertainty, {"units": "rad"}),
            "gain_uncertainty": ((), settings.gain_uncertainty, {"units": "1"}),
            "position_uncertainty": ((), settings.position_uncertainty, m),
            "nest_uncertainty": ((), settings.nest_uncertainty, m),
        },
        {"angle": ("angle", angle, {"units": "rad"}), "direction": list("xyz")},
        {"schema": SCHEMA, "axis": settings.axis, "machine": "expected"},
    )
