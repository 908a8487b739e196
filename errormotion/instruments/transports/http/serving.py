"""An HTTP server on loopback, for simulated agents."""

from __future__ import annotations

import socket
import socketserver
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from urllib.parse import parse_qsl, unquote, urlsplit

from errormotion.instruments.transports.loopback.serving import listening_at, not_listening, reachable_at

_MAX_LINE_BYTES = 8192
_MAX_HEADERS = 100

Respond = Callable[[str, Mapping[str, str]], Iterator[bytes] | None]


class HttpServer:
    """Answers GET requests on any number of connections, where `serving.placed` states, else on a free loopback port.

    Parameters
    ----------
    name : str
        Name for the threads.
    respond : callable
        ``respond(path, query)`` returns the answer with its header in pieces; an empty piece, or None instead
        of the pieces, closes the connection. It is called in the thread of the connection.

    Attributes
    ----------
    url : str
        Address for the client.
    ended : threading.Event
        Set when the server closes: streams must end then.
    """

    def __init__(self, name: str, respond: Respond) -> None:
        self.ended = threading.Event()
        self._lines: set[socket.socket] = set()
        self._lock = threading.Lock()
        outer = self

        class Handler(socketserver.StreamRequestHandler):
            disable_nagle_algorithm = True

            def setup(self) -> None:
                super().setup()
                with outer._lock:
                    outer._lines.add(self.connection)

            def handle(self) -> None:
                with suppress(OSError, ValueError):
                    while (request := _request(self)) is not None and not outer.ended.is_set():
                        pieces = respond(*request)
                        if pieces is None:
                            return
                        for piece in pieces:
                            if not piece:
                                return
                            self.connection.sendall(piece)

            def finish(self) -> None:
                with outer._lock:
                    outer._lines.discard(self.connection)
                with suppress(OSError):
                    super().finish()

        class Server(socketserver.ThreadingTCPServer):
            allow_reuse_address = True
            daemon_threads = False  # closing waits for them

        host, port = listening_at()
        try:
            self._server = Server((host, port), Handler)
        except (OSError, UnicodeError) as error:
            raise not_listening(host, port, error) from None
        self.url = f"tcp://{reachable_at(host, self._server.server_address[1])}"
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.05,), name=f"sim-{name}-http", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """End all connections and threads; idempotent."""
        if self.ended.is_set():
            return
        self.ended.set()
        self._server.shutdown()
        self._thread.join()
        with self._lock:
            lines = list(self._lines)
        for line in lines:
            with suppress(OSError):
                line.shutdown(socket.SHUT_RDWR)
        self._server.server_close()


def _request(handler: socketserver.StreamRequestHandler) -> tuple[str, dict[str, str]] | None:
    """Return path and query of the next request; None if the client has disconnected or sent something else."""
    words = handler.rfile.readline(_MAX_LINE_BYTES).decode("latin-1").split()
    for _ in range(_MAX_HEADERS):
        if handler.rfile.readline(_MAX_LINE_BYTES) in (b"\r\n", b"\n", b""):
            break
    if len(words) != 3 or words[0] != "GET":
        return None
    parts = urlsplit(words[1])
    return unquote(parts.path), dict(parse_qsl(parts.query))
