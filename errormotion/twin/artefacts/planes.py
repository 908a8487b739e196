"""Targets of a point sensor: a plane of a sine gauge on a turntable, and a check bar."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import BenchError
from errormotion.kinematics.beams import turned
from errormotion.twin import kernels

#: Radius and length of the check bar in its certificate, m, and deviation of the true radius, m (one sigma).
BAR_RADIUS, BAR_LENGTH, BAR_RADIUS_ERROR = 25e-3, 0.2, 0.3e-6
#: Deviation of the bar from the machine's axis, rad (one sigma, each direction).
BAR_MISALIGNMENT = 0.2e-3


@dataclass(frozen=True)
class Plane:
    """A face of a gauge.

    Attributes
    ----------
    normal : ndarray, (3,)
        Unit vector out of the material.
    point : ndarray, (3,)
        m.
    radius : float
        Radius of the face about the point, m.
    """

    normal: Array
    point: Array
    radius: float = np.inf

    def meet(self, origins: Array, direction: Array) -> tuple[Array, Array]:
        """Return the lengths of beams from origins (n, 3), m, (n,), NaN for a miss, and the normals there (n, 3)."""
        facing = float(self.normal @ direction)
        if facing >= 0:
            return np.full(len(origins), np.nan), np.broadcast_to(self.normal, origins.shape)
        depth = (self.point - origins) @ self.normal / facing
        off = np.linalg.norm(origins + depth[:, None] * direction - self.point, axis=1)
        return np.where(off <= self.radius, depth, np.nan), np.broadcast_to(self.normal, origins.shape)


@dataclass(frozen=True)
class CheckBar:
    """A cylinder on the table.

    Attributes
    ----------
    point : ndarray, (3,)
        Middle of the axis, m.
    axis : ndarray, (3,)
        Unit vector.
    nominal_axis : ndarray, (3,)
        Nominal direction.
    radius, certified_radius : float
        True radius, and that in the certificate, m.
    length : float
        m.
    """

    point: Array
    axis: Array
    nominal_axis: Array
    radius: float
    certified_radius: float = BAR_RADIUS
    length: float = BAR_LENGTH

    def meet(self, origins: Array, direction: Array) -> tuple[Array, Array]:
        """Return the lengths of beams from origins (n, 3), m, (n,), NaN for a miss, and the normals there (n, 3)."""
        start = origins - self.point
        w = start - (start @ self.axis)[:, None] * self.axis
        v = direction - (direction @ self.axis) * self.axis
        a, b, c = v @ v, w @ v, np.sum(w * w, axis=1) - self.radius**2
        with np.errstate(invalid="ignore", divide="ignore"):
            depth = -(b + np.sqrt(b * b - a * c)) / a
            along = (start + depth[:, None] * direction) @ self.axis
            normals = (w + depth[:, None] * v) / self.radius
        return np.where(np.abs(along) <= self.length / 2, depth, np.nan), normals


Target = Plane | CheckBar


@dataclass(frozen=True)
class SineGauge:
    """A sine gauge on a turntable about Z: its face contains nearly the same point at all inclinations and rotations.

    Attributes
    ----------
    seed : int
        Seed of the deviations of each setting.
    pivot : ndarray, (3,)
        This point, m.
    point_uncertainty : float
        Deviation of the face along its normal, independent at every setting, m (one sigma).
    angle_uncertainty : float
        Deviation of its normal in each direction, independent at every setting, rad (one sigma).
    radius : float
        Radius of the face about the pivot, m.
    steepest : float
        Largest inclination, rad.
    """

    seed: int
    pivot: Array
    point_uncertainty: float = 1e-6
    angle_uncertainty: float = np.radians(5 / 3600)
    radius: float = 0.08
    steepest: float = np.radians(60.0)

    def nominal_normal(self, inclination: float, rotation: float) -> Array:
        """Return the nominal normal, (3,), of a setting.

        Parameters
        ----------
        inclination : float
            Of the face to the table, rad.
        rotation : float
            Of the turntable, rad; at 0 the face inclines towards +X, and its normal towards +X.

        Raises
        ------
        BenchError
            The inclination is larger than that of the gauge.
        """
        if not 0 <= inclination <= self.steepest:
            raise BenchError(
                f"expected an inclination from 0 to {np.degrees(self.steepest):g} deg; found "
                f"{np.degrees(inclination):g} deg",
                code="virtual.plane.inclination",
            )
        flat = np.sin(inclination)
        return np.array([flat * np.cos(rotation), flat * np.sin(rotation), np.cos(inclination)])

    def plane(self, inclination: float, rotation: float, setting: int = 0) -> tuple[Array, Array]:
        """Return the true normal (3,) and a true point (3,), m, of the face of a setting.

        Parameters
        ----------
        inclination, rotation : float
            Commanded, rad, see `nominal_normal`.
        setting : int
            Number of the setting, which selects its deviations.
        """
        normal = self.nominal_normal(inclination, rotation)
        bits = np.array([inclination, rotation], dtype=np.float64).view(np.int64)
        errors = kernels.normals(kernels.stream_key(self.seed, setting, *(int(b) for b in bits)), 0, 3)
        true = turned(normal, self.angle_uncertainty * errors[:2])
        return true, self.pivot + self.point_uncertainty * errors[2] * true

    def face(self, inclination: float, rotation: float, setting: int = 0) -> Plane:
        """Return the face of a setting, see `plane`, as a target."""
        return Plane(*self.plane(inclination, rotation, setting), self.radius)


def seeded_check_bar(rng: np.random.Generator, point: Array) -> CheckBar:
    """Return a bar approximately along Y."""
    nominal = np.array([0.0, 1.0, 0.0])
    axis = turned(nominal, BAR_MISALIGNMENT * rng.normal(size=2))
    return CheckBar(point, axis, nominal, BAR_RADIUS + BAR_RADIUS_ERROR * float(rng.normal()))
