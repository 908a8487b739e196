"""The door of the server: how many connections it keeps, and which requests it reads.

**Connections.** Idle ones cost nothing but their number, which the system limits. Beyond `Budget.most`, the one that
has been idle for longest is closed for each new one, first among those that have not presented a session: whoever holds
connections open does not keep the next one out.

A new one has `GRACE` and `TURNS` of the event loop for its first request, in which no other closes it; meanwhile those
that follow wait to be accepted.

**Requests.** Host, origin and session are checked when the header has arrived. The body of a refused request is not
stored; it is discarded up to a small size and time, so that the client can read the answer.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Awaitable, Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from tornado.httpserver import HTTPServer
from tornado.httputil import (
    HTTPConnection,
    HTTPHeaders,
    HTTPMessageDelegate,
    HTTPServerConnectionDelegate,
    RequestStartLine,
    ResponseStartLine,
)
from tornado.ioloop import IOLoop
from tornado.iostream import IOStream
from tornado.netutil import bind_sockets

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

MOST = 256
"""Number of connections; fewer where the system permits the process few open files."""
SHARE = 0.4
"""Share of the open files of the process that connections may use."""
GRACE, TURNS = 0.5, 5
"""Time for the first request of a connection, s, and turns of the event loop after it: under load these are slow."""
PAUSE = 0.02
"""Time after which the number of connections is checked again, s."""
WAITING = 1024
"""Number of connections that the system keeps until they are accepted."""
DISCARDED = 1 << 16
"""Size of the body of a refused request that is discarded before the connection is closed, bytes."""
DISCARD_TIMEOUT = 2.0
"""Time for it, s."""

Refusal = Callable[[str, str, HTTPHeaders], tuple[int, str] | None]
"""Function of method, path and header: status and reason of a refusal, or None."""


@dataclass
class Line:
    """One connection: a request is in progress, or since when not; its first was due; it has presented a session."""

    since: float
    busy: bool = False
    settled: bool = False
    trusted: bool = False


def most_connections() -> int:
    """Return the number of connections that the open files of this process permit."""
    if resource is None:
        return MOST
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return MOST if soft == resource.RLIM_INFINITY else max(16, min(MOST, int(SHARE * soft)))


@dataclass
class Budget:
    """The connections of a server."""

    most: int = field(default_factory=most_connections)
    lines: dict[IOStream, Line] = field(default_factory=dict)

    def has_room(self) -> bool:
        """Return whether a connection can be accepted, after another one is closed if necessary."""
        for each in [each for each in self.lines if each.closed()]:
            del self.lines[each]
        return len(self.lines) < self.most or bool(self._idle())

    def _idle(self) -> list[IOStream]:
        return [each for each, line in self.lines.items() if line.settled and not line.busy]

    def arrive(self, stream: IOStream) -> bool:
        """Register a connection; return whether there is room for it, after another one was closed if necessary."""
        if not self.has_room():
            return False
        if len(self.lines) >= self.most:
            idle = self._idle()
            oldest = min(idle, key=lambda each: (self.lines[each].trusted, self.lines[each].since))
            del self.lines[oldest]
            oldest.close()
        self.lines[stream] = Line(time.monotonic())
        return True

    def settle(self, stream: IOStream | None) -> None:
        """State that a request of a connection has arrived, or was due; until `begin` it can be closed for another."""
        if stream in self.lines:
            self.lines[stream].settled = True

    def begin(self, stream: IOStream | None, *, trusted: bool) -> None:
        """State that a request of a connection is in progress, and whether its client has presented a session."""
        if stream in self.lines:
            line = self.lines[stream]
            line.busy, line.settled, line.trusted = True, True, line.trusted or trusted

    def end(self, stream: IOStream | None) -> None:
        """State that the answer to a request has been written."""
        if stream in self.lines:
            self.lines[stream].busy, self.lines[stream].since = False, time.monotonic()


class Listener(socket.socket):
    """A listening socket that accepts connections while there is room; ``budget`` must be set before."""

    budget: Budget

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept a connection.

        Raises
        ------
        BlockingIOError
            None waits, or there is no room.
        """
        if not self.budget.has_room():
            loop = IOLoop.current()
            loop.update_handler(self, 0)
            loop.call_later(PAUSE, self._resume)
            raise BlockingIOError
        return super().accept()

    def _resume(self) -> None:
        if self.fileno() >= 0:
            IOLoop.current().update_handler(self, IOLoop.READ)


def listeners(port: int, host: str) -> list[Listener]:
    """Return sockets that listen on an address.

    Raises
    ------
    OSError
        The address is unknown or in use.
    """
    return [Listener(fileno=each.detach()) for each in bind_sockets(port, host, backlog=WAITING)]


class Server(HTTPServer):
    """An HTTP server with a budget of connections; ``budget`` must be set before it listens."""

    budget: Budget

    def add_sockets(self, sockets: Iterable[socket.socket]) -> None:
        """Accept connections while the budget has room."""
        sockets = list(sockets)
        for each in sockets:
            if isinstance(each, Listener):
                each.budget = self.budget
        super().add_sockets(sockets)

    def handle_stream(self, stream: IOStream, address: tuple[Any, ...]) -> None:
        """Serve a connection, or close it if all others have a request in progress."""
        if self.budget.arrive(stream):
            super().handle_stream(stream, address)
            IOLoop.current().call_later(GRACE, self._settle, stream, TURNS)
        else:
            stream.close()

    def _settle(self, stream: IOStream, turns: int) -> None:
        if turns:
            IOLoop.current().add_callback(self._settle, stream, turns - 1)
        else:
            self.budget.settle(stream)


class Door(HTTPServerConnectionDelegate):
    """Passes the requests on to an application that may be read.

    Parameters
    ----------
    application : HTTPServerConnectionDelegate
    refusal : callable
    longest : callable
        Largest size of the body of a path, bytes.
    """

    def __init__(
        self, application: HTTPServerConnectionDelegate, refusal: Refusal, longest: Callable[[str], int]
    ) -> None:
        self.application, self.refusal, self.longest = application, refusal, longest

    def start_request(self, server_conn: object, request_conn: HTTPConnection) -> HTTPMessageDelegate:
        """Return the reader of a request."""
        return _Request(self, self.application.start_request(server_conn, request_conn), request_conn)

    def on_close(self, server_conn: object) -> None:
        """Pass the end of a connection on."""
        self.application.on_close(server_conn)


class _Request(HTTPMessageDelegate):
    def __init__(self, door: Door, inner: HTTPMessageDelegate, connection: Any) -> None:
        self._door, self._inner, self._connection = door, inner, connection
        self._answered = False

    def headers_received(
        self, start_line: RequestStartLine | ResponseStartLine, headers: HTTPHeaders
    ) -> Awaitable[None] | None:
        assert isinstance(start_line, RequestStartLine)
        path = start_line.path.partition("?")[0]
        has_body = "Content-Length" in headers or "Transfer-Encoding" in headers
        self._answered = has_body and self._door.refusal(start_line.method, path, headers) is not None
        if has_body:
            self._connection.set_max_body_size(DISCARDED if self._answered else self._door.longest(path))
        if not self._answered:
            return self._inner.headers_received(start_line, headers)
        self._connection.set_body_timeout(DISCARD_TIMEOUT)
        self._inner.headers_received(start_line, headers)
        self._inner.finish()  # the handler refuses a request without its body, by the same rule
        return None

    def data_received(self, chunk: bytes) -> Awaitable[None] | None:
        return None if self._answered else self._inner.data_received(chunk)

    def finish(self) -> None:
        if not self._answered:
            self._inner.finish()

    def on_connection_close(self) -> None:
        self._inner.on_connection_close()
