"""The controller of the virtual machine: JSON lines over TCP.

A request is ``{"id": 1, "op": "mount", "tool": "bar"}``, its answer ``{"id": 1, "ok": true, "result": ...}`` or
``{"id": 1, "ok": false, "error": "..."}``, each on a separate line.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

from pydantic import Field

from errormotion.datasets.units import Time
from errormotion.errors import InstrumentError, ProtocolError
from errormotion.instruments.driver import Driver
from errormotion.instruments.interlock import ArmedSettings, Interlock
from errormotion.instruments.nc_limits import check_program
from errormotion.instruments.transports import Transport, open_transport
from errormotion.plugins import Identity, InstrumentInfo, InstrumentSubject, MachineLimits

LINE_END = b"\n"
MAX_DIGITS = 300
"""Largest number of digits of a whole number."""
MAX_LINE = 1 << 16
"""Longest answer, bytes."""

# ---------------------------------------------------------------------- codec


def encode_request(number: int, op: str, arguments: Mapping[str, Any]) -> bytes:
    """Return a request as bytes."""
    return json.dumps({"id": number, "op": op, **arguments}, allow_nan=False).encode() + LINE_END


class Answer(NamedTuple):
    """The answer to a request: whether it was accepted, and its result or the reason for the refusal."""

    ok: bool
    content: Any

    @property
    def result(self) -> Any:
        """The result; InstrumentError if the controller refuses."""
        if not self.ok:
            raise InstrumentError(f"The controller refuses: {self.content}", code="instrument.refused")
        return self.content


def decode_answer(line: bytes, number: int) -> Answer:
    """Return the answer to a request; ProtocolError if the line is not an answer, or answers another request."""
    try:
        answer = json.loads(line, parse_int=_whole)
        matches, ok = answer["id"] == number, bool(answer["ok"])
        content = answer["result"] if ok else answer["error"]
    except (ValueError, KeyError, TypeError, RecursionError):
        raise ProtocolError(
            f"Expected an answer in JSON to request {number}; found {line[:200]!r}", code="protocol.reply.form"
        ) from None
    if not matches:
        raise ProtocolError(
            f"Expected the answer to request {number}; found {line[:200]!r}", code="protocol.reply.other"
        )
    return Answer(ok, content)


def _whole(text: str) -> int:
    """Return a whole number; ValueError beyond the range of a float."""
    if len(text) > MAX_DIGITS:
        raise ValueError(f"a whole number of {len(text)} digits")
    return int(text)


def event_fields(event: Any) -> dict[str, Any]:
    """Return an event (a mapping, or an object with these attributes) as an object for JSON."""
    names = ("time", "spindle_speed", "compensation")
    stated = event if isinstance(event, Mapping) else {name: getattr(event, name, None) for name in names}
    if stated.get("time") is None or set(stated) - set(names):
        raise InstrumentError(
            f"Expected an event with time, spindle_speed and compensation; found {event!r}", code="event.form"
        )
    fields: dict[str, Any] = {name: stated[name] for name in names if stated.get(name) is not None}
    if "compensation" in fields:
        fields["compensation"] = dict(fields["compensation"])
    return fields


_READING = ("identify", "state", "snapshot")

# ---------------------------------------------------------------------- driver


class ControllerSettings(ArmedSettings):
    """Settings of the virtual controller."""

    timeout: Time = Field(default=2.0, description="time limit for an answer", gt=0)


class VirtualController(Driver):
    """The control of the virtual machine. Without ``arm`` in the settings the driver only reads, and can stop it.

    Parameters
    ----------
    address : str
        ``sim://cframe/controller?seed=3``, ``tcp://host:port``, ``replay://file``.
    settings : ControllerSettings, optional
    record : Path, optional
        Recording of the session.
    """

    info: ClassVar[InstrumentInfo] = InstrumentInfo(
        id="virtual_controller",
        kind="controller",
        summary="Controller of the virtual machine: tool, spindle, touch probe, compensation, step and NC programs",
        status="simulated_only",
        simulator="errormotion.instruments.simulators.controller.virtual:SimulatedController",
    )
    Settings: ClassVar[type[ControllerSettings]] = ControllerSettings
    settings: ControllerSettings
    virtual = True
    _number = 0

    def __init__(self, address: str, settings: Any = None, *, record: Any = None) -> None:
        super().__init__(address, settings, record=record)
        self._interlock = Interlock(self.info.id, address)

    @classmethod
    def conformance(cls) -> InstrumentSubject:
        """Return the subject of the conformance kit."""
        # Faults of the machine appear when it moves, not when it is read.
        harmless = ("split", "alarm", "estop", "no_trip", "tripped")
        return InstrumentSubject(cls, "sim://cframe/controller", harmless=harmless)

    def identify(self) -> Identity:
        """Request the identity of the controller."""
        facts = self._facts("identify", "manufacturer", "model", "serial_number")
        return Identity(
            manufacturer=str(facts["manufacturer"]),
            model=str(facts["model"]),
            serial_number=str(facts["serial_number"]),
            simulated=self.transport.simulated,
            details={"address": self.address},
        )

    def configure(self, settings: ControllerSettings) -> None:
        """Use other settings from now on."""
        self.settings = settings

    def bound(self, limits: MachineLimits) -> None:
        """Apply limits to every command from now on."""
        self._interlock.limits = limits

    def read(self) -> dict[str, Any]:
        """Return the present state."""
        return self.state()

    def state(self) -> dict[str, Any]:
        """Return the state of the control.

        As for every controller: ``time`` (s since the start of the schedule), ``position`` and ``commanded_position``
        (X, Y, Z, m), ``spindle_speed`` (actual, 1/min), ``spindle_load`` (fraction of that at top speed), ``feed``
        (actual, m/s; NaN while the sphere is stepped), ``mode`` (``mdi``, or ``automatic`` while a program waits or
        runs), ``program`` (its title), ``running`` (whether an NC program waits or runs), ``homed``, ``enabled``,
        ``estop``, ``alarms`` (list of str).

        Only for this controller: ``commanded_spindle_speed`` (1/min), ``compensation`` (axis to on or off), ``tool``,
        ``stepping`` (whether a step program waits or runs); ``target`` if one is set (``kind``, and for a plane
        ``inclination`` and ``rotation``, rad).
        """
        return self._facts("state", "time", "position", "running")

    def mount(self, tool: str) -> None:
        """Mount ``"bar"``, ``"sphere"`` or ``"probe"`` in the spindle.

        The probe is mounted automatically for a probing move, and replaced by the bar before the spindle turns.
        """
        self._change("mount", tool=tool)

    def start(self, schedule: Iterable[Any]) -> None:
        """Restart with a cold machine at time 0, with a schedule of events.

        An event has ``time`` (s), and optionally ``spindle_speed`` (1/min) and ``compensation`` (axis to on or off).
        The first sample of the next stream is taken at time 0.

        Raises
        ------
        InstrumentError
            A stream is running, or the machine cannot follow the schedule.
        """
        self._change("start", schedule=self._events(schedule))

    def follow(self, schedule: Iterable[Any], time: float) -> None:
        """Warm up by a schedule from time 0 on, and set the clock to a time, s, which may be earlier than now.

        From then on `spindle` turns the spindle and does not change the heat, and `start` expects a part of this
        schedule: several measurements thus find the machine in the same state at the same time.

        Raises
        ------
        InstrumentError
            A stream is running, the machine is in alarm, or cannot follow the schedule.
        """
        self._change("follow", schedule=self._events(schedule), time=float(time))

    def snapshot(self) -> dict[str, Any]:
        """Return the state of axes at rest and the commands to the machine, for `restore`.

        ``time`` (s), ``position`` (m), ``programs`` (number started), ``readings`` (number by command), ``settings``
        (number of targets), ``tool``, ``noise`` (state of the noise of each device) and ``schedule``.
        """
        return self._facts(
            "snapshot", "time", "position", "programs", "readings", "settings", "tool", "noise", "schedule"
        )

    def restore(
        self,
        time: float,
        position: Sequence[float],
        programs: int,
        readings: int = 0,
        settings: int = 0,
        tool: str = "",
        noise: Mapping[str, Any] | None = None,
        schedule: Iterable[Any] | None = None,
    ) -> None:
        """Set clock, axes and commands as they were in another process at a `snapshot`.

        The times of motions after a command are random. They follow from the number of programs, so that a test that is
        continued in another process equals one without interruption.
        """
        state: dict[str, Any] = {"time": float(time), "position": [float(x) for x in position], "tool": str(tool)}
        state |= {
            "programs": int(programs),
            "readings": int(readings),
            "settings": int(settings),
            "noise": dict(noise or {}),
        }
        self._change("restore", **state, **({} if schedule is None else {"schedule": self._events(schedule)}))

    def elapse(self, seconds: float) -> None:
        """Advance the simulated time without samples."""
        self._call("elapse", seconds=self._interlock.duration(seconds))

    def run_steps(
        self,
        start: Sequence[float],
        direction: Sequence[float],
        step: float,
        count: int,
        dwell: float = 1.0,
        travel: float = 0.1,
    ) -> dict[str, Any]:
        """Step the mounted sphere along a line; return at once.

        The motion starts a short and unknown time after the next sample.

        Parameters
        ----------
        start : (3,)
            Commanded centre of the sphere at the first position, m, in the coordinates of the measuring frame. The
            position of the frame on the machine is unknown to the driver, which therefore only checks the length of the
            path against the limits.
        direction : (3,)
            Direction of the steps.
        step : float
            Distance between two positions, m.
        count : int
            Number of positions.
        dwell, travel : float
            Times at a position and between two positions, s.

        Returns
        -------
        dict
            ``duration`` of the motion and ``longest_lead_in`` before it, s.
        """
        self._interlock.extent([float(step) * (count - 1) * float(u) for u in direction], "steps")
        if not all(math.isfinite(x) for x in start):
            raise InstrumentError(f"Expected a start of three finite numbers; found {start!r}", code="position.form")
        self._interlock.feed(step / travel if travel > 0 else math.nan)
        return self._facts(
            "run_steps",
            "duration",
            start=[float(x) for x in start],
            direction=[float(x) for x in direction],
            step=float(step),
            count=int(count),
            dwell=float(dwell),
            travel=float(travel),
        )

    def run_program(self, text: str) -> dict[str, Any]:
        """Run an NC program; return at once.

        The motion starts a short and unknown time after the command. ``state()["running"]`` is false when it has ended;
        only samples and ``elapse`` advance the simulated time.

        Parameters
        ----------
        text : str
            ISO 6983: G0 and G1 with X, Y, Z (mm) and F (mm/min), G4 P (s), G21, G90, G94, M3 S (1/min) and M5, M30 or
            M2, and comments; also G31, a move that ends where the probe trips, and DPRNT[...], which prints that
            position (#5061 to #5063, mm).

        Returns
        -------
        dict
            ``duration`` of the motion and ``longest_lead_in`` before it, s.

        Raises
        ------
        InstrumentError
            Another program runs, a word is unknown or a position is out of travel: nothing moves, and the message
            states the line.
        """
        check_program(str(text), self._interlock)
        return self._facts("run_program", "duration", text=str(text))

    def move_to(self, position: Sequence[float], feed: float | None = None) -> dict[str, Any]:
        """Move the axes in a straight line.

        The move advances the simulated time by its duration; while sensors stream, their samples advance it, and
        ``state()["running"]`` is false when the move has ended.

        Parameters
        ----------
        position : (3,)
            X, Y, Z, m.
        feed : float, optional
            m/s; default: rapid.

        Returns
        -------
        dict
            ``duration`` of the move, s.

        Raises
        ------
        InstrumentError
            The position is out of travel, or another motion runs: nothing moves.
        """
        goal, limit = self._interlock.position(position), self._interlock.limits.feed
        extra = {} if feed is not None or limit is None else {"feed_limit": limit}
        feed = None if feed is None else self._interlock.feed(feed)
        return self._facts("move_to", "duration", position=goal, feed=feed, **extra)

    def probe(self, target: Sequence[float], feed: float) -> dict[str, Any]:
        """Move the touch probe in a straight line until it trips or reaches the target.

        Parameters
        ----------
        target : (3,)
            Commanded position of the tip, X, Y, Z, m.
        feed : float
            m/s.

        Returns
        -------
        dict
            ``tripped`` (bool), ``position`` (of the tip when it has tripped, m; None when it has not) and ``time`` (s).

        Raises
        ------
        InstrumentError
            The probe is tripped before it moves, the spindle turns, the target is out of travel, alarm or emergency
            stop: nothing moves.
        """
        goal, feed = self._interlock.position(target, "target"), self._interlock.feed(feed)
        facts = self._facts("probe", "tripped", "position", "time", target=goal, feed=feed)
        try:
            position = None if facts["position"] is None else [float(x) for x in facts["position"]]
        except (TypeError, ValueError):
            raise ProtocolError(
                f"Expected a position; found {str(facts['position'])[:200]}", code="protocol.reply.form"
            ) from None
        return {**facts, "position": position}

    def spindle(self, speed: float) -> None:
        """Turn the spindle at a speed in 1/min; 0 stops it.

        Raises
        ------
        InstrumentError
            The speed is too high, or the machine is in alarm or emergency stop.
        """
        self._change("spindle", speed=self._interlock.speed(speed))

    def stop(self, *, spindle: bool = False) -> None:
        """Abort all motion of the axes, and with ``spindle`` also stop the spindle; always permitted."""
        self._call("stop", spindle=bool(spindle))

    def press_estop(self) -> None:
        """Press the emergency stop: axes and spindle stop, and nothing moves until `reset`."""
        self._call("estop")

    def reset(self) -> None:
        """Clear alarm and emergency stop; this starts no motion."""
        self._change("reset")

    def act(self, action: str, **values: Any) -> None:
        """Do what an operator of a real machine would do: ``set_target`` or ``set_station``, with their arguments."""
        if action not in ("set_target", "set_station"):
            raise InstrumentError(f"Expected the action set_target or set_station; found {action!r}", code="event.form")
        self._change(action, **values)

    def set_target(self, kind: str | None, inclination: float | None = None, rotation: float | None = None) -> None:
        """Put a target in front of the point sensors, which are then mounted on the stage.

        Parameters
        ----------
        kind : {"plane", "bar"} or None
            A face of a sine gauge on a turntable, a check bar, or none: the sensors are then those of the frame.
        inclination, rotation : float, optional
            Angles of the gauge and its turntable, rad; for a plane.

        Raises
        ------
        InstrumentError
            A sensor streams, or the target is unknown.
        """
        angles = {"inclination": inclination, "rotation": rotation}
        self._change("set_target", kind=kind, **{name: float(x) for name, x in angles.items() if x is not None})

    def set_station(self, position: Sequence[float]) -> None:
        """Place the laser tracker at a position in machine coordinates, m, to within some millimetres.

        Raises
        ------
        InstrumentError
            No tracker is open, or a sensor streams.
        """
        self._change("set_station", position=[float(x) for x in position])

    def _facts(self, op: str, *required: str, **arguments: Any) -> dict[str, Any]:
        """Return the result of a request, a mapping with the required keys."""
        facts = self._call(op, **arguments) if op in _READING else self._change(op, **arguments)
        if not isinstance(facts, dict) or (missing := [key for key in required if key not in facts]):
            what = ", ".join(missing) if isinstance(facts, dict) else ", ".join(required)
            raise ProtocolError(
                f"The answer to '{op}' lacks {what}; found {str(facts)[:200]}", code="protocol.reply.field"
            )
        return facts

    def _events(self, schedule: Iterable[Any]) -> list[dict[str, Any]]:
        """Return the events of a schedule; InstrumentError unless their spindle speeds are within the limits."""
        events = [event_fields(event) for event in schedule]
        for event in events:
            self._interlock.speed(event.get("spindle_speed", 0.0))
        return events

    def _change(self, op: str, **arguments: Any) -> Any:
        """Send a command that moves or changes the machine."""
        words = ", ".join(f"{name} {value}" for name, value in arguments.items())
        self._interlock.require_armed(self.settings.arm, f"{op.replace('_', ' ')} {words}")
        return self._call(op, **arguments)

    def _call(self, op: str, **arguments: Any) -> Any:
        with self.exchange() as line:
            self._number += 1
            line.write(encode_request(self._number, op, arguments))
            answer = decode_answer(line.read_until(LINE_END, limit=MAX_LINE), self._number)
        return answer.result  # after the block: a refusal is a complete answer

    def _connect(self) -> Transport:
        self._number = 0
        return open_transport(
            self.address,
            simulator=self.info.simulator,
            recorder=self._record,
            timeout=self.settings.timeout,
        )

    def _start_session(self) -> None:
        self.identify()
