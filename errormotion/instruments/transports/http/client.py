"""Requests to an HTTP server, one after another on one connection that is opened again when the server closes it.

Only GET, bodies of a limited size, and streams of many parts are available. Each answer has a time limit, each body a
size limit. Sessions are recorded and played back like those of
every other transport; the end of a connection is recorded as a frame without bytes.
"""

from __future__ import annotations

import http.client
import io
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.transports import load_simulator
from errormotion.instruments.transports.address import Address, parse_address
from errormotion.instruments.transports.base import CHUNK, Transport
from errormotion.instruments.transports.recording import Recorder, ReplayTransport
from errormotion.instruments.transports.tcp import TcpTransport

PORT = 80
MAX_BODY_BYTES = 16 << 20
"""Default limit of the size of a body, bytes."""
_MAX_LINE_BYTES = 4096
_ANSWER_TIMEOUTS = 10.0
"""Time limit of a complete answer, in multiples of the time limit without data."""


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
        ``module:Class`` of the simulator behind ``sim://``.
    recorder : Recorder or path, optional
        Where every frame of the session is written.
    timeout : float
        Time limit without data, s.

    Attributes
    ----------
    target : Address
        Address of the server; of a recording the address that was recorded.

    Raises
    ------
    InstrumentError
        Another scheme, no answer, no simulator, a recording that exists already.
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
                raise InstrumentError(f"Expected an address such as http://192.168.0.5:5000/device; found '{url}'")
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
            No answer, or an answer that takes too long.
        ProtocolError
            The answer is not HTTP, or its body is larger than ``limit``.
        InstrumentError
            The connection is lost.
        """
        response = self._response(path, query, keep=True)
        try:
            body = response.read(limit + 1)
            if len(body) > limit:
                raise ProtocolError(f"{self.url}: the answer to '{path}' is larger than {limit} bytes")
            if response.length:
                raise ProtocolError(
                    f"{self.url}: the answer to '{path}' is cut off, {response.length} bytes before its end"
                )
        except http.client.HTTPException as error:
            self._disconnect()
            raise ProtocolError(f"{self.url}: the answer to '{path}' is cut off: {error!r}") from None
        except BaseException:
            self._disconnect()
            raise
        if response.will_close:
            self._disconnect()
        return Answer(response.status, response.headers.get_content_type(), body)

    def parts(
        self, path: str, query: Mapping[str, str] | None = None, *, limit: int = MAX_BODY_BYTES
    ) -> Iterator[bytes]:
        """Request a stream of many parts, and yield the body of each as it arrives.

        An answer of one part only is yielded as one body. The connection is closed with the iterator; the next request
        opens another one.

        Raises
        ------
        InstrumentTimeoutError, ProtocolError, InstrumentError
            As of `get`, while the stream is read. When the server ends the stream, the iterator ends.
        """
        response = self._response(path, query, keep=False)
        try:
            boundary = response.headers.get_boundary()
            if response.headers.get_content_maintype() != "multipart" or not boundary:
                body = response.read(limit + 1)
                if len(body) > limit:
                    raise ProtocolError(f"{self.url}: the answer to '{path}' is larger than {limit} bytes")
                yield body
                return
            while (part := self._part(response, boundary, limit)) is not None:
                yield part
        except http.client.HTTPException as error:
            raise ProtocolError(f"{self.url}: the stream of '{path}' is damaged: {error!r}") from None
        finally:
            self._disconnect()

    def _part(self, response: http.client.HTTPResponse, boundary: str, limit: int) -> bytes | None:
        """Return the next part of a stream; None when it is over."""
        line = self._text_line(response)
        while line == "":  # the end of the part before
            line = self._text_line(response)
        if line is None or line == f"--{boundary}--":
            return None
        if line != f"--{boundary}":
            raise ProtocolError(f"{self.url}: expected the boundary '--{boundary}' of a part; found {line[:80]!r}")
        size: int | None = None
        while line := self._text_line(response):
            name, _, value = line.partition(":")
            if name.strip().lower() == "content-length":
                size = int(value) if value.strip().isascii() and value.strip().isdigit() else None
        if size is None or size > limit:
            raise ProtocolError(f"{self.url}: expected a part of 0 to {limit} bytes; found {size}")
        body = response.read(size)
        if len(body) < size:
            return None
        return body

    def _text_line(self, response: http.client.HTTPResponse) -> str | None:
        """Return the next line without its end; None at the end of the stream."""
        line = response.readline(_MAX_LINE_BYTES)
        if not line:
            return None
        if not line.endswith(b"\n"):
            raise ProtocolError(f"{self.url}: expected a header line of a part; found {line[:80]!r}")
        return line.decode("latin-1").strip()

    def _response(self, path: str, query: Mapping[str, str] | None, *, keep: bool) -> http.client.HTTPResponse:
        """Send a request and return the answer, its header read."""
        target = quote(path) + (f"?{urlencode(query)}" if query else "")
        host = f"{self.target.host}:{self.target.port}" if self.target.port else self.target.host
        request = (
            f"GET {target} HTTP/1.1\r\nHost: {host}\r\nAccept: text/xml, application/xml\r\n"
            f"Connection: {'keep-alive' if keep else 'close'}\r\n\r\n"
        ).encode("ascii")
        while True:
            fresh = self._fresh
            response = http.client.HTTPResponse(_Wire(self, keep))  # type: ignore[arg-type]
            try:
                self.write(request)
                response.begin()
            except InstrumentTimeoutError:
                self._disconnect()
                raise
            except (_EndedError, http.client.RemoteDisconnected):
                self._disconnect()
                if fresh:
                    raise InstrumentError(
                        f"The connection to {self.url} is lost: the server closed it without an answer"
                    ) from None
                continue  # the server had closed an idle connection
            except http.client.HTTPException as error:
                self._disconnect()
                raise ProtocolError(f"{self.url}: expected an HTTP answer; found {str(error)[:100]!r}") from None
            except BaseException:
                self._disconnect()
                raise
            self._fresh = False
            return response

    # ------------------------------------------------------------------ the line beneath

    def _connected(self) -> Transport:
        if self._line is None:
            there = self._address if self._device is None else parse_address(self._device.url)
            port = PORT if there.port is None else there.port
            self._line = TcpTransport(Address(self.url, "tcp", there.host, port), timeout=self.timeout)
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
        """Record that the connection is lost."""
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


class _Wire:
    """A replacement of a socket for the standard library."""

    def __init__(self, transport: HttpTransport, whole: bool) -> None:
        self._transport = transport
        self._whole = whole

    def makefile(self, *_: Any) -> io.BufferedReader:
        return io.BufferedReader(_Bytes(self._transport, self._whole))


class _Bytes(io.RawIOBase):
    """Bytes of one answer; with ``whole`` all must arrive within a time limit."""

    def __init__(self, transport: HttpTransport, whole: bool) -> None:
        self._transport = transport
        self._end = time.monotonic() + _ANSWER_TIMEOUTS * transport.timeout if whole else float("inf")

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        left = self._end - time.monotonic()
        if left <= 0:
            raise InstrumentTimeoutError(f"{self._transport.url}: the answer was not complete within the time limit")
        try:
            data = self._transport.read(min(len(buffer), CHUNK), min(left, self._transport.timeout))
        except _EndedError:
            return 0
        buffer[: len(data)] = data
        return len(data)

    def close(self) -> None:
        with suppress(ValueError):
            super().close()
