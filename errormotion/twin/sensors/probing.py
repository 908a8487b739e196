"""Balls on the table, probed by the machine: positions at which the probe trips, and the true errors.

The tip of the probe has the position of the end of the bar. Where the control displays p, the tip is at p + e(p, t):

    e(p, t) = E(t) + R(t) x M (p - f) + g(p)

E is the thermal displacement of the spindle with the tip at f, R the part of its rotation that rotates the frame of the
axes, M selects the axes that carry the tool (the others carry the table, which does not rotate), and g is the geometric
error.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.kinematics.twists import cross
from errormotion.twin import kernels, truth
from errormotion.twin.artefacts.balls import Balls, Probe, seeded_balls, seeded_probe
from errormotion.twin.geometry import GeometricErrors
from errormotion.twin.thermal.state import ThermalState

ErrorAt = Callable[[Array], Array]

#: Default number of balls on the table.
BALLS = 4
#: Noise of a temperature sensor, K (one sigma).
TEMPERATURE_NOISE = 0.02
#: Distance of the tip from a ball at which the probe is released, m.
RELEASE = 3e-6
#: Distance from which on a path passes a ball without a trip: far above all errors of the machine, m.
PASSING = 10e-3

_TRIGGER, _THERMOMETER = 60, 61
_SETTLED = 1e-15  # m
_NO_SHIFT = np.zeros(3)


class ProbeMeasurements:
    """A touch probe in the spindle, and balls on the table.

    Attributes
    ----------
    balls : Balls
        The four balls on the table; `balls_on_table` for more.
    probe : Probe
        In the spindle.
    """

    name: str
    kind: str
    seed: int
    chain: str
    travel: Mapping[str, tuple[float, float]]
    state: ThermalState
    geometry: GeometricErrors
    balls: Balls
    probe: Probe

    @property
    def spindle_functional_point(self) -> Array:
        """Intersection of the cold axis of rotation with the end of the bar, m, shape (3,)."""
        raise NotImplementedError

    @property
    def temperature_sensors(self) -> tuple[str, ...]:
        """Names of the temperature sensors."""
        raise NotImplementedError

    def temperatures(self, t: ArrayLike) -> Array:
        """Return the true temperatures at times t, degC, shape (n, sensor)."""
        raise NotImplementedError

    def spindle_speed(self, t: ArrayLike) -> Array:
        """Return the speed of the spindle at times t, 1/min, shape (n,)."""
        raise NotImplementedError

    def _origin(self) -> truth.Origin:
        raise NotImplementedError

    def _set_up_probing(self, rng: np.random.Generator) -> None:
        self._all_balls = seeded_balls(rng, self.travel)
        self.balls = self._all_balls.first(BALLS)
        self.probe = seeded_probe(rng)

    # ------------------------------------------------------------------ truth

    @property
    def tool_axes(self) -> str:
        """Axes that carry the tool, such as ``"XYZ"`` or ``"Z"``; the others carry the table."""
        carrying = {joint.name for joint in self.geometry.machine.joints if joint.carries_tool}
        return "".join(axis for axis in "XYZ" if axis in carrying)

    @property
    def probing_functional_point(self) -> Array:
        """Commanded position of the tip at which it is at the end of the bar, m, shape (3,)."""
        return self.spindle_functional_point

    def balls_on_table(self, count: int = BALLS) -> Balls:
        """Return the first ``count`` balls, 1 to 8."""
        return self._all_balls.first(count)

    def probe_error(self, p: ArrayLike, t: ArrayLike) -> Array:
        """Return the true position of the tip minus the displayed one, m, shape (n, 3).

        Parameters
        ----------
        p : (n, 3) or (3,)
            Commanded positions of the tip, m.
        t : (n,) or scalar
            s.
        """
        times = np.atleast_1d(np.asarray(t, dtype=float))
        return self._error_at(times)(np.atleast_2d(np.asarray(p, dtype=float)))

    def truth_probing(self, t: ArrayLike, functional_point: ArrayLike | None = None) -> xr.Dataset:
        """Return the thermal error that probing can determine, as an error dataset over ``time``, without uncertainty.

        EX, EY, EZ are the displacement of the tip at ``functional_point``; EA, EB, EC the rotation of the frame of the
        axes. A tilt of the spindle relative to the last axis displaces all balls equally and affects the displacement
        only. On a machine whose table moves, the errors at two functional points are not related by a rigid motion:
        call this method for each point.

        Parameters
        ----------
        t : (n,)
            Times, s, increasing.
        functional_point : (3,), optional
            Commanded position of the tip, m; by default ``probing_functional_point``.
        """
        times = np.atleast_1d(np.asarray(t, dtype=float))
        point = self.probing_functional_point if functional_point is None else np.asarray(functional_point, dtype=float)
        twist, turn = self.state.twist_and_turn(times)
        displacement = twist[:, :3] + cross(turn, self._lever(point))
        coords = {
            "time": ("time", times, {"units": "s"}),
            "sensor": list(self.temperature_sensors),
            "temperature": (("time", "sensor"), self.temperatures(times), {"units": "degC"}),
            "spindle_speed": ("time", self.spindle_speed(times), {"units": "1/min"}),
        }
        where = "time", coords, "tool", point, "cold state at time 0", self._origin()
        return truth.dataset(np.hstack([displacement, turn]), *where)

    def thermal_twist(self, p: ArrayLike, t: ArrayLike) -> Array:
        """Return the thermal error of the tool at commanded positions p and times t, m and rad, shape (n, 6).

        It is the displacement of the end of the bar and the rotation of the spindle, relative to the cold state.

        Parameters
        ----------
        p : (n, 3) or (3,)
            m.
        t : (n,) or scalar
            s.
        """
        twist, turn = self.state.twist_and_turn(np.atleast_1d(np.asarray(t, dtype=float)))
        lever = self._lever(np.atleast_2d(np.asarray(p, dtype=float)))
        displacement = twist[:, :3] + cross(turn, lever)
        return np.hstack([displacement, np.broadcast_to(twist[:, 3:], displacement.shape)])

    @cached_property
    def _carried(self) -> Array:
        """The diagonal of M, (3,)."""
        return np.array([axis in self.tool_axes for axis in "XYZ"], dtype=float)

    def _lever(self, position: Array) -> Array:
        """Return M (p - f), the lever that rotates with the frame of the axes, m."""
        return np.asarray(self._carried * (position - self.probing_functional_point))

    def _error_at(self, times: Array) -> ErrorAt:
        """Return the error of the tip at given times as a function of its commanded positions (n, 3)."""
        twist, turn = self.state.twist_and_turn(times)

        def error(p: Array) -> Array:
            return np.asarray(twist[:, :3] + cross(turn, self._lever(p)) + self.geometry.displacement(p))

        return error

    # ------------------------------------------------------------------ contacts

    def probe_gap(self, p: ArrayLike, t: ArrayLike, *, balls: Balls | None = None) -> Array:
        """Return the distance of the tip to a trip on the nearest ball, m, shape (n,); 0 or less if it has tripped.

        The scatter of the trigger is not included.

        Parameters
        ----------
        p : (n, 3) or (3,)
            Commanded positions of the tip, m.
        t : (n,) or scalar
            s.
        balls : Balls, optional
            By default those of the attribute.
        """
        balls = self.balls if balls is None else balls
        tip = np.atleast_2d(np.asarray(p, dtype=float)) + self.probe_error(p, t)
        offset = (tip[:, None] - balls.centre).reshape(-1, 3)
        distance = np.sqrt((offset**2).sum(axis=1))
        normal = offset / np.maximum(distance, _SETTLED)[:, None]
        gaps = distance - self._contact_distance(balls, np.tile(np.arange(len(balls)), len(tip)), normal)
        return np.asarray(gaps.reshape(len(tip), -1).min(axis=1))

    def released(self, p: ArrayLike, t: float, *, balls: Balls | None = None) -> bool:
        """Return whether a tripped probe is released with the tip at a commanded position p (3,), m."""
        balls_there = self.balls if balls is None else balls
        offset = balls_there.centre - np.asarray(p, dtype=float)
        if (np.sqrt((offset**2).sum(axis=1)) > balls_there.radius + self.probe.tip_radius + PASSING).all():
            return True
        return bool(self.probe_gap(p, t, balls=balls)[0] > RELEASE)

    def contact(
        self,
        start: ArrayLike,
        target: ArrayLike,
        t: float,
        feed: float | None = None,
        *,
        balls: Balls | None = None,
        noise: bool = True,
        leaving: bool = False,
    ) -> tuple[Array | None, float]:
        """Return the position at which the probe trips on the straight path from ``start`` to ``target``.

        Parameters
        ----------
        start, target : (3,)
            Commanded positions of the tip, m.
        t : float
            Time at the start, s.
        feed : float, optional
            m/s; by default the path takes no time.
        balls : Balls, optional
            By default those of the attribute.
        noise : bool
            Whether the trigger scatters; its scatter depends on the path and the time.
        leaving : bool
            Whether the probe may be in contact at the start with a ball from which it moves away.

        Returns
        -------
        position : ndarray (3,) or None
            Commanded position of the tip when the probe trips, m; the start if it has tripped there; None without
            contact.
        distance : float
            Path length from the start to this position, or to the target, m.
        """
        balls = self.balls if balls is None else balls
        first, last = np.asarray(start, dtype=float), np.asarray(target, dtype=float)
        length = float(np.linalg.norm(last - first))
        if not leaving and self.probe_gap(first, t, balls=balls)[0] <= 0:
            return first.copy(), 0.0
        if length == 0:
            return None, 0.0
        heading = (last - first) / length
        ball = self._near_path(balls, first, heading, length)
        count = ball.size
        if count == 0:
            return None, length
        direction = np.tile(heading, (count, 1))
        scatter = np.full(count, self.probe.noise * self._trigger(first, last, t) if noise else 0.0)
        times = np.full(count, float(t))
        path = np.full(count, np.nan)
        for _ in range(3):  # with a feed, the time of the contact depends on its position
            path = self._path_to_trip(first, direction, ball, balls, self._error_at(times), scatter)
            if not feed or not np.isfinite(path).any():
                break
            times = t + np.where(np.isfinite(path), path, 0.0) / feed
        path = path[path <= length]
        if path.size == 0:
            return None, length
        return first + path.min() * direction[0], float(path.min())

    def trip_positions(
        self,
        ball: NDArray[np.intp],
        start: Array,
        direction: Array,
        t: Array,
        balls: Balls,
        scatter: Array,
        shift: Array,
    ) -> Array:
        """Return the positions at which the probe trips on given balls, each on a straight path that takes no time.

        Parameters
        ----------
        ball : ndarray, (n,)
            Number of the ball of each touch.
        start, direction : ndarray, (n, 3)
            Commanded start of the tip, m, and unit direction of its motion.
        t : ndarray, (n,)
            s.
        balls : Balls
        scatter : ndarray, (n,)
            Scatter of the trigger along the normal, m.
        shift : ndarray, (n, 3)
            Displacement of the ball from its position on the table, m.

        Returns
        -------
        ndarray, (n, 3)
            Commanded positions of the tip, m; NaN where the path misses the ball.
        """
        distance = self._path_to_trip(start, direction, ball, balls, self._error_at(t), scatter, shift)
        return np.asarray(start + distance[:, None] * direction)

    def _near_path(self, balls: Balls, start: Array, heading: Array, length: float) -> NDArray[np.intp]:
        """Return the numbers of the balls on which the probe can trip on a path."""
        offset = balls.centre - start
        ahead = (offset * heading).sum(axis=1)
        aside = np.sqrt(((offset - ahead[:, None] * heading) ** 2).sum(axis=1))
        contact_distance = balls.radius + self.probe.tip_radius + PASSING
        return np.flatnonzero((aside <= contact_distance) & (ahead >= -PASSING) & (ahead - contact_distance <= length))

    def _contact_distance(self, balls: Balls, ball: NDArray[np.intp], normal: Array) -> Array:
        """Return the distance of the tip's centre from that of a ball when the probe trips, m."""
        return np.asarray(balls.height(ball, normal) + self.probe.tip_radius - self.probe.pretravel(normal))

    def _path_to_trip(
        self,
        start: Array,
        direction: Array,
        ball: NDArray[np.intp],
        balls: Balls,
        error: ErrorAt,
        scatter: Array,
        shift: Array = _NO_SHIFT,
    ) -> Array:
        """Return the path length of the tip along unit directions (n, 3) to the trip on a ball each (n,), m; NaN: none.

        It does not trip on a ball from which it moves away, and trips immediately where it touches and approaches one.
        The error of the tip and its distance from a ball at contact vary by at most 1e-4 of the path: a few iterations
        converge.
        """
        centre = balls.centre[ball] + shift
        path = np.einsum("ni,ni->n", centre - start, direction)
        normal = -direction
        for _ in range(60):
            offset = start + error(start + np.where(np.isfinite(path), path, 0.0)[:, None] * direction) - centre
            along = np.einsum("ni,ni->n", offset, direction)
            contact_distance = self._contact_distance(balls, ball, normal) + scatter
            inside = along**2 - np.einsum("ni,ni->n", offset, offset) + contact_distance**2
            found = np.where((inside >= 0) & (along < 0), -along - np.sqrt(np.maximum(inside, 0.0)), np.nan)
            change = np.abs(found - path)
            path = found
            if not (change > _SETTLED).any():
                break
            normal = offset + np.where(np.isfinite(path), path, -along)[:, None] * direction
            normal /= np.sqrt((normal**2).sum(axis=1, keepdims=True))
        return np.asarray(np.maximum(path, 0.0))

    def _trigger(self, start: Array, target: Array, t: float) -> float:
        """Return a standard normal number that depends on a path and a time."""
        bits = np.array([*start, *target, t], dtype=float).view(np.int64)
        return float(kernels.normal(kernels.stream_key(self.seed, _TRIGGER, *bits), 0))

    # ------------------------------------------------------------------ temperatures

    def sensor_temperatures(self, t: ArrayLike, *, seed: int = 0, noise: float = TEMPERATURE_NOISE) -> Array:
        """Return the readings of all temperature sensors at times t, degC, shape (n, sensor).

        The noise of a reading depends on its sensor and time only.
        """
        times = np.atleast_1d(np.asarray(t, dtype=float))
        readings = self.temperatures(times)
        for sensor in range(readings.shape[1]):
            key = kernels.stream_key(self.seed, _THERMOMETER, seed, sensor)
            for i, bits in enumerate(times.view(np.int64)):
                readings[i, sensor] += noise * kernels.normal(key, bits)
        return readings
