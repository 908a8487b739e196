"""The agent: observations of the virtual machine over HTTP.

In addition to `faults` it offers ``overrun`` (the buffer is overwritten before a request for observations: the agent
refuses), ``jump`` (the same, but the agent continues at its first observation without an error), ``restart`` (a new
instance, with sequence numbers from 1), ``alarm`` (a fault condition) and ``unavailable`` (the machine is off).
``fault_at`` counts requests, and intervals of a stream; ``overrun``, ``jump`` and ``restart`` happen once.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.controller.mtconnect.devices import Devices
from errormotion.instruments.simulators.controller.mtconnect.documents import Frame, RefusedError
from errormotion.instruments.simulators.controller.mtconnect.machine import UNAVAILABLE, clock_text, reading, readings
from errormotion.instruments.simulators.controller.mtconnect.observations import Buffer, Observation, empty_value
from errormotion.instruments.simulators.controller.mtconnect.paths import PathError
from errormotion.instruments.simulators.controller.mtconnect.requests import COUNT, Request, check_range, read_request
from errormotion.instruments.simulators.controller.mtconnect.styles import STYLES, series
from errormotion.instruments.simulators.device import DEFAULT_MACHINE
from errormotion.instruments.simulators.faults import parse_fault, stray_bytes
from errormotion.instruments.simulators.virtual_world.world import world
from errormotion.instruments.transports import Address
from errormotion.instruments.transports.http.serving import HttpServer

BUFFER = 1024
FIRST_INSTANCE = 1735689600
BOUNDARY = "6f1d2b52c4a94a0d8d5f0b3a7c1e9f24"
_VERSIONS = {f"1.{minor}" for minor in range(3, 9)} | {f"2.{minor}" for minor in range(8)}
_REASONS = {200: "OK", 400: "Bad Request", 404: "Not Found"}
_POLL_INTERVAL = 0.02
"""Longest interval between two readings of the machine in a stream, s."""
_OLD = (2, 0)


class SimulatedAgent:
    """An agent whose device is the machine; see the package for the parameters of its address.

    Attributes
    ----------
    url : str
        Address for the client.

    Raises
    ------
    InstrumentError
        Unknown style, version, offset or fault.
    """

    faults = (
        *("silence", "split", "garbage", "drop", "disconnect", "late"),
        *("overrun", "jump", "restart", "alarm", "unavailable"),
    )

    def __init__(self, address: Address) -> None:
        self.fault = parse_fault(address, self.faults)
        seed = int(address.number("seed", 0))
        self._rng = np.random.default_rng([abs(seed), *b"mtconnect"])
        style = STYLES[_choice(address, "style", "own", set(STYLES))]
        version = _choice(address, "version", style.version, _VERSIONS)
        self._multipart = _choice(address, "multipart", style.multipart, {"x-mixed-replace", "mixed"})
        self._offset = work_offset(address, style.offset)
        self._shows_next = bool(address.number("next", 1))
        self._frame = Frame(version, max(1, int(address.number("buffer", BUFFER))), FIRST_INSTANCE)
        self._requests = 0
        self._fault_applied = False
        self._delayed = WeakKeyDictionary[threading.Thread, bytes]()  # late answers, by the thread of their connection
        self._lock = threading.Lock()
        self.world = world(address.host or DEFAULT_MACHINE, seed, warm=bool(address.number("warm", 1)))
        self.world.attach(self, address.number("pace", 0.0) or None)
        try:
            if clock := address.number("clock", 0.0):
                self.world.tick(clock)
            text = style.document(self.world.name, f"errormotion-{seed}", f"seed {seed}")
            self._devices = Devices(text, series() if address.number("series", 0) else "")
            self._names = {each.get(name, "") for each in self._devices.root[0] for name in ("name", "uuid")}
            self._start()
            self._server = HttpServer(address.path or "mtconnect", self._respond)
        except BaseException:
            self.world.detach(self)
            raise
        self.url = self._server.url

    @property
    def driver_url(self) -> str:
        """Address of the agent in a bench file."""
        return f"http://{self.url.partition('://')[2]}/"

    def close(self) -> None:
        """End the agent; the last device of a world also ends the world."""
        self._server.close()
        self.world.detach(self)

    def report_delivered(self, samples: int) -> None:
        """Do nothing: an agent follows the world's clock and never drives it."""

    # ------------------------------------------------------------------ observations

    def _start(self) -> None:
        """Start an instance: every data item is unavailable before its first value."""
        self._buffer = Buffer(self._frame.buffer_size)
        now = clock_text(self.world.time)
        for key, item in self._devices.items.items():
            self._buffer.add(key, now, empty_value(item.category))

    def _observe(self) -> None:
        """Add an observation of every data item that has changed."""
        now = clock_text(self.world.time)
        faulty = self._requests > self.fault.at
        alarm = "the machine is in alarm" if self.fault.kind == "alarm" and faulty else ""
        values = readings(self.world.commanded(), self._offset, alarm)
        latest = self._buffer.values()
        for key, item in self._devices.items.items():
            value = reading(values, item.source)
            if value == UNAVAILABLE or (self.fault.kind == "unavailable" and faulty):
                value = empty_value(item.category)
            if latest[key] != value:
                self._buffer.add(key, now, value)

    def _apply_fault(self, kind: str, number: int) -> None:
        """Apply an overrun, jump or restart at this request."""
        if self.fault.kind not in ("overrun", "jump", "restart") or kind != "sample":
            return
        if number < self.fault.at or self._fault_applied:
            return
        self._fault_applied = True
        if self.fault.kind == "restart":
            self._frame = replace(self._frame, instance=self._frame.instance + 1)
            self._start()
            return
        key = next(key for key, item in self._devices.items.items() if item.source == "spindle.load")
        now = clock_text(self.world.time)
        for k in range(2 * self._buffer.size):
            self._buffer.add(key, now, f"{k % 100}")

    # ------------------------------------------------------------------ HTTP

    def _respond(self, path: str, query: Mapping[str, str]) -> Iterator[bytes] | None:
        with self._lock:
            number, fault = self._requests, self.fault
            self._requests += 1
            if fault.kind == "disconnect" and number >= fault.at:
                return None
            if fault.suppresses(number):
                return iter(())
            status = 200
            try:
                request = read_request(path, query, self._frame.schema, self._names)
                self._apply_fault(request.kind, number)
                self._observe()
                if request.interval >= 0 and request.kind in ("current", "sample"):
                    self._check_stream(request)
                    return self._stream(request)
                body = self._document(request)[0]
            except RefusedError as refused:
                status = 200 if self._frame.schema < _OLD else refused.status
                body = self._frame.error(refused, clock_text(self.world.time), path)
        head = (
            f"HTTP/1.1 {status} {_REASONS[status]}\r\nServer: MTConnectAgent\r\nContent-Type: text/xml\r\n"
            f"Cache-Control: no-store, max-age=0\r\nContent-Length: {len(body)}\r\n\r\n"
        ).encode()
        if fault.kind == "late" and number == fault.at:
            return self._hold(head + body)
        stray = stray_bytes(self._rng) if fault.hits("garbage", number) else b""
        return fault.pieces(self._delayed.pop(threading.current_thread(), b"") + stray + head + body)

    def _hold(self, answer: bytes) -> Iterator[bytes]:
        """Yield an answer late, or delay it until the next one of its connection."""
        if math.isinf(self.fault.delay):
            self._delayed[threading.current_thread()] = answer
        elif not self._server.ended.wait(self.fault.delay):
            yield answer

    def _check_stream(self, request: Request) -> None:
        items = self._items(request)
        if request.kind == "sample":
            self._select(request, items)

    def _stream(self, request: Request) -> Iterator[bytes]:
        """Yield the parts of a stream: new observations, not more often than the interval, or a heartbeat."""
        yield (
            "HTTP/1.1 200 OK\r\nServer: MTConnectAgent\r\nConnection: close\r\n"
            f"Content-Type: multipart/{self._multipart};boundary={BOUNDARY}\r\n"
            "Expires: -1\r\nCache-Control: no-cache, no-store, max-age=0\r\nTransfer-Encoding: chunked\r\n\r\n"
        ).encode()
        begin, sent, frame = request.begin, float("-inf"), self._frame
        while True:
            with self._lock:
                number, fault = self._requests, self.fault
                self._requests += 1
                if fault.kind == "disconnect" and number >= fault.at:
                    yield b""  # closes the connection
                    return
                silent = fault.kind == "silence" and number >= fault.at
                self._apply_fault(request.kind, number)
                self._observe()
                if self._frame is not frame:
                    yield b""  # a new instance has no connections of the previous one
                    return
                refused = False
                try:
                    body, following, news = self._document(request, begin)
                except RefusedError as error:
                    body, following, news = self._frame.error(error, clock_text(self.world.time), "/sample"), 0, True
                    refused = True
                due = request.kind == "current" or news or time.monotonic() - sent >= request.heartbeat
                begin = following
            if due and not silent:
                part = f"--{BOUNDARY}\r\nContent-Type: text/xml\r\nContent-Length: {len(body)}\r\n\r\n".encode()
                part += body + b"\r\n"
                yield from fault.pieces(f"{len(part):x}\r\n".encode() + part + b"\r\n")
                sent = time.monotonic()
            if refused:  # the stream ends after an overrun
                yield b"0\r\n\r\n"
                yield b""
                return
            if self._server.ended.wait(max(request.interval, 1e-3) if due else max(request.interval, _POLL_INTERVAL)):
                return

    # ------------------------------------------------------------------ documents

    def _document(self, request: Request, begin: int | None = None) -> tuple[bytes, int, bool]:
        """Return the document of an answer, the next sequence number, and whether it has observations."""
        now = clock_text(self.world.time)
        if request.kind == "asset":
            if request.asset:
                raise RefusedError("ASSET_NOT_FOUND", f"Cannot find asset: {request.asset}", 404)
            return self._frame.assets(now), 0, False
        if request.kind == "probe":
            device = self._devices.named(request.device) if request.device else None
            return self._frame.devices(self._devices.text(device), now), 0, False
        items = self._items(request)
        buffer = self._buffer
        if request.kind == "sample":
            seen, following = self._select(request, items, begin)
        else:
            if request.at is not None:
                check_range("at", request.at, buffer.first - 1, buffer.next)
            state = buffer.latest if request.at is None else buffer.at(request.at)
            seen, following = state.observations(items), buffer.next
        sequences: dict[str, object] = {
            "nextSequence": following,
            "firstSequence": buffer.first,
            "lastSequence": buffer.next - 1,
        }
        if request.kind == "current" and not self._shows_next:
            del sequences["nextSequence"]
        return self._frame.streams(seen, self._devices.items, now, sequences), following, bool(seen)

    def _items(self, request: Request) -> set[str]:
        device = self._devices.named(request.device) if request.device else None
        try:
            items = self._devices.chosen(request.path, device)
        except PathError:
            items = set()
        if not items:
            text = f"The path could not be parsed. Invalid syntax: {request.path}"
            raise RefusedError("INVALID_XPATH", text, parameter="path")
        return items

    def _select(self, request: Request, items: set[str], begin: int | None = None) -> tuple[list[Observation], int]:
        """Check a request against the stored sequence numbers, and return its observations."""
        buffer, most = self._buffer, self._buffer.size + 1
        start = request.begin if begin is None else begin
        if start is not None:
            if self.fault.kind == "jump":
                start = max(start, buffer.first)
            check_range("from", start, buffer.first - 1, buffer.next + 1)
        if request.end is not None:
            check_range("to", request.end, buffer.first if start is None else start, buffer.next + 1)
        backwards = self._frame.schema >= (1, 5) and request.end is None
        count = min(COUNT, buffer.size) if request.count is None else request.count
        check_range("count", count, -most if backwards else 0, most, zero=False)
        if start is None:
            start = buffer.first if count > 0 else buffer.next - 1
        return buffer.select(start, count, items, request.end)


def _choice(address: Address, name: str, default: str, known: set[str]) -> str:
    value = address.params.get(name, default)
    if value not in known:
        raise InstrumentError(
            f"'{name}={value}' in '{address.url}': expected one of {', '.join(sorted(known))}", code="simulator.setting"
        )
    return value


def work_offset(address: Address, default: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the work offset of an address, m; ``default`` in mm."""
    text = address.params.get("offset")
    try:
        x, y, z = default if text is None else (float(part) for part in text.split(","))
    except ValueError:
        raise InstrumentError(
            f"'offset={text}' in '{address.url}': expected x,y,z in mm", code="simulator.setting"
        ) from None
    return x / 1e3, y / 1e3, z / 1e3
