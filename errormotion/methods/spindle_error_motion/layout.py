"""Geometry of a test: what each sensor sees of the motion of the spindle, and which freedoms all of them determine.

The spindle turns by the angle q about its axis k. With the error motion (E, W) of the artefact at a point of the axis,
tool side relative to workpiece side, a sensor with the direction n that looks at the point r from there reads

    m = g n . d + n . o f(a - q) - (n . o) (t . d)^2 / 2 R,    d = E + W x r,

with its gain g, the outward normal o at azimuth a, the form f of the artefact (outward, over its own azimuth), and the
second order of a displacement along the tangent t = k x o of a surface of radius R.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.kinematics.iso import DOF, ROTARY_AXES, direction_of

RADIAL, AXIAL = 0.1, 0.9
"""Largest component along the axis of a radial sensor, and the smallest one of an axial sensor."""
SAME_HEIGHT = 1e-4
"""Radial sensors within this distance along the axis look at one section of the artefact, m."""
_LEVER = 0.1
"""m; converts a rotation to a displacement where both are compared."""
_NULL = 1e-9


@dataclass(frozen=True, eq=False)
class Layout:
    """The sensors of one test.

    Attributes
    ----------
    axis : str
        A, B or C.
    direction, position : ndarray, (sensor, 3)
        Unit vectors; the points that the sensors look at, from ``origin``, m.
    origin : ndarray, (3,)
        The functional point on the axis, m: the stated one, or that at the height of all radial sensors.
    radius : float
        Of the artefact, m.
    """

    axis: str
    direction: Array
    position: Array
    origin: Array
    radius: float

    @classmethod
    def of(cls, raw: xr.Dataset) -> Layout:
        """Return the layout of raw data.

        Raises
        ------
        MethodError
            The axis is not stated, or a direction or position is not usable.
        """
        axis = str(raw.attrs.get("axis", ""))
        if axis not in ROTARY_AXES:
            raise MethodError(
                f"Attribute 'axis' of the raw data: expected A, B or C; found '{axis}'.", code="raw.axis.unknown"
            )
        direction, position, origin = (
            raw[name].transpose(..., "direction").values.astype(float)
            for name in ("sensor_direction", "sensor_position", "axis_point")
        )
        length = np.linalg.norm(direction, axis=1)
        if np.abs(length - 1).max() > 1e-3:
            raise MethodError(
                "sensor_direction: expected unit vectors; found one of length "
                f"{length[np.argmax(np.abs(length - 1))]:.4g}",
                code="sensor.direction.form",
            )
        layout = cls(axis, direction / length[:, None], position - origin, origin, float(raw["artefact_radius"]))
        if not layout.radius > 0:
            raise MethodError(
                f"artefact_radius: expected a radius above 0; found {layout.radius:g}", code="raw.value.not_positive"
            )
        layout._check()
        if layout.radial.any() and layout.sections.max() == 0:
            shift = layout.position[layout.radial][:, layout.along].mean() * np.eye(3)[layout.along]
            return cls(axis, layout.direction, layout.position - shift, origin + shift, layout.radius)
        return layout

    def _check(self) -> None:
        """Refuse sensors that are neither radial nor axial, and radial ones that do not face the artefact."""
        for k, n in enumerate(self.direction):
            across = self.position[k] * (np.arange(3) != self.along)
            part = abs(n[self.along])
            if RADIAL < part < AXIAL:
                raise MethodError(
                    f"sensor_direction: expected sensors across or along axis {self.axis}; found sensor {k + 1} at "
                    f"{np.degrees(np.arccos(part)):.3g} deg to it",
                    code="sensor.direction.skew",
                )
            distance = float(np.linalg.norm(across))
            if part <= RADIAL and not abs(n @ across) > 0.9 * distance > 0:
                raise MethodError(
                    f"sensor_position: expected the point of the surface that sensor {k + 1} looks at, from the axis "
                    "along its direction; found one beside that line. State axis_point and the side of the sensor.",
                    code="sensor.position.form",
                )

    @property
    def along(self) -> int:
        """Coordinate of the axis: 0 X, 1 Y, 2 Z."""
        return direction_of(self.axis)

    @property
    def plane(self) -> tuple[int, int]:
        """Coordinates across the axis; angles count from the first towards the second."""
        return (self.along + 1) % 3, (self.along + 2) % 3

    @cached_property
    def radial(self) -> NDArray[np.bool_]:
        """Which sensors look across the axis, (sensor,)."""
        return np.asarray(np.abs(self.direction[:, self.along]) <= RADIAL)

    @cached_property
    def outward(self) -> Array:
        """Outward unit vectors at the radial sensors, (sensor, 3); 0 for the others."""
        across = self.position * (np.arange(3) != self.along) * self.radial[:, None]
        return np.asarray(across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12))

    @property
    def side(self) -> Array:
        """+1 where a larger radius increases the reading, -1 where it decreases it, 0 without, (sensor,)."""
        return np.asarray(np.sum(self.outward * self.direction, axis=1))

    @property
    def tangent(self) -> Array:
        """Unit vectors along the surface in the sense of positive rotation, (sensor, 3); 0 for an axial sensor."""
        return np.asarray(np.cross(np.eye(3)[self.along], self.outward))

    @cached_property
    def azimuth(self) -> Array:
        """Angles of the radial sensors from the first coordinate across the axis, (sensor,), rad."""
        first, second = self.plane
        return np.arctan2(self.outward[:, second], self.outward[:, first])

    @cached_property
    def sections(self) -> NDArray[np.intp]:
        """Number of the section of the artefact that each radial sensor looks at, (sensor,); -1 for an axial one."""
        section, heights = np.full(len(self.direction), -1), list[float]()
        for k in np.flatnonzero(self.radial):
            z = float(self.position[k, self.along])
            near = [j for j, other in enumerate(heights) if abs(z - other) <= SAME_HEIGHT]
            section[k] = near[0] if near else len(heights)
            heights += [] if near else [z]
        return section

    @cached_property
    def design(self) -> Array:
        """Derivatives of the readings by the six freedoms, (sensor, 6)."""
        return np.concatenate([self.direction, np.cross(self.position, self.direction)], axis=1)

    @cached_property
    def determined(self) -> NDArray[np.bool_]:
        """Which freedoms the sensors determine, (6,): those that are no part of a motion which no sensor sees.

        Raises
        ------
        MethodError
            None is, or one is mixed with others.
        """
        rows = self.design / np.array([1.0, 1.0, 1.0, *[_LEVER] * 3])
        rows[:, 3 + self.along] = 0.0  # a rotation about the axis is the angle of the spindle
        rows[np.abs(rows) < 1e-6] = 0.0
        power, vectors = np.linalg.eigh(rows.T @ rows)
        null = np.square(vectors) @ (power <= _NULL * max(float(power[-1]), _NULL))
        seen, mixed = null < 1e-6, (null >= 1e-6) & (null <= 1 - 1e-6)
        if mixed.any() or not seen.any():
            names = ", ".join(name for name, its in zip(DOF, mixed, strict=True) if its)
            raise MethodError(
                f"The sensors show {names or 'no freedom'} mixed with one another. Use sensors along the directions "
                "across and along the axis, each pair at one height, or only those of one height.",
                code="spindle.freedoms.mixed",
            )
        return np.asarray(seen)

    @cached_property
    def solver(self) -> Array:
        """Freedoms by readings, (6, sensor): least squares with equal weights; 0 for those that are not determined."""
        solver = np.zeros((6, len(self.direction)))
        solver[self.determined] = np.linalg.pinv(self.design[:, self.determined])
        return solver

    def eccentric(self, angle: Array) -> Array:
        """Return error motions that an eccentric and tilted artefact imitates, (g, place, 6).

        A vector of one size that turns with the spindle, of E and of W, cannot be told from the artefact's position in
        it. Where one direction across the axis is measured only, nothing that occurs once a turn can.
        """
        first, second = self.plane
        cos, sin, columns = np.cos(angle), np.sin(angle), []
        for i, j in ((first, second), (first + 3, second + 3)):
            one = self.determined[[i, j]]
            for along, across in ((cos, sin), (-sin, cos)):  # a vector that turns with the spindle
                motion = np.zeros((angle.size, 6))
                motion[:, i], motion[:, j] = (along, across) if one.all() else (along * one[0], along * one[1])
                if one.any():
                    columns.append(motion)
        return np.array(columns).reshape(-1, angle.size, 6)
