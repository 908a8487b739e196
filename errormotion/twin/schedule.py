"""Commands to the machine: spindle speeds, compensation, and the steps of a sphere."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from errormotion.arrays import Array
from errormotion.errors import BenchError

#: Time in which the control switches a compensation off or on, s.
SLEW = 0.5


@dataclass(frozen=True)
class Event:
    """A command at a time.

    Attributes
    ----------
    time : float
        Seconds after the start.
    spindle_speed : float, optional
        New spindle speed, 1/min; None: unchanged.
    compensation : mapping of str to bool, optional
        Thermal compensation of the axes X, Y, Z on or off; other axes are unchanged.
    """

    time: float
    spindle_speed: float | None = None
    compensation: Mapping[str, bool] | None = None


@dataclass(frozen=True)
class StepProgram:
    """A sphere in the spindle, moved along a line with a rest at each position.

    At the time ``begin`` the sphere leaves ``home`` and reaches ``start`` after ``approach`` seconds. It rests for
    ``dwell`` seconds at each of ``count`` positions, moves for ``travel`` seconds between two, and returns home in
    ``approach`` seconds.

    Attributes
    ----------
    start : (3,) array_like
        Commanded centre of the sphere at the first position, m, in machine coordinates.
    direction : (3,) array_like
        Direction of the steps; normalised here.
    step : float
        Distance of two positions, m.
    count : int
        Number of positions.
    dwell, travel, approach : float
        Times, s.
    begin : float
        Time of the machine at the start of the program, s.
    home : (3,) array_like, optional
        Position of the sphere before and after; by default the middle of the line.
    """

    start: Any
    direction: Any
    step: float
    count: int
    dwell: float = 1.0
    travel: float = 0.1
    begin: float = 0.0
    approach: float = 0.5
    home: Any = None
    places: Array = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        start, direction = _vector(self.start, "start"), _vector(self.direction, "direction")
        length = float(np.linalg.norm(direction))
        if length == 0:
            raise BenchError("expected a direction of the steps; found (0, 0, 0)", code="virtual.steps.direction")
        if self.count < 1 or self.dwell <= 0 or self.travel <= 0 or self.approach <= 0:
            raise BenchError(
                "expected at least one position and positive dwell, travel and approach times; found "
                f"count = {self.count}, dwell = {self.dwell} s, travel = {self.travel} s, approach = {self.approach} s",
                code="virtual.steps.form",
            )
        line = start + np.arange(self.count)[:, None] * self.step * (direction / length)
        home = (line[0] + line[-1]) / 2 if self.home is None else _vector(self.home, "home")
        object.__setattr__(self, "places", np.vstack([home, line, home]))

    @property
    def arrivals(self) -> Array:
        """Start of the rest at each of ``places``, s, shape (count + 2,); the first is -inf."""
        steps = self.begin + self.approach + np.arange(self.count) * (self.dwell + self.travel)
        return np.concatenate([[-np.inf], steps, [self.end]])

    @property
    def departures(self) -> Array:
        """End of the rest at each of ``places``, s, shape (count + 2,); the last is inf."""
        return np.concatenate([[self.begin], self.arrivals[1:-1] + self.dwell, [np.inf]])

    @property
    def end(self) -> float:
        """Time at which the sphere has returned home, s."""
        return self.begin + 2 * self.approach + self.count * self.dwell + (self.count - 1) * self.travel

    @property
    def duration(self) -> float:
        """Time from ``begin`` to ``end``, s."""
        return self.end - self.begin


@dataclass(frozen=True)
class Schedule:
    """Events in order, and the resulting speed and angle of the spindle and compensation.

    Attributes
    ----------
    events : sequence of Event
    spin_up : float
        Acceleration of the spindle, revolutions / s^2.
    top_speed : float
        Highest spindle speed, 1/min.
    """

    events: tuple[Event, ...]
    spin_up: float
    top_speed: float
    #: times, s, and values (1/min) of commanded speeds; the first is (0, 0) or an event at 0
    speed_times: Array = field(init=False, repr=False)
    speeds: Array = field(init=False, repr=False)
    #: times of the spindle's phases, and (revolutions, 1/s, 1/s^2 / 2) at their start
    phase_times: Array = field(init=False, repr=False)
    phases: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._check()
        changes = {0.0: 0.0} | {
            float(e.time): float(e.spindle_speed) for e in self.events if e.spindle_speed is not None
        }
        object.__setattr__(self, "speed_times", np.array(list(changes)))
        object.__setattr__(self, "speeds", np.array(list(changes.values())))
        self._spin()

    def _check(self) -> None:
        times = [event.time for event in self.events]
        if any(time < 0 or not np.isfinite(time) for time in times) or sorted(times) != times:
            raise BenchError(
                f"expected events at finite times from 0 on, in order; found {times} s", code="virtual.events.times"
            )
        for event in self.events:
            speed = event.spindle_speed
            if speed is not None and not 0 <= speed <= self.top_speed:
                raise BenchError(
                    f"The spindle turns at 0 to {self.top_speed:g} /min; found {speed:g} /min",
                    code="virtual.spindle.too_fast",
                )
            unknown = set(event.compensation or {}) - {"X", "Y", "Z"}
            if unknown:
                raise BenchError(
                    f"expected compensation of the axes X, Y and Z; found {', '.join(sorted(unknown))}",
                    code="virtual.compensation.axes",
                )

    def _spin(self) -> None:
        """Compute the phases: constant acceleration up to each commanded speed, then constant speed."""
        times, phases = [0.0], [(0.0, 0.0, 0.0)]
        for time, speed in zip(self.speed_times, self.speeds / 60, strict=True):
            while times[-1] > time:  # a change of speed during an acceleration
                del times[-1], phases[-1]
            revolutions, rate = self._after(times[-1], phases[-1], time)
            if times[-1] == time:
                del times[-1], phases[-1]
            acceleration = np.copysign(self.spin_up, speed - rate)
            ramp = (speed - rate) / acceleration
            if ramp > 0:
                times.append(float(time))
                phases.append((revolutions, rate, acceleration / 2))
                revolutions += ramp * (rate + speed) / 2
            times.append(float(time + ramp))
            phases.append((revolutions, float(speed), 0.0))
        object.__setattr__(self, "phase_times", np.array(times))
        object.__setattr__(self, "phases", np.array(phases))

    @staticmethod
    def _after(begin: float, phase: tuple[float, float, float], time: float) -> tuple[float, float]:
        revolutions, rate, half = phase
        dt = time - begin
        return revolutions + dt * (rate + dt * half), rate + 2 * dt * half

    def turning(self, t: ArrayLike) -> Array:
        """Return (revolutions, 1/s, half the acceleration) at times t, shape (n, 3)."""
        revolutions, rate, half, dt = self._phase(t)
        return np.stack([revolutions + dt * (rate + dt * half), rate + 2 * dt * half, half], axis=-1)

    def _phase(self, t: ArrayLike) -> tuple[Array, Array, Array, Array]:
        """Return (revolutions, 1/s, half the acceleration) at the start of the phase at times t, and the time since."""
        t = np.asarray(t, dtype=float)
        at = np.maximum(self.phase_times.searchsorted(t, side="right") - 1, 0)
        revolutions, rate, half = self.phases[at].T
        return revolutions, rate, half, np.asarray(t - self.phase_times[at])

    def speed(self, t: ArrayLike) -> Array:
        """Return the spindle's true speed at times t, 1/min, shape (n,)."""
        _, rate, half, dt = self._phase(t)
        return np.asarray((rate + 2 * dt * half) * 60)

    def compensation(self, t: ArrayLike) -> Array:
        """Return the effective share of the compensation of X, Y, Z at times t, 0 to 1, shape (n, 3)."""
        t = np.asarray(t, dtype=float)
        share = np.ones((*t.shape, 3))
        for axis, time, change in self._switches:
            share[..., axis] += change * np.clip((t - time) / SLEW, 0, 1)
        return share

    @cached_property
    def _switches(self) -> list[tuple[int, float, float]]:
        """Axis, time and change of the share of each change of the compensation."""
        state, switches = {"X": 1.0, "Y": 1.0, "Z": 1.0}, []
        for event in self.events:
            for name, target in (event.compensation or {}).items():
                if float(target) != state[name]:
                    switches.append(("XYZ".index(name), event.time, float(target) - state[name]))
                    state[name] = float(target)
        return switches

    @property
    def cuts(self) -> Array:
        """Times of all changes of slope, with five pieces of each change of the compensation, s, sorted."""
        slews = [event.time + np.linspace(0, SLEW, 6) for event in self.events if event.compensation]
        return np.unique(np.concatenate([self.phase_times, self.speed_times, *slews]))


def _vector(value: Any, name: str) -> Array:
    vector = np.asarray(value, dtype=float)
    if vector.shape != (3,) or not np.all(np.isfinite(vector)):
        raise BenchError(
            f"expected '{name}' as three finite numbers (x, y, z) in m; found {value!r}", code="virtual.point.form"
        )
    return vector
