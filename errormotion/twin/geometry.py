"""Geometric errors of the axes of any chain: smooth, seeded, and zero at the zero of the axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from operator import mul

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform

from errormotion.arrays import Array
from errormotion.kinematics.description import MachineDescription
from errormotion.kinematics.iso import DOF, ROTARY_AXES, direction_of, location_names
from errormotion.kinematics.machines import Machine
from errormotion.kinematics.twists import cross

WAVES = 4
"""Number of waves over the travel of a linear axis, or over a turn of a rotary one."""
_WAVE_NUMBERS = np.pi * np.arange(1, WAVES + 1)
STRAIGHTNESS = 3e-6
"""Displacement of the first wave on 1 m of travel (proportional to its root), or on a turn, m, 1 sigma."""
ANGLE = 8e-6
"""Rotation of the first wave, in the same way, rad, 1 sigma."""
SCALE = 6e-6
"""Linear part of the positioning error, m/m, 1 sigma."""
SQUARENESS = 15e-6
"""Squareness of a linear axis and tilt of the line of a rotary axis, rad, 1 sigma."""
LINE_OFFSET = 10e-6
"""Offset of the line of a rotary axis, m, 1 sigma."""


@dataclass(frozen=True)
class AxisErrors:
    """Six error motions of one axis as functions of its position, or those of several axes (see `stacked`).

    Attributes
    ----------
    travel : float
        Length of a linear axis, m; half a turn of a rotary axis, rad.
    sine, cosine : ndarray, (6, wave)
        Amplitudes of waves with 1, 2, ... half periods over the travel, m and rad.
    slope : ndarray, (6,)
        Linear part, m/m and rad/m.
    """

    travel: float | Array
    sine: Array
    cosine: Array
    slope: Array

    def __call__(self, position: ArrayLike) -> Array:
        """Return the error twists (..., 6), m and rad, at positions (...), m or rad."""
        q = np.asarray(position, dtype=float)[..., None, None]
        phase = _WAVE_NUMBERS * (q / self.travel)
        waves = self.sine * np.sin(phase) + self.cosine * (np.cos(phase) - 1)
        return np.asarray(waves.sum(axis=-1) + self.slope * q[..., 0])

    @classmethod
    def stacked(cls, axes: Sequence[AxisErrors]) -> AxisErrors:
        """Return the errors of several axes: twists (..., axis, 6) at positions (..., axis)."""
        travel = np.array([axis.travel for axis in axes])[:, None, None]
        sine, cosine, slope = (np.array([getattr(axis, of) for axis in axes]) for of in ("sine", "cosine", "slope"))
        return cls(travel, sine, cosine, slope)


@dataclass(frozen=True)
class GeometricErrors:
    """The geometric errors of a machine: 21 with three linear axes, ten more with each rotary axis.

    Attributes
    ----------
    description : MachineDescription
        The machine.
    machine : Machine
        Its kinematic model.
    motions : mapping
        Error motions by axis, stated at the machine's origin, or on the line of a rotary axis.
    locations : mapping
        Values of the errors of position (such as squareness) by name, rad or m.
    """

    description: MachineDescription
    machine: Machine
    motions: Mapping[str, AxisErrors]
    locations: Mapping[str, float]

    def twist(self, points: ArrayLike) -> Array:
        """Return the error twists of the tool relative to the workpiece.

        They are stated in the frame of the workpiece that coincides with the machine's frame when the moving axes are
        at zero and the fixed ones at their angle, for the point of the tool that is then at the origin.

        Parameters
        ----------
        points : array_like, (..., moving axis)
            Commands of the moving axes in the order of `MachineDescription.moving_axes`, m and rad. For a machine with
            rotary axes, X Y Z are sufficient: the others are then at zero.

        Returns
        -------
        ndarray, (..., 6)
            m and rad.
        """
        moving = np.asarray(points, dtype=float)
        count = len(self.description.moving_axes)
        if self.description.moving_axes[:3] == ("X", "Y", "Z") and moving.shape[-1:] == (3,):
            moving = np.concatenate([moving, np.zeros((*moving.shape[:-1], count - 3))], axis=-1)
        q = self.description.commands(moving)
        errors = self.machine.errors_at(q, self.motions, self.locations)
        table, head = self._fixed_poses
        twist = self.machine.volumetric_error(q, errors, head.inv().apply(np.zeros(3)))
        if not self.description.fixed:
            return twist
        parts = twist.reshape(-1, 3)  # rows alternate: displacement, rotation
        return np.asarray(table.rotation.inv().apply(parts)).reshape(twist.shape)

    @cached_property
    def _fixed_poses(self) -> tuple[RigidTransform, RigidTransform]:
        """Nominal poses of the bed in the workpiece, and of the tool in the bed, with the moving axes at zero."""
        at_zero = self.description.commands(np.zeros(len(self.description.moving_axes)))
        command = dict(zip(self.description.axes, at_zero, strict=True))
        table, head = (
            [joint.motion([command[joint.name]])[0] for joint in self.machine.joints if joint.carries_tool is side]
            for side in (False, True)
        )
        still = RigidTransform.identity()
        return reduce(mul, table, still), reduce(mul, head, still)

    def displacement(self, points: ArrayLike) -> Array:
        """Return EX, EY, EZ of `twist`, (..., 3), m; fifty times faster for the axes X, Y and Z."""
        if self.machine.axis_names != ("X", "Y", "Z"):
            return self.twist(points)[..., :3]
        order, motions, levers, tilts = self._linear_axes
        q = np.asarray(points, dtype=float)
        along = q[..., order]
        error = motions(along)
        parts = np.empty((*along.shape, 2, 3))
        np.add(error[..., :3], cross(error[..., 3:], levers * q[..., None, :]), out=parts[..., 0, :])
        np.multiply(tilts, along[..., None], out=parts[..., 1, :])
        return np.asarray(parts.reshape(*q.shape[:-1], 6, 3).sum(axis=-2))

    @cached_property
    def _linear_axes(self) -> tuple[list[int], AxisErrors, Array, Array]:
        """Of X, Y and Z in the order of the joints: index, error motions, levers, and displacements by squareness.

        A lever is 1 for each coordinate of the tool's position relative to the point of the error, else 0. The
        displacements by errors of orientation are those per metre of motion.
        """
        axes = self.machine.axis_names
        names = [joint.name for joint in self.machine.joints]
        directions = np.array([joint.direction for joint in self.machine.joints])
        moved = np.cumsum(directions, axis=0)
        follows = np.array([joint.error_follows_motion for joint in self.machine.joints])[:, None]
        orientations = [
            [self.locations.get(location_names(axis, axes).get(dof, ""), 0.0) for dof in DOF[3:]] for axis in names
        ]
        return (
            [axes.index(axis) for axis in names],
            AxisErrors.stacked([self.motions[axis] for axis in names]),
            1 - np.where(follows, moved, moved - directions),
            cross(np.array(orientations), directions),
        )


def seeded_errors(rng: np.random.Generator, description: MachineDescription) -> GeometricErrors:
    """Return the errors of a good machine: a few micrometres and seconds of arc."""
    machine = description.machine()
    motions = {}
    for axis in machine.axis_names:
        first, slope = np.array([STRAIGHTNESS] * 3 + [ANGLE] * 3), np.zeros(6)
        if axis in ROTARY_AXES:
            length = np.pi
        else:
            low, high = description.travel[axis]
            length = high - low
            first *= np.sqrt(length)
            slope[direction_of(axis)] = rng.normal(0, SCALE)
        size = first[:, None] / np.arange(1, WAVES + 1) ** 2
        motions[axis] = AxisErrors(length, rng.normal(0, size), rng.normal(0, size), slope)
    locations = {
        name: float(rng.normal(0, LINE_OFFSET if name[:2] in DOF[:3] else SQUARENESS))
        for name in machine.error_names[6 * len(motions) :]
    }
    return GeometricErrors(description, machine, motions, locations)
