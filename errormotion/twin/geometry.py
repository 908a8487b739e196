"""Geometric errors of the axes: smooth, seeded, zero at the axis's zero."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from errormotion.arrays import Array
from errormotion.kinematics.iso import DOF, location_names
from errormotion.kinematics.machines import Machine

#: waves over the travel, and how large the first one is on a metre of travel (it grows with the root): m, rad
WAVES = 4
STRAIGHTNESS = 3e-6
ANGLE = 8e-6
#: linear growth of the positioning error, and squareness, rad (one sigma)
SCALE = 6e-6
SQUARENESS = 15e-6


@dataclass(frozen=True)
class AxisErrors:
    """Six error motions of one axis as functions of its position.

    Attributes
    ----------
    travel : float
        Length of the axis, m.
    sine, cosine : ndarray, (6, wave)
        Amplitudes of waves with 1, 2, ... half periods over the travel, m and rad.
    slope : ndarray, (6,)
        Linear part, m/m and rad/m.
    """

    travel: float
    sine: Array
    cosine: Array
    slope: Array

    def __call__(self, position: ArrayLike) -> Array:
        """Return the error twists (..., 6), m and rad, at positions (...), m."""
        q = np.asarray(position, dtype=float)[..., None, None]
        phase = np.pi * np.arange(1, WAVES + 1) * (q / self.travel)
        waves = self.sine * np.sin(phase) + self.cosine * (np.cos(phase) - 1)
        return np.asarray(np.sum(waves, axis=-1) + self.slope * q[..., 0])


@dataclass(frozen=True)
class GeometricErrors:
    """The 21 geometric errors of a machine with three linear axes.

    Attributes
    ----------
    machine : Machine
        The chain of bodies.
    motions : mapping
        Axis to its error motions, stated at the machine's origin.
    locations : mapping
        Name of a squareness to its value, rad.
    """

    machine: Machine
    motions: Mapping[str, AxisErrors]
    locations: Mapping[str, float]

    def twist(self, points: ArrayLike) -> Array:
        """Return the error twists of the tool at commanded points (..., 3), m; shape (..., 6), m and rad."""
        errors = self.machine.errors_at(points, self.motions, self.locations)
        return self.machine.volumetric_error(points, errors)

    def displacement(self, points: ArrayLike) -> Array:
        """Return EX, EY, EZ of `twist`, (..., 3), m, in a fiftieth of the time: for who asks point by point."""
        q = np.asarray(points, dtype=float)
        total, before = np.zeros(q.shape), np.zeros(q.shape)
        for joint in self.machine.joints:
            way = q[..., self.machine.axis_names.index(joint.name), None] * joint.direction
            error = self.motions[joint.name](np.sum(way, axis=-1))
            at = before + way if joint.error_follows_motion else before
            total += error[..., :3] + np.cross(error[..., 3:], q - at)
            total += np.cross(self._places[joint.name], way)
            before = before + way
        return total

    @cached_property
    def _places(self) -> Mapping[str, Array]:
        """Rotational errors of place of each axis, (3,), rad."""
        axes = self.machine.axis_names
        named = {axis: location_names(axis, axes) for axis in axes}
        return {
            axis: np.array([self.locations.get(names.get(dof, ""), 0.0) for dof in DOF[3:]])
            for axis, names in named.items()
        }


def seeded_errors(rng: np.random.Generator, chain: str, travel: Mapping[str, tuple[float, float]]) -> GeometricErrors:
    """Return the errors of a good machine with this chain: some micrometres and seconds of arc."""
    machine = Machine(chain)
    motions = {}
    for axis, (low, high) in travel.items():
        length = high - low
        first = np.sqrt(length) * np.array([STRAIGHTNESS] * 3 + [ANGLE] * 3)
        size = first[:, None] / np.arange(1, WAVES + 1) ** 2
        slope = np.zeros(6)
        slope["XYZ".index(axis)] = rng.normal(0, SCALE)
        motions[axis] = AxisErrors(length, rng.normal(0, size), rng.normal(0, size), slope)
    places = machine.error_names[6 * len(motions) :]
    return GeometricErrors(machine, motions, {name: float(rng.normal(0, SQUARENESS)) for name in places})
