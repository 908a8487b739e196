"""The virtual world: one machine, one clock, and the thread that makes the samples of all channels in lockstep.

The clock advances only while samples stream, evenly spaced or wherever a moving axis triggers them, or by ``elapse``.
Nobody waits for real time unless a pace is asked for: a block of samples is made for every streaming channel, then
sent, and sending waits for the readers. The time of the world is that of the last sample that its readers have handed
over, so that what else is asked (a temperature) belongs to it, although the samples under way are further on; and when
the streams end, the world goes on from there.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.nc_program import interpret
from errormotion.instruments.simulators.streams import Carried, Device, Stream, TriggeredStream
from errormotion.instruments.simulators.targets import TargetStand
from errormotion.twin import Event, StepProgram
from errormotion.twin.paths import Path

BLOCK = 4096  # samples made at once when running freely
PACED_BLOCK = 0.01  # s, when running at a pace
LEAD_IN = (0.5, 2.5)  # s between an order and the first motion: nobody outside knows exactly
_ROUNDING = 1e-9  # m


class VirtualWorld:
    """A virtual machine with a clock, shared by all simulated devices on it.

    Parameters
    ----------
    name : str
        Kind of the machine, ``cframe`` or ``gantry``.
    seed : int
    warm : bool
        Whether the sensors were switched on long ago.

    Attributes
    ----------
    machine : VirtualMachine
        The twin, which knows the truth.
    pace : float or None
        Simulated seconds per second; None = as fast as the readers.
    """

    def __init__(self, name: str, seed: int, *, warm: bool = True) -> None:
        from errormotion.twin import VirtualMachine

        self.name = name
        self.seed = seed
        self.machine = VirtualMachine(name, seed, warm=warm)
        self._compile()
        self.pace: float | None = None
        self._front = 0.0  # time up to which samples have been made
        self._making = 0.0  # time up to which they are being made
        self._settings_of_clock = 0
        self.tool = "bar"
        self.motion: StepProgram | None = None
        self._programs = 0
        self.path = Path.resting((0.0, 0.0, 0.0))
        self.stand = TargetStand(self.machine)
        self._asked = 0  # readings by command
        self._warm_up: float | None = None  # time at which it began
        self._schedule: tuple[Event, ...] = ()
        self._devices: set[Device] = set()
        self._streams: list[Stream] = []
        self._armed: list[Stream] = []  # slaves that wait for their master
        self._triggered: list[TriggeredStream] = []
        self._change = threading.Condition()
        self._thread: threading.Thread | None = None

    def _compile(self) -> None:
        """Have the twin's loops compiled now, so that nobody waits in vain for the first samples."""
        resting = StepProgram((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 1e-5, 1)
        self.machine.distances(0, 1, 1e3, tool="bar")
        self.machine.distances(0, 1, 1e3, tool="sphere", motion=resting)

    def attach(self, device: Device, pace: float | None = None) -> None:
        """Count a device in; ``pace`` holds for the whole world."""
        with self._change:
            self._devices.add(device)
            if pace is not None:
                self.pace = pace

    def detach(self, device: Device) -> None:
        """Count a device out; with the last one the world ends."""
        with self._change:
            self._devices.discard(device)
            empty = not self._devices
        if empty:
            self.end()

    def end(self) -> None:
        """Forget this world, end its devices and its thread; what it knows can still be asked. Idempotent."""
        with _lock:
            if _worlds.get(self._key) is self:
                del _worlds[self._key]
        with self._change:
            devices, self._devices = self._devices, set()
            self._streams.clear()
            self._armed.clear()
            self._triggered.clear()
            thread, self._thread = self._thread, None
            self._change.notify_all()
        for device in devices:
            device.close()
        if thread is not None:
            thread.join()

    @property
    def _key(self) -> tuple[str, int, bool]:
        return self.name, self.seed, self.machine.sensors_on_for > 0

    @property
    def time(self) -> float:
        """Simulated seconds since the start of the schedule."""
        with self._change:
            seen = [(each.start + each.taken) / each.rate for each in self._streams if each.taken is not None]
            seen += [each.seen for each in self._triggered if each.seen is not None]
            return min(seen, default=self._front)

    def _set_clock(self, time: float) -> None:
        self._front = self._making = time
        self._settings_of_clock += 1

    @property
    def streaming(self) -> bool:
        """Whether any channel streams."""
        return bool(self._streams or self._triggered)

    @property
    def following(self) -> bool:
        """Whether a device follows the axes: its profiles drive the clock."""
        return bool(self._triggered)

    # ------------------------------------------------------------------ what a controller orders

    def start(self, schedule: Sequence[Event]) -> None:
        """Begin anew at time 0, cold, with a schedule."""
        with self._change:
            self._refuse_while_streaming("start a schedule")
            self.machine.start(schedule)
            self._schedule = tuple(schedule)
            resting = Path.resting(self.path.place(self.time))
            self._set_clock(0.0)
            self.motion, self.path, self._warm_up = None, resting, None

    def mount(self, tool: str) -> None:
        """Put the bar or the sphere into the spindle."""
        if tool not in ("bar", "sphere"):
            raise InstrumentError(f"The machine has a 'bar' and a 'sphere' to mount; found '{tool}'")
        with self._change:
            self._refuse_while_streaming("change the tool")
            self.tool, self.motion = tool, None

    def elapse(self, seconds: float) -> None:
        """Let simulated time pass without samples."""
        if not seconds >= 0:
            raise InstrumentError(f"Time passes forwards only; found {seconds} s")
        with self._change:
            self._refuse_while_streaming("let time pass")
            self._set_clock(self._front + seconds)

    def run_steps(
        self, start: Sequence[float], direction: Sequence[float], step: float, count: int, dwell: float, travel: float
    ) -> StepProgram:
        """Step the sphere along a line; the motion begins a short and unknown time from now."""
        with self._change:
            if self.tool != "sphere":
                raise InstrumentError("Only the sphere is stepped; mount it first")
            self._refuse_while_moving()
            begin = self._begin_of_motion()
            self.motion = StepProgram(tuple(start), tuple(direction), step, count, dwell, travel, begin=begin)
            return self.motion

    def run_program(self, text: str) -> Path:
        """Run an NC program, see `nc_program`; the motion begins a short and unknown time from now."""
        with self._change:
            self._refuse_while_moving()
            place = self.path.place(self.time)
            path = interpret(text, tuple(place), self.machine.travel, self.machine.rapid)
            self.motion, self.path = None, path.beginning(self._begin_of_motion())
            if self._warm_up is None:
                self._warm_up = self.path.warm_up()
            return self.path

    def move_to(self, position: Sequence[float], feed: float | None = None) -> float:
        """Move the axes in a straight line, at a feed in m/s or in rapid; return how long that takes, s.

        The time passes at once, or with the samples while any stream.
        """
        with self._change:
            self._refuse_while_moving()
            goal, feed = self._within_travel(position), self.machine.rapid if feed is None else float(feed)
            if not 0 < feed <= self.machine.rapid * (1 + 1e-9):
                raise InstrumentError(f"The feed is above 0 and at most {self.machine.rapid:g} m/s; found {feed:g}")
            begin, start = max(self._front, self._making, self.time), np.array(self.position())
            duration = float(np.linalg.norm(goal - start)) / feed
            if duration > 0:
                times, places = np.array([begin, begin + duration]), np.array([start, goal])
                self.motion, self.path = None, Path(times, places, np.array([feed == self.machine.rapid]))
                if not self.streaming:
                    self._set_clock(self.path.end)
            return duration

    def _within_travel(self, position: Sequence[float]) -> np.ndarray[Any, Any]:
        goal = np.array(position, dtype=float)
        if goal.shape != (3,) or not np.isfinite(goal).all():
            raise InstrumentError(f"Expected a position X, Y, Z in m; found {position!r}")
        for (axis, (low, high)), place in zip(self.machine.travel.items(), goal, strict=True):
            if not low - _ROUNDING <= place <= high + _ROUNDING:
                raise InstrumentError(f"{axis} travels from {low:g} to {high:g} m; found {place:g}")
        return goal

    def set_target(self, kind: str | None, inclination: float | None = None, rotation: float | None = None) -> None:
        """Put a target before the point sensors, see `TargetStand.put`; from then on they ride on the stage."""
        with self._change:
            self._refuse_while_streaming("change the target")
            self._refuse_while_moving()
            here = Path.resting(self.position())
            self.stand.put(kind, inclination, rotation)
            if self.stand.target is not None:
                self.motion, self.path = None, here

    def set_station(self, position: Sequence[float]) -> None:
        """Have the trackers beside the machine carried to a place in its coordinates, m."""
        trackers = [device for device in self._devices if isinstance(device, Carried)]
        if not trackers:
            raise InstrumentError("No tracker stands beside this machine; open it first, at the same machine and seed")
        with self._change:
            self._refuse_while_streaming("carry a tracker")
        for tracker in trackers:
            tracker.carry_to(position)

    def read_point(self, name: str) -> float:
        """Return what a point sensor with a range about zero reads now, m.

        Minus or plus infinity before or behind its range; NaN without a target, and where the beam misses it.
        """
        with self._change:
            self._asked += 1
            now = np.array([self.time])
            return float(self.stand.read(name, now, self.path.place(now), self._asked)[0])

    def _refuse_while_moving(self) -> None:
        if self.stepping or self.running:
            what = "stepping" if self.stepping else "running"
            raise InstrumentError(f"The machine is still {what}; wait until its program has ended")

    def _begin_of_motion(self) -> float:
        rng = np.random.default_rng([abs(self.seed), self._programs])
        self._programs += 1
        return float(max(self._front, self.time) + rng.uniform(*LEAD_IN))

    @property
    def stepping(self) -> bool:
        """Whether a step program waits or runs."""
        return self.motion is not None and self.time < self.motion.end

    @property
    def running(self) -> bool:
        """Whether an NC program waits or runs."""
        return self.time < self.path.end

    def warm_time(self, times: ArrayLike) -> np.ndarray[Any, Any]:
        """Return how long the axes have been warming up at times of the world's clock, s; 0 before they began.

        This is the time for which the gantry's `truth_crossbeam` tells the errors. It begins with the first move of
        a program that warms up (`Path.warm_up`) and then counts on.
        """
        times = np.asarray(times, dtype=float)
        with self._change:
            begin = self._warm_up
        return np.zeros_like(times) if begin is None else np.maximum(times - begin, 0.0)

    @property
    def sensors_on_for(self) -> float:
        """How long the sensors have been on, s."""
        return self.machine.sensors_on_for + self.time

    def commanded(self) -> dict[str, Any]:
        """Return what a controller displays: time, speed, compensation, whether it moves, a target if there is one."""
        now = self.time
        speed, compensation = 0.0, {"X": True, "Y": True, "Z": True}
        for event in self._schedule:
            if event.time <= now:
                speed = speed if event.spindle_speed is None else event.spindle_speed
                compensation.update(event.compensation or {})
        shown = {"time": now, "spindle_speed": speed, "compensation": compensation}
        target = {"target": self.stand.order} if self.stand.order else {}
        return {**shown, **target, "stepping": self.stepping, "running": self.running}

    def position(self) -> list[float]:
        """Return the commanded position of the tool, m."""
        motion = self.motion
        if motion is None:
            return [float(x) for x in self.path.place(self.time)]
        place = max(int(np.searchsorted(motion.arrivals, self.time, side="right")) - 1, 0)
        return [float(x) for x in motion.places[place]]

    def _refuse_while_streaming(self, what: str) -> None:
        names = [each.channel for each in self._streams] + [each.channel for each in self._triggered]
        if names:
            raise InstrumentError(f"Cannot {what} while {', '.join(names)} stream; stop the streams first")

    # ------------------------------------------------------------------ samples

    def begin_stream(self, stream: Stream) -> None:
        """Begin to make samples: at once, for a slave when its master begins, for a master with all its slaves."""
        with self._change:
            if stream.sync == "SLAVE":
                self._armed.append(stream)
                return
            starting = [stream]
            if stream.sync == "MASTER":
                starting, self._armed = [*self._armed, stream], []
            for each in starting:
                each.start = each.position = _first_sample(self._front, each.rate)
                each.taken = None
            self._streams.extend(starting)
            if self._thread is None:
                self._thread = threading.Thread(target=self._generate, name=f"sim-world-{self.name}", daemon=True)
                self._thread.start()
            self._change.notify_all()

    def end_stream(self, stream: Stream) -> None:
        """Make no more samples for this channel, nor for the slaves of a master; a block in the making may come."""
        with self._change:
            if stream in self._armed:
                self._armed.remove(stream)
            if stream in self._streams:
                seen = self.time
                self._streams.remove(stream)
                if stream.sync == "MASTER":
                    slaves = [each for each in self._streams if each.sync == "SLAVE"]
                    self._armed.extend(slaves)
                    self._streams = [each for each in self._streams if each not in slaves]
                if not self._streams:
                    self._set_clock(seen)

    def begin_triggered(self, stream: TriggeredStream) -> float:
        """Let a device follow the axes; return the time from which on.

        Raises
        ------
        InstrumentError
            Devices with a clock of their own stream.
        """
        with self._change:
            if self._streams:
                self._refuse_while_streaming("follow the axes")
            now = self.time
            self._triggered.append(stream)
            return now

    def end_triggered(self, stream: TriggeredStream) -> None:
        """Let the clock stand where the device's reader is. Idempotent."""
        with self._change:
            if stream in self._triggered:
                seen = self.time
                self._triggered.remove(stream)
                if not self.streaming:
                    self._set_clock(seen)

    def _generate(self) -> None:
        wall, began = time.monotonic(), 0.0
        running = False
        while True:
            with self._change:
                if not self._streams:
                    running = False
                    self._change.wait_for(lambda: bool(self._streams) or self._thread is None)
                if self._thread is not threading.current_thread():
                    return
                if not running:
                    wall, began, running = time.monotonic(), self._front, True
                streams, setting, pace = tuple(self._streams), self._settings_of_clock, self.pace
                fastest = max(streams, key=lambda stream: stream.rate)
                size = BLOCK if pace is None else max(1, round(PACED_BLOCK * pace * fastest.rate))
                until = self._making = (fastest.position + size) / fastest.rate
            self._make(streams, until)
            with self._change:
                if self._settings_of_clock == setting:  # nobody has set the clock meanwhile
                    self._front = until
            if pace is not None:
                time.sleep(max(0.0, wall + (until - began) / pace - time.monotonic()))

    def _make(self, streams: Sequence[Stream], until: float) -> None:
        """Make the samples of all streams before a time; channels on one clock in one go."""
        groups: dict[tuple[float, int], list[Stream]] = {}
        for stream in streams:
            groups.setdefault((stream.rate, stream.position), []).append(stream)
        for (rate, first), group in groups.items():
            size = _first_sample(until, rate) - first
            if size <= 0:
                continue
            distances = self._distances(first, size, rate, group)
            for stream, values in zip(group, distances, strict=True):
                stream.position += size
                stream.push(values)
                if stream.ended:
                    self.end_stream(stream)

    def _distances(self, first: int, n: int, rate: float, streams: Sequence[Stream]) -> np.ndarray[Any, Any]:
        if self.stand.target is not None:
            return self.stand.samples(streams, first, n, rate, self.path)
        channels = [stream.channel for stream in streams]
        if self.tool == "sphere" and self.motion is None:  # parked outside of the frame
            return np.full((len(channels), n), np.nan)
        return self.machine.distances(first, n, rate, channels, tool=self.tool, motion=self.motion)


def _first_sample(time: float, rate: float) -> int:
    """Return the number of the first sample at or after a time, rounding errors aside."""
    return int(np.ceil(time * rate - 1e-6))


_worlds: dict[tuple[str, int, bool], VirtualWorld] = {}
_lock = threading.RLock()


def world(name: str = "cframe", seed: int = 0, *, warm: bool = True) -> VirtualWorld:
    """Return the world of a machine and seed; made when it is not there yet."""
    with _lock:
        key = (name, int(seed), warm)
        if key not in _worlds:
            _worlds[key] = VirtualWorld(name, int(seed), warm=warm)
        return _worlds[key]


def reset() -> None:
    """End all worlds of this process and their threads."""
    with _lock:
        worlds = list(_worlds.values())
    for each in worlds:
        each.end()
