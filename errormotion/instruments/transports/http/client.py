"""Requests to an HTTP server on one connection, which is opened again after the server has closed it.

Only GET, bodies of limited size, and multipart streams are available. Each answer, and each part of a stream, has a
time limit from its first byte to its last; each line, head and body has a size limit. Sessions are recorded and
replayed like those of every other transport; the end of a connection is recorded as a frame without bytes.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.transports import load_simulator
from errormotion.instruments.transports.address import Address, parse_address
from errormotion.instruments.transports.base import CHUNK, Transport
from errormotion.instruments.transports.http.answer import Head, Input, Lines, header_fields
from errormotion.instruments.transports.recording import Recorder, ReplayTransport
from errormotion.instruments.transports.tcp import TcpTransport

PORT = 80
MAX_BODY_BYTES = 16 << 20
"""Default size limit of a body, bytes."""
_MAX_BLANK_LINES = 16
"""Largest number of blank lines between two parts of a stream."""
_MAX_DIGITS = 12
"""Largest number of digits of the size of a part."""
_ANSWER_TIMEOUTS = 10.0
"""Time limit for a complete answer, as a multiple of the time limit without data."""


@dataclass(frozen=True)
class Answer:
    """Answer of a server: status (200, 404, ...), type of the body, body."""

    status: int
    content_type: str
    body: bytes


class HttpTransport(Transport):
    """A connection to an HTTP server.

    Parameters
    ----------
    url : str
        ``http://host:port/path``, ``sim://``, ``replay://file``.
    simulator : str, optional
        ``module:Class`` of the simulator for ``sim://``.
    recorder : Recorder or path, optional
        File or recorder to which every frame of the session is written.
    timeout : float
        Time limit without data, s.

    Attributes
    ----------
    target : Address
        Address of the server; for a recording the recorded address.

    Raises
    ------
    InstrumentError
        Another scheme, no answer, no simulator, or the recording already exists.
    """

    def __init__(
        self,
        url: str,
        *,
        simulator: str | None = None,
        recorder: Recorder | Path | str | None = None,
        timeout: float = 1.0,
    ) -> None:
        super().__init__(url, timeout)
        self._address = self.target = parse_address(url)
        self._device: Any = None
        self._line: Transport | None = None
        self._fresh = True
        self._recorder: Recorder | None = None
        match self._address.scheme:
            case "http" | "tcp":
                pass
            case "sim":
                self._device = load_simulator(simulator, url)(self._address)
                self.simulated = True
            case "replay":
                replayed = ReplayTransport(Path(self._address.path), timeout=timeout)
                self.target, self.simulated = parse_address(replayed.recorded_address), replayed.simulated
                self._line = replayed
            case _:
                raise InstrumentError(
                    f"Expected an address such as http://192.168.0.5:5000/device; found '{url}'", code="address.form"
                )
        try:
            self._connected()
            if recorder is not None:
                self._recorder = recorder if isinstance(recorder, Recorder) else Recorder(recorder, url)
        except BaseException:
            self.close()
            raise

    # ------------------------------------------------------------------ requests

    def get(self, path: str, query: Mapping[str, str] | None = None, *, limit: int = MAX_BODY_BYTES) -> Answer:
        """Request a path.

        A connection that the server has closed since the last answer is opened again.

        Raises
        ------
        InstrumentTimeoutError
            No answer, or an incomplete one within ten times the time limit without data.
        ProtocolError
            The answer is not HTTP, or its body is larger than ``limit``.
        InstrumentError
            The connection is lost.
        """
        response, source = self._response(path, query, keep=True)
        try:
            body = response.body(limit)
        except BaseException:
            self._disconnect()
            raise
        if response.closes or source.waiting:  # bytes after the answer would be read as the next one
            self._disconnect()
        return Answer(response.status, _content_type(response), body)

    def parts(
        self, path: str, query: Mapping[str, str] | None = None, *, limit: int = MAX_BODY_BYTES
    ) -> Iterator[bytes]:
        """Request a multipart stream, and yield the body of each part as it arrives.

        An answer that is not multipart is yielded as one body. The connection is closed with the iterator; the next
        request opens another one.

        Raises
        ------
        InstrumentTimeoutError
            See `get`; each part must be complete within ten times the time limit after its first line.
        ProtocolError, InstrumentError
            See `get`. The iterator ends when the server ends the stream.
        """
        response, source = self._response(path, query, keep=False)
        try:
            boundary = _boundary(response)
            if not boundary:
                yield response.body(limit)
                return
            lines = Lines(response, self.url)
            while (part := self._part(source, lines, boundary, limit)) is not None:
                yield part
        finally:
            self._disconnect()

    def _part(self, source: Input, lines: Lines, boundary: bytes, limit: int) -> bytes | None:
        """Return the next part of a stream; None at its end."""
        source.deadline = math.inf  # between two parts only the time limit without data applies
        for _ in range(_MAX_BLANK_LINES + 1):  # blank lines after the preceding part
            line = lines.line()
            if line != b"":
                break
        if line is None or line == b"--" + boundary + b"--":
            return None
        if line != b"--" + boundary:
            raise ProtocolError(
                f"{self.url}: expected the boundary {b'--' + boundary!r} of a part; found {line[:80]!r}",
                code="protocol.http.boundary",
            )
        source.deadline = self._deadline()
        text = header_fields(lines.line, self.url).get("content-length", "")
        size = int(text) if text.isascii() and text.isdigit() and len(text) <= _MAX_DIGITS else None
        if size is None or size > limit:
            raise ProtocolError(
                f"{self.url}: expected a part of 0 to {limit} bytes; found {size}", code="protocol.http.length"
            )
        return lines.block(size)

    def _response(self, path: str, query: Mapping[str, str] | None, *, keep: bool) -> tuple[Head, Input]:
        """Send a request; return the answer, whose head has been read, and the bytes that follow."""
        target = quote(path) + (f"?{urlencode(query)}" if query else "")
        host = f"{self.target.host}:{self.target.port}" if self.target.port else self.target.host
        request = (
            f"GET {target} HTTP/1.1\r\nHost: {host}\r\nAccept: text/xml, application/xml\r\n"
            f"Connection: {'keep-alive' if keep else 'close'}\r\n\r\n"
        ).encode("ascii")
        while True:
            fresh = self._fresh
            source = Input(self._next_bytes, self.url, self.timeout)
            source.deadline = self._deadline()
            try:
                self.write(request)
                response = Head(source, self.url)
            except (_EndedError, EOFError):
                self._disconnect()
                if fresh:
                    raise InstrumentError(
                        f"The connection to {self.url} is lost: the server closed it without an answer",
                        code="connection.lost",
                    ) from None
                continue  # the server had closed an idle connection
            except BaseException:
                self._disconnect()
                raise
            self._fresh = False
            if 300 <= response.status < 400:
                self._disconnect()
                there = response.headers.get("location", "")[:200]
                raise ProtocolError(
                    f"The server at {self.url} redirects '{target}' (HTTP status {response.status}) to '{there}'. "
                    "Redirections are not followed: if the device is there, state this address",
                    code="protocol.http.redirected",
                )
            return response, source

    def _deadline(self) -> float:
        return time.monotonic() + _ANSWER_TIMEOUTS * self.timeout

    def _next_bytes(self, timeout: float) -> bytes:
        try:
            return self.read(CHUNK, timeout)
        except _EndedError:
            return b""

    # ------------------------------------------------------------------ the connection

    def _connected(self) -> Transport:
        if self._line is None:
            server = self._address if self._device is None else parse_address(self._device.url)
            port = PORT if server.port is None else server.port
            self._line = TcpTransport(Address(self.url, "tcp", server.host, port), timeout=self.timeout)
            self._fresh = True
        return self._line

    def _disconnect(self) -> None:
        """Close the connection; a replayed one remains open for the rest of the recording."""
        self._fresh = True
        if self._line is not None and self._address.scheme != "replay":
            self._line.close()
            self._line = None

    def _send(self, data: bytes) -> None:
        line = self._connected()
        if self._recorder is not None:
            self._recorder.frame("W", data)
        try:
            line.write(data)
        except InstrumentTimeoutError:
            raise
        except InstrumentError as error:
            self._lost(error)

    def _receive(self, max_bytes: int, timeout: float) -> bytes:
        try:
            data = self._connected().read(max_bytes, timeout)
        except InstrumentTimeoutError:
            raise
        except InstrumentError as error:
            self._lost(error)
        if self._recorder is not None:
            self._recorder.frame("R", data)
        return data

    def _lost(self, error: InstrumentError) -> Any:
        """Record the loss of the connection, and raise an error."""
        if self._address.scheme == "replay":
            raise error
        if self._recorder is not None:
            self._recorder.frame("R", b"")
        raise _EndedError(str(error)) from None

    def close(self) -> None:
        """Close the connection; idempotent."""
        line, self._line = self._line, None
        device, self._device = self._device, None
        try:
            if line is not None:
                line.close()
        finally:
            if device is not None:
                device.close()
            if self._recorder is not None:
                self._recorder.close()


class _EndedError(InstrumentError):
    """The server has closed the connection."""

    code = "connection.lost"


def _content_type(response: Head) -> str:
    return response.headers.get("content-type", "").partition(";")[0].strip().lower()


def _boundary(response: Head) -> bytes:
    """Return the boundary between the parts; empty if the answer is not multipart."""
    if not _content_type(response).startswith("multipart/"):
        return b""
    for word in response.headers["content-type"].split(";")[1:]:
        key, _, value = word.partition("=")
        if key.strip().lower() == "boundary":
            return value.strip().strip('"').encode("latin-1")
    return b""
