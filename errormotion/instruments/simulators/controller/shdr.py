"""An SHDR adapter on the virtual machine: lines of text for an MTConnect agent, over TCP.

After a connection it sends commands, the present value of every key, then changes. A line is
``time|key|value|key|value...``; conditions, messages, series, data sets and assets have separate lines. It answers ``*
PING`` with ``* PONG`` and the heartbeat in ms. After a first ``* PING`` it closes a connection that is silent for two
heartbeats. It ignores all other lines.

Source: the descriptions of the adapter protocol, versions 1.4 and 2.0, of mtconnect/cppagent, and the recorded adapter
of its demo device OKUMA.

Parameters of the address in addition to those of every simulated device:

* ``style``, ``offset`` and ``series``: as for the simulated agent; default ``okuma``. Keys are the sources, names or
identifiers of its data items. Values have their native units: feeds of ``okuma`` are in mm/min
* ``heartbeat``: in ms, 10000; 0: ``* PING`` is ignored, as by adapters without heartbeat
* ``device``: name before every key, ``device:key``
* ``name``: name of the device in ``* device: name``; default: that of ``device``, else that of the machine
* ``pipes=raw``: separators within values are not escaped, as by adapters that do not know of them
* ``times``: ``absolute``, or ``none`` (lines start with the separator)
* ``assets=1``: a cutting tool in several lines

In addition to `faults`: ``alarm`` (a fault condition), ``unavailable`` (the machine is off). ``fault_at`` counts lines,
also for ``late``.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.controller.mtconnect.agent import work_offset
from errormotion.instruments.simulators.controller.mtconnect.devices import DataItem, Devices
from errormotion.instruments.simulators.controller.mtconnect.machine import (
    UNAVAILABLE,
    Condition,
    Series,
    Value,
    clock_text,
    reading,
    readings,
)
from errormotion.instruments.simulators.controller.mtconnect.styles import STYLES, series
from errormotion.instruments.simulators.device import DEFAULT_MACHINE
from errormotion.instruments.simulators.faults import LateAnswer, parse_fault, stray_bytes
from errormotion.instruments.simulators.virtual_world.world import world
from errormotion.instruments.transports import Address
from errormotion.instruments.transports.loopback.serving import TcpServer

HEARTBEAT = 10000
"""Heartbeat stated in ``* PONG``, ms."""
POLL_INTERVAL = 0.02
"""Interval between two readings of the machine, s."""
MAX_LINE = 1024
"""Longest line of an agent, bytes."""
_COMMANDS = ("shdrVersion: 2.0", "adapterVersion: 1.0", "mtconnectVersion: 2.0")
_NATIVE = {("MILLIMETER/SECOND", "MILLIMETER/MINUTE"): 60.0}
_ASSET = (
    '<CuttingTool toolId="1" serialNumber="7" assetId="1.7"><Description/>\n'
    "<CuttingToolLifeCycle><ProgramToolNumber>1</ProgramToolNumber></CuttingToolLifeCycle></CuttingTool>"
)


class SimulatedAdapter:
    """An adapter whose device is the machine.

    Attributes
    ----------
    url : str
        Address for the client.

    Raises
    ------
    InstrumentError
        Unknown style, times, offset or fault.
    """

    faults = ("silence", "split", "garbage", "drop", "disconnect", "late", "alarm", "unavailable")

    def __init__(self, address: Address) -> None:
        self.fault = parse_fault(address, self.faults)
        seed = int(address.number("seed", 0))
        self._rng = np.random.default_rng([abs(seed), *b"shdr"])
        name, times = address.params.get("style", "okuma"), address.params.get("times", "absolute")
        if name not in STYLES or times not in ("absolute", "none"):
            known = f"'style' one of {', '.join(STYLES)}, 'times' absolute or none"
            raise InstrumentError(
                f"'{address.url}': expected {known}; found '{name}', '{times}'", code="simulator.setting"
            )
        style = STYLES[name]
        self._offset = work_offset(address, style.offset)
        self._timed = times == "absolute"
        self._heartbeat = int(address.number("heartbeat", HEARTBEAT))
        self._prefix = f"{address.params['device']}:" if "device" in address.params else ""
        self._name = address.params.get("name", address.params.get("device", ""))
        self._raw = _choice(address, "pipes", ("escaped", "raw")) == "raw"
        self._assets = bool(address.number("assets", 0))
        self._lines = 0
        self._pinged: tuple[object, float] = (None, 0.0)  # connection and time of the last ``* PING``
        self._received = b""
        self._late = LateAnswer()
        self._ended = threading.Event()
        self.world = world(address.host or DEFAULT_MACHINE, seed, warm=bool(address.number("warm", 1)))
        self.world.attach(self, address.number("pace", 0.0) or None)
        try:
            if clock := address.number("clock", 0.0):
                self.world.tick(clock)
            text = style.document(self.world.name, f"errormotion-{seed}", f"seed {seed}")
            devices = Devices(text, series() if address.number("series", 0) else "")
            self._device = self._name or devices.root[0][-1].get("name", "")
            machine = [item for item in devices.items.values() if item.device is devices.root[0][-1]]
            self._items = {self._prefix + item.key: item for item in machine}
            self._server = TcpServer(address.path or "shdr", self._on_data, self._on_connection)
        except BaseException:
            self.world.detach(self)
            raise
        self.url = self._server.url
        self._server.start()
        self._thread = threading.Thread(target=self._run, name="sim-shdr-sender", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the adapter; the last device of a world also ends the world."""
        self._ended.set()
        self._late.close()
        self._server.close()
        if self._thread is not threading.current_thread():
            self._thread.join()
        self.world.detach(self)

    def report_delivered(self, samples: int) -> None:
        """Do nothing: an adapter follows the world's clock and never drives it."""

    # ------------------------------------------------------------------ lines

    def _run(self) -> None:
        connection, sent = None, dict[str, Value]()
        while not self._ended.wait(POLL_INTERVAL):
            present = self._server.connection
            if present is None:
                continue
            if present is not connection:
                connection, sent = present, {}
                self._send_all(f"* {command}" for command in (*_COMMANDS, f"device: {self._device}"))
                self._send_all(self._asset())
            pinged, last = self._pinged
            if pinged is connection and time.monotonic() - last > 2 * self._heartbeat / 1e3:
                self._server.disconnect()
                continue
            self._send_all(self._changes(sent))

    def _changes(self, sent: dict[str, Value]) -> Iterator[str]:
        """Yield lines of values that differ from those sent before, and update these."""
        faulty = self._lines >= self.fault.at
        alarm = "the machine is in alarm" if self.fault.kind == "alarm" and faulty else ""
        values = readings(self.world.commanded(), self._offset, alarm)
        stamp = clock_text(self.world.time) if self._timed else ""
        simple: list[str] = []
        separate: list[str] = []
        for key, item in self._items.items():
            value = reading(values, item.source)
            if self.fault.kind == "unavailable" and faulty:
                value = UNAVAILABLE
            if sent.get(key) == value:
                continue
            sent[key] = value
            field = field_text(value, item)
            fields = f"{key}|{value if self._raw and isinstance(value, str) and field == escaped(value) else field}"
            alone = item.category == "CONDITION" or "representation" in item.attributes or _kind(item) == "MESSAGE"
            (separate if alone else simple).append(fields)
        if simple:
            yield "|".join((stamp, *simple))
        yield from (f"{stamp}|{fields}" for fields in separate)

    def _asset(self) -> Iterator[str]:
        if self._assets:
            stamp = clock_text(self.world.time) if self._timed else ""
            yield f"{stamp}|@ASSET@|1.7|CuttingTool|--multiline--ABCD"
            yield from _ASSET.split("\n")
            yield "--multiline--ABCD"

    def _send_all(self, lines: Iterator[str]) -> None:
        for line in lines:
            self._send(line)

    def _send(self, line: str) -> None:
        number, fault = self._lines, self.fault
        self._lines += 1
        if fault.suppresses(number):
            return
        if fault.kind == "disconnect" and number >= fault.at:
            self._server.disconnect()
            return
        data = line.encode() + b"\n"
        if fault.hits("garbage", number):
            data = stray_bytes(self._rng) + data
        self._late.send(self._server, fault, number, data)

    def _on_connection(self) -> None:
        """Discard an incomplete line of the previous connection."""
        self._received = b""

    def _on_data(self, data: bytes) -> None:
        *lines, self._received = (self._received + data).split(b"\n")
        self._received = self._received[-MAX_LINE:]
        for line in lines:
            if line.strip() == b"* PING" and self._heartbeat:
                self._pinged = (self._server.connection, time.monotonic())
                self._send(f"* PONG {self._heartbeat}")


def _choice(address: Address, name: str, known: tuple[str, ...]) -> str:
    value = address.params.get(name, known[0])
    if value not in known:
        raise InstrumentError(
            f"'{name}={value}' in '{address.url}': expected one of {', '.join(known)}", code="simulator.setting"
        )
    return value


def field_text(value: Value, item: DataItem) -> str:
    """Return the fields that follow the key of a data item."""
    if item.category == "CONDITION":
        if not isinstance(value, Condition):
            return "UNAVAILABLE||||"
        texts = (value.code, value.severity, value.qualifier, value.text)
        return "|".join((value.level.upper(), *(escaped(text) for text in texts)))
    if isinstance(value, Series):
        return f"{len(value.values)}|{value.rate:g}|{' '.join(value.values)}"
    if isinstance(value, Mapping):
        return " ".join(f"{key}={_entry(cells)}" for key, cells in value.items())
    assert isinstance(value, str)
    if _kind(item) == "MESSAGE":
        return f"|{escaped(value)}"
    units = item.attributes.get("units", ""), item.attributes.get("nativeUnits", "")
    if units in _NATIVE and value != UNAVAILABLE:
        return f"{float(value) * _NATIVE[units]:.4f}"
    return escaped(value)


def escaped(text: str) -> str:
    """Return a value as the text of a field: with quotes and backslashes if it contains a separator."""
    line = " ".join(text.split("\n"))
    if "|" not in line:
        return line
    return '"' + line.replace("|", r"\|") + '"'


def _entry(value: str | Mapping[str, str]) -> str:
    if isinstance(value, str):
        return f"{{{value}}}" if " " in value else value
    return "{" + " ".join(f"{key}={_entry(cell)}" for key, cell in value.items()) + "}"


def _kind(item: DataItem) -> str:
    return item.attributes["type"]
