"""Motion of the axes of a virtual world: steps of a sphere, NC programs, straight moves, and the touch probe.

During a program, samples or ``elapse`` advance the time. A straight move and a touch advance it at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from errormotion.errors import ErrormotionError, InstrumentError
from errormotion.instruments.simulators.virtual_world.clock import SampleClock
from errormotion.instruments.simulators.virtual_world.nc_program import interpret, title
from errormotion.instruments.simulators.virtual_world.printing import Block, PortCommand
from errormotion.twin import Event, StepProgram
from errormotion.twin.paths import Path

if TYPE_CHECKING:
    from errormotion.twin import VirtualMachine
    from errormotion.twin.artefacts.balls import Balls

Array = np.ndarray[Any, Any]

TOOLS = ("bar", "sphere", "probe")
LEAD_IN = (0.5, 2.5)  # s between a command and the first motion: unknown to the driver
_ROUNDING = 1e-9  # m


class Motion(SampleClock):
    """A clock, and moving axes.

    Attributes
    ----------
    tool : str
        Tool in the spindle. The probe is mounted automatically for probing, and removed before the spindle turns.
    motion : StepProgram or None
        Steps of the sphere.
    path : Path
        Path of the axes without a step program.
    program : str
        Title of the last NC program; empty after other motions.
    balls : Balls
        Balls on the table; obstacles only for the probe.
    alarms : list of str
        Texts of the alarms; while there are any, nothing moves.
    estop : bool
        Whether the emergency stop is pressed.
    stuck : {"open", "closed"} or None
        A fault of the probe: it never trips, or is always tripped.
    port_output : list of (float, PortCommand)
        Output of NC programs to the printer port, with its times, s.
    """

    seed: int
    machine: VirtualMachine

    def __init__(self) -> None:
        super().__init__()
        self.tool = "bar"
        self.motion: StepProgram | None = None
        self.path = Path.resting((0.0, 0.0, 0.0))
        self.program = ""
        self.balls: Balls = self.machine.balls
        self.alarms: list[str] = []
        self.estop = False
        self.stuck: Literal["open", "closed"] | None = None
        self.port_output: list[tuple[float, PortCommand]] = []
        self._programs = 0
        self._program_events: list[Event] = []
        self._warm_up: float | None = None  # time at which the warm-up started

    # ------------------------------------------------------------------ commands

    def mount(self, tool: str) -> None:
        """Mount the bar, the sphere or the touch probe in the spindle."""
        if tool not in TOOLS:
            raise InstrumentError(
                f"Expected the tool 'bar', 'sphere' or 'probe'; found '{tool}'", code="simulator.tool.unknown"
            )
        with self._change:
            self._refuse_while_streaming("change the tool")
            self._refuse_in_alarm()
            self.tool, self.motion = tool, None

    def run_steps(
        self, start: Sequence[float], direction: Sequence[float], step: float, count: int, dwell: float, travel: float
    ) -> StepProgram:
        """Step the sphere along a line; the motion starts after a short and unknown time."""
        with self._change:
            if self.tool != "sphere":
                raise InstrumentError("Only the sphere can be stepped; mount it first", code="simulator.tool.no_sphere")
            self._refuse_to_move()
            begin = self._start_of_motion()
            self.motion = StepProgram(tuple(start), tuple(direction), step, count, dwell, travel, begin=begin)
            self.program = ""
            return self.motion

    def run_program(self, text: str) -> Path:
        """Run an NC program, see `nc_program`; the motion starts after a short and unknown time."""
        with self._change:
            self._refuse_to_move()
            start, begin = self.path.place(self.time), self._start_of_motion()
            actions = ProgramActions(self, begin)
            try:
                path = interpret(text, tuple(start), self.machine.travel, self.machine.rapid, actions)
            except ErrormotionError:
                actions.undo()
                self._programs -= 1
                raise
            self.motion, self.path = None, path.beginning(begin)
            self.program, self._program_events = title(text), actions.events
            self.port_output += actions.port_output
            if self._warm_up is None:
                self._warm_up = self.path.warm_up()
            return self.path

    def move_to(self, position: Sequence[float], feed: float | None = None) -> float:
        """Move the axes in a straight line, at a feed in m/s or in rapid; return the duration, s.

        The move advances the time at once, or, while sensors stream, their samples do. A probe that trips during the
        move stops the machine and sets an alarm.
        """
        with self._change:
            self._refuse_to_move()
            goal, feed = self._within_travel(position), self._possible_feed(feed)
            begin, start = self._next_instant(), np.array(self.position())
            contact = self.obstacle(start, goal, begin, feed)
            if contact is not None:
                self._go(start, contact, begin, feed)
                distance = float(np.linalg.norm(contact - start))
                self.raise_alarm(f"the probe has tripped during a move, after {distance * 1e3:.3f} mm")
                self._refuse_in_alarm()
            return self._go(start, goal, begin, feed)

    def probe(self, target: Sequence[float], feed: float) -> dict[str, Any]:
        """Move the touch probe in a straight line until it trips, or to the target; this advances the time at once.

        Parameters
        ----------
        target : (3,)
            Commanded position of the tip, m.
        feed : float
            m/s.

        Returns
        -------
        dict
            ``tripped``, ``position`` (of the trip, where the tip now is, m; else None) and ``time`` (s).

        Raises
        ------
        InstrumentError
            The probe is tripped before it moves, the spindle turns, a device streams, the machine moves or is in alarm,
            or the target is out of travel.
        """
        with self._change:
            self._refuse_while_streaming("probe")
            self._refuse_to_move()
            goal, feed = self._within_travel(target), self._possible_feed(feed)
            begin, start = self.time, np.array(self.position())
            if speed := self.commanded_speed(begin):
                raise InstrumentError(
                    f"The spindle turns at {speed:g} /min; stop it before the machine probes",
                    code="machine.spindle.turning",
                )
            if self.stuck == "closed" or not (
                self.stuck == "open" or self.machine.released(start, begin, balls=self.balls)
            ):
                raise InstrumentError(
                    "The probe is tripped before it moves; remove the contact or repair the probe",
                    code="probe.tripped.before",
                )
            self.tool = "probe"
            contact = self.trip(start, goal, begin, feed, released=True)
            self._go(start, goal if contact is None else contact, begin, feed)
            return {
                "tripped": contact is not None,
                "position": None if contact is None else [float(x) for x in contact],
                "time": self.time,
            }

    def trip(self, start: Array, goal: Array, time: float, feed: float, *, released: bool = False) -> Array | None:
        """Return where the probe trips on a straight path, m; None: never; the start if it is already tripped.

        With ``released``, it is known that the probe has not tripped at the start.
        """
        if self.stuck:
            return start if self.stuck == "closed" else None
        return self.machine.contact(start, goal, time, feed, balls=self.balls, leaving=released)[0]

    def obstacle(self, start: Array, goal: Array, time: float, feed: float) -> Array | None:
        """Return where a probe in the spindle collides with a ball, m, unless it moves away from it; None: nowhere."""
        if self.tool != "probe":
            return None
        return self.machine.contact(start, goal, time, feed, balls=self.balls, leaving=True)[0]

    def stop(self) -> None:
        """Abort all motion of the axes; the spindle is not affected."""
        with self._change:
            now = self._next_instant()
            if self.motion is not None and now < self.motion.end:
                self.motion, self.path = None, Path.resting(self._sphere(now))  # the sphere leaves the beams
            elif now < self.path.end:
                self.path = self.path.cut(now)
                self.machine.forget(self._program_events, now)
                self.port_output = [each for each in self.port_output if each[0] <= now]  # keeps the objects
                if self._warm_up is not None and self._warm_up > now:
                    self._warm_up = None
            self.program = ""

    def raise_alarm(self, text: str) -> None:
        """Set an alarm: the axes stop, and nothing moves until `reset_alarms`."""
        with self._change:
            self.stop()
            if text not in self.alarms:
                self.alarms.append(text)

    def reset_alarms(self) -> None:
        """Clear alarm and emergency stop; this starts no motion."""
        with self._change:
            self.alarms.clear()
            self.estop = False

    # ------------------------------------------------------------------ refusals

    def _refuse_in_alarm(self) -> None:
        if self.estop:
            raise InstrumentError(
                "The machine is in emergency stop; release it and reset the machine", code="machine.emergency_stop"
            )
        if self.alarms:
            raise InstrumentError(
                f"The machine is in alarm: {'; '.join(self.alarms)}. Remove the cause and reset the machine",
                code="machine.alarm",
            )

    def _refuse_to_move(self) -> None:
        self._refuse_in_alarm()
        self._refuse_while_moving()

    def _refuse_while_moving(self) -> None:
        if self.stepping or self.running:
            what = "stepping" if self.stepping else "running"
            raise InstrumentError(
                f"The machine is still {what}; wait until its program has ended", code="machine.moving"
            )

    def _within_travel(self, position: Sequence[float]) -> Array:
        goal = np.array(position, dtype=float)
        if goal.shape != (3,) or not np.isfinite(goal).all():
            raise InstrumentError(f"Expected a position X, Y, Z in m; found {position!r}", code="position.form")
        for (axis, (low, high)), x in zip(self.machine.travel.items(), goal, strict=True):
            if not low - _ROUNDING <= x <= high + _ROUNDING:
                raise InstrumentError(
                    f"{axis} travels from {low:g} to {high:g} m; found {x:g}", code="machine.position.outside"
                )
        return goal

    def _possible_feed(self, feed: float | None) -> float:
        chosen = self.machine.rapid if feed is None else float(feed)
        if not 0 < chosen <= self.machine.rapid * (1 + 1e-9):
            raise InstrumentError(
                f"Expected a feed above 0 and at most {self.machine.rapid:g} m/s; found {chosen:g}",
                code="machine.feed.outside",
            )
        return chosen

    def commanded_speed(self, time: float) -> float:
        """Return the commanded spindle speed at a time, 1/min."""
        raise NotImplementedError

    def turn(self, speed: float, time: float) -> Event | None:
        """Turn the spindle at a speed from a time on; return the event in the machine's schedule, if any."""
        raise NotImplementedError

    # ------------------------------------------------------------------ position

    def _go(self, start: Array, goal: Array, begin: float, feed: float) -> float:
        """Move in a straight line; return the duration, s."""
        duration = float(np.linalg.norm(goal - start)) / feed
        if duration > 0:
            times, places = np.array([begin, begin + duration]), np.array([start, goal])
            self.motion, self.path = None, Path(times, places, np.array([feed == self.machine.rapid]))
            self.program = ""
            if not self.streaming:
                self._set_clock(self.path.end)
        return duration

    def _start_of_motion(self) -> float:
        rng = np.random.default_rng([abs(self.seed), self._programs])
        self._programs += 1
        return float(self._next_instant() + rng.uniform(*LEAD_IN))

    @property
    def stepping(self) -> bool:
        """Whether a step program waits or runs."""
        return self._stepping_at(self.time)

    def _stepping_at(self, time: float) -> bool:
        return self.motion is not None and time < self.motion.end

    @property
    def running(self) -> bool:
        """Whether an NC program waits or runs."""
        return self.time < self.path.end

    def position(self) -> list[float]:
        """Return the commanded position of the tool, m."""
        return self._position_at(self.time)

    def _position_at(self, time: float) -> list[float]:
        place = self.path.place(time) if self.motion is None else self._sphere(time)
        return [float(x) for x in place]

    def _sphere(self, time: float) -> Array:
        """Return the position of the sphere at a time, or its last position at rest, m."""
        if self.motion is None:
            return self.path.place(time)
        step = max(int(np.searchsorted(self.motion.arrivals, time, side="right")) - 1, 0)
        return np.asarray(self.motion.places[step])

    @property
    def printed(self) -> list[tuple[float, str]]:
        """Lines of NC programs, without leading blanks, with the times at which they are printed, s."""
        return [
            (time, command.text("fanuc", "none")) for time, command in self.port_output if isinstance(command, Block)
        ]

    def _feed_at(self, time: float) -> float:
        """Return the feed at a time, m/s; NaN while the sphere is stepped."""
        return float("nan") if self._stepping_at(time) else self.path.feed(time)

    def warm_time(self, times: ArrayLike) -> Array:
        """Return the duration of the warm-up of the axes at times of the world's clock, s; 0 before its start.

        The thermal errors of the gantry's crossbeam depend on this time. It starts with the first move of a warm-up
        program (`Path.warm_up`) and then continues.
        """
        times = np.asarray(times, dtype=float)
        with self._change:
            begin = self._warm_up
        return np.zeros_like(times) if begin is None else np.maximum(times - begin, 0.0)


class ProgramActions:
    """Actions of an NC program in addition to its path; see `nc_program.Peripherals`."""

    def __init__(self, world: Motion, begin: float) -> None:
        self._world, self._begin = world, begin
        self._tool = world.tool
        self.events: list[Event] = []
        self.port_output: list[tuple[float, PortCommand]] = []

    def pass_by(self, start: Array, goal: Array, feed: float, time: float) -> None:
        """Refuse a move on which the probe would collide with a ball."""
        if self._world.obstacle(start, goal, self._begin + time, feed) is not None:
            raise InstrumentError("the probe would trip on this path", code="probe.path.not_free")

    def skip(self, start: Array, goal: Array, feed: float, time: float) -> Array:
        """Return where the probe stops a move."""
        if speed := self._world.commanded_speed(self._begin + time):
            raise InstrumentError(f"the spindle turns at {speed:g} /min; M5 first", code="machine.spindle.turning")
        self._world.tool = "probe"
        contact = self._world.trip(start, goal, self._begin + time, feed)
        return goal if contact is None else contact

    def spindle(self, speed: float, time: float) -> None:
        """Turn the spindle."""
        event = self._world.turn(speed, self._begin + time)
        self.events += [event] if event is not None else []
        if speed and self._world.tool == "probe":
            self._world.tool = "bar"

    def print(self, command: PortCommand, time: float) -> None:
        """Open or close the printer port, or send a block, at a time of the program."""
        self.port_output.append((self._begin + time, command))

    def clock(self, time: float) -> float:
        """Return the time of the world, s."""
        return self._begin + time

    def undo(self) -> None:
        """Cancel the actions of an aborted program."""
        self._world.machine.forget(self.events, self._begin)
        self._world.tool = self._tool
