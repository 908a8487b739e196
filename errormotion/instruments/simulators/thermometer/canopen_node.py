"""A thermometer with CANopen (CiA 404, analogue inputs) on the virtual machine.

Written from the public manuals of such devices, not from the driver: esd CAN-CBX-THERMO C.3034.21 rev. 1.2 (p. 50, 54,
90-97) and CAN-CBX-Pt100 C.3032.21 rev. 1.1 (p. 49, 91), HYDAC's CiA 404 protocol description (objects of the device
profile), WIKA D-20-9 (contents, object 0x2330), SIKO AP10 (p. 49, TPDO parameters), Bonfiglioli ACU (p. 69, order of
mapping), ABB FCAN-01 (p. 126-129, SDO), JUMO 902910 CANtrans T (p. 16, emergency 5030h of a broken sensor).

Assumptions without a source: the reading of a broken input (a limit of a Pt100 input); a TPDO by event without event
timer is not sent.
"""

from __future__ import annotations

import math
import time
from functools import partial
from typing import Any

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.device import DEFAULT_MACHINE
from errormotion.instruments.simulators.faults import Fault, parse_fault
from errormotion.instruments.simulators.thermometer.canopen_objects import (
    FORMATS,
    NO_DATA,
    NO_SIGNATURE,
    VALUE_OUT_OF_RANGE,
    Dictionary,
    Entry,
    Refused,
)
from errormotion.instruments.simulators.thermometer.canopen_slave import (
    FIRST_TPDO,
    INVALID,
    MAX_MAPPED,
    PREDEFINED_TPDOS,
    STOPPED,
    Slave,
    Tpdo,
)
from errormotion.instruments.simulators.thermometer.temperatures import Inputs, Unplugging
from errormotion.instruments.simulators.virtual_world.world import world
from errormotion.instruments.transports import Address
from errormotion.instruments.transports.can.serving import CanServer

CIA_404_ANALOGUE_INPUTS = 0x00020194
PT100 = 30  # sensor type
CELSIUS, KELVIN, FAHRENHEIT = 0x2D, 0x05, 0xAC  # numerator of a unit, CiA 303-2
NOT_VALID, OVER_RANGE, UNDER_RANGE = 0x01, 0x02, 0x04
LOWEST, HIGHEST = (
    -200.715,
    853.498,
)  # degC, limits of a Pt100 input; a broken one reads the upper, a shorted one the lower
ZERO = int.from_bytes(b"zero", "little")  # signature of the autozero
MAX_DIGITS = 3
VALUES = {"float": (0x6130, "f32"), "int16": (0x7130, "i16"), "int32": (0x9130, "i32")}
FIRST_SDO_ANSWER = 0x580  # COB-ID without the node
BROKEN_SENSOR = (0x5030, 0x21)  # emergency code (JUMO); error register: generic and device profile


class SimulatedCanopen:
    """A CiA 404 node whose inputs are temperature sensors of the machine.

    Further parameters of the address: ``node`` (1), ``bus`` (``virtual``, or ``udp_multicast`` with ``group`` and
    ``port``, between processes), ``heartbeat`` (s, 0.1), ``sensors``, ``open``, ``shorted``, ``noise`` (see
    `temperatures`), ``code`` (of the abort).

    Objects of the node: ``values`` (``float``, ``int16``, ``int32``, several separated by commas), ``digits`` (content
    of 0x6132; 1), ``unit`` (content of 0x6131; ``none``: without it, degC), ``status`` (``array``, ``single``: 0x6150
    without sub-indices, ``none``), ``pdo`` (``event``, ``sync``, ``timer`` with ``event_timer`` in ms, 50, ``off``:
    switched off, ``none``: no TPDO), ``state`` after power-on (``operational``: it starts by itself, as with WIKA's
    object 0x2330; ``pre-operational``: it waits for a master).

    Faults: ``silence``, ``garbage``, ``drop``, ``out_of_range``, ``late`` as for all devices, counted over SDO answers
    and PDOs (``late`` is an SDO answer); ``abort`` (the node refuses), ``bus_off`` (the controllers leave the bus; for
    ``unplugged_for`` seconds nothing is answered), ``stopped`` (the node enters the state STOPPED), ``unplugged`` (see
    `temperatures`; it boots when the power returns).

    Attributes
    ----------
    url : str
        Address of the node.
    """

    faults: tuple[str, ...] = (
        "silence",
        "garbage",
        "drop",
        "out_of_range",
        "late",
        "abort",
        "bus_off",
        "stopped",
        "unplugged",
    )

    def __init__(self, address: Address) -> None:
        self.fault: Fault = parse_fault(address, self.faults)
        self._away = Unplugging(address, ("unplugged", "bus_off"))
        self._code = _code(address, "code", NO_DATA)
        self._unit = None if address.params.get("unit") == "none" else _code(address, "unit", CELSIUS << 16)
        self._values = _choices(address, "values", "float", tuple(VALUES))
        self._status = _choices(address, "status", "array", ("array", "single", "none"))[0]
        pdo = _choices(address, "pdo", "event", ("event", "sync", "timer", "off", "none"))[0]
        state = _choices(address, "state", "operational", ("operational", "pre-operational"))[0]
        self._answers = 0
        self._was_late = False
        self._delayed: tuple[float, int, bytes] | None = None  # time, s, and frame of the delayed answer
        node, seed = address.whole("node", 1, 127), int(address.number("seed", 0))
        self._rng = np.random.default_rng([abs(seed), *(address.path or "thermometer").encode()])
        self.world = world(address.host or DEFAULT_MACHINE, seed, warm=bool(address.number("warm", 1)))
        self.world.attach(self, address.number("pace", 0.0) or None)
        self._server: CanServer | None = None
        try:
            self._inputs = Inputs(self.world.machine, address)
            n = len(self._inputs.names)
            self._digits = [address.whole("digits", 1, MAX_DIGITS)] * n
            self._offsets = [0.0] * n
            tpdos = [] if pdo == "none" else self._tpdos(node, pdo, address.whole("event_timer", 50, 65535))
            self._slave = Slave(
                node,
                self._dictionary(n),
                self._outgoing,
                tpdos,
                heartbeat=address.number("heartbeat", 0.1),
                autonomous=state == "operational",
                errors=BROKEN_SENSOR if self._inputs.open or self._inputs.shorted else None,
            )
            self._server = CanServer(node, self._received, self._due, bus=_bus(address))
        except BaseException:
            self.close()
            raise
        self.url = self._server.url
        self._slave.boot()
        self._server.start()

    def close(self) -> None:
        """End the device; the last device of a world also ends the world."""
        server, self._server = self._server, None
        if server is not None:
            server.close()
        self.world.detach(self)

    def report_delivered(self, samples: int) -> None:
        """Do nothing: a node does not stream."""

    def _dictionary(self, n: int) -> Dictionary:
        objects, serial = Dictionary(), self.world.seed & 0xFFFFFFFF
        objects.constant(0x1000, "u32", CIA_404_ANALOGUE_INPUTS)
        objects.constant(0x1008, "text", "Virtual CiA 404 thermometer")
        objects.constant(0x1009, "text", "1.0")
        objects.constant(0x100A, "text", "1.02.3")
        objects.array(0x1018, [Entry("u32", partial(int, value)) for value in (0, 404, 0x00010000, serial)])
        objects.array(0x6110, [Entry("u16", lambda: PT100)] * n)
        objects.array(0x6125, [Entry("u32", None, partial(self._zero, k)) for k in range(n)])
        if self._unit is not None:
            objects.array(0x6131, [Entry("u32", lambda: self._unit)] * n)
        digits = [Entry("u8", partial(self._digits.__getitem__, k), partial(self._set_digits, k)) for k in range(n)]
        objects.array(0x6132, digits)
        for index, kind in (VALUES[name] for name in self._values):
            objects.array(index, [Entry(kind, partial(self._value, k, kind), mappable=True) for k in range(n)])
        if self._status == "array":
            objects.array(0x6150, [Entry("u8", partial(self._state, k), mappable=True) for k in range(n)])
        elif self._status == "single":
            objects.add(0x6150, 0, Entry("u8", self._all_states, mappable=True))
        return objects

    def _tpdos(self, node: int, pdo: str, event_timer: int) -> list[Tpdo]:
        """Return the default TPDOs: the first format of the values of all inputs, then the status."""
        index, kind = VALUES[self._values[0]]
        n = len(self._inputs.names)
        size = 16 if kind == "i16" else 32
        mapped = [index << 16 | (k + 1) << 8 | size for k in range(n)]
        groups = [mapped[k : k + 64 // size] for k in range(0, n, 64 // size)]
        if self._status == "array":
            states = [0x6150 << 16 | (k + 1) << 8 | 8 for k in range(n)]
            groups += [states[k : k + MAX_MAPPED] for k in range(0, n, MAX_MAPPED)]
        elif self._status == "single":
            groups.append([0x6150 << 16 | 8])
        found = []
        for number, group in enumerate(groups):
            reserved = number < PREDEFINED_TPDOS
            cob_id = FIRST_TPDO + 0x100 * number + node if reserved else INVALID | FIRST_TPDO + node
            found.append(
                Tpdo(
                    cob_id | (INVALID if pdo == "off" else 0),
                    1 if pdo == "sync" else 255,
                    event_timer if pdo == "timer" else 0,
                    group + [0] * (MAX_MAPPED - len(group)),
                    len(group),
                )
            )
        return found

    def _value(self, channel: int, kind: str) -> Any:
        """Return the process value of an input, in the unit of the device."""
        if self.fault.hits("abort", self._answers):
            raise Refused(self._code)
        celsius = self._inputs.temperatures(self.world.time, self._rng)[channel] + self._offsets[channel]
        state = self._state(channel)
        if state:
            celsius = LOWEST if state & UNDER_RANGE else HIGHEST
        value = _in_unit(celsius, self._unit)
        if kind == "f32":
            return value
        limit = 2 ** (8 * np.dtype(FORMATS[kind]).itemsize - 1)
        return max(-limit, min(limit - 1, math.floor(value * 10 ** self._digits[channel] + 0.5)))

    def _state(self, channel: int) -> int:
        if self.fault.hits("abort", self._answers):
            raise Refused(self._code)
        if self.fault.hits("out_of_range", self._answers):
            return NOT_VALID | OVER_RANGE
        if channel in self._inputs.shorted:
            return NOT_VALID | UNDER_RANGE
        return NOT_VALID if channel in self._inputs.open else 0

    def _all_states(self) -> int:
        return int(np.bitwise_or.reduce([self._state(k) for k in range(len(self._inputs.names))]))

    def _zero(self, channel: int, signature: int) -> None:
        if signature != ZERO:
            raise Refused(NO_SIGNATURE)
        self._offsets[channel] = -self._inputs.temperatures(self.world.time, self._rng)[channel]

    def _set_digits(self, channel: int, value: int) -> None:
        if value > MAX_DIGITS:
            raise Refused(VALUE_OUT_OF_RANGE)
        self._digits[channel] = value

    def _received(self, can_id: int, data: bytes, remote: bool) -> None:
        if not self._absent():
            self._slave.receive(can_id, data, remote)

    def _due(self, now: float) -> float:
        if self._absent():
            return now + 1.0
        if self._delayed and now >= self._delayed[0]:
            self._send_held()
        return min(self._slave.due(now), self._delayed[0] if self._delayed else math.inf)

    def _send_held(self) -> None:
        held, self._delayed = self._delayed, None
        if held and self._server is not None:
            self._server.send(*held[1:])

    def _absent(self) -> bool:
        """Whether the node has no power; boot it when the power returns."""
        if self._away.now():
            return True
        if self._away.returns():
            self._slave.boot()
        return False

    def _outgoing(self, can_id: int, data: bytes) -> None:
        """Send a frame; SDO answers and PDOs with the fault that applies to them."""
        server = self._server
        if server is None or self._away.now():
            return
        if not FIRST_TPDO < can_id < FIRST_SDO_ANSWER + 0x80:
            server.send(can_id, data)
            return
        number = self._answers
        if self._away.begins(number):
            if self.fault.kind == "bus_off":
                server.send_bus_off()
            return
        self._answers += 1
        if can_id >= FIRST_SDO_ANSWER:
            self._send_held()
            if self.fault.kind == "late" and number >= self.fault.at and not self._was_late:
                self._was_late, self._delayed = True, (time.monotonic() + self.fault.delay, can_id, data)
                return
        if self.fault.kind == "stopped" and number >= self.fault.at:
            self._slave.enter(STOPPED)
        elif self.fault.suppresses(number):
            return
        elif self.fault.hits("garbage", number):
            server.send(can_id, self._rng.integers(0, 256, self._rng.integers(1, 8), dtype=np.uint8).tobytes())
        else:
            server.send(can_id, data)


def _in_unit(celsius: float, unit: int | None) -> float:
    """Return a temperature in a unit of 0x6131: a decimal prefix in the highest byte, the unit in the next."""
    if unit is None:
        return celsius
    prefix = (unit >> 24) - (256 if unit >> 31 else 0)
    value = {KELVIN: celsius + 273.15, FAHRENHEIT: 1.8 * celsius + 32.0}.get(unit >> 16 & 0xFF, celsius)
    return float(value / 10.0**prefix)


def _code(address: Address, key: str, default: int) -> int:
    text = address.params.get(key, f"{default:#x}")
    try:
        return int(text, 16)
    except ValueError:
        raise InstrumentError(
            f"'{key}' in '{address.url}': expected a hexadecimal number; found '{text}'", code="simulator.setting"
        ) from None


def _choices(address: Address, key: str, default: str, known: tuple[str, ...]) -> list[str]:
    found = address.params.get(key, default).split(",")
    if unknown := [each for each in found if each not in known]:
        raise InstrumentError(
            f"'{key}' in '{address.url}': expected {', '.join(known)}; found {', '.join(unknown)}",
            code="simulator.setting",
        )
    return found


def _bus(address: Address) -> dict[str, Any] | None:
    kind = address.params.get("bus", "virtual")
    if kind == "virtual":
        return None
    if kind != "udp_multicast":
        raise InstrumentError(
            f"'bus' in '{address.url}': expected 'virtual' or 'udp_multicast'; found '{kind}'", code="simulator.setting"
        )
    return {
        "interface": kind,
        "channel": address.params.get("group", "239.74.163.2"),
        "port": int(address.number("port", 43113)),
        "hop_limit": 0,  # only on this computer
    }
