"""The virtual world: one machine, one clock, and all simulated devices on it."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.virtual_world.described import described
from errormotion.instruments.simulators.virtual_world.motion import LEAD_IN, Motion
from errormotion.instruments.simulators.virtual_world.streams import Carried, Device, Stream
from errormotion.instruments.simulators.virtual_world.targets import TargetStand
from errormotion.twin import Event, StepProgram
from errormotion.twin.paths import Path

__all__ = ["LEAD_IN", "VirtualWorld", "reset", "world"]


SAME_INSTANT = 1e-3
"""Difference of the times of one event in two schedules, s."""
ORIGIN = (0.0, 0.0, 0.0)
"""Position of the axes when the clock is set, m."""


class VirtualWorld(Motion):
    """A virtual machine with a clock, shared by all simulated devices on it.

    Parameters
    ----------
    name : str
        Type of the machine, ``cframe`` or ``gantry``; ``machine`` for the one that the bench describes.
    seed : int
    warm : bool
        Whether the sensors have been on long enough to be stable.

    Attributes
    ----------
    machine : VirtualMachine
        The twin with the true errors.
    stand : TargetStand
        Target of the point sensors.
    """

    def __init__(self, name: str, seed: int, *, warm: bool = True) -> None:
        from errormotion.twin import VirtualMachine

        self.name = name
        self.seed = seed
        self.machine = VirtualMachine(described(name), seed, warm=warm)
        self._compile()
        super().__init__()
        self.stand = TargetStand(self.machine)
        self._readings = 0  # number of readings by command
        self._commanded: float | None = None  # commanded spindle speed while the heat follows a schedule
        self._follows: tuple[Event, ...] | None = None
        self._devices: set[Device] = set()

    def _compile(self) -> None:
        """Compile the twin's loops before the first samples, once for each type of machine."""
        if self.name in _compiled:
            return
        _compiled.add(self.name)
        resting = StepProgram((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 1e-5, 1)
        self.machine.distances(0, 1, 1e3, tool="bar")
        self.machine.distances(0, 1, 1e3, tool="sphere", motion=resting)

    def attach(self, device: Device, pace: float | None = None) -> None:
        """Register a device; ``pace`` applies to the whole world."""
        with self._change:
            self._devices.add(device)
            if pace is not None:
                self.pace = pace

    def detach(self, device: Device) -> None:
        """Unregister a device; the world ends with its last device."""
        with self._change:
            self._devices.discard(device)
            empty = not self._devices
        if empty:
            self.end()

    def end(self) -> None:
        """End this world, its devices and its thread; its truth can still be read. Idempotent."""
        with _lock:
            if _worlds.get(self._key) is self:
                del _worlds[self._key]
        with self._change:
            devices, self._devices = self._devices, set()
            thread = self._forget_streams()
        for device in devices:
            device.close()
        if thread is not None:
            thread.join()

    @property
    def _key(self) -> tuple[str, int, bool]:
        return self.name, self.seed, self.machine.sensors_on_for > 0

    # ------------------------------------------------------------------ heat and time

    def start(self, schedule: Sequence[Event]) -> None:
        """Restart with a cold machine at time 0, with a schedule.

        A world that follows a schedule (`follow`) continues at its time; this schedule has to be a part of the other.
        """
        with self._change:
            self._refuse_while_streaming("start a schedule")
            self._refuse_in_alarm()
            if self._follows is not None:
                self._refuse_others(schedule)
                return
            self.machine.start(schedule)
            self._restart(0.0, self.path.place(self.time))

    def follow(self, schedule: Sequence[Event], time: float) -> None:
        """Warm up by a schedule from time 0 on, and set the clock to a time, s, which may be earlier than now.

        The axes are then at zero. Several measurements thus find the machine in the same state at the same time. A
        command to the spindle turns it, and does not change the heat.
        """
        if not 0 <= time < np.inf:
            raise InstrumentError(f"Expected a time of at least 0 s; found {time} s", code="simulator.time.negative")
        with self._change:
            self._refuse_while_streaming("set the clock")
            self._refuse_in_alarm()
            self.machine.start(schedule)
            self._follows, self._commanded = self.machine.state.schedule.events, None
            self._restart(float(time), ORIGIN)

    def _refuse_others(self, schedule: Sequence[Event]) -> None:
        now = self.time
        for event in schedule:
            at = now + event.time
            known = [each for each in self._follows or () if abs(each.time - at) < SAME_INSTANT]
            if not any(replace(each, time=0.0) == replace(event, time=0.0) for each in known):
                found = "; ".join(map(str, known)) or "nothing"
                raise InstrumentError(
                    f"The machine follows a schedule: expected {event} at {at:g} s in it; found {found}. State the "
                    "same events in both schedules",
                    code="simulator.schedule.differs",
                )

    def _restart(self, time: float, position: ArrayLike) -> None:
        """Set the clock, with the axes at rest and nothing in progress."""
        self._set_clock(time)
        self.motion, self.path, self.program, self._warm_up = None, Path.resting(position, time), "", None
        self.port_output, self._program_events = [], []

    def snapshot(self) -> dict[str, Any]:
        """Return the state of the axes at rest, from which the times of later motions follow: see `restore`.

        Both worlds count as having arrived at this instant.
        """
        with self._change:
            if self.motion is None and self.time >= self.path.end:
                self.path = Path.resting(self.position(), self.time)
        return {
            "time": self.time,
            "position": self.position(),
            "programs": self._programs,
            "readings": self._readings,
            "settings": self.stand.settings,
            "tool": self.tool,
            "noise": {name: rng.bit_generator.state for name, rng in self._noise().items()},
            "schedule": [_stated(event) for event in self.machine.state.schedule.events],
        }

    def restore(
        self,
        time: float,
        position: Sequence[float],
        programs: int,
        readings: int = 0,
        settings: int = 0,
        tool: str = "",
        noise: Mapping[str, Any] | None = None,
        schedule: Sequence[Mapping[str, Any]] | None = None,
    ) -> None:
        """Set the state of a `snapshot` in another process; the heat is not changed without its ``schedule``."""
        with self._change:
            self._refuse_while_streaming("set the clock")
            self._refuse_in_alarm()
            if schedule is not None and self._follows is None:
                self.machine.start([Event(**event) for event in schedule])
            self._restart(float(time), tuple(map(float, position)))
            self._programs, self._readings, self.tool = int(programs), int(readings), tool or self.tool
            self.stand.settings = int(settings)
            generators = self._noise()
            for name, state in (noise or {}).items():
                if name in generators:
                    generators[name].bit_generator.state = state

    def _noise(self) -> dict[str, np.random.Generator]:
        """Return the generators of the noise of the devices by name."""
        found = [(str(getattr(device, "name", "")), getattr(device, "_rng", None)) for device in self._devices]
        return {name: rng for name, rng in found if isinstance(rng, np.random.Generator)}

    def elapse(self, seconds: float) -> None:
        """Advance the simulated time without samples."""
        if not seconds >= 0:
            raise InstrumentError(f"Expected a time of at least 0 s; found {seconds} s", code="simulator.time.negative")
        with self._change:
            self._refuse_while_streaming("advance the time")
            self._set_clock(self.time + seconds)

    def spindle(self, speed: float) -> None:
        """Turn the spindle at a speed, 1/min, which heats the machine; 0 stops it."""
        with self._change:
            if speed:
                self._refuse_in_alarm()
            self.turn(float(speed), self._next_instant())
            if speed and self.tool == "probe":
                self.tool = "bar"

    def turn(self, speed: float, time: float) -> Event | None:
        """Turn the spindle at a speed from a time on; return the event in the machine's schedule, if any."""
        if self._follows is not None:
            if not 0 <= speed <= self.machine.top_speed:
                raise InstrumentError(
                    f"The spindle turns at up to {self.machine.top_speed:g} /min; found {speed:g}",
                    code="machine.spindle.too_fast",
                )
            self._commanded = speed
            return None
        event = Event(time, spindle_speed=speed)
        self.machine.command(event)
        return event

    def press_estop(self) -> None:
        """Press the emergency stop: axes and spindle stop, and the schedule of the spindle is cancelled."""
        with self._change:
            self.estop = True
            self.stop()
            self.machine.stop_spindle(self._next_instant())

    @property
    def sensors_on_for(self) -> float:
        """Time since the sensors were switched on, s."""
        return self.machine.sensors_on_for + self.time

    # ------------------------------------------------------------------ state of the controller

    def commanded_speed(self, time: float) -> float:
        """Return the commanded spindle speed at a time, 1/min."""
        if self._commanded is not None:
            return self._commanded
        speeds = [event.spindle_speed for event in self._events(time) if event.spindle_speed is not None]
        return float(speeds[-1]) if speeds else 0.0

    def _events(self, time: float) -> list[Event]:
        return [event for event in self.machine.state.schedule.events if event.time <= time]

    def commanded(self) -> dict[str, Any]:
        """Return the state that a controller displays."""
        with self._change:
            now = self.time
            stepping, running = self._stepping_at(now), now < self.path.end
            compensation = {"X": True, "Y": True, "Z": True}
            for event in self._events(now):
                compensation.update(event.compensation or {})
            true_speed = float(self.machine.spindle_speed(now)[0])
            position = self._position_at(now)
            return {
                "time": now,
                "position": position,
                "commanded_position": list(position),
                "spindle_speed": true_speed if self._commanded is None else self._commanded,
                "commanded_spindle_speed": self.commanded_speed(now),
                "spindle_load": float(self.machine.spindle_load(true_speed)),
                "feed": self._feed_at(now),
                "mode": "automatic" if stepping or running else "mdi",
                "program": self.program if stepping or running else "",
                "stepping": stepping,
                "running": running,
                "homed": True,
                "enabled": not self.estop and not self.alarms,
                "estop": self.estop,
                "alarms": [*(["emergency stop"] if self.estop else []), *self.alarms],
                "compensation": compensation,
                "tool": self.tool,
                **({"target": self.stand.requested} if self.stand.requested else {}),
            }

    # ------------------------------------------------------------------ targets, trackers, sensors

    def set_target(self, kind: str | None, inclination: float | None = None, rotation: float | None = None) -> None:
        """Place a target in front of the point sensors, see `TargetStand.put`; they are then on the stage."""
        with self._change:
            self._refuse_while_streaming("change the target")
            self._refuse_while_moving()
            here = Path.resting(self.position())
            self.stand.put(kind, inclination, rotation)
            if self.stand.target is not None:
                self.motion, self.path = None, here

    def set_station(self, position: Sequence[float]) -> None:
        """Move the trackers beside the machine to a position in its coordinates, m."""
        trackers = [device for device in self._devices if isinstance(device, Carried)]
        if not trackers:
            raise InstrumentError(
                "This machine has no tracker; open one first, at the same machine and seed",
                code="simulator.tracker.missing",
            )
        with self._change:
            self._refuse_while_streaming("move a tracker")
        for tracker in trackers:
            tracker.carry_to(position)

    def read_point(self, name: str) -> float:
        """Return the present reading of a point sensor with a range about zero, m.

        Minus or plus infinity before or behind its range; NaN without a target, or if the beam misses it.
        """
        with self._change:
            self._readings += 1
            now = np.array([self.time])
            return float(self.stand.read(name, now, self.path.place(now), self._readings)[0])

    def _distances(self, first: int, n: int, rate: float, streams: Sequence[Stream]) -> np.ndarray[Any, Any]:
        if self.stand.target is not None:
            return self.stand.samples(streams, first, n, rate, self.path)
        channels = [stream.channel for stream in streams]
        if self.tool != "bar" and self.motion is None:  # parked outside of the frame
            return np.full((len(channels), n), np.nan)
        return self.machine.distances(first, n, rate, channels, tool=self.tool, motion=self.motion)


_worlds: dict[tuple[str, int, bool], VirtualWorld] = {}
_compiled: set[str] = set()
_lock = threading.RLock()


def world(name: str = "cframe", seed: int = 0, *, warm: bool = True) -> VirtualWorld:
    """Return the world of a machine and seed, which is created at the first call."""
    with _lock:
        key = (name, int(seed), warm)
        machine = described(name)
        if key in _worlds and not isinstance(machine, str) and _worlds[key].machine.description != machine:
            _worlds[key].end()  # belongs to another bench
        if key not in _worlds:
            _worlds[key] = VirtualWorld(name, int(seed), warm=warm)
        return _worlds[key]


def let_time_pass(name: str, seed: int, seconds: float, *, warm: bool = True) -> None:
    """Advance the time in the world of a machine and seed, if it exists and no device streams."""
    with _lock:
        found = _worlds.get((name, seed, warm))
    if found is not None:
        with suppress(InstrumentError):  # samples advance its clock
            found.elapse(seconds)


def reset() -> None:
    """End all worlds of this process and their threads."""
    with _lock:
        worlds = list(_worlds.values())
    for each in worlds:
        each.end()


def _stated(event: Event) -> dict[str, Any]:
    """Return the fields of an event that it states."""
    return {name: value for name, value in asdict(event).items() if value is not None}
