"""The virtual machine: one seeded individual, its true errors, and the readings of its sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.errors import BenchError
from errormotion.kinematics.description import MachineDescription
from errormotion.kinematics.iso import ROTARY_AXES
from errormotion.kinematics.twists import move
from errormotion.twin import truth
from errormotion.twin.artefacts import bar as bars
from errormotion.twin.crossbeam import Crossbeam, seeded_crossbeam
from errormotion.twin.geometry import GeometricErrors, seeded_errors
from errormotion.twin.kinds import machine_kind
from errormotion.twin.schedule import Event, Schedule, StepProgram
from errormotion.twin.sensors import frame as frames
from errormotion.twin.sensors.probing import ProbeMeasurements
from errormotion.twin.sensors.sensing import Sensing
from errormotion.twin.sensors.stage_sensor import StageSensor
from errormotion.twin.thermal.state import ThermalState, seeded_state

#: Time to full spindle speed, s.
SPIN_UP_TIME = 0.75
#: Time since switching on after which sensors are warm, s.
WARM_AFTER = 4 * 3600.0

_PARTS = ("heat", "frame", "bar", "geometry", "crossbeam", "point_sensor", "probing")
_PART = {name: number for number, name in enumerate(_PARTS)}


class VirtualMachine(StageSensor, ProbeMeasurements):
    """A machine tool whose true errors are known.

    The seed selects an individual: thermal amplitudes, beams, bar, geometric errors, noise. The results depend on the
    seed and the schedule only, not on the order of the calls.

    Parameters
    ----------
    machine : str or MachineDescription
        "cframe" (610 x 510 x 460 mm), "gantry" (4 x 1.8 x 1 m), or the description of any other machine; see
        `machine_kind` for its thermal properties.
    seed : int
        Number of the individual.
    warm : bool
        Whether the sensors were switched on long before time 0, else at time 0.

    Attributes
    ----------
    name : str
        For reports.
    kind : str
        "cframe" or "gantry".
    description : MachineDescription
        Chain, travel, spindle axis and rotary axes.
    travel : mapping
        (Lowest, highest) position of each moving axis, m or rad.
    rapid : float
        Feed of rapid moves, m/s.
    chain : str
        Bodies from workpiece to tool, without the fixed axes.
    frame : FrameGeometry
        The five sensors.
    bar : Bar
        The true bar; ``bar_radius`` is the radius in its certificate, m.
    sphere_radius : float
        m.
    state : ThermalState
        Temperatures and thermal errors under the current schedule.
    geometry : GeometricErrors
        The geometric errors of all axes.
    point_sensor, sine_gauge, check_bar
        A point sensor on the stage, and its targets.
    """

    def __init__(self, machine: str | MachineDescription = "cframe", seed: int = 0, *, warm: bool = True) -> None:
        self.kind, tables = machine_kind(machine)
        self.seed = int(seed)
        self.name = tables.name
        self._described = isinstance(machine, MachineDescription)
        self.description = machine if isinstance(machine, MachineDescription) else tables.description
        self.travel = {axis: self.description.travel[axis] for axis in self.description.moving_axes}
        self.rapid = tables.rapid
        self.chain = self.description.moving_chain
        self.top_speed = tables.top_speed
        self.bar_radius = bars.RADIUS
        self.sphere_radius = 5e-3
        self.sensors_on_for = WARM_AFTER if warm else 0.0
        self.frame = frames.seeded_frame(self._rng("frame"), self.bar_radius)
        self.bar = bars.seeded_bar(self._rng("bar"), len(self.frame.channels))
        self.state: ThermalState = seeded_state(tables, self._rng("heat"), self._schedule(()))
        self.geometry: GeometricErrors = seeded_errors(self._rng("geometry"), self.description)
        self._along_crossbeam = tables.travel.get("Y", (0.0, 0.0))
        self._set_up_point_sensor(self._rng("point_sensor"))
        self._set_up_probing(self._rng("probing"))
        self._sensing = self._sense()

    def __repr__(self) -> str:
        return f"VirtualMachine({self.name if self._described else self.kind!r}, seed={self.seed})"

    def _rng(self, part: str) -> np.random.Generator:
        return np.random.default_rng([abs(self.seed), int(self.seed < 0), _PART[part]])

    @cached_property
    def crossbeam(self) -> Crossbeam:
        """Thermal errors of the Y axis of the gantry, and the line profiler in its spindle; made when it is used."""
        return seeded_crossbeam(self._rng("crossbeam"), self._along_crossbeam)

    def _schedule(self, events: Sequence[Event]) -> Schedule:
        return Schedule(tuple(events), self.top_speed / 60 / SPIN_UP_TIME, self.top_speed)

    def _sense(self) -> Sensing:
        return Sensing(self.seed, self.frame, self.bar, self.sphere_radius, self.state, self.sensors_on_for)

    # ------------------------------------------------------------------ commands

    def start(self, schedule: Sequence[Event] = ()) -> None:
        """Restart at time 0, cold and at rest, with a schedule of commands and without offsets.

        Raises
        ------
        BenchError
            Events out of order, a speed outside the range of the spindle, an unknown axis.
        """
        self._follow(schedule, None)

    def compensate(self, times: ArrayLike, offsets: ArrayLike) -> None:
        """Add offsets to the commanded positions; the errors of a tool in the spindle are then the remaining errors.

        Parameters
        ----------
        times : (n,)
            s, increasing.
        offsets : (n, 3)
            X, Y and Z, m; linear between, constant before and after. They replace earlier offsets.

        Raises
        ------
        BenchError
            Wrong shapes, times that do not increase, numbers that are not finite.
        """
        t, values = np.asarray(times, dtype=float), np.asarray(offsets, dtype=float)
        if t.ndim != 1 or values.shape != (t.size, 3) or t.size == 0:
            raise BenchError(
                f"expected times (n,) and offsets (n, 3); found {t.shape} and {values.shape}",
                code="virtual.offsets.shape",
            )
        if not np.isfinite(t).all() or not np.isfinite(values).all() or not (np.diff(t) > 0).all():
            raise BenchError("expected finite offsets at increasing times", code="virtual.offsets.not_finite")
        self._follow(self._events, (t, values))

    def _follow(self, schedule: Sequence[Event], offset: tuple[Array, Array] | None) -> None:
        self.state = replace(self.state, schedule=self._schedule(schedule), offset=offset)
        self._sensing = self._sense()

    def command(self, event: Event) -> None:
        """Add a command to the schedule; the state before its time does not change.

        Later commands of the schedule are kept, and those at the same time are executed before it.

        Raises
        ------
        BenchError
            As for `start`; the schedule is not changed.
        """
        events = sorted([*self._events, event], key=lambda each: each.time)
        self._follow(events, self.state.offset)

    def stop_spindle(self, time: float) -> None:
        """Stop the spindle at a time, s, and remove its later commands from the schedule."""
        events = [event if event.time < time else replace(event, spindle_speed=None) for event in self._events]
        self._follow(events, self.state.offset)
        self.command(Event(time, spindle_speed=0.0))

    def forget(self, events: Sequence[Event], time: float) -> None:
        """Remove those of these events from the schedule that are at or after a time, s."""
        kept = [each for each in self._events if each.time < time or each not in events]
        self._follow(kept, self.state.offset)

    @property
    def _events(self) -> tuple[Event, ...]:
        return self.state.schedule.events

    def spindle_load(self, speed: ArrayLike) -> Array:
        """Return the heat of the spindle at speeds in 1/min as a share of that at top speed."""
        return np.asarray(self.state.power(speed) / self.state.power(self.top_speed))

    def spindle_speed(self, t: ArrayLike) -> Array:
        """Return the speed of the spindle at times t, 1/min, shape (n,)."""
        return self.state.schedule.speed(np.atleast_1d(np.asarray(t, dtype=float)))

    # ------------------------------------------------------------------ truth

    @property
    def temperature_sensors(self) -> tuple[str, ...]:
        """Names of the temperature sensors."""
        return self.state.sensors

    @property
    def spindle_functional_point(self) -> Array:
        """Intersection of the cold axis of rotation with the end of the bar, m, shape (3,)."""
        return self.bar.point.copy()

    def temperatures(self, t: ArrayLike) -> Array:
        """Return the true temperatures at times t, degC, shape (n, sensor)."""
        return self.state.temperatures(_times(t))

    def spindle_twist(self, t: ArrayLike) -> Array:
        """Return the thermal error of the spindle at ``spindle_functional_point``, m and rad, shape (n, 6).

        Tool side relative to workpiece side, relative to the cold state at time 0.
        """
        return self.state.twist(_times(t))

    def spindle_axis(self, t: ArrayLike) -> tuple[Array, Array]:
        """Return a point on the axis of rotation, m, and its unit direction at times t, each (n, 3).

        The point is the material point at the end of the bar.
        """
        return self._sensing.axis(_times(t))

    def truth_spindle(self, t: ArrayLike, functional_point: ArrayLike | None = None) -> xr.Dataset:
        """Return the thermal error of the spindle as an error dataset over ``time``, without uncertainty.

        Parameters
        ----------
        t : (n,)
            Times, s, increasing.
        functional_point : (3,), optional
            m; by default ``spindle_functional_point``.
        """
        t = _times(t)
        point = self.spindle_functional_point if functional_point is None else np.asarray(functional_point, dtype=float)
        coords = {
            "time": t,
            "sensor": list(self.temperature_sensors),
            "temperature": (("time", "sensor"), self.temperatures(t), {"units": "degC"}),
            "spindle_speed": ("time", self.spindle_speed(t), {"units": "1/min"}),
        }
        twist = move(self.spindle_twist(t), point - self.spindle_functional_point)
        return truth.dataset(twist, "time", coords, "spindle", point, "cold state at time 0", self._origin())

    def truth_axis(self, axis: str, positions: ArrayLike) -> xr.Dataset:
        """Return the geometric errors of an axis as an error dataset over ``position``, m or rad.

        They are stated at the machine's origin; those of a rotary axis at the point of its line in the description.
        """
        if axis not in self.geometry.motions:
            raise BenchError(
                f"expected one of the axes {', '.join(self.geometry.motions)}; found {axis!r}",
                code="virtual.axis.unknown",
            )
        q = _times(positions)
        (joint,) = (each for each in self.geometry.machine.joints if each.name == axis)
        coords = {axis.lower(): ("position", q, {"units": "rad" if joint.rotary else "m"})}
        twist = self.geometry.motions[axis](q)
        return truth.dataset(twist, "position", coords, axis, joint.reference, "axis at zero", self._origin())

    def volumetric_truth(self, points: ArrayLike) -> xr.Dataset:
        """Return the errors of the tool at commanded points as an error dataset over ``target``.

        Parameters
        ----------
        points : (n, moving axis)
            See `GeometricErrors.twist`, m and rad.
        """
        commands = np.atleast_2d(np.asarray(points, dtype=float))
        coords = {
            axis.lower(): ("target", column, {"units": "rad" if axis in ROTARY_AXES else "m"})
            for axis, column in zip(self.description.moving_axes, commands.T, strict=False)
        }
        twist = self.geometry.twist(commands)
        return truth.dataset(twist, "target", coords, "tool", np.zeros(3), "commanded point", self._origin())

    def _origin(self) -> truth.Origin:
        description = self.description if self._described else None
        return truth.Origin(self.name, self.kind, self.seed, self._events, description)

    # ------------------------------------------------------------------ readings

    def still_readings(self, t: ArrayLike, *, expansion: bool = True, warm_up: bool = True) -> Array:
        """Return the readings at times t without noise, runout and texture, m, shape (channel, n).

        Parameters
        ----------
        t : (n,)
            Times, s.
        expansion, warm_up : bool
            Whether the frame expands with its temperature, and the sensors warm up.
        """
        return self._sensing.still(_times(t), expansion=expansion, warm_up=warm_up)

    def distances(
        self,
        first: int,
        n: int,
        rate: float,
        channels: Sequence[str] | None = None,
        tool: str = "bar",
        motion: StepProgram | None = None,
    ) -> Array:
        """Return the readings of the sensors: samples first .. first + n - 1 of their streams.

        Parameters
        ----------
        first, n : int
            Counter of the first sample, and number of samples; sample i is taken at i / rate seconds.
        rate : float
            Samples per second.
        channels : sequence of str, optional
            The sensors; by default all.
        tool : {"bar", "sphere"}
            The piece in the spindle.
        motion : StepProgram, optional
            Motion of the sphere; required for the sphere.

        Returns
        -------
        ndarray, (channel, n)
            m; NaN outside of the measuring range and where a beam misses the target.
        """
        if first < 0 or n < 0 or not rate > 0:
            raise BenchError(
                f"expected first >= 0, n >= 0 and a rate above 0 Hz; found {first}, {n}, {rate} Hz",
                code="virtual.samples.count",
            )
        chosen = self._chosen(channels)
        out = np.full((chosen.size, n), np.nan)
        if tool == "bar":
            self._sensing.read_bar(out, first, float(rate), chosen)
        elif tool == "sphere" and motion is not None:
            self._sensing.read_sphere(out, first, float(rate), chosen, motion)
        else:
            raise BenchError(
                f"expected the tool 'bar', or 'sphere' with a StepProgram; found {tool!r}, {motion!r}",
                code="virtual.tool.unknown",
            )
        return out

    def _chosen(self, channels: Sequence[str] | None) -> NDArray[np.int64]:
        names = self.frame.channels if channels is None else tuple(channels)
        unknown = [name for name in names if name not in self.frame.channels]
        if unknown:
            raise BenchError(
                f"expected channels of {', '.join(self.frame.channels)}; found {', '.join(unknown)}",
                code="virtual.channels.unknown",
            )
        return np.array([self.frame.channels.index(name) for name in names], dtype=np.int64)


def _times(t: ArrayLike) -> Array:
    return np.atleast_1d(np.asarray(t, dtype=float))
