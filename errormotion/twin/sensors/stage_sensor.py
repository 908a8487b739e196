"""The point sensor on the stage of the machine, and its targets: a sine gauge on a turntable, and a check bar."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from errormotion.arrays import Array
from errormotion.twin import kernels
from errormotion.twin.artefacts.planes import CheckBar, SineGauge, Target, seeded_check_bar
from errormotion.twin.sensors.point_sensor import PointSensor, seeded_point_sensor

PIVOT, BAR_POSITION = (0.10, 0.05, 0.12), (-0.10, 0.05, 0.10)
"""A point on every face of the sine gauge, and a point on the axis of the check bar, m."""
NOISE, TEXTURE = 1, 2
"""Keys of the random streams of noise and speckle."""


class StageSensor:
    """A point sensor on the stage.

    Attributes
    ----------
    point_sensor : PointSensor
        A seeded individual. Its nominal beam is tilted by 20 deg from -Z towards +X.
    sine_gauge : SineGauge
        On a turntable.
    check_bar : CheckBar
        Along Y.
    """

    seed: int
    sensors_on_for: float
    point_sensor: PointSensor
    sine_gauge: SineGauge
    check_bar: CheckBar

    def _set_up_point_sensor(self, rng: np.random.Generator) -> None:
        """Mount the sensor, and position gauge and bar on the table."""
        self.point_sensor = seeded_point_sensor(rng)
        self.sine_gauge = SineGauge(self.seed, np.array(PIVOT))
        self.check_bar = seeded_check_bar(rng, np.array(BAR_POSITION))

    def home(self, sensor: PointSensor | None = None) -> Array:
        """Return the position of the stage, m, (3,), at which the gauge's pivot is at mid-range of the nominal beam."""
        sensor = sensor or self.point_sensor
        return np.asarray(self.sine_gauge.pivot - sensor.nominal_origin - sensor.mid_range * sensor.nominal_direction)

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
        """Return the readings of the point sensor, with all its deviations.

        Parameters
        ----------
        t : (n,)
            Times on the simulated clock, s.
        stage : (n, 3) or (3,)
            Positions of the stage, m.
        target : Plane or CheckBar
            The surface.
        sensor : PointSensor, optional
            By default ``point_sensor``.
        first : int
            Number of the first reading, on which the noise depends.
        key : tuple of int
            Selects the noise of the sensor and the texture of the target.
        beyond : bool
            Whether a reading outside of the range is minus or plus infinity instead of NaN.

        Returns
        -------
        ndarray, (n,)
            m; NaN outside of the range, and where the beam misses the target.
        """
        sensor = sensor or self.point_sensor
        times = np.atleast_1d(np.asarray(t, dtype=float))
        positions = np.atleast_2d(np.asarray(stage, dtype=float))
        still = sensor.still(target, positions, beyond=beyond) + sensor.speckles((self.seed, TEXTURE, *key), positions)
        noise = sensor.noise * kernels.normals(kernels.stream_key(self.seed, NOISE, *key), first, times.size)
        return np.asarray(still + sensor.warm_up_offset(self.sensors_on_for + times) + noise)
