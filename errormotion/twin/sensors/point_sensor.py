"""A point laser sensor on the machine's stage: its nominal and true beam, and its readings."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from errormotion.arrays import Array
from errormotion.kinematics.beams import tilt, turned
from errormotion.twin.artefacts.planes import Target
from errormotion.twin.sensors.triangulation import Optics, key_of, speckle

#: Nominal position of the zero point with the stage at 0, m.
NOMINAL_ORIGIN = (0.05, 0.0, -0.08)
#: Nominal angle of the beam to -Z, rad.
NOMINAL_TILT = np.radians(20.0)
#: Side of the receiver for an observer who looks along the beam and has the triangulation normal upwards.
RECEIVER = "right"
#: Deviation of the beam: zero point in each direction, m; direction, rad; rotation about itself, rad (one sigma).
ORIGIN_DEVIATION, DIRECTION_DEVIATION, ROLL_DEVIATION = 0.1e-3, np.radians(0.3), np.radians(0.5)


@dataclass(frozen=True)
class PointSensor:
    """A beam from a zero point along a direction; a reading d means a surface point at origin + stage + d direction.

    Depth is the true distance from the zero point.

    Attributes
    ----------
    nominal_origin, nominal_direction, nominal_triangulation_normal : ndarray, (3,)
        Nominal: point where the reading is 0 with the stage at 0, m; unit vector from the sensor to the target;
        unit normal of the plane of emitted and received beam, with the receiver to the `RECEIVER` of the laser.
    true_origin, true_direction, triangulation_normal : ndarray, (3,)
        The true ones.
    range : (low, high)
        Measuring range in depth, m.
    optics : Optics
        Effect of the tilt of the surface.
    noise : float
        White noise of one reading, m (one sigma).
    speckle, speckle_length : float
        Effect of the surface texture on a reading, m (one sigma), and its correlation length on the surface, m.
    warm_up, warm_up_time : float
        Rise of the reading after switching on, m, and its time constant, s.
    """

    nominal_origin: Array
    nominal_direction: Array
    nominal_triangulation_normal: Array
    true_origin: Array
    true_direction: Array
    triangulation_normal: Array
    range: tuple[float, float] = (-10e-3, 10e-3)
    optics: Optics = field(default_factory=Optics)
    noise: float = 0.1e-6
    speckle: float = 0.3e-6
    speckle_length: float = 50e-6
    warm_up: float = 10.5e-6
    warm_up_time: float = 1440.0

    @property
    def mid_range(self) -> float:
        """Depth at which the tilt of the surface has no effect, m."""
        return (self.range[0] + self.range[1]) / 2

    def from_start(self, measuring_range: float) -> PointSensor:
        """Return the beam as that of a sensor with another range, whose readings are relative to its start, m."""
        shift = self.mid_range - measuring_range / 2
        return replace(
            self,
            nominal_origin=self.nominal_origin + shift * self.nominal_direction,
            true_origin=self.true_origin + shift * self.true_direction,
            range=(0.0, measuring_range),
        )

    def slope(self, q: ArrayLike) -> Array:
        """Return the error of the reading per depth from mid-range at tilt vectors (..., 2), 1; NaN without light."""
        return self.optics.slope(q)

    def still(self, target: Target, stage: Array, *, inclination_error: bool = True, beyond: bool = False) -> Array:
        """Return the readings of the warm sensor without noise and speckle.

        Parameters
        ----------
        target : Plane or CheckBar
            The surface.
        stage : ndarray, (n, 3)
            Positions of the stage, m.
        inclination_error : bool
            Whether the tilt of the surface has an effect.
        beyond : bool
            Whether the reading of a surface before or after the range is minus or plus infinity instead of NaN.

        Returns
        -------
        ndarray, (n,)
            m; NaN outside of the range, where the beam misses the target, and without received light.
        """
        depth, normals = target.meet(self.true_origin + stage, self.true_direction)
        slope = self.slope(tilt(self.true_direction, self.triangulation_normal, normals))
        reading = depth + (depth - self.mid_range) * (slope if inclination_error else 0.0 * slope)
        low, high = self.range
        with np.errstate(invalid="ignore"):
            reading = np.where(depth < low, -np.inf, np.where(depth > high, np.inf, reading))
        reading = np.where(np.isnan(slope), np.nan, reading)
        return reading if beyond else np.where(np.isinf(reading), np.nan, reading)

    def speckles(self, key: tuple[int, ...], stage: Array) -> Array:
        """Return the effect of a target's texture on the readings at stage positions (n, 3), m, shape (n,).

        Parameters
        ----------
        key : tuple of int
            Key of the texture, different for each target.
        stage : ndarray, (n, 3)
            Positions of the sensor relative to the target, m.
        """
        return self.speckle * speckle(key_of(*key), stage, self.speckle_length)

    def warm_up_offset(self, since_on: ArrayLike) -> Array:
        """Return the readings minus their settled values, m (not positive)."""
        return np.asarray(-self.warm_up * np.exp(-np.asarray(since_on, dtype=float) / self.warm_up_time))


def seeded_point_sensor(rng: np.random.Generator, lean: float = NOMINAL_TILT, azimuth: float = 0.0) -> PointSensor:
    """Return a sensor whose beam deviates from nominal by about 0.1 mm and 0.3 deg.

    Parameters
    ----------
    rng : Generator
        Selects the individual.
    lean : float
        Angle of the nominal beam to -Z, rad.
    azimuth : float
        Direction of this angle, rad; 0 = towards +X.
    """
    towards = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    nominal = np.sin(lean) * towards - np.cos(lean) * np.array([0.0, 0.0, 1.0])
    plane = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    origin = np.array(NOMINAL_ORIGIN)
    direction = turned(nominal, DIRECTION_DEVIATION * _limited(rng, 2))
    rolled = plane - (plane @ direction) * direction
    rolled /= np.linalg.norm(rolled)
    rolled = rolled + ROLL_DEVIATION * float(_limited(rng, 1)[0]) * np.cross(direction, rolled)
    optics = Optics(
        roughness=float(rng.uniform(0.5, 0.6)),
        glossy=float(rng.uniform(0.3, 0.4)),
        defocus=float(rng.uniform(0.33, 0.39)),
        scale=float(rng.uniform(-1e-4, 1e-4)),
    )
    return PointSensor(
        nominal_origin=origin,
        nominal_direction=nominal,
        nominal_triangulation_normal=plane,
        true_origin=origin + ORIGIN_DEVIATION * _limited(rng, 3),
        true_direction=direction,
        triangulation_normal=rolled / np.linalg.norm(rolled),
        optics=optics,
        warm_up=10.5e-6 * float(rng.uniform(0.95, 1.05)),
    )


def _limited(rng: np.random.Generator, n: int) -> Array:
    """Return standard normal numbers limited to -2 .. 2."""
    return np.clip(rng.normal(size=n), -2.0, 2.0)
