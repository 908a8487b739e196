"""Bases of simulated devices: world, connection, fault, and answers by line."""

from __future__ import annotations

import numpy as np

from errormotion.instruments.simulators.faults import Fault, LateAnswer, parse_fault, stray_bytes
from errormotion.instruments.simulators.virtual_world.world import world
from errormotion.instruments.transports import Address
from errormotion.instruments.transports.loopback.serving import make_server

DEFAULT_MACHINE = "cframe"


class SimulatedDevice:
    """A device in a virtual world that answers line by line.

    Parameters
    ----------
    address : Address
        ``sim://machine/device?seed=...``
    line_end : bytes
        End of a request.
    default_name : str
        Name of the device, if the address has none.
    every : int
        Default period of faults.

    Attributes
    ----------
    url : str
        Address of the device for the driver.
    """

    def __init__(self, address: Address, *, line_end: bytes, default_name: str, every: int = 1) -> None:
        self.name = address.path or default_name
        self.params = address.params
        self.fault: Fault = parse_fault(address, self.faults, every=every)
        self._line_end = line_end
        self._buffer = b""
        self._answers = 0
        self._late = LateAnswer()
        seed = int(address.number("seed", 0))
        self._rng = np.random.default_rng([abs(seed), *self.name.encode()])
        self.world = world(address.host or DEFAULT_MACHINE, seed, warm=bool(address.number("warm", 1)))
        pace = address.number("pace", 0.0)
        self.world.attach(self, pace or None)
        if clock := address.number("clock", 0.0):
            self.world.tick(clock)
        try:
            self._server = make_server(
                address.params.get("wire", "tcp"), self.name, self._on_data, self.connection_opened
            )
        except BaseException:
            self.world.detach(self)
            raise
        self.url = self._server.url
        self._server.start()

    faults: tuple[str, ...] = ()
    """Faults that the device offers."""

    drops_answers = True
    """Whether ``drop`` and ``disconnect`` count answers; else samples."""

    def close(self) -> None:
        """End the device; the last device of a world also ends the world."""
        self._late.close()
        self._server.close()
        self.world.detach(self)

    def report_delivered(self, samples: int) -> None:
        """Record the number of samples of the running stream that the reader has received."""

    def connection_opened(self) -> None:
        """Discard an incomplete request of the previous connection."""
        self._buffer = b""

    def answer(self, request: bytes) -> bytes:
        """Return the answer to one request, given without its line end."""
        raise NotImplementedError

    def reply(self, data: bytes) -> None:
        """Send an answer, with the fault that applies to it."""
        number, fault = self._answers, self.fault
        self._answers += 1
        if (fault.kind == "silence" and self._silent()) or (fault.hits("drop", number) and self.drops_answers):
            return
        if fault.kind == "disconnect" and self.drops_answers and number >= fault.at:
            self._server.disconnect()
            return
        if fault.hits("garbage", number):
            data = stray_bytes(self._rng) + data
        self._late.send(self._server, fault, number, data)

    def _silent(self) -> bool:
        return self._answers > self.fault.at

    def _on_data(self, data: bytes) -> None:
        self._buffer += data
        while self._line_end in self._buffer:
            request, _, self._buffer = self._buffer.partition(self._line_end)
            self.reply(self.answer(request))
