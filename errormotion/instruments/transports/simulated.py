"""``sim://``: a simulated device, and a real connection on loopback to it."""

from __future__ import annotations

from typing import Any

from errormotion.instruments.transports.address import Address, parse_address
from errormotion.instruments.transports.base import Transport
from errormotion.instruments.transports.serial_line import SerialTransport
from errormotion.instruments.transports.tcp import TcpTransport

RECEIVE_BUFFER = 65536
"""Bytes: bounds how far a virtual clock runs ahead of its reader."""


class SimulatedTransport(Transport):
    """A connection to a simulator that lives in this process and ends with the connection.

    ``simulator(address)`` starts the device; the object has ``url`` (a ``tcp://`` or ``serial://`` address on this
    machine), ``close()`` and ``handed_over(samples)``.
    """

    simulated = True

    def __init__(self, address: Address, simulator: Any, *, timeout: float = 1.0) -> None:
        super().__init__(address.url, timeout)
        self._device = simulator(address)
        inner = parse_address(self._device.url)
        try:
            self._inner: Transport = (
                TcpTransport(inner, timeout=timeout, receive_buffer=RECEIVE_BUFFER)
                if inner.scheme == "tcp"
                else SerialTransport(inner, timeout=timeout)
            )
        except BaseException:
            self._device.close()
            raise
        self._inner.url = self.url  # messages name the address that a person knows

    def _send(self, data: bytes) -> None:
        self._inner.write(data)

    def _receive(self, max_bytes: int, timeout: float) -> bytes:
        return self._inner.read(max_bytes, timeout)

    def handed_over(self, samples: int) -> None:
        """Tell the simulator how far its reader is."""
        self._device.handed_over(samples)

    def close(self) -> None:
        """Close the connection and end the device; idempotent."""
        self._inner.close()
        self._device.close()
