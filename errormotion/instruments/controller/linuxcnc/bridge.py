#!/usr/bin/python3
"""Connects LinuxCNC with other programs: JSON lines on a Unix socket, or on a port of this computer.

LinuxCNC's Python module works only in the system's Python, on the computer of LinuxCNC. This file therefore runs there,
as the ``DISPLAY`` of an INI file or as an ``APP`` in addition to another display, and needs only that Python. It is
copied to the machine as a single file and imports nothing of this package: it is therefore not divided into modules. A
request is ``{"id": 1, "op": "move_to", "position": [0.1, 0, 0]}``, its answer ``{"id": 1, "ok": true, "result": ...}``
or ``{"id": 1, "ok": false, "error": "..."}``. While an operation runs, ``{"id": 1, "beat": 7, "time": 3.2}`` is sent
five times a second. Lengths are in m, speeds in m/s, spindle speeds in 1/min, times in s since the start of the bridge;
unknown values are null. Positions are in machine coordinates (G53), without any offset of work, tool or compensation.

The first request of a connection is ``{"id": 0, "op": "hello", "token": "...", "control": true, "client": "NAME"}``
with the token from a file that only the user can read. A connection with another first line, or with a line that is not
a request, is closed. One client at a time controls the machine; the others can read, and stop it. NAME is for messages
only. Connections that state the same random ``"secret"`` are of one client; with the same ``"session"`` as well, the
new one replaces the other, which a cut has ended. The bridge sends no secret. One operation at a time moves the
machine. An operation or program ends with its connection: if this is lost, the bridge aborts the motion. No request can
end the bridge. A bridge with ``--compensate`` permits one client, which states ``"compensate": true`` in its first
request, to set the offset of ``compensation.tcl``; this includes no other right.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import hmac
import json
import math
import os
import secrets
import signal
import socket
import stat
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

PROTOCOL = 2
FOLDER = "~/.errormotion"
SOCKET, TOKEN = f"{FOLDER}/linuxcnc.sock", f"{FOLDER}/linuxcnc.token"
POLL_INTERVAL = 0.01  # s between two checks of an operation
BEAT_INTERVAL = 0.2  # s
ACCEPT_TIMEOUT = 5.0  # s for LinuxCNC to accept a command
START_TIMEOUT = 30.0  # s for LinuxCNC to start
REST_TIMEOUT = 0.5  # s for an idle machine to come to rest
CHANGE_TIMEOUT = 1.0  # s for a change of state or mode
ATTEMPTS = 3  # number of times a command is sent that LinuxCNC may have lost or ignored
TEXT_TIMEOUT = 0.3  # s for the text of an error to arrive
HELLO_TIMEOUT = 5.0  # s from a connection to its first request
POSITION_TOLERANCE = 1e-6  # m between goal and final position
MAX_CLIENTS = 64
MAX_STRANGERS = 16  # connections without a valid first request
STRANGER_TIME = 0.2  # s that each of them has at least, independent of their number
MAX_REQUEST_BYTES = 1 << 16  # of one line
MAX_PROGRAM_BYTES = 1 << 24  # of all parts
MAX_UNREAD_BYTES = 1 << 18  # of answers to one client
MAX_WAITING = 16  # requests of one client that wait
LINES_AT_ONCE = 4  # lines of one client that are processed before those of other clients
CLOSE_TIMEOUT = 1.0  # s for the last answer to be sent
MAX_TASKS = 16  # requests of one client that are in progress
MAX_NAME = 64  # characters of an id or a name
MAX_SECRET = 256  # characters
MAX_TEXT = 500  # characters of an error text
MIN_TOKEN = 32  # characters of a token or a secret
SIGN_INTERVAL = 0.02  # s between two changes of the heartbeat; several servo cycles
THREAD_INTERVAL = 0.02  # s between two checks whether a thread is cut
PROBING = 5  # motion.motion-type
OFFSET_TOLERANCE = 1e-6  # m between LinuxCNC's offset and the one that was set
MAX_FEED = 10.0  # m/s, if LinuxCNC states no limit
MAX_SPINDLE = 1e6  # 1/min, if LinuxCNC states no limit
AXES = "XYZ"
MODAL_CODES = {200: "G20", 910: "G91", 930: "G93", 950: "G95"}  # modes that an operation restores
ORDER_MODES = "G21 G90 G94"  # mm, absolute, mm/min


class RefusedError(Exception):
    """LinuxCNC or the bridge refuses an operation."""


def parse_request(line: bytes) -> tuple[Any, str, dict[str, Any]]:
    """Return id, operation and arguments of a line; ValueError if it is not a request."""
    if len(line) > MAX_REQUEST_BYTES:
        raise ValueError("the line is too long")
    try:
        request = json.loads(line.decode("utf-8"), parse_constant=_no_number)
        number, op = request.pop("id"), request.pop("op")
    except (KeyError, AttributeError, TypeError, RecursionError) as error:
        raise ValueError(repr(error)) from None
    if isinstance(number, bool) or not isinstance(number, (int, str)) or not isinstance(op, str):
        raise ValueError("expected a number or a name as id, and a name as op")
    if len(str(number)) > MAX_NAME or len(op) > MAX_NAME:
        raise ValueError(f"expected id and op of at most {MAX_NAME} characters")
    return number, op, request


def _no_number(text: str) -> None:
    raise ValueError(f"{text} is not a number")


class Client(asyncio.Protocol):
    """One connection.

    Lines are processed as they arrive. A stop is executed at once; all other requests are queued, and no further lines
    are read from a client with too many queued requests.
    """

    def __init__(self, bridge: Bridge) -> None:
        self.bridge = bridge
        self.transport: Any = None
        self.greeted = self.control = self.compensate = self.gone = False
        self.name = ""
        self.secret = b""
        self.session = ""
        self.since = time.monotonic()
        self.program: list[str] = []  # parts of a program received so far
        self.program_size = 0
        self.tasks: set[asyncio.Task[None]] = set()
        self._buffer = bytearray()
        self._reading = False  # whether further lines will be processed soon
        self._waiting: deque[tuple[Any, str, dict[str, Any]]] = deque()
        self._serving: asyncio.Task[None] | None = None
        self._deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        """Wait for the first request, for a limited time."""
        self.transport = transport
        self._deadline = asyncio.get_running_loop().call_later(HELLO_TIMEOUT, self.end)
        self.bridge.arrived(self)

    def connection_lost(self, exc: Any) -> None:  # noqa: ARG002
        """End the operations of the client."""
        self._forget()

    def data_received(self, data: bytes) -> None:
        """Process the lines; close the connection at the first line that is not a request."""
        self._buffer += data
        if len(self._buffer) > MAX_REQUEST_BYTES:
            self.transport.pause_reading()
        if not self._reading:
            self._read()

    def _read(self) -> None:
        """Process some lines; the rest follows after the lines of other clients."""
        self._reading = False
        for _ in range(LINES_AT_ONCE):
            if self.gone or not self._buffer or len(self._waiting) >= MAX_WAITING:
                break
            if self._buffer[:1] != b"{":  # HTTP, TLS, a terminal
                self.end()
                return
            length = self._buffer.find(b"\n", 0, MAX_REQUEST_BYTES + 1)
            if length < 0:
                if len(self._buffer) > MAX_REQUEST_BYTES:
                    self.end(f"expected a request of at most {MAX_REQUEST_BYTES} bytes")
                break
            line = bytes(self._buffer[:length])
            del self._buffer[: length + 1]
            try:
                request = parse_request(line)
            except ValueError:
                self.end("expected a request in JSON")
                return
            self._take(*request)
        else:
            self._reading = True
            asyncio.get_running_loop().call_soon(self._read)
        if not self.gone and len(self._waiting) < MAX_WAITING and len(self._buffer) <= MAX_REQUEST_BYTES:
            self.transport.resume_reading()

    def _take(self, number: Any, op: str, arguments: dict[str, Any]) -> None:
        if op == "hello":
            self.bridge.greet(self, number, arguments)
        elif not self.greeted:
            self.end("expected 'hello' with the token first")
        elif op in ("stop", "estop"):
            self.bridge.begin(self, number, op, arguments)  # before all queued requests
        else:
            self._waiting.append((number, op, arguments))
            if len(self._waiting) >= MAX_WAITING:
                self.transport.pause_reading()
            if self._serving is None:
                self._serving = asyncio.ensure_future(self._serve())

    def discard_program(self) -> None:
        """Discard the parts of a program."""
        self.program.clear()
        self.program_size = 0

    def is_of(self, other: Client) -> bool:
        """Whether both connections are of one client: they state the same secret."""
        return bool(self.secret) and hmac.compare_digest(self.secret, other.secret)

    def welcome(self) -> None:
        """Accept the client."""
        self.greeted = True
        if self._deadline is not None:
            self._deadline.cancel()

    async def _serve(self) -> None:
        """Execute the queued requests; all clients take turns."""
        while self._waiting:
            async with self.bridge.turn:
                number, op, arguments = self._waiting.popleft()
                done = self.bridge.begin(self, number, op, arguments)
                await asyncio.sleep(0)  # data received meanwhile are read before the next turn
            if done is not None and op in self.bridge.in_order:
                await asyncio.wait([done])
            if not self._reading and not self.gone:
                self._read()
        self._serving = None

    def send(self, message: dict[str, Any]) -> None:
        """Send a line; ignored for a lost client. A client that does not read is disconnected."""
        if self.gone or self.transport.is_closing():
            return
        self.transport.write(json.dumps(message).encode() + b"\n")
        if self.transport.get_write_buffer_size() > MAX_UNREAD_BYTES:
            self.transport.abort()

    def end(self, why: str = "") -> None:
        """Close the connection; nothing further is read from it."""
        if self.gone:
            return
        if why:
            self.send({"id": None, "ok": False, "error": why, "time": self.bridge.time})
        self._forget()
        self.transport.close()
        asyncio.get_running_loop().call_later(CLOSE_TIMEOUT, self.transport.abort)

    def _forget(self) -> None:
        self.gone = True
        self._buffer.clear()
        self._waiting.clear()
        if self._deadline is not None:
            self._deadline.cancel()
        if self._serving is not None:
            self._serving.cancel()
        self.bridge.left(self)


class Sender(asyncio.Protocol):
    """Sends commands to LinuxCNC from a separate process.

    LinuxCNC's module waits until a command is accepted, 10 to 100 ms, and blocks the process. There is one process for
    operations and one for stops, so that a stop is never delayed. Senders must be created before any thread or socket.
    """

    def __init__(self) -> None:
        self._line, theirs = socket.socketpair()
        self.pid = os.fork()
        if self.pid == 0:
            self._line.close()
            with contextlib.suppress(BaseException):
                _obey(theirs)
            os._exit(0)
        theirs.close()
        self._transport: Any = None
        self._buffer = b""
        self._sent: deque[asyncio.Future[int]] = deque()
        self.when_lost: Callable[[], Any] = lambda: None

    async def connect(self, when_lost: Callable[[], Any]) -> None:
        """Connect to the process; ``when_lost`` is called when it has ended."""
        self.when_lost = when_lost
        await asyncio.get_running_loop().create_connection(lambda: self, sock=self._line)

    def connection_made(self, transport: Any) -> None:
        """Store the connection."""
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        """Process the results of commands, in their order."""
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        for line in lines:
            number, error = json.loads(line)
            done = self._sent.popleft()
            if done.cancelled():
                continue
            if error:
                done.set_exception(RefusedError(error))
            else:
                done.set_result(number)

    def connection_lost(self, exc: Any) -> None:  # noqa: ARG002
        """Set an error for all commands in progress."""
        self._transport = None
        while self._sent:
            done = self._sent.popleft()
            if not done.done():
                done.set_exception(RefusedError(_NO_SENDER))
        self.when_lost()

    def send(self, name: str, *arguments: Any) -> asyncio.Future[int]:
        """Send a command at once; the result is its serial number, once LinuxCNC has accepted it."""
        done: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        done.add_done_callback(lambda each: each.cancelled() or each.exception())  # also if its result is not used
        if self._transport is None:
            done.set_exception(RefusedError(_NO_SENDER))
        else:
            self._sent.append(done)
            self._transport.write(json.dumps([name, arguments]).encode() + b"\n")
        return done


_NO_SENDER = "the process that sends commands to LinuxCNC has ended"


def _obey(line: socket.socket) -> None:
    """Send the commands that arrive to LinuxCNC, until the bridge ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    command: Any = None
    with line.makefile("rwb") as file:
        for request in file:
            name, arguments = json.loads(request)
            error = ""
            try:
                if command is None:
                    import linuxcnc

                    command = linuxcnc.command()
                getattr(command, name)(*arguments)
            except Exception as found:  # noqa: BLE001 - reported as the error of the operation
                error = f"{type(found).__name__}: {found}"
            file.write(json.dumps([getattr(command, "serial", 0), error]).encode() + b"\n")
            file.flush()


class Job:
    """The running operation, its client, and the reason of an abort."""

    def __init__(self, client: Client, what: str) -> None:
        self.client = client
        self.what = what
        self.ended_by = ""


class Offsets:
    """The offset of ``compensation.tcl``: requested and effective values, and why it must not change.

    Limit, slew limit, hold and watchdog are in the servo thread, and work without this process. Offsets are also
    checked here.

    Parameters
    ----------
    hal : module
        LinuxCNC's module.
    """

    def __init__(self, hal: Any) -> None:
        self.hal = hal
        self._signed = -math.inf  # time of the last change of the heartbeat

    @property
    def route(self) -> str:
        """``external``, ``feedback``, or empty if ``compensation.tcl`` is not loaded."""
        for route, pin in (("external", "errormotion-counts-x.out"), ("feedback", "errormotion-limit-x.out")):
            with contextlib.suppress(Exception):
                self.hal.get_value(pin)
                return route
        return ""

    def state(self, unit: float) -> dict[str, Any]:
        """Return limits and offset, m, and why the offset must not change; ``unit`` is LinuxCNC's unit of length, m."""
        route = self.route
        if not route:
            raise RefusedError("LinuxCNC has not loaded compensation.tcl; add it to the INI file")
        before = self._three("errormotion-limit-{}.out")
        offset, asked = before, before
        if route == "external":
            # The servo thread runs meanwhile: both are compared with the values planned before and after.
            offset, asked = self._three("axis.{}.eoffset"), self._three("axis.{}.eoffset-request")
        planned = [before, self._three("errormotion-limit-{}.out")]
        return {
            "route": route,
            "offset": [unit * x for x in offset],
            "limit": unit * min(self._get(f"errormotion-limit-{each}.max") for each in "xyz"),
            "slew": unit * self._get("errormotion-slew.in0"),
            "watchdog": self._get("errormotion-alive.width"),
            "alive": bool(self._get("errormotion-alive.out")),
            "busy": self._busy(route, unit * _distance(offset, planned)),
            "fault": self._fault(unit * _distance(asked, planned)),
        }

    def set(self, offset: Any, unit: float) -> None:
        """Set the requested offset, m, and change the heartbeat."""
        state = self.state(unit)
        if not isinstance(offset, list) or len(offset) != len(AXES):
            raise RefusedError(f"expected an offset of X, Y, Z in m; found {str(offset)[:MAX_NAME]}")
        goal = [_number(x, "an offset in m") for x in offset]
        if state["fault"]:
            raise RefusedError(state["fault"])
        most = state["slew"] * state["watchdog"] + OFFSET_TOLERANCE
        for axis, x, now in zip(AXES, goal, state["offset"]):  # noqa: B905
            if abs(x) > state["limit"] * (1 + 1e-9):
                raise RefusedError(
                    f"expected an offset of at most {1e6 * state['limit']:g} um; found {axis} {1e6 * x:g}"
                )
            if abs(x - now) > most:
                raise RefusedError(
                    f"{axis} {1e6 * x:g} um is a change of {1e6 * abs(x - now):.3g} um; the slew limit permits "
                    f"{1e6 * most:.3g} um until the watchdog acts"
                )
        for each, x in zip("xyz", goal):  # noqa: B905
            self.hal.set_p(f"errormotion-source-{each}.in1", repr(x / unit))
        if time.monotonic() - self._signed > SIGN_INTERVAL:  # two changes in one servo cycle would cancel each other
            self._signed = time.monotonic()
            self.hal.set_p("errormotion-sign.in0", str(int(not self._get("errormotion-sign.in0"))))

    def hold(self) -> None:
        """Hold the offset for the next 3 s, while a thread is cut."""
        self.hal.set_p("errormotion-thread.in", str(int(not self._get("errormotion-thread.in"))))

    def spindle_leads(self) -> bool:
        """Whether the axes follow the spindle, or wait for its index: G33, G33.1, G76, G95."""
        return bool(self._get("motion.debug-float-1") or self._get("spindle.0.index-enable"))

    def _get(self, pin: str) -> float:
        return float(self.hal.get_value(pin))

    def _three(self, pin: str) -> list[float]:
        return [self._get(pin.format(each)) for each in "xyz"]

    def _busy(self, route: str, behind: float) -> str:
        if self._get("errormotion-motion.out5"):
            return "the machine probes"
        if self._get("errormotion-thread.out"):
            return "a thread is cut"
        if self._get("errormotion-hold-2.in1"):
            return "the program holds the offset"
        if route == "external" and (self._get("motion.eoffset-limited") or behind > OFFSET_TOLERANCE):
            return "LinuxCNC limits the offset at an end of travel"
        return ""

    def _fault(self, wrong: float) -> str:
        if not self._get("motion.motion-enabled"):
            return "the machine is off or in e-stop"
        if not self._get("motion.is-all-homed"):
            return "the machine is not homed"
        if wrong > OFFSET_TOLERANCE:
            return (
                f"LinuxCNC has an external offset that differs by {1e6 * wrong:.3g} um from the one set here: another "
                "program, or an end of travel; switch the machine off and on"
            )
        return ""


def _distance(values: list[float], bounds: list[list[float]]) -> float:
    """Return the largest distance of a value from the interval between its two bounds; 0 within it."""
    first, second = bounds
    return max(max(min(a, b) - x, x - max(a, b), 0.0) for x, a, b in zip(values, first, second))  # noqa: B905


class Bridge:
    """Operations of LinuxCNC by request.

    Parameters
    ----------
    linuxcnc, hal : module
        LinuxCNC's two Python modules.
    orders, stops : Sender
        Processes that send commands to LinuxCNC.
    programs : Path
        Folder for the programs of clients.
    pins : tuple of str
        Prefixes of the HAL pins that clients may set.
    load : str
        HAL pin with the load of the spindle, as a fraction of the rated load; empty: none.
    compensates : bool
        Whether one client may set the offset of ``compensation.tcl``.
    token : str
        Token that the first request of a client must contain.
    """

    def __init__(
        self,
        linuxcnc: Any,
        hal: Any,
        orders: Sender,
        stops: Sender,
        programs: Path,
        pins: tuple[str, ...] = (),
        load: str = "",
        *,
        compensates: bool = False,
        token: str,
    ) -> None:
        if len(token) < MIN_TOKEN:
            raise ValueError(f"expected a token of at least {MIN_TOKEN} characters")
        self.cnc, self.hal = linuxcnc, hal
        self.stat, self.errors = linuxcnc.stat(), linuxcnc.error_channel()
        self.orders, self.stops = orders, stops
        self._serial = 0  # of the last command that LinuxCNC has accepted
        self.programs, self.load = programs, load
        self.pins = tuple(pin for pin in (each.strip() for each in pins) if pin)
        self.offsets = Offsets(hal)
        self.compensates = compensates
        self.turn = asyncio.Lock()
        self._token = token.encode()
        self.alarms: list[str] = []
        self.clients: dict[Client, None] = {}  # in the order of their arrival
        self.job: Job | None = None
        self.program: Job | None = None
        self.outcome: dict[str, Any] | RefusedError = {"duration": 0.0}  # of the last program
        self._probed_with = [0.0, 0.0, 0.0]  # external offset of the last probing, m; held during it
        self._written = 0
        self._stops = 0
        self._stopping: dict[str, asyncio.Future[int]] = {}  # stops in progress, which further ones join
        self._began = time.monotonic()
        reads = (self.identify, self.state, self.elapse, self.finish, self.stop, self.estop, self.offset)
        changes = (self.reset, self.set_pins, self.program_part)
        moves = (self.home, self.enable, self.move_to, self.probe, self.spindle, self.run_program)
        every = (*reads, *changes, *moves, self.set_offset)
        self._work: dict[str, Callable[..., Any]] = {each.__name__: each for each in every}
        self._waits, self._orders = {"elapse", "finish"}, {each.__name__ for each in moves}
        self._reads = {each.__name__ for each in reads}
        self._of_client = {"elapse", "finish", "program_part", "run_program"}
        self.in_order = (
            {*self._work} - self._waits - self._orders
        )  # answered before the next request of the client starts

    async def await_linuxcnc(self) -> None:
        """Wait until LinuxCNC has started or START_TIMEOUT has passed; until then its state is invalid."""
        until = time.monotonic() + START_TIMEOUT
        while not self.stat.linear_units > 0 and time.monotonic() < until:
            await asyncio.sleep(POLL_INTERVAL)
            self.stat.poll()

    # ------------------------------------------------------------------ requests

    def arrived(self, client: Client) -> None:
        """Register a connection. Of too many strangers the oldest is disconnected."""
        strangers = self._strangers()
        if len(strangers) >= MAX_STRANGERS:
            strangers[0].end()
        self.clients[client] = None

    def crowded(self) -> bool:
        """Whether so many new connections without a valid request exist that the next one has to wait."""
        strangers = self._strangers()
        return len(strangers) >= MAX_STRANGERS and time.monotonic() - strangers[0].since < STRANGER_TIME

    def _strangers(self) -> list[Client]:
        return [each for each in self.clients if not each.greeted]

    def left(self, client: Client) -> None:
        """Remove a connection, and end its motions."""
        if client in self.clients:
            del self.clients[client]
            self._end_jobs("the connection of its client is lost", client)

    def greet(self, client: Client, number: Any, arguments: dict[str, Any]) -> None:
        """Accept a client with the token; grant it control of the machine if no other client has it."""
        token, name = arguments.get("token"), arguments.get("client", "")
        given = token.encode("utf-8", "replace") if isinstance(token, str) else b""
        if not hmac.compare_digest(given, self._token):
            client.end("the token is not valid for this bridge")
            return
        if not isinstance(name, str) or len(name) > MAX_NAME or not isinstance(arguments.get("control"), bool):
            client.end(f"expected 'control', true or false, and a name of at most {MAX_NAME} characters as 'client'")
            return
        if not isinstance(arguments.get("compensate", False), bool):
            client.end("expected 'compensate', true or false")
            return
        secret, session = arguments.get("secret", ""), arguments.get("session", "")
        if not isinstance(secret, str) or (secret and not MIN_TOKEN <= len(secret) <= MAX_SECRET):
            client.end(f"expected a random text of {MIN_TOKEN} to {MAX_SECRET} characters as 'secret', or none")
            return
        if not isinstance(session, str) or len(session) > MAX_NAME:
            client.end(f"expected a name of at most {MAX_NAME} characters as 'session'")
            return
        if not client.greeted and sum(each.greeted for each in self.clients) >= MAX_CLIENTS:
            client.end(f"{MAX_CLIENTS} clients are already connected")
            return
        client.welcome()
        client.name, client.control, client.compensate = name, False, False
        client.secret, client.session = secret.encode("utf-8", "surrogatepass"), session
        for lost in [each for each in self.clients if each is not client and each.session == session != ""]:
            if client.is_of(lost):
                lost.end("its client has connected again")
        holder = next((each for each in self.clients if each.control), None)
        client.control = arguments["control"] and (holder is None or client.is_of(holder))
        other = next((each for each in self.clients if each.compensate), None)
        asked = arguments.get("compensate", False) and self.compensates
        client.compensate = asked and (other is None or client.is_of(other))
        result = {
            "protocol": PROTOCOL,
            "control": client.control,
            "controlled_by": None if holder is None else holder.name,
            "compensate": client.compensate,
            "compensated_by": None if other is None else other.name,
        }
        client.send({"id": number, "ok": True, "result": result, "time": self.time})

    def begin(self, client: Client, number: Any, op: str, arguments: dict[str, Any]) -> asyncio.Task[None] | None:
        """Start a request; return the task that answers it, None if it has been answered."""
        work = self._work.get(op)
        if work is None:
            client.send(self._failure(number, f"unknown operation: {op}"))
        elif op == "set_offset" and not client.compensate:
            client.send(self._failure(number, self._no_compensation()))
        elif op not in self._reads and op != "set_offset" and not client.control:
            client.send(
                self._failure(
                    number, "this client only reads: another one controls the machine, or it did not request control"
                )
            )
        elif len(client.tasks) >= MAX_TASKS:
            client.send(
                self._failure(number, f"{MAX_TASKS} requests of this client are in progress; wait for an answer")
            )
        elif op in self._orders and (busy := self.job or self.program):
            client.send(self._failure(number, f"the machine is busy: {busy.what}"))
        else:
            bound = partial(work, client, **arguments) if op in self._of_client else partial(work, **arguments)
            if op in self._orders:
                self.job = Job(client, op.replace("_", " "))
                return self._in_background(client, self._order(client, number, bound))
            answer = self._wait if op in self._waits else self._reply
            return self._in_background(client, answer(client, number, bound))
        return None

    def _no_compensation(self) -> str:
        if not self.compensates:
            return "the bridge was started without --compensate"
        return "this client does not compensate: another one does, or it did not request the right"

    def _in_background(self, client: Client, work: Any) -> asyncio.Task[None]:
        task: asyncio.Task[None] = asyncio.ensure_future(work)
        client.tasks.add(task)
        task.add_done_callback(client.tasks.discard)
        return task

    async def _reply(self, client: Client, number: Any, work: Callable[[], Any]) -> None:
        client.send(await self._answer(number, work))

    async def _order(self, client: Client, number: Any, work: Callable[[], Any]) -> None:
        self.alarms.clear()
        answer = await self._with_beats(client, number, self._answer(number, work))
        if not answer["ok"]:
            await self._abort_motion()
        if self.program is None:
            await self._rest()
        self.job = None  # before the answer, which the next operation may follow at once
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
        """Time since the start of the bridge, s."""
        return time.monotonic() - self._began

    def _poll_state(self) -> None:
        """Read the state and the texts of errors."""
        self.stat.poll()
        while (message := self.errors.poll()) is not None:
            kind, text = message
            if kind in (self.cnc.NML_ERROR, self.cnc.OPERATOR_ERROR):
                self.alarms.append(str(text).strip()[:MAX_TEXT])
                del self.alarms[:-20]

    @property
    def _unit(self) -> float:
        """Unit of length of the INI file, m."""
        per_millimetre = float(self.stat.linear_units)
        if not per_millimetre > 0:
            raise RefusedError("LinuxCNC is still starting")
        return 1e-3 / per_millimetre

    def _metres(self, values: Any) -> list[float]:
        return [self._unit * float(x) for x in values[:3]]

    def _without_offset(self, position: Any) -> list[float]:
        """Return a position of LinuxCNC, m, without the external offset, which LinuxCNC adds to the commanded position.

        The offset may have changed since the state was read. LinuxCNC subtracts it from its command in the servo cycle.
        """
        place = self._metres(position)
        with contextlib.suppress(Exception):  # LinuxCNC 2.7 has no external offset
            command = self._metres([self.hal.get_value(f"axis.{each}.pos-cmd") for each in "xyz"])
            lag = [x - y for x, y in zip(place, self._metres(self.stat.position))]  # noqa: B905
            return [x + y for x, y in zip(command, lag)]  # noqa: B905
        return place

    def _external(self) -> list[float]:
        """Return the external offset, m."""
        with contextlib.suppress(Exception):  # LinuxCNC 2.7 has none
            return self._metres([self.hal.get_value(f"axis.{each}.eoffset") for each in "xyz"])
        return [0.0, 0.0, 0.0]

    async def identify(self) -> dict[str, Any]:
        """Return the version of LinuxCNC, the name of the machine, and its INI file."""
        self._poll_state()
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
        self._poll_state()
        s = self.stat
        modes = {self.cnc.MODE_MANUAL: "manual", self.cnc.MODE_MDI: "mdi", self.cnc.MODE_AUTO: "automatic"}
        return {
            "time": self.time,
            "position": self._without_offset(s.actual_position),
            "commanded_position": self._without_offset(s.position),
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
        """Return the measured speed if HAL has an encoder, else the commanded speed; 1/min."""
        pin = "spindle.0.speed-in"
        with contextlib.suppress(Exception):
            if self.hal.pin_has_writer(pin):
                return 60.0 * float(self.hal.get_value(pin))
        return float(self.stat.spindle[0]["speed"])

    def _pin(self, name: str) -> float | None:
        try:
            value = float(self.hal.get_value(name)) if name else math.nan
        except Exception:  # noqa: BLE001 - the value of a missing pin is unknown
            return None
        return value if math.isfinite(value) else None

    def _homed(self) -> bool:
        joints = int(self.stat.joints)
        return joints > 0 and all(self.stat.homed[:joints])

    def _idle(self) -> bool:
        s = self.stat
        return bool(s.interp_state == self.cnc.INTERP_IDLE and s.queue == 0 and s.inpos)

    # ------------------------------------------------------------------ operations

    async def estop(self) -> None:
        """Send the e-stop to LinuxCNC, which takes about 0.1 s; its state reports when it is in e-stop."""
        self._end_jobs("e-stop", None, abort=False)
        if "estop" not in self._stopping:
            sent = self.stops.send("state", self.cnc.STATE_ESTOP)
            self._under_way("estop", asyncio.ensure_future(self._pressed(sent)))

    async def _pressed(self, sent: asyncio.Future[int]) -> int:
        """Wait until LinuxCNC is in e-stop; a command of another process may have replaced the first one."""
        with contextlib.suppress(Exception):  # LinuxCNC has ended: nothing moves
            for _ in range(ATTEMPTS):
                self._serial = max(self._serial, await sent)
                if await self._becomes(lambda: self.stat.task_state == self.cnc.STATE_ESTOP):
                    return self._serial
                sent = self.stops.send("state", self.cnc.STATE_ESTOP)
            self.alarms.append("LinuxCNC does not go into e-stop")
        return self._serial

    def _abort(self) -> asyncio.Future[int]:
        """Send an abort at once, unless one is in progress; return a future of its acceptance by LinuxCNC."""
        return self._stopping.get("abort") or self._under_way("abort", self.stops.send("abort"))

    def _under_way(self, what: str, stop: asyncio.Future[int]) -> asyncio.Future[int]:
        """Register a stop, which further ones of its type join, and for which the next operation waits."""
        self._stopping[what] = stop
        stop.add_done_callback(lambda _: self._stopping.pop(what, None))
        return stop

    async def _stopped(self) -> None:
        """Wait until LinuxCNC has accepted the stops in progress."""
        while self._stopping:
            await asyncio.wait(list(self._stopping.values()))

    async def reset(self) -> None:
        """Release the e-stop and clear the alarms; the machine remains off."""
        await self._stopped()
        self._poll_state()
        if self.stat.task_state == self.cnc.STATE_ESTOP:
            await self._send("state", self.cnc.STATE_ESTOP_RESET)
            if not await self._becomes(lambda: self.stat.task_state != self.cnc.STATE_ESTOP):
                raise RefusedError(f"the e-stop cannot be released; check the buttons{await self._texts()}")
        self.alarms.clear()

    async def stop(self, spindle: bool = False) -> None:
        """Abort all motion; LinuxCNC's abort also stops the spindle."""
        self._stops += 1
        self._end_jobs("it was stopped", None, abort=False)
        accepted = self._abort()
        if spindle:
            self.stops.send("spindle", self.cnc.SPINDLE_OFF)
        self._serial = max(self._serial, await asyncio.shield(accepted))
        await self._settle("abort")
        until = time.monotonic() + ACCEPT_TIMEOUT
        while (self.job or self.program) and time.monotonic() < until:  # an operation that was started meanwhile
            await asyncio.sleep(POLL_INTERVAL)
        await self._rest()

    async def enable(self) -> None:
        """Switch the machine on."""
        await self._stopped()
        self._poll_state()
        if self.stat.task_state == self.cnc.STATE_ESTOP:
            raise RefusedError("the machine is in e-stop; reset it first")
        for _ in range(ATTEMPTS):  # LinuxCNC ignores the first one while the e-stop is being released
            await self._send("state", self.cnc.STATE_ON)
            if await self._becomes(lambda: self.stat.task_state in (self.cnc.STATE_ON, self.cnc.STATE_ESTOP)):
                break
            if self.job is not None and self.job.ended_by:
                raise RefusedError(f"enable was aborted: {self.job.ended_by}")
        if self.stat.task_state != self.cnc.STATE_ON:
            raise RefusedError(f"the machine remains off{await self._texts()}")

    async def home(self) -> None:
        """Home all joints; return when all are homed."""
        await self._require_ready(homed=False)
        await self._mode(self.cnc.MODE_MANUAL)
        await self._send("teleop_enable", 0)
        await self._settle("joint mode")
        await self._ended(self.job)  # it may have been aborted already
        await self._send("home", -1)
        await self._settle("homing")
        while not (self._homed() and self._idle()):
            await self._poll()
            homing = any(joint["homing"] for joint in self.stat.joint[: self.stat.joints])
            if not homing and not self._homed() and (self.alarms or self.stat.state == self.cnc.RCS_ERROR):
                raise RefusedError(f"homing failed{await self._texts()}")
        await self._send("teleop_enable", 1)
        await self._settle("world mode")

    async def move_to(self, position: Any, feed: Any = None, feed_limit: Any = None) -> dict[str, Any]:
        """Move in a straight line, at a feed in m/s or in rapid; return when the machine has arrived.

        A rapid move that would exceed ``feed_limit``, m/s, is made at this feed.
        """
        await self._require_ready()
        goal, words = self._goal(position), "G0"
        if feed is not None:
            words = f"G1 {self._feed(feed)}"
        elif feed_limit is not None and _number(feed_limit, "a feed in m/s") < self._fastest():
            words = f"G1 {self._feed(feed_limit)}"
        began = self.time
        await self._mdi(f"G53 {words} {_axis_words(goal)}")
        await self._require_arrival(goal)
        return {"duration": self.time - began}

    async def probe(self, target: Any, feed: Any) -> dict[str, Any]:
        """Move in a straight line until the probe trips, and return its position."""
        await self._require_ready()
        goal, words = self._goal(target), f"G38.3 {self._feed(feed)}"
        if self.stat.probe_val:
            raise RefusedError("the probe is tripped before it moves")
        if math.dist(goal, self._without_offset(self.stat.position)) < POSITION_TOLERANCE:
            raise RefusedError("the probe is already at the target")
        if self.stat.spindle[0]["direction"]:
            raise RefusedError("the spindle turns; stop it before the machine probes")
        self._probed_with = self._external()
        await self._mdi(f"{words} {_axis_words(self._in_work_frame(goal))}")
        if self.stat.probe_tripped:
            found = self._metres(self.stat.probed_position)
            position = [x - offset for x, offset in zip(found, self._probed_with)]  # noqa: B905
            return {"tripped": True, "position": position, "time": self.time}
        await self._require_arrival(goal)
        return {"tripped": False, "position": None, "time": self.time}

    async def spindle(self, speed: Any) -> None:
        """Turn the spindle at a speed in 1/min, negative for reverse, 0 to stop it."""
        await self._require_ready(homed=False)
        number, most = _number(speed, "spindle speed in /min"), self._fastest_spindle(speed)
        if abs(number) > most:
            raise RefusedError(f"expected a spindle speed of at most {most:g} /min; found {number:g} /min")
        await self._mdi("M5" if number == 0 else f"{'M3' if number > 0 else 'M4'} S{abs(number):.3f}")
        if self.stat.state == self.cnc.RCS_ERROR:
            raise RefusedError(f"the spindle does not turn{await self._texts()}")

    async def program_part(self, client: Client, text: Any) -> None:
        """Store a part of a long program; `run_program` receives the last one. An empty part discards earlier ones."""
        if not isinstance(text, str):
            raise RefusedError("expected the text of a part of a program")
        if not text:
            client.discard_program()
        client.program.append(text)
        client.program_size += len(text)
        if client.program_size > MAX_PROGRAM_BYTES:
            client.discard_program()
            raise RefusedError(f"expected a program of at most {MAX_PROGRAM_BYTES} bytes")

    async def run_program(self, client: Client, text: Any, machine_coordinates: Any = False) -> dict[str, Any]:
        """Run an NC program, with the parts received before; return when it has started.

        With ``machine_coordinates`` it is refused while an offset of work or tool, or a rotation, is in effect.
        """
        parts = client.program.copy()
        client.discard_program()
        await self._require_ready()
        if not isinstance(text, str):
            raise RefusedError("expected the text of a program")
        text = "".join([*parts, text])
        if not text.strip():
            raise RefusedError("expected the text of a program")
        s = self.stat
        if machine_coordinates and any([*s.g5x_offset, *s.g92_offset, *s.tool_offset, s.rotation_xy]):
            raise RefusedError(
                "an offset of work or tool is in effect: the program would not run in machine coordinates"
            )
        self._written += 1
        file = self.programs / f"errormotion-{self._written}.ngc"
        file.write_text(text if text.endswith("\n") else text + "\n")
        await self._mode(self.cnc.MODE_AUTO)
        await self._send("program_open", str(file))
        await self._settle("opening the program")
        await self._ended(self.job)  # it may have been aborted already
        await self._send("auto", self.cnc.AUTO_RUN, 0)
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
            await self._abort_motion()
        except Exception as error:  # noqa: BLE001 - reported when the result is requested
            self.outcome = RefusedError(f"{type(error).__name__}: {error}")
            await self._abort_motion()
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
        """Wait."""
        until, stops = time.monotonic() + _number(seconds, "a time in s", least=0.0), self._stops
        while (left := until - time.monotonic()) > 0 and not client.gone:
            if self._stops != stops:
                raise RefusedError("waiting was stopped")
            await asyncio.sleep(min(left, 0.05))

    async def set_pins(self, pins: Any) -> None:
        """Set HAL pins whose names have a prefix of `pins`."""
        values = {str(name): _number(value, f"a value of the pin {name}") for name, value in dict(pins).items()}
        for name in values:
            if not self.pins or not name.startswith(self.pins) or name.startswith("errormotion-"):
                raise RefusedError(f"the pin {name} is not among those that clients may set")
        for name, value in values.items():
            self.hal.set_p(name, repr(value))

    # ------------------------------------------------------------------ compensation

    async def offset(self) -> dict[str, Any]:
        """Return the offset in effect, its limits, and why it must not change."""
        self._poll_state()
        holder = next((each.name for each in self.clients if each.compensate), None)
        return {**self.offsets.state(self._unit), "by": holder}

    async def set_offset(self, offset: Any) -> None:
        """Set the offset of X, Y, Z, m; each request is also a heartbeat for the watchdog in the servo thread."""
        self._poll_state()
        self.offsets.set(offset, self._unit)

    async def watch_threads(self) -> None:
        """Hold the offset while a thread is cut."""
        while self.offsets.route:
            with contextlib.suppress(Exception):  # LinuxCNC has ended, or is still starting
                if self.offsets.spindle_leads():
                    self.offsets.hold()
            await asyncio.sleep(THREAD_INTERVAL)

    # ------------------------------------------------------------------ steps of operations

    async def _require_ready(self, *, homed: bool = True) -> None:
        """Refuse unless the machine is ready for an operation."""
        await self._stopped()
        self._poll_state()
        await self._rest(REST_TIMEOUT)
        if self.stat.task_state == self.cnc.STATE_ESTOP:
            raise RefusedError("the machine is in e-stop; reset it, and enable it again")
        if self.stat.task_state != self.cnc.STATE_ON:
            raise RefusedError("the machine is off; enable it first")
        if homed and not self._homed():
            raise RefusedError("the machine is not homed; home it first")
        if not self._idle():
            raise RefusedError("the machine is busy with a motion that this bridge has not started")

    def _goal(self, position: Any) -> list[float]:
        if not isinstance(position, list) or len(position) != 3:
            raise RefusedError(f"expected a position X, Y, Z in m; found {position!r}")
        goal = [_number(x, "a coordinate in m") for x in position]
        for (axis, (low, high)), x in zip(self._travel().items(), goal):  # noqa: B905
            if not low <= x <= high:
                raise RefusedError(f"{axis} travels from {low:g} to {high:g} m; found {x:g}")
        return goal

    def _feed(self, feed: Any) -> str:
        """Return the F word for a feed in m/s; refuse more than the feed of the INI file."""
        speed, most = _number(feed, "a feed in m/s"), self._fastest()
        if not 0 < speed <= most * (1 + 1e-6):
            raise RefusedError(f"expected a feed above 0 and at most {most:g} m/s; found {feed!r}")
        word = f"F{speed * 6e4:.6f}"
        if not float(word[1:]) > 0:
            raise RefusedError(f"expected a feed of at least 1e-6 mm/min; found {feed!r} m/s")
        return word

    def _fastest(self) -> float:
        """Return the highest feed of the INI file, m/s."""
        stated = float(getattr(self.stat, "max_velocity", 0.0)) * self._unit
        return stated if 0 < stated < MAX_FEED else MAX_FEED

    def _fastest_spindle(self, speed: float) -> float:
        """Return the highest speed of the spindle in the INI file, 1/min."""
        name = "MAX_FORWARD_VELOCITY" if speed > 0 else "MAX_REVERSE_VELOCITY"
        with contextlib.suppress(Exception):
            stated = abs(float(self.cnc.ini(str(self.stat.ini_filename)).find("SPINDLE_0", name)))
            return stated if 0 < stated < MAX_SPINDLE else MAX_SPINDLE
        return MAX_SPINDLE

    def _in_work_frame(self, position: list[float]) -> list[float]:
        """Return a machine position in the coordinates in effect: G54, G92 and tool offset."""
        s = self.stat
        work, extra, tool = (self._metres(offset) for offset in (s.g5x_offset, s.g92_offset, s.tool_offset))
        x, y, z = (p - w - t for p, w, t in zip(position, work, tool))  # noqa: B905
        angle = -math.radians(s.rotation_xy)
        x, y = x * math.cos(angle) - y * math.sin(angle), x * math.sin(angle) + y * math.cos(angle)
        return [x - extra[0], y - extra[1], z - extra[2]]

    async def _mode(self, mode: int) -> None:
        if self.stat.task_mode != mode:
            await self._send("mode", mode)
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
        await self._send("mdi", line)
        while not await self._ended(self.job):
            offset = self._external()
            if self._pin("motion.motion-type") == PROBING:
                self._probed_with = offset
            await asyncio.sleep(POLL_INTERVAL)

    async def _ended(self, job: Job | None) -> bool:
        """Whether LinuxCNC has finished the last operation; RefusedError if it was aborted."""
        self._poll_state()
        if job is not None and job.ended_by:
            raise RefusedError(f"{job.what} was aborted: {job.ended_by}")
        if self.stat.task_state != self.cnc.STATE_ON:
            what = "e-stop" if self.stat.task_state == self.cnc.STATE_ESTOP else "the machine was switched off"
            raise RefusedError(f"{job.what if job else 'operation'} was aborted: {what}{await self._texts()}")
        accepted = self.stat.echo_serial_number >= self._serial and self.stat.state != self.cnc.RCS_EXEC
        return accepted and self._idle()

    async def _poll(self) -> None:
        await asyncio.sleep(POLL_INTERVAL)
        await self._ended(self.job)

    async def _settle(self, what: str, *, running: bool = False) -> None:
        """Wait until LinuxCNC has accepted a command and, unless ``running``, executed it."""
        until = time.monotonic() + ACCEPT_TIMEOUT
        while True:
            self._poll_state()
            done = running or self.stat.state != self.cnc.RCS_EXEC
            if self.stat.echo_serial_number >= self._serial and done:
                return
            if time.monotonic() > until:
                self._abort()  # a command that is not accepted now must not be executed later
                raise RefusedError(f"LinuxCNC does not respond: {what} took more than {ACCEPT_TIMEOUT:g} s")
            await asyncio.sleep(POLL_INTERVAL / 2)

    async def _abort_motion(self) -> None:
        """Abort all motion after a failed operation, also of a command that LinuxCNC received after the stop."""
        await self._stopped()
        with contextlib.suppress(Exception):
            self._poll_state()
            if self._idle() and not (self.job and self.job.ended_by):
                return
        self._abort()
        await self._stopped()

    async def _send(self, name: str, *arguments: Any) -> None:
        """Send a command, and wait until LinuxCNC has accepted it."""
        self._serial = max(self._serial, await self.orders.send(name, *arguments))

    async def _rest(self, limit: float = ACCEPT_TIMEOUT) -> None:
        """Wait until the machine is at rest, at most ``limit`` s."""
        until = time.monotonic() + limit
        with contextlib.suppress(Exception):  # LinuxCNC has ended: nothing moves
            while not self._idle() and time.monotonic() < until:
                await asyncio.sleep(POLL_INTERVAL)
                self._poll_state()

    async def _becomes(self, condition: Callable[[], bool]) -> bool:
        """Wait for a condition, at most CHANGE_TIMEOUT; return whether it is true."""
        until = time.monotonic() + CHANGE_TIMEOUT
        while True:
            self._poll_state()
            if condition() or time.monotonic() > until:
                return condition()
            await asyncio.sleep(POLL_INTERVAL)

    async def _require_arrival(self, goal: list[float]) -> None:
        position = self._without_offset(self.stat.position)
        if math.dist(goal, position) > POSITION_TOLERANCE:
            found = ", ".join(f"{1e3 * x:.4f}" for x in position)
            raise RefusedError(f"the machine has stopped before its goal, at {found} mm{await self._texts()}")

    async def _texts(self) -> str:
        """Return the error texts of LinuxCNC, for the end of a message."""
        until = time.monotonic() + TEXT_TIMEOUT
        while not self.alarms and time.monotonic() < until:
            await asyncio.sleep(POLL_INTERVAL)
            self._poll_state()
        return f": {'; '.join(self.alarms)}" if self.alarms else ""

    def _end_jobs(self, why: str, client: Client | None, *, abort: bool = True) -> None:
        """Abort operation and program, of all clients or of one."""
        ended = [job for job in (self.job, self.program) if job and client in (None, job.client)]
        for job in ended:
            job.ended_by = job.ended_by or why
        if abort and (ended or client is None):
            self._abort()


def _number(value: Any, what: str, least: float = -math.inf) -> float:
    try:
        number = math.nan if isinstance(value, bool) or not isinstance(value, (int, float)) else float(value)
    except OverflowError:  # an integer
        number = math.nan
    if not math.isfinite(number) or number < least:
        raise RefusedError(f"expected {what}; found {str(value)[:MAX_NAME]}")
    return number


def _axis_words(position: list[float]) -> str:
    return " ".join(f"{axis}{1e3 * x:.7f}" for axis, x in zip(AXES, position))  # noqa: B905


# ---------------------------------------------------------------------- socket and token


def own_folder(path: Path) -> None:
    """Create the folder of a file, for its user only; PermissionError if others can write to it."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    found = path.parent.stat()
    if found.st_uid not in (os.getuid(), 0) or found.st_mode & 0o022:
        raise PermissionError(f"{path.parent}: expected a folder that only its user can write to; use chmod 700")


def own_token(path: Path) -> str:
    """Return the token in a file that only its user can read; create it if it does not exist.

    Raises
    ------
    PermissionError
        Others can read the file, or it belongs to another user.
    ValueError
        The token is too short.
    """
    own_folder(path)
    if not path.exists():
        handle, part = tempfile.mkstemp(dir=path.parent)  # mode 0600
        try:
            with os.fdopen(handle, "w") as file:
                file.write(secrets.token_hex(32) + "\n")
            with contextlib.suppress(FileExistsError):  # another bridge has created it
                os.link(part, path)
        finally:
            os.unlink(part)
    handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    with os.fdopen(handle) as file:
        found = os.fstat(handle)
        if not stat.S_ISREG(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
            raise PermissionError(
                f"{path}: expected a file of this user that no other user can read (mode 0600); remove it, and the "
                "bridge creates another one"
            )
        token = file.read(4096).strip()
    if len(token) < MIN_TOKEN:
        raise ValueError(f"{path}: expected a token of at least {MIN_TOKEN} characters; remove the file")
    return token


def unix_socket(path: Path) -> socket.socket:
    """Return a listening socket for its user only; OSError if another bridge listens there."""
    own_folder(path)
    if path.exists():
        if not stat.S_ISSOCK(path.lstat().st_mode):
            raise FileExistsError(f"{path}: expected the socket of a bridge, or nothing; remove the file")
        with socket.socket(socket.AF_UNIX) as other:
            try:
                other.connect(str(path))
            except OSError:
                path.unlink()  # left by a bridge that was killed
            else:
                raise FileExistsError(f"{path}: another bridge listens there")
    line = socket.socket(socket.AF_UNIX)
    before = os.umask(0o177)
    try:
        line.bind(str(path))
    finally:
        os.umask(before)
    return line


async def admit(bridge: Bridge, line: socket.socket) -> None:
    """Accept connections one by one, so that many of them delay neither the clients nor later connections for long."""
    loop = asyncio.get_running_loop()
    while True:
        while bridge.crowded():
            await asyncio.sleep(POLL_INTERVAL)
        try:
            connection, _ = await loop.sock_accept(line)
            await loop.connect_accepted_socket(lambda: Client(bridge), connection)
        except OSError:  # already lost, or too many open files
            await asyncio.sleep(POLL_INTERVAL)


async def run(make: Callable[[], Bridge], line: socket.socket, announce: Path | None, idle: float) -> None:
    """Serve until this process is terminated, or no client has been connected for ``idle`` s."""
    bridge, ended = make(), asyncio.Event()
    for sender in (bridge.orders, bridge.stops):
        await sender.connect(ended.set)  # a bridge that cannot stop the machine ends
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        loop.add_signal_handler(number, ended.set)
    await bridge.await_linuxcnc()
    watch = asyncio.ensure_future(bridge.watch_threads()) if bridge.compensates else None
    line.setblocking(False)
    line.listen(MAX_CLIENTS)
    accepting = asyncio.ensure_future(admit(bridge, line))
    name = line.getsockname()
    where = {"socket": name} if isinstance(name, str) else {"port": name[1]}
    print(f"errormotion's bridge listens on {name if isinstance(name, str) else f'127.0.0.1:{name[1]}'}", flush=True)
    if announce is not None:
        part = announce.with_suffix(".part")
        part.write_text(json.dumps({**where, "pid": os.getpid()}))
        part.rename(announce)
    last_client = time.monotonic()
    while not ended.is_set() and time.monotonic() - last_client < idle:
        with contextlib.suppress(asyncio.TimeoutError):
            await asyncio.wait_for(ended.wait(), 0.1)
        if bridge.clients:
            last_client = time.monotonic()
    if watch is not None:
        watch.cancel()
    accepting.cancel()
    line.close()


def _component(hal: Any) -> Any:
    """Return a component of HAL; the name of a bridge that was killed remains in use until LinuxCNC ends."""
    try:
        return hal.component("errormotion-bridge")
    except Exception:  # noqa: BLE001 - of LinuxCNC's module
        return hal.component(f"errormotion-bridge-{os.getpid()}")


def main(words: list[str]) -> int:
    """Run the bridge."""
    parser = argparse.ArgumentParser(prog="bridge.py", description="JSON lines between LinuxCNC and errormotion")
    parser.add_argument("-ini", metavar="FILE", help="passed by LinuxCNC to its display; ignored")
    parser.add_argument("--socket", type=Path, default=Path(SOCKET), help=f"Unix socket; default {SOCKET}")
    parser.add_argument("--port", type=int, help="port of 127.0.0.1 instead of the socket; 0: any free port")
    parser.add_argument("--token", type=Path, default=Path(TOKEN), help=f"file with the token; default {TOKEN}")
    parser.add_argument("--announce", type=Path, help="file for the socket or port, and the process id")
    parser.add_argument(
        "--idle", type=float, default=math.inf, help="time without a client after which the bridge ends, s"
    )
    parser.add_argument("--pins", default="", help="prefixes of the HAL pins that clients may set, separated by commas")
    parser.add_argument("--load-pin", default="", help="HAL pin with the load of the spindle, 1 = rated")
    parser.add_argument(
        "--compensate", action="store_true", help="permit one client to set the offset of compensation.tcl"
    )
    options = parser.parse_args(words)
    path = options.socket.expanduser()
    orders, stops = Sender(), Sender()
    try:
        token = own_token(options.token.expanduser())
        line = unix_socket(path) if options.port is None else socket.create_server(("127.0.0.1", options.port))
    except (OSError, ValueError) as error:
        print(f"errormotion's bridge cannot start: {error}", file=sys.stderr)
        return 1
    import hal
    import linuxcnc

    component = _component(hal)  # LinuxCNC then ends this process with the others
    component.ready()
    try:
        with tempfile.TemporaryDirectory(prefix="errormotion-") as folder:
            pins = tuple(options.pins.split(","))
            make = partial(
                Bridge,
                linuxcnc,
                hal,
                orders,
                stops,
                Path(folder),
                pins,
                options.load_pin,
                compensates=options.compensate,
                token=token,
            )
            asyncio.run(run(make, line, options.announce, options.idle))
    finally:
        if options.port is None:
            path.unlink(missing_ok=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
