"""A thermometer with CANopen on the virtual machine: a local node of `canopen` on a python-can bus."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.device import DEFAULT_MACHINE
from errormotion.instruments.simulators.faults import Fault, parse_fault
from errormotion.instruments.simulators.thermometer.temperatures import Inputs, Unplugging
from errormotion.instruments.simulators.virtual_world.world import world
from errormotion.instruments.thermometer.cia404 import (
    CELSIUS,
    DEVICE_TYPE,
    HEARTBEAT,
    IDENTITY,
    NAME,
    NEGATIVE,
    POSITIVE,
    PROFILE,
    STATUS,
    UNIT,
    VALUE,
    to_celsius,
)
from errormotion.instruments.transports import Address
from errormotion.instruments.transports.can.serving import CanopenServer, Entry, Refused

NO_DATA = 0x08000024  # SDO abort code: no data available


class SimulatedCanopen:
    """A CiA 404 node whose inputs are temperature sensors of the machine.

    Further parameters of the address: ``node`` (1), ``bus`` (``virtual``, or ``udp_multicast`` with ``group`` and
    ``port``, which crosses processes), ``heartbeat`` (s, 0.1), ``sensors``, ``open``, ``shorted``, ``noise`` (see
    `simulators.thermometers`), ``code`` (of the abort), ``unit`` (as in 0x6131).

    Faults: ``silence``, ``garbage``, ``drop``, ``out_of_range`` as of all devices; ``abort`` (the node refuses),
    ``bus_off`` (the controllers leave the bus; for ``unplugged_for`` seconds nothing is answered), ``stopped`` (the
    node goes to the state STOPPED), ``unplugged`` (see `simulators.thermometers`; it boots when it is back).

    Attributes
    ----------
    url : str
        Where the node is.
    """

    faults: tuple[str, ...] = (
        "silence",
        "garbage",
        "drop",
        "out_of_range",
        "abort",
        "bus_off",
        "stopped",
        "unplugged",
    )

    def __init__(self, address: Address) -> None:
        self.fault: Fault = parse_fault(address, self.faults)
        self._away = Unplugging(address, ("unplugged", "bus_off"))
        self._code = int(address.params.get("code", f"{NO_DATA:#x}"), 16)
        self._unit = int(address.params.get("unit", f"{CELSIUS:#x}"), 16)
        self._answers = 0
        node, seed = address.whole("node", 1, 127), int(address.number("seed", 0))
        self._rng = np.random.default_rng([abs(seed), *(address.path or "thermometer").encode()])
        self.world = world(address.host or DEFAULT_MACHINE, seed, warm=bool(address.number("warm", 1)))
        self.world.attach(self, address.number("pace", 0.0) or None)
        self._server: CanopenServer | None = None
        try:
            self._inputs = Inputs(self.world.machine, address)
            self._server = CanopenServer(
                node,
                _entries(len(self._inputs.names)),
                self._value,
                self._outgoing,
                bus=_bus(address),
                heartbeat=address.number("heartbeat", 0.1),
            )
        except BaseException:
            self.close()
            raise
        self.url = self._server.url

    def close(self) -> None:
        """End the device; with the last one of its world the world ends."""
        server, self._server = self._server, None
        if server is not None:
            server.close()
        self.world.detach(self)

    def report_delivered(self, samples: int) -> None:
        """Take no note: a node does not stream."""

    def _value(self, index: int, subindex: int) -> Any:
        n = len(self._inputs.names)
        if index in (VALUE, STATUS, UNIT):
            return n if subindex == 0 else self._reading(index, subindex - 1)
        known: dict[tuple[int, int], Any] = {
            (DEVICE_TYPE, 0): PROFILE,
            (NAME, 0): "Virtual CiA 404 thermometer",
            (HEARTBEAT, 0): 0,
            (IDENTITY, 0): 4,
            (IDENTITY, 1): 0,
            (IDENTITY, 2): 404,
            (IDENTITY, 3): 1,
            (IDENTITY, 4): self.world.seed,
        }
        return known.get((index, subindex))

    def _reading(self, index: int, channel: int) -> Any:
        if index == UNIT:
            return self._unit
        if self.fault.hits("abort", self._answers):
            raise Refused(self._code)
        far = self.fault.hits("out_of_range", self._answers)
        if index == STATUS:
            return POSITIVE if far or channel in self._inputs.open else NEGATIVE * (channel in self._inputs.shorted)
        if far or channel in self._inputs.open or channel in self._inputs.shorted:
            return math.inf if channel not in self._inputs.shorted else -math.inf
        scale, offset = to_celsius(self._unit)
        return (self._inputs.temperatures(self.world.time, self._rng)[channel] - offset) / scale

    def _outgoing(self, data: bytes) -> bytes | None:
        """Return an SDO answer as it goes out, None without an answer."""
        number, server = self._answers, self._server
        if server is None:
            return data
        if self._away.begins(number):
            if self.fault.kind == "bus_off":
                server.send_bus_off()
            server.stop_heartbeat()
        if self._away.now():
            return None
        if self._away.returns():
            server.boot()
        self._answers += 1
        if self.fault.kind == "stopped" and number >= self.fault.at:
            server.stop()
            return None
        if (self.fault.kind == "silence" and number >= self.fault.at) or self.fault.hits("drop", number):
            return None
        if self.fault.hits("garbage", number):
            return self._rng.integers(0, 256, self._rng.integers(1, 8), dtype=np.uint8).tobytes()
        return data


def _entries(n: int) -> list[Entry]:
    return [
        Entry(DEVICE_TYPE, "Device type", "u32"),
        Entry(NAME, "Manufacturer device name", "text"),
        Entry(HEARTBEAT, "Producer heartbeat time", "u16"),
        Entry(IDENTITY, "Identity", "u32", 4),
        Entry(VALUE, "AI input PV", "f32", n),
        Entry(UNIT, "AI physical unit PV", "u32", n),
        Entry(STATUS, "AI status", "u8", n),
    ]


def _bus(address: Address) -> dict[str, Any] | None:
    kind = address.params.get("bus", "virtual")
    if kind == "virtual":
        return None
    if kind != "udp_multicast":
        raise InstrumentError(f"'bus' in '{address.url}': expected 'virtual' or 'udp_multicast'; found '{kind}'")
    return {
        "interface": kind,
        "channel": address.params.get("group", "239.74.163.2"),
        "port": int(address.number("port", 43113)),
        "hop_limit": 0,  # it stays on this computer
    }
