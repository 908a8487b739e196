"""Connections to TCP and Unix sockets."""

from __future__ import annotations

import socket
from pathlib import Path

from errormotion.errors import InstrumentError, InstrumentTimeoutError
from errormotion.instruments.transports.address import Address
from errormotion.instruments.transports.base import Transport


class TcpTransport(Transport):
    """A TCP connection to a device or a serial server.

    ``receive_buffer`` (bytes) limits the data that the system buffers for a slow reader; default: the limit of the
    system.
    """

    _family = socket.AF_INET

    def __init__(self, address: Address, *, timeout: float = 1.0, receive_buffer: int | None = None) -> None:
        super().__init__(address.url, timeout)
        self._host, self._port, self._receive_buffer = address.host, address.port, receive_buffer
        self._socket: socket.socket | None = self._connected()

    def reopen(self) -> bool:
        """Open another connection to the same device; always True."""
        self._rest = b""
        self.close()
        self._socket = self._connected()
        return True

    def _connect(self, line: socket.socket) -> None:
        line.connect((self._host, self._port))
        line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def _connected(self) -> socket.socket:
        line = socket.socket(self._family, socket.SOCK_STREAM)
        try:
            if self._receive_buffer is not None:
                line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, self._receive_buffer)
            line.settimeout(self.timeout)
            self._connect(line)
        except TimeoutError:
            line.close()
            raise InstrumentTimeoutError(
                f"No device answered at {self.url} within {self.timeout:g} s", code="instrument.no_answer"
            ) from None
        except OSError as error:
            line.close()
            raise InstrumentError(
                f"No connection to {self.url}: {error.strerror or error}; is the device on?",
                code="connection.not_opened",
            ) from None
        return line

    def _line(self) -> socket.socket:
        if self._socket is None:
            raise InstrumentError(f"The connection to {self.url} is closed", code="connection.closed")
        return self._socket

    def _send(self, data: bytes) -> None:
        line = self._line()
        try:
            line.settimeout(self.timeout)
            line.sendall(data)
        except TimeoutError:
            raise InstrumentTimeoutError(
                f"{self.url} accepted no data for {self.timeout:g} s", code="instrument.no_answer"
            ) from None
        except OSError as error:
            raise InstrumentError(
                f"The connection to {self.url} is lost: {error.strerror or error}", code="connection.lost"
            ) from None

    def _receive(self, max_bytes: int, timeout: float) -> bytes:
        line = self._line()
        try:
            line.settimeout(timeout)
            data = line.recv(max_bytes)
        except (TimeoutError, BlockingIOError):
            raise InstrumentTimeoutError(
                f"{self.url} sent no data for {timeout:g} s", code="instrument.no_answer"
            ) from None
        except OSError as error:
            raise InstrumentError(
                f"The connection to {self.url} is lost: {error.strerror or error}", code="connection.lost"
            ) from None
        if not data:
            raise InstrumentError(f"The connection to {self.url} is lost: the device closed it", code="connection.lost")
        return data

    def close(self) -> None:
        """Close the connection; idempotent."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class UnixTransport(TcpTransport):
    """A connection to a Unix socket of this computer; the path may start with ``~``."""

    _family = socket.AF_UNIX

    def __init__(self, address: Address, *, timeout: float = 1.0) -> None:
        self._path = str(Path(address.path).expanduser())
        super().__init__(address, timeout=timeout)

    def _connect(self, line: socket.socket) -> None:
        line.connect(self._path)
