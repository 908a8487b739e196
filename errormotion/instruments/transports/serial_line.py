"""A serial line, by default 8N1."""

from __future__ import annotations

import serial

from errormotion.errors import InstrumentError, InstrumentTimeoutError
from errormotion.instruments.transports.address import Address
from errormotion.instruments.transports.base import Transport

DEFAULT_BAUDRATE = 9600


class SerialTransport(Transport):
    """A serial line: 8 data bits, no parity, one stop bit, no flow control.

    Parameters of the address change this: ``databits=7``, ``parity=E`` or ``O``, ``stopbits=2``, ``xonxoff=1`` (either
    end holds the other by DC3 and releases it by DC1, which are then no data).
    """

    flow_control = False

    def __init__(self, address: Address, *, timeout: float = 1.0, baudrate: int | None = None) -> None:
        super().__init__(address.url, timeout)
        speed = int(address.number("baudrate", baudrate or DEFAULT_BAUDRATE))
        parity, stop_bits = address.params.get("parity", "N"), address.whole("stopbits", 1, 2)
        data_bits, held = address.whole("databits", 8, 8), address.whole("xonxoff", 0, 1)
        if data_bits < 7:
            raise InstrumentError(
                f"'databits' in '{address.url}': expected 7 or 8; found {data_bits}", code="address.number"
            )
        self._port: serial.Serial | None = None
        try:
            self._port = serial.Serial(
                address.path,
                speed,
                bytesize=data_bits,
                parity=parity,
                stopbits=stop_bits,
                xonxoff=bool(held),
                timeout=timeout,
                write_timeout=timeout,
            )
        except (OSError, ValueError) as error:  # SerialException is an OSError
            raise InstrumentError(
                f"The serial line {self.url} cannot be opened at {speed} baud: {error}", code="connection.not_opened"
            ) from None

    def _line(self) -> serial.Serial:
        if self._port is None:
            raise InstrumentError(f"The serial line {self.url} is closed", code="connection.closed")
        return self._port

    def _send(self, data: bytes) -> None:
        try:
            self._line().write(data)
        except serial.SerialTimeoutException:
            raise InstrumentTimeoutError(
                f"{self.url} accepted no data for {self.timeout:g} s", code="instrument.no_answer"
            ) from None
        except OSError as error:
            raise InstrumentError(f"The serial line {self.url} is lost: {error}", code="connection.lost") from None

    def _receive(self, max_bytes: int, timeout: float) -> bytes:
        port = self._line()
        try:
            if port.timeout != timeout:
                port.timeout = timeout
            data: bytes = port.read(1)
            if data and max_bytes > 1 and (waiting := port.in_waiting):
                data += port.read(min(waiting, max_bytes - 1))
        except (OSError, TypeError) as error:  # TypeError: from pyserial if the port is closed during the read
            raise InstrumentError(f"The serial line {self.url} is lost: {error}", code="connection.lost") from None
        if not data:
            raise InstrumentTimeoutError(f"{self.url} sent no data for {timeout:g} s", code="instrument.no_answer")
        return data

    def close(self) -> None:
        """Close the line; idempotent."""
        if self._port is not None:
            self._port.close()
            self._port = None
