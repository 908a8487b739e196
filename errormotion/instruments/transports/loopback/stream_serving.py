"""Server of a line that only sends, with several connections: it sends to the newest one."""

from __future__ import annotations

import select
import socket
import threading
from collections.abc import Callable

from errormotion.instruments.transports.loopback.serving import TcpServer, closed_by_client

MAX_CONNECTIONS = 16
"""Largest number of open connections; beyond it the oldest one is closed."""


class NewestConnectionServer(TcpServer):
    """Sends data to the connection that was the newest at `select`.

    Others remain open and receive nothing, as expected by clients that open a connection for each measurement.
    """

    def __init__(self, name: str, on_data: Callable[[bytes], None]) -> None:
        super().__init__(name, on_data)
        self._listener.setblocking(False)
        self._lines: list[socket.socket] = []  # the newest one last
        self._accepting = threading.Lock()

    def accept_pending(self) -> bool:
        """Accept pending connections; return whether there is one that its client has not closed.

        A client may have closed a connection before it was accepted, or without the thread having noticed.
        """
        with self._accepting:
            while not self._ended.is_set():
                try:
                    line, _ = self._listener.accept()
                except OSError:
                    break
                line.setblocking(True)
                line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._lines.append(line)
                self._connected.set()
                self._wake_write.send(b"+")
            for line in self._lines[:-MAX_CONNECTIONS]:
                _shut(line)
            return any(not closed_by_client(line) for line in self._lines)

    def select(self) -> None:
        """Send to the newest connection from now on."""
        with self._accepting:
            self._line = self._lines[-1] if self._lines else None

    def drop_older(self) -> None:
        """End all connections but the newest one, so that a sender that waits for one of them continues."""
        with self._accepting:
            for line in self._lines[:-1]:
                _shut(line)

    def disconnect(self) -> None:
        """Drop all connections; clients can connect again."""
        with self._accepting:
            for line in self._lines:
                _shut(line)

    def send(self, data: bytes | memoryview) -> bool:
        """Send all bytes on the selected connection, waiting while its buffers are full; False without one."""
        with self.lock:
            line = self._line
            try:
                if line is None:
                    return False
                line.sendall(data)
            except OSError:
                return False
            return True

    def _run(self) -> None:
        while not self._ended.is_set():
            ready, _, _ = select.select([self._listener, self._wake_read, *self._lines], [], [])
            if self._wake_read in ready:
                self._wake_read.recv(64)
            if self._ended.is_set():
                break
            for line in [line for line in self._lines if line in ready]:
                self._receive(line)
            self.accept_pending()

    def _receive(self, line: socket.socket) -> None:
        try:
            data = line.recv(4096)
        except OSError:
            data = b""
        if data:
            self._deliver(data)
            return
        with self._accepting:
            self._lines.remove(line)
            if line is self._line:
                self._line = None
            if not self._lines:
                self._connected.clear()
        with self.lock:  # a sender that used it has ended
            line.close()

    def _release(self) -> None:
        with self.lock:
            for line in self._lines:
                line.close()
            self._lines, self._line = [], None
            self._listener.close()


def _shut(line: socket.socket) -> None:
    try:
        line.shutdown(socket.SHUT_RDWR)
    except OSError:
        return  # the other side has closed it already
