"""``sim://``: a simulated device, and a real connection on loopback to it."""

from __future__ import annotations

from copy import copy
from typing import Any

from errormotion.errors import InstrumentError
from errormotion.instruments.transports.address import Address, parse_address
from errormotion.instruments.transports.base import Transport
from errormotion.instruments.transports.serial_line import SerialTransport
from errormotion.instruments.transports.tcp import TcpTransport

RECEIVE_BUFFER = 65536
"""Size of the buffer, bytes; limits how far a virtual clock runs ahead of its reader."""


class SimulatedTransport(Transport):
    """A connection to a simulator, which runs in this process and ends with the connection.

    ``simulator(address)`` starts the device, see `load_simulator`; the object has ``url`` (a ``tcp://`` or
    ``serial://`` address on this machine), ``close()`` and ``report_delivered(samples)``. A device with several lines
    has ``urls`` with the further ones by name.
    """

    simulated = True

    def __init__(self, address: Address, simulator: Any, *, timeout: float = 1.0, baudrate: int | None = None) -> None:
        super().__init__(address.url, timeout)
        self._baudrate = baudrate
        self._device = simulator(address)
        self._inner = self._connect(self._device.url)

    def further(self, name: str) -> Transport:
        """Open a further line of the same device; InstrumentError if it has none with this name."""
        urls = getattr(self._device, "urls", {})
        if name not in urls:
            raise InstrumentError(
                f"The simulated device at {self.url} has no line '{name}'; it has: {', '.join(urls)}",
                code="simulator.line.missing",
            )
        line = copy(self)
        line._inner = self._connect(urls[name])
        return line

    def _connect(self, url: str) -> Transport:
        inner = parse_address(url)
        try:
            line: Transport = (
                TcpTransport(inner, timeout=self.timeout, receive_buffer=RECEIVE_BUFFER)
                if inner.scheme == "tcp"
                else SerialTransport(inner, timeout=self.timeout, baudrate=self._baudrate)
            )
        except BaseException:
            self._device.close()
            raise
        line.url = self.url  # messages state the address in the bench file
        return line

    def _send(self, data: bytes) -> None:
        self._inner.write(data)

    def _receive(self, max_bytes: int, timeout: float) -> bytes:
        return self._inner.read(max_bytes, timeout)

    def reopen(self) -> bool:
        """Open another connection to the same simulated device."""
        self._rest = b""
        return self._inner.reopen()

    def report_delivered(self, samples: int) -> None:
        """Report the number of samples that the caller has received to the simulator."""
        self._device.report_delivered(samples)

    def close(self) -> None:
        """Close the connection and end the device; idempotent."""
        self._inner.close()
        self._device.close()
