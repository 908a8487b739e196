"""Servers of simulated devices, on a free port of loopback or at the port and host in an address.

The parameters ``port`` and ``host`` of a ``sim://`` address apply to every server of the simulator: the first one
listens at ``port``, a further line of the same device at the next port.
"""

from __future__ import annotations

import logging
import os
import select
import socket
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

from errormotion.errors import InstrumentError
from errormotion.instruments.transports.address import Address

LOOPBACK = "127.0.0.1"
ANY_HOST = "0.0.0.0"
ACCEPT_POLL = 0.002
"""Interval between two checks for a client, s."""
SEND_BUFFER = 32768
"""Size of the buffer, bytes; limits how far a virtual clock runs ahead of its reader."""

log = logging.getLogger(__name__)


@dataclass
class Placement:
    """Host and port of the servers of one simulated device.

    Attributes
    ----------
    host : str
        Name or address of an interface of this computer.
    port : int
        Port of the next server; 0: any free one.
    """

    host: str = LOOPBACK
    port: int = 0


_placement: ContextVar[Placement | None] = ContextVar("placement", default=None)


@contextmanager
def placed(address: Address) -> Iterator[None]:
    """Make the servers that are created in this context listen at the port and host in an address; see the module.

    Raises
    ------
    InstrumentError
        ``port`` is not a port number.
    """
    placement = Placement(address.params.get("host", LOOPBACK), address.whole("port", 0, 65535))
    token = _placement.set(placement)
    try:
        yield
    finally:
        _placement.reset(token)


def standing_alone() -> bool:
    """Whether the servers that are created now have a stated port, so that their device outlives its clients."""
    placement = _placement.get()
    return placement is not None and placement.port > 0


def listening_at() -> tuple[str, int]:
    """Return host and port for the next server to be created; the one after it gets the next port."""
    placement = _placement.get() or Placement()
    port = placement.port
    if port:
        placement.port = port + 1 if port < 65535 else 0
    return placement.host, port


def reachable_at(host: str, port: int) -> str:
    """Return host and port for a client on this computer."""
    return f"{LOOPBACK if host in (ANY_HOST, '') else host}:{port}"


def not_listening(host: str, port: int, error: Exception) -> InstrumentError:
    """Return the error of a server that cannot listen."""
    reason = getattr(error, "strerror", None) or error
    return InstrumentError(
        f"The simulated device cannot listen at {host}:{port}: {reason}. Choose another port, or an address of this "
        "computer",
        code="simulator.not_listening",
    )


class Server(ABC):
    """Server of one device, with a thread that passes received bytes on.

    Attributes
    ----------
    url : str
        Address for the driver.
    lock : threading.RLock
        Held while bytes are sent, so that the bytes of two senders are not mixed.
    """

    url: str

    def __init__(
        self, name: str, on_data: Callable[[bytes], None], on_connection: Callable[[], None] | None = None
    ) -> None:
        self._on_data = on_data
        self._on_connection = on_connection or _nothing
        self._alone = standing_alone()
        self.lock = threading.RLock()
        self._ended = threading.Event()
        self._wake_read, self._wake_write = socket.socketpair()
        self._thread = threading.Thread(target=self._run, name=f"sim-{name}", daemon=True)

    def start(self) -> None:
        """Start listening."""
        self._thread.start()

    def close(self) -> None:
        """Disconnect and end the thread; idempotent."""
        if self._ended.is_set():
            return
        self._ended.set()
        self.disconnect()
        self._wake_write.send(b".")
        if self._thread is not threading.current_thread() and self._thread.ident is not None:
            self._thread.join()
        self._release()
        self._wake_read.close()
        self._wake_write.close()

    @property
    def connection(self) -> object:
        """The present connection: a different object for each connection."""
        return self

    @abstractmethod
    def send(self, data: bytes | memoryview) -> bool:
        """Send all bytes, waiting while the buffers of the reader are full; False without a connection."""

    @abstractmethod
    def disconnect(self) -> None:
        """Drop the present connection; clients can connect again."""

    def _deliver(self, data: bytes) -> None:
        """Pass bytes on. After an error, a device with a stated port disconnects its client and continues."""
        try:
            self._on_data(data)
        except Exception:
            if not self._alone:
                raise
            log.exception("the simulated device failed at %r", data[:200])
            self.disconnect()

    @abstractmethod
    def _run(self) -> None: ...

    @abstractmethod
    def _release(self) -> None: ...


def _nothing() -> None:
    return


class TcpServer(Server):
    """Listens where `placed` states, else on a free port of loopback; one connection at a time.

    Attributes
    ----------
    connections : int
        Number of connections accepted so far.
    """

    def __init__(
        self, name: str, on_data: Callable[[bytes], None], on_connection: Callable[[], None] | None = None
    ) -> None:
        super().__init__(name, on_data, on_connection)
        host, port = listening_at()
        try:
            self._listener = socket.create_server((host, port))
        except (OSError, UnicodeError) as error:
            self._wake_read.close()
            self._wake_write.close()
            raise not_listening(host, port, error) from None
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        self._line: socket.socket | None = None
        self._connected = threading.Event()
        self.connections = 0
        self.url = f"tcp://{reachable_at(host, self._listener.getsockname()[1])}"

    @property
    def connection(self) -> object:
        """The present connection; None without one."""
        return self._line

    def await_connection(self, timeout: float) -> bool:
        """Wait for a connection; return False without one within ``timeout`` s.

        A new connection may not have been accepted yet; on a line that only sends, nothing else indicates it.
        """
        return self._connected.wait(timeout)

    def await_present_client(self, timeout: float) -> bool:
        """Wait for a connection that the client has not closed; return False without one within ``timeout`` s.

        For a line that only sends: that a client has disconnected, or another one has connected, may not have been
        detected.
        """
        end = time.monotonic() + timeout
        while (left := end - time.monotonic()) > 0:
            line = self._line
            if line is not None and not closed_by_client(line):
                return self._connected.wait(left)
            time.sleep(ACCEPT_POLL)
        return False

    def send(self, data: bytes | memoryview) -> bool:
        """Send all bytes, waiting while the buffers of the reader are full; False without a connection."""
        with self.lock:
            line = self._line
            if line is None:
                return False
            try:
                line.sendall(data)
            except OSError:
                return False
            return True

    def disconnect(self) -> None:
        """Drop the present connection; clients can connect again."""
        line = self._line  # no lock: a sender may hold it while it waits for a reader that has disconnected
        if line is not None:
            try:
                line.shutdown(socket.SHUT_RDWR)
            except OSError:
                return  # the other side has closed it already

    def _run(self) -> None:
        while not self._ended.is_set():
            ready, _, _ = select.select([self._line or self._listener, self._wake_read], [], [])
            if self._wake_read in ready:
                break
            if self._line is None:
                line, _ = self._listener.accept()
                line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._line = line
                self.connections += 1
                self._on_connection()
                self._connected.set()
                continue
            try:
                data = self._line.recv(4096)
            except OSError:
                data = b""
            if data:
                self._deliver(data)
            else:
                self._forget()

    def _forget(self) -> None:
        line = self._line
        self.disconnect()
        with self.lock:
            self._line = None
            self._connected.clear()
        if line is not None:
            line.close()

    def _release(self) -> None:
        self._forget()
        self._listener.close()


def closed_by_client(line: socket.socket) -> bool:
    """Whether the other side has closed a connection on which nothing is received."""
    try:
        return line.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True


class PtyServer(Server):
    """A pseudo terminal: the driver opens its far end as a serial line."""

    def __init__(
        self, name: str, on_data: Callable[[bytes], None], on_connection: Callable[[], None] | None = None
    ) -> None:
        import termios  # only available on systems with terminals
        import tty

        super().__init__(name, on_data, on_connection)
        self._near, self._far = os.openpty()  # the far end remains open here, since its last close would end the line
        tty.setraw(self._far)
        flags = termios.tcgetattr(self._far)
        flags[4] = flags[5] = termios.B0  # not set by a driver yet
        termios.tcsetattr(self._far, termios.TCSANOW, flags)
        os.set_blocking(self._near, False)
        self._cut = False
        self.url = f"serial://{os.ttyname(self._far)}"

    @property
    def baudrate(self) -> int:
        """Baud rate that a driver has set; 0 before."""
        import termios

        code = termios.tcgetattr(self._far)[5]
        rates = {
            getattr(termios, name): int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit()
        }
        return rates.get(code, 0)

    def send(self, data: bytes | memoryview) -> bool:
        """Send all bytes, waiting while the buffers of the reader are full; False without a connection."""
        view = memoryview(data)
        with self.lock:
            while len(view) and not (self._ended.is_set() or self._cut):
                if select.select([], [self._near], [], 0.05)[1]:
                    try:
                        view = view[os.write(self._near, view) :]
                    except BlockingIOError:
                        continue
                    except OSError:
                        return False
        return not self._cut and not self._ended.is_set()

    def disconnect(self) -> None:
        """Simulate an unplugged cable: a serial line has no connection to drop, it only stops sending."""
        self._cut = True

    def _run(self) -> None:
        while not self._ended.is_set():
            ready, _, _ = select.select([self._near, self._wake_read.fileno()], [], [])
            if self._wake_read.fileno() in ready:
                break
            try:
                data = os.read(self._near, 4096)
            except OSError:
                break
            if data and not self._cut:
                self._deliver(data)

    def _release(self) -> None:
        os.close(self._near)
        os.close(self._far)


def make_server(
    wire: str, name: str, on_data: Callable[[bytes], None], on_connection: Callable[[], None] | None = None
) -> Server:
    """Return a server for ``wire``, ``tcp`` or ``pty``; InstrumentError for another value.

    ``on_data`` is called with received bytes, ``on_connection`` at the start of a TCP connection.
    """
    if wire == "tcp":
        return TcpServer(name, on_data, on_connection)
    if wire == "pty":
        return PtyServer(name, on_data, on_connection)
    raise InstrumentError(
        f"Expected 'wire=tcp' or 'wire=pty' for a simulated device; found 'wire={wire}'", code="simulator.wire.unknown"
    )
