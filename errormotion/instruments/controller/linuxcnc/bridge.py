#!/usr/bin/python3
"""Connects LinuxCNC with other programs: JSON lines on a port of this computer.

LinuxCNC's Python module works only in the Python of the system, beside LinuxCNC. This file therefore runs there, as the
``DISPLAY`` of an INI file or as an ``APP`` beside another display, and needs only that Python. A request is
``{"id": 1, "op": "move_to", "position": [0.1, 0, 0]}``, its answer ``{"id": 1, "ok": true, "result": ...}`` or
``{"id": 1, "ok": false, "error": "..."}``. While an order runs, ``{"id": 1, "beat": 7, "time": 3.2}`` is sent five
times a second. Lengths are in m, speeds in m/s, those of spindles in 1/min, times in s since the bridge started;
what is unknown is null. Positions are those of the machine (G53), without any offset of work or tool.

Several clients can be connected. One order at a time moves the machine. An order or program ends with the connection of
its client: if that is lost, the bridge aborts the motion. No request can end the bridge.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import math
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

PORT = 5007
POLL_INTERVAL = 0.01  # s between two checks of an order
BEAT_INTERVAL = 0.2  # s
ACCEPT_TIMEOUT = 5.0  # s for LinuxCNC to accept an order
START_TIMEOUT = 30.0  # s for LinuxCNC to start
REST_TIMEOUT = 0.5  # s for a machine without orders to come to rest
CHANGE_TIMEOUT = 1.0  # s for a change of state or mode
TEXT_TIMEOUT = 0.3  # s for the text of an error to arrive
POSITION_TOLERANCE = 1e-6  # m between goal and final position
MAX_REQUEST_BYTES = 1 << 24  # of one line
MAX_UNREAD_BYTES = 1 << 20  # of answers to one client
AXES = "XYZ"
MODAL_CODES = {200: "G20", 910: "G91", 930: "G93", 950: "G95"}  # modes that an order restores
ORDER_MODES = "G21 G90 G94"  # mm, absolute, mm/min


class RefusedError(Exception):
    """LinuxCNC or the bridge refuses an order."""


class Client:
    """One connection."""

    def __init__(self, writer: asyncio.StreamWriter) -> None:
        self.writer = writer
        self.gone = False
        self.tasks: set[asyncio.Task[None]] = set()

    def send(self, message: dict[str, Any]) -> None:
        """Send a line; ignored for a lost client. A client that does not read is disconnected."""
        if self.gone or self.writer.is_closing():
            return
        self.writer.write(json.dumps(message).encode() + b"\n")
        if self.writer.transport.get_write_buffer_size() > MAX_UNREAD_BYTES:
            self.writer.transport.abort()


class Job:
    """The running order, its client, and the reason of an abort."""

    def __init__(self, client: Client, what: str) -> None:
        self.client = client
        self.what = what
        self.ended_by = ""


class Bridge:
    """Operations of LinuxCNC by request.

    Parameters
    ----------
    linuxcnc, hal : module
        LinuxCNC's two Python modules.
    programs : Path
        Folder for the programs that clients pass on.
    pins : tuple of str
        Prefix of the HAL pins that clients may set.
    load : str
        HAL pin with the load of the spindle, as a fraction of the rated one; empty where there is none.
    """

    def __init__(self, linuxcnc: Any, hal: Any, programs: Path, pins: tuple[str, ...] = (), load: str = "") -> None:
        self.cnc, self.hal = linuxcnc, hal
        self.stat, self.command, self.errors = linuxcnc.stat(), linuxcnc.command(), linuxcnc.error_channel()
        self.programs, self.pins, self.load = programs, pins, load
        self.alarms: list[str] = []
        self.clients: set[Client] = set()
        self.job: Job | None = None
        self.program: Job | None = None
        self.outcome: dict[str, Any] | RefusedError = {"duration": 0.0}  # of the last program
        self._written = 0
        self._stops = 0
        self._began = time.monotonic()
        quick = (self.identify, self.state, self.stop, self.estop, self.reset, self.set_pins)
        waits = (self.elapse, self.finish)
        orders = (self.home, self.enable, self.move_to, self.probe, self.spindle, self.run_program)
        self._quick, self._waits = {each.__name__ for each in quick}, {each.__name__ for each in waits}
        self._work: dict[Any, Callable[..., Any]] = {each.__name__: each for each in (*quick, *waits, *orders)}

    async def await_linuxcnc(self) -> None:
        """Wait until LinuxCNC has started or START_TIMEOUT has passed; until then its state is invalid."""
        until = time.monotonic() + START_TIMEOUT
        while not self.stat.linear_units > 0 and time.monotonic() < until:
            await asyncio.sleep(POLL_INTERVAL)
            self.stat.poll()

    # ------------------------------------------------------------------ requests

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer one client until it disconnects."""
        client = Client(writer)
        self.clients.add(client)
        try:
            while line := await reader.readline():
                await self._take(client, line)
        except ValueError:
            client.send(self._failure(None, f"expected a request of at most {MAX_REQUEST_BYTES} bytes"))
        except OSError:
            pass
        finally:
            client.gone = True
            self.clients.discard(client)
            self._end_jobs("the connection of its client is lost", client)
            writer.close()

    async def _take(self, client: Client, line: bytes) -> None:
        number: Any = None
        try:
            request = json.loads(line)
            number, op = request.pop("id"), request.pop("op")
            work = self._work.get(op)
        except Exception as error:  # noqa: BLE001 - a request must not end the bridge
            client.send(self._failure(number, f"expected a request in JSON: {error!r}"))
            return
        if work is None:
            client.send(self._failure(number, f"unknown operation: {op}"))
        elif op in self._quick:
            client.send(await self._answer(number, partial(work, **request)))
        elif op in self._waits:
            self._in_background(client, self._wait(client, number, partial(work, client, **request)))
        elif busy := self.job or self.program:
            client.send(self._failure(number, f"the machine is busy: {busy.what}"))
        else:
            self.job = Job(client, op.replace("_", " "))
            self._in_background(client, self._order(client, number, partial(work, **request)))

    def _in_background(self, client: Client, work: Any) -> None:
        task = asyncio.ensure_future(work)
        client.tasks.add(task)
        task.add_done_callback(client.tasks.discard)

    async def _order(self, client: Client, number: Any, work: Callable[[], Any]) -> None:
        self.alarms.clear()
        answer = await self._with_beats(client, number, self._answer(number, work))
        if not answer["ok"]:
            self._abort_motion()
        if self.program is None:
            await self._rest()
        self.job = None  # before the answer, which the next order may follow at once
        client.send(answer)

    async def _wait(self, client: Client, number: Any, work: Callable[[], Any]) -> None:
        client.send(await self._with_beats(client, number, self._answer(number, work)))

    async def _with_beats(self, client: Client, number: Any, answer: Any) -> dict[str, Any]:
        beats = asyncio.ensure_future(self._beat(client, number))
        try:
            message: dict[str, Any] = await answer
            return message
        finally:
            beats.cancel()

    async def _beat(self, client: Client, number: Any) -> None:
        count = 0
        while True:
            count += 1
            client.send({"id": number, "beat": count, "time": self.time, "running": bool(self.job or self.program)})
            await asyncio.sleep(BEAT_INTERVAL)

    async def _answer(self, number: Any, work: Callable[[], Any]) -> dict[str, Any]:
        try:
            return {"id": number, "ok": True, "result": await work(), "time": self.time}
        except RefusedError as error:
            return self._failure(number, str(error))
        except Exception as error:  # noqa: BLE001 - wrong arguments, an error of LinuxCNC's module
            return self._failure(number, f"{type(error).__name__}: {error}")

    def _failure(self, number: Any, text: str) -> dict[str, Any]:
        return {"id": number, "ok": False, "error": text, "time": self.time}

    # ------------------------------------------------------------------ state of LinuxCNC

    @property
    def time(self) -> float:
        """Seconds since the bridge started."""
        return time.monotonic() - self._began

    def _look(self) -> None:
        """Read the state and the texts of errors."""
        self.stat.poll()
        while (message := self.errors.poll()) is not None:
            kind, text = message
            if kind in (self.cnc.NML_ERROR, self.cnc.OPERATOR_ERROR):
                self.alarms.append(str(text).strip())
                del self.alarms[:-20]

    @property
    def _unit(self) -> float:
        """Metres in the INI file's unit of length."""
        per_millimetre = float(self.stat.linear_units)
        if not per_millimetre > 0:
            raise RefusedError("LinuxCNC is still starting")
        return 1e-3 / per_millimetre

    def _metres(self, places: Any) -> list[float]:
        return [self._unit * float(x) for x in places[:3]]

    async def identify(self) -> dict[str, Any]:
        """Identify the version of LinuxCNC, the machine's name and its INI file."""
        self._look()
        ini = str(self.stat.ini_filename)
        machine = self.cnc.ini(ini).find("EMC", "MACHINE") if ini else None
        return {
            "manufacturer": "LinuxCNC",
            "model": str(machine or "LinuxCNC"),
            "serial_number": f"{os.uname().nodename}:{ini}",
            "firmware": str(self.cnc.version),
            "travel": self._travel(),
        }

    def _travel(self) -> dict[str, list[float]]:
        limits = [(axis["min_position_limit"], axis["max_position_limit"]) for axis in self.stat.axis[:3]]
        return {name: [self._unit * x for x in pair] for name, pair in zip(AXES, limits)}  # noqa: B905

    async def state(self) -> dict[str, Any]:
        """Return the state of the machine."""
        self._look()
        s = self.stat
        modes = {self.cnc.MODE_MANUAL: "manual", self.cnc.MODE_MDI: "mdi", self.cnc.MODE_AUTO: "automatic"}
        return {
            "time": self.time,
            "position": self._metres(s.actual_position),
            "commanded_position": self._metres(s.position),
            "spindle_speed": self._spindle_speed(),
            "spindle_commanded": float(s.spindle[0]["speed"]),
            "spindle_load": self._pin(self.load),
            "feed": self._unit * float(s.current_vel),
            "mode": modes.get(s.task_mode, ""),
            "program": Path(s.file).name if s.file else "",
            "running": bool(self.job or self.program) or not self._idle(),
            "ordered": bool(self.job or self.program),
            "homed": self._homed(),
            "enabled": s.task_state == self.cnc.STATE_ON,
            "estop": s.task_state == self.cnc.STATE_ESTOP,
            "alarms": list(self.alarms),
        }

    def _spindle_speed(self) -> float:
        """Return the measured speed where HAL has an encoder, else the commanded one; 1/min."""
        pin = "spindle.0.speed-in"
        with contextlib.suppress(Exception):
            if self.hal.pin_has_writer(pin):
                return 60.0 * float(self.hal.get_value(pin))
        return float(self.stat.spindle[0]["speed"])

    def _pin(self, name: str) -> float | None:
        try:
            value = float(self.hal.get_value(name)) if name else math.nan
        except Exception:  # noqa: BLE001 - of a pin that is not there nothing is known
            return None
        return value if math.isfinite(value) else None

    def _homed(self) -> bool:
        joints = int(self.stat.joints)
        return joints > 0 and all(self.stat.homed[:joints])

    def _idle(self) -> bool:
        s = self.stat
        return bool(s.interp_state == self.cnc.INTERP_IDLE and s.queue == 0 and s.inpos)

    # ------------------------------------------------------------------ orders

    async def estop(self) -> None:
        """Press the e-stop."""
        self._end_jobs("e-stop", None, abort=False)
        self.command.state(self.cnc.STATE_ESTOP)
        if not await self._becomes(lambda: self.stat.task_state == self.cnc.STATE_ESTOP):
            raise RefusedError(f"LinuxCNC does not go into e-stop{await self._texts()}")

    async def reset(self) -> None:
        """Release the e-stop and clear the alarms; the machine stays off."""
        self._look()
        if self.stat.task_state == self.cnc.STATE_ESTOP:
            self.command.state(self.cnc.STATE_ESTOP_RESET)
            if not await self._becomes(lambda: self.stat.task_state != self.cnc.STATE_ESTOP):
                raise RefusedError(f"the e-stop cannot be released; check the buttons{await self._texts()}")
        self.alarms.clear()

    async def stop(self, spindle: bool = False) -> None:
        """Abort everything; LinuxCNC's abort stops the spindle as well."""
        self._stops += 1
        self._end_jobs("it was stopped", None)
        if spindle:
            self.command.spindle(self.cnc.SPINDLE_OFF)
        await self._settle("abort")
        await self._rest()

    async def enable(self) -> None:
        """Switch the machine on."""
        self._look()
        if self.stat.task_state == self.cnc.STATE_ESTOP:
            raise RefusedError("the machine is in e-stop; reset it first")
        self.command.state(self.cnc.STATE_ON)
        if not await self._becomes(lambda: self.stat.task_state == self.cnc.STATE_ON):
            raise RefusedError(f"the machine stays off{await self._texts()}")

    async def home(self) -> None:
        """Home all joints; return when all are homed."""
        await self._demand(homed=False)
        await self._mode(self.cnc.MODE_MANUAL)
        self.command.teleop_enable(0)
        await self._settle("joint mode")
        await self._ended(self.job)  # it may have been aborted already
        self.command.home(-1)
        await self._settle("homing")
        while not (self._homed() and self._idle()):
            await self._poll()
            homing = any(joint["homing"] for joint in self.stat.joint[: self.stat.joints])
            if not homing and not self._homed() and (self.alarms or self.stat.state == self.cnc.RCS_ERROR):
                raise RefusedError(f"homing failed{await self._texts()}")
        self.command.teleop_enable(1)
        await self._settle("world mode")

    async def move_to(self, position: Any, feed: Any = None) -> dict[str, Any]:
        """Move in a straight line, at a feed in m/s or in rapid; return when the machine is there."""
        await self._demand()
        goal, words = self._goal(position), _speed(feed)
        began = self.time
        await self._mdi(f"G53 {words} {_axis_words(goal)}")
        await self._require_arrival(goal)
        return {"duration": self.time - began}

    async def probe(self, target: Any, feed: Any) -> dict[str, Any]:
        """Move in a straight line until the probe trips, and return its position."""
        await self._demand()
        goal, words = self._goal(target), _speed(feed, "G38.3")
        if self.stat.probe_val:
            raise RefusedError("the probe is tripped before it moves")
        if math.dist(goal, self._metres(self.stat.position)) < POSITION_TOLERANCE:
            raise RefusedError("the probe is at the target already")
        if self.stat.spindle[0]["direction"]:
            raise RefusedError("the spindle turns; stop it before the machine probes")
        await self._mdi(f"{words} {_axis_words(self._in_work_frame(goal))}")
        if self.stat.probe_tripped:
            return {"tripped": True, "position": self._metres(self.stat.probed_position), "time": self.time}
        await self._require_arrival(goal)
        return {"tripped": False, "position": None, "time": self.time}

    async def spindle(self, speed: Any) -> None:
        """Turn the spindle at a speed in 1/min, backwards where it is negative; 0 stops it."""
        await self._demand(homed=False)
        number = _number(speed, "spindle speed in 1/min")
        await self._mdi("M5" if number == 0 else f"{'M3' if number > 0 else 'M4'} S{abs(number):.3f}")
        if self.stat.state == self.cnc.RCS_ERROR:
            raise RefusedError(f"the spindle does not turn{await self._texts()}")

    async def run_program(self, text: Any) -> dict[str, Any]:
        """Run an NC program; return when it has started."""
        await self._demand()
        if not isinstance(text, str) or not text.strip():
            raise RefusedError("expected the text of a program")
        self._written += 1
        file = self.programs / f"errormotion-{self._written}.ngc"
        file.write_text(text if text.endswith("\n") else text + "\n")
        await self._mode(self.cnc.MODE_AUTO)
        self.command.program_open(str(file))
        await self._settle("opening the program")
        await self._ended(self.job)  # it may have been aborted already
        self.command.auto(self.cnc.AUTO_RUN, 0)
        await self._settle("starting the program", running=True)
        assert self.job is not None
        self.program = Job(self.job.client, f"program {file.name}")
        asyncio.ensure_future(self._follow(self.program, file))  # noqa: RUF006 - ends with the program
        return {"program": file.name, "longest_lead_in": 0.0}

    async def _follow(self, program: Job, file: Path) -> None:
        began = self.time
        try:
            while not await self._ended(program):
                await asyncio.sleep(POLL_INTERVAL)
            if self.alarms or self.stat.state == self.cnc.RCS_ERROR:
                raise RefusedError(f"{program.what} ended early{await self._texts()}")
            self.outcome = {"duration": self.time - began}
        except RefusedError as error:
            self.outcome = error
        except Exception as error:  # noqa: BLE001 - reported when the result is requested
            self.outcome = RefusedError(f"{type(error).__name__}: {error}")
        finally:
            await self._rest()
            self.program = None
            with contextlib.suppress(OSError):
                file.unlink()

    async def finish(self, client: Client) -> dict[str, Any]:
        """Wait for the end of the program, and return its duration."""
        while self.program is not None and not client.gone:
            await asyncio.sleep(POLL_INTERVAL)
        if isinstance(self.outcome, RefusedError):
            raise self.outcome
        return self.outcome

    async def elapse(self, client: Client, seconds: Any) -> None:
        """Let time pass."""
        until, stops = time.monotonic() + _number(seconds, "a time in s", least=0.0), self._stops
        while (left := until - time.monotonic()) > 0 and not client.gone:
            if self._stops != stops:
                raise RefusedError("waiting was stopped")
            await asyncio.sleep(min(left, 0.05))

    async def set_pins(self, pins: dict[str, float]) -> None:
        """Set HAL pins whose names have the prefix `pins`."""
        for name, value in pins.items():
            if not name.startswith(self.pins):
                raise RefusedError(f"the pin {name} is not among those that clients may set")
            self.hal.set_p(name, repr(float(value)))

    # ------------------------------------------------------------------ steps of orders

    async def _demand(self, *, homed: bool = True) -> None:
        """Refuse unless the machine is ready for an order."""
        self._look()
        await self._rest(REST_TIMEOUT)
        if self.stat.task_state == self.cnc.STATE_ESTOP:
            raise RefusedError("the machine is in e-stop; reset it, and enable it again")
        if self.stat.task_state != self.cnc.STATE_ON:
            raise RefusedError("the machine is off; enable it first")
        if homed and not self._homed():
            raise RefusedError("the machine is not homed; home it first")
        if not self._idle():
            raise RefusedError("the machine is busy with a motion that this bridge has not ordered")

    def _goal(self, position: Any) -> list[float]:
        if not isinstance(position, list) or len(position) != 3:
            raise RefusedError(f"expected a position X, Y, Z in m; found {position!r}")
        goal = [_number(x, "a coordinate in m") for x in position]
        for (axis, (low, high)), x in zip(self._travel().items(), goal):  # noqa: B905
            if not low <= x <= high:
                raise RefusedError(f"{axis} travels from {low:g} to {high:g} m; found {x:g}")
        return goal

    def _in_work_frame(self, place: list[float]) -> list[float]:
        """Return a position of the machine in the coordinates in force: G54, G92 and the tool's offset."""
        s = self.stat
        work, extra, tool = (self._metres(offset) for offset in (s.g5x_offset, s.g92_offset, s.tool_offset))
        x, y, z = (p - w - t for p, w, t in zip(place, work, tool))  # noqa: B905
        angle = -math.radians(s.rotation_xy)
        x, y = x * math.cos(angle) - y * math.sin(angle), x * math.sin(angle) + y * math.cos(angle)
        return [x - extra[0], y - extra[1], z - extra[2]]

    async def _mode(self, mode: int) -> None:
        if self.stat.task_mode != mode:
            self.command.mode(mode)
            await self._settle("change of mode")
            if not await self._becomes(lambda: self.stat.task_mode == mode):
                raise RefusedError(f"LinuxCNC does not change its mode{await self._texts()}")

    async def _mdi(self, line: str) -> None:
        """Execute one line in mm and mm/min, then restore the modes."""
        await self._mode(self.cnc.MODE_MDI)
        before = [word for code, word in MODAL_CODES.items() if code in self.stat.gcodes]
        if before:  # on a separate line: a feed on the same line would be read in the previous units
            await self._line(ORDER_MODES)
        await self._line(line)
        if before and self.stat.state != self.cnc.RCS_ERROR:
            await self._line(" ".join(before))

    async def _line(self, line: str) -> None:
        await self._ended(self.job)  # it may have been aborted already
        self.command.mdi(line)
        while not await self._ended(self.job):
            await asyncio.sleep(POLL_INTERVAL)

    async def _ended(self, job: Job | None) -> bool:
        """Whether LinuxCNC has finished the last order; RefusedError where it was aborted."""
        self._look()
        if job is not None and job.ended_by:
            raise RefusedError(f"{job.what} was aborted: {job.ended_by}")
        if self.stat.task_state != self.cnc.STATE_ON:
            what = "e-stop" if self.stat.task_state == self.cnc.STATE_ESTOP else "the machine was switched off"
            raise RefusedError(f"{job.what if job else 'order'} was aborted: {what}{await self._texts()}")
        taken = self.stat.echo_serial_number >= self.command.serial and self.stat.state != self.cnc.RCS_EXEC
        return taken and self._idle()

    async def _poll(self) -> None:
        await asyncio.sleep(POLL_INTERVAL)
        await self._ended(self.job)

    async def _settle(self, what: str, *, running: bool = False) -> None:
        """Wait until LinuxCNC has accepted an order and, unless ``running``, carried it out."""
        until = time.monotonic() + ACCEPT_TIMEOUT
        while True:
            self._look()
            done = running or self.stat.state != self.cnc.RCS_EXEC
            if self.stat.echo_serial_number >= self.command.serial and done:
                return
            if time.monotonic() > until:
                self.command.abort()  # an order that is not accepted now must not be carried out later
                raise RefusedError(f"LinuxCNC does not respond: {what} took more than {ACCEPT_TIMEOUT:g} s")
            await asyncio.sleep(POLL_INTERVAL / 2)

    def _abort_motion(self) -> None:
        """Abort all motion after a failed order."""
        with contextlib.suppress(Exception):
            self._look()
            if self._idle():
                return
        with contextlib.suppress(Exception):  # LinuxCNC has ended: nothing moves
            self.command.abort()

    async def _rest(self, limit: float = ACCEPT_TIMEOUT) -> None:
        """Wait until nothing moves, at most ``limit`` s."""
        until = time.monotonic() + limit
        with contextlib.suppress(Exception):  # LinuxCNC has ended: nothing moves
            while not self._idle() and time.monotonic() < until:
                await asyncio.sleep(POLL_INTERVAL)
                self._look()

    async def _becomes(self, condition: Callable[[], bool]) -> bool:
        """Wait for a condition, at most CHANGE_TIMEOUT; return whether it holds."""
        until = time.monotonic() + CHANGE_TIMEOUT
        while True:
            self._look()
            if condition() or time.monotonic() > until:
                return condition()
            await asyncio.sleep(POLL_INTERVAL)

    async def _require_arrival(self, goal: list[float]) -> None:
        place = self._metres(self.stat.position)
        if math.dist(goal, place) > POSITION_TOLERANCE:
            found = ", ".join(f"{1e3 * x:.4f}" for x in place)
            raise RefusedError(f"the machine has stopped before its goal, at {found} mm{await self._texts()}")

    async def _texts(self) -> str:
        """Return the error texts of LinuxCNC, to be appended to a message."""
        until = time.monotonic() + TEXT_TIMEOUT
        while not self.alarms and time.monotonic() < until:
            await asyncio.sleep(POLL_INTERVAL)
            self._look()
        return f": {'; '.join(self.alarms)}" if self.alarms else ""

    def _end_jobs(self, why: str, client: Client | None, *, abort: bool = True) -> None:
        """Abort order and program, of all clients or of one."""
        ended = [job for job in (self.job, self.program) if job and client in (None, job.client)]
        for job in ended:
            job.ended_by = job.ended_by or why
        if abort and (ended or client is None):
            with contextlib.suppress(Exception):  # LinuxCNC has ended: nothing moves
                self.command.abort()


def _number(value: Any, what: str, least: float = -math.inf) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value) or value < least:
        raise RefusedError(f"expected {what}; found {value!r}")
    return float(value)


def _speed(feed: Any, word: str = "G1") -> str:
    """Return the words of a feed in m/s; of a rapid move without a feed."""
    if feed is None and word == "G1":
        return "G0"
    if (speed := _number(feed, "a feed in m/s")) <= 0:
        raise RefusedError(f"expected a feed above 0 in m/s; found {feed!r}")
    return f"{word} F{speed * 6e4:.6f}"


def _axis_words(place: list[float]) -> str:
    return " ".join(f"{axis}{1e3 * x:.7f}" for axis, x in zip(AXES, place))  # noqa: B905


async def run(bridge: Bridge, port: int, announce: Path | None, idle: float) -> None:
    """Serve until this process is ended, or no client has been connected for ``idle`` s."""
    ended = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        loop.add_signal_handler(number, ended.set)
    await bridge.await_linuxcnc()
    server = await asyncio.start_server(bridge.serve, "127.0.0.1", port, limit=MAX_REQUEST_BYTES)
    port = server.sockets[0].getsockname()[1]
    print(f"errormotion's bridge listens on 127.0.0.1:{port}", flush=True)
    if announce is not None:
        part = announce.with_suffix(".part")
        part.write_text(json.dumps({"port": port, "pid": os.getpid()}))
        part.rename(announce)
    last_client = time.monotonic()
    while not ended.is_set() and time.monotonic() - last_client < idle:
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(ended.wait(), 0.1)
        if bridge.clients:
            last_client = time.monotonic()
    server.close()


def main(words: list[str]) -> int:
    """Run beside LinuxCNC."""
    parser = argparse.ArgumentParser(prog="bridge.py", description="JSON lines between LinuxCNC and errormotion")
    parser.add_argument("-ini", metavar="FILE", help="passed by LinuxCNC to its display; ignored")
    parser.add_argument("--port", type=int, default=PORT, help="port of 127.0.0.1; 0: any free port")
    parser.add_argument("--announce", type=Path, help="file to which port and process are written")
    parser.add_argument(
        "--idle", type=float, default=math.inf, help="time without a client after which the bridge ends, s"
    )
    parser.add_argument("--pins", default="", help="prefix of the HAL pins that clients may set")
    parser.add_argument("--load-pin", default="", help="HAL pin with the load of the spindle, 1 = rated")
    options = parser.parse_args(words)
    import hal
    import linuxcnc

    component = hal.component("errormotion-bridge")  # so that LinuxCNC ends this process with the others
    component.ready()
    pins = tuple(options.pins.split(",")) if options.pins else ()
    with tempfile.TemporaryDirectory(prefix="errormotion-") as folder:
        bridge = Bridge(linuxcnc, hal, Path(folder), pins, options.load_pin)
        asyncio.run(run(bridge, options.port, options.announce, options.idle))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
