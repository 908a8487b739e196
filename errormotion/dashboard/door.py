"""The door of the server: how many connections it keeps, and which requests it reads.

**Connections.** Idle ones cost nothing but their number, which the system limits. Beyond `Budget.most`, the one that
has been idle for longest is closed for each new one, first among those that have not presented a session: whoever holds
connections open does not keep the next one out.

**Requests.** Host, origin and session are checked when the header has arrived. The body of a refused request is not
stored; it is discarded up to a small size and time, so that the client can read the answer.
"""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable
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
from tornado.iostream import IOStream

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

MOST = 256
"""Number of connections; fewer where the system permits the process few open files."""
SHARE = 0.4
"""Share of the open files of the process that connections may use."""
DISCARDED = 1 << 16
"""Size of the body of a refused request that is discarded before the connection is closed, bytes."""
DISCARD_TIMEOUT = 2.0
"""Time for it, s."""

Refusal = Callable[[str, str, HTTPHeaders], tuple[int, str] | None]
"""Function of method, path and header: status and reason of a refusal, or None."""


@dataclass
class Line:
    """One connection: whether a request is in progress, since when not, and whether it has presented a session."""

    since: float
    busy: bool = False
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

    def arrive(self, stream: IOStream) -> bool:
        """Register a connection; return whether there is room for it, after another one was closed if necessary."""
        for each in [each for each in self.lines if each.closed()]:
            del self.lines[each]
        if len(self.lines) >= self.most:
            idle = [each for each, line in self.lines.items() if not line.busy]
            if not idle:
                return False
            oldest = min(idle, key=lambda each: (self.lines[each].trusted, self.lines[each].since))
            del self.lines[oldest]
            oldest.close()
        self.lines[stream] = Line(time.monotonic())
        return True

    def begin(self, stream: IOStream | None, *, trusted: bool) -> None:
        """State that a request of a connection is in progress, and whether its client has presented a session."""
        if stream in self.lines:
            line = self.lines[stream]
            line.busy, line.trusted = True, line.trusted or trusted

    def end(self, stream: IOStream | None) -> None:
        """State that the answer to a request has been written."""
        if stream in self.lines:
            self.lines[stream].busy, self.lines[stream].since = False, time.monotonic()


class Server(HTTPServer):
    """An HTTP server with a budget of connections; ``budget`` must be set before it listens."""

    budget: Budget

    def handle_stream(self, stream: IOStream, address: tuple[Any, ...]) -> None:
        """Serve a connection, or close it if all others have a request in progress."""
        if self.budget.arrive(stream):
            super().handle_stream(stream, address)
        else:
            stream.close()


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
