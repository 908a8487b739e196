"""Reading of HTTP/1.x answers: head and body, with limits of size and time (RFC 9112).

Longest line of a head: 8192 bytes, of the head of a part 4096; at most 100 lines of a head or trailer; a chunk size has
at most 8 digits.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Mapping

from errormotion.errors import InstrumentTimeoutError, ProtocolError

MAX_LINE_BYTES = 8192
MAX_PART_LINE_BYTES = 4096
MAX_HEAD_LINES = 100
_MAX_INTERIM_ANSWERS = 5  # 1xx, before the final one
_STATUS_LINE = re.compile(r"HTTP/1\.([01]) ([1-5][0-9][0-9])(?: .*)?")
_CHUNK_SIZE = re.compile(rb"([0-9A-Fa-f]{1,8})[ \t]*(?:;.*)?")


class CutOffError(ProtocolError):
    """The connection ended within a body in chunks."""

    code = "protocol.http.incomplete"


Read = Callable[[float], bytes]
"""``read(timeout)`` returns bytes as soon as any are available, no bytes at the end of the connection."""


class Input:
    """Bytes of one connection, as lines and blocks.

    Attributes
    ----------
    deadline : float
        Time (`time.monotonic`, s) at which reading fails; infinite: only the time limit without data applies.
    """

    def __init__(self, read: Read, url: str, timeout: float) -> None:
        self._read, self._url, self._timeout = read, url, timeout
        self._buffer = bytearray()
        self._ended = False
        self.deadline = math.inf

    @property
    def waiting(self) -> bool:
        """Whether received bytes have not been used."""
        return bool(self._buffer)

    def fill(self) -> bool:
        """Wait for further bytes; False at the end of the connection.

        Raises
        ------
        InstrumentTimeoutError
            No data within the time limit, or the deadline has passed.
        """
        if not self._ended:
            try:
                data = self._read(min(max(self.deadline - time.monotonic(), 0.0), self._timeout))
            except InstrumentTimeoutError:
                self._check()
                raise
            self._check()
            self._buffer += data
            self._ended = not data
        return not self._ended

    def _check(self) -> None:
        if time.monotonic() >= self.deadline:
            raise InstrumentTimeoutError(
                f"{self._url}: the answer was not complete within the time limit", code="instrument.no_answer"
            ) from None

    def line(self) -> bytes | None:
        """Return the next line without its line end; None at the end of the connection."""
        start = 0
        while (end := self._buffer.find(b"\n", start)) < 0:
            start = len(self._buffer)
            if start > MAX_LINE_BYTES:
                raise ProtocolError(
                    f"{self._url}: a line longer than {MAX_LINE_BYTES} bytes: {self._start()}",
                    code="protocol.http.line",
                )
            if not self.fill():
                if self._buffer:
                    raise ProtocolError(
                        f"{self._url}: the connection ended within a line: {self._start()}",
                        code="protocol.http.incomplete",
                    )
                return None
        if end > MAX_LINE_BYTES:
            raise ProtocolError(
                f"{self._url}: a line longer than {MAX_LINE_BYTES} bytes: {self._start()}", code="protocol.http.line"
            )
        return self.some(end + 1).rstrip(b"\r\n")

    def some(self, most: int) -> bytes:
        """Return up to ``most`` bytes; none at the end of the connection."""
        if not self._buffer and not self.fill():
            return b""
        data = bytes(self._buffer[:most])
        del self._buffer[:most]
        return data

    def _start(self) -> str:
        return repr(bytes(self._buffer[:80]))


class Head:
    """The head of an answer, with methods to read its body.

    Parameters
    ----------
    source : Input
    url : str
        For messages.

    Attributes
    ----------
    status : int
    headers : mapping of str to str
        By lower-case name; the last one if a name occurs twice.
    closes : bool
        Whether the connection ends with this answer.

    Raises
    ------
    ProtocolError
        The data are not an HTTP answer, or the body has an unknown length or coding.
    EOFError
        The connection ended before the answer.
    """

    def __init__(self, source: Input, url: str) -> None:
        self._source, self._url = source, url
        for _ in range(_MAX_INTERIM_ANSWERS + 1):
            version, self.status = self._status_line()
            self.headers: Mapping[str, str] = self._fields()
            if self.status >= 200:
                break
        else:
            raise ProtocolError(
                f"{url}: expected a final HTTP answer; found only interim ones", code="protocol.http.form"
            )
        connection = self.headers.get("connection", "").lower()
        coding = self.headers.get("transfer-encoding", "identity").strip().lower()
        if coding not in ("identity", "chunked"):
            raise ProtocolError(
                f"{url}: expected a body without transfer coding, or in chunks; found '{coding[:40]}'",
                code="protocol.http.coding",
            )
        if (content := self.headers.get("content-encoding", "identity").strip().lower()) != "identity":
            raise ProtocolError(
                f"{url}: expected a body that is not compressed; found '{content[:40]}'", code="protocol.http.coding"
            )
        self._chunked = coding == "chunked"
        self._left = self._length()
        self._first_chunk = True
        self.closes = (
            "close" in connection or (version == 0 and "keep-alive" not in connection) or math.isinf(self._left)
        )

    @property
    def missing(self) -> int:
        """Number of bytes of a body with a stated length that have not been received."""
        return 0 if self._chunked or math.isinf(self._left) else int(self._left)

    def body(self, limit: int) -> bytes:
        """Return the complete body.

        Raises
        ------
        ProtocolError
            The body is larger than ``limit`` bytes, or incomplete.
        """
        content = bytearray()
        while data := self.some(limit + 1 - len(content)):
            content += data
            if len(content) > limit:
                raise ProtocolError(
                    f"{self._url}: the answer is larger than {limit} bytes", code="protocol.reply.too_long"
                )
        if self.missing:
            raise ProtocolError(
                f"{self._url}: the answer is incomplete: {self.missing} bytes are missing",
                code="protocol.http.incomplete",
            )
        return bytes(content)

    def some(self, most: int) -> bytes:
        """Return up to ``most`` bytes of the body; none at its end."""
        if self._left == 0 and not (self._chunked and self._next_chunk()):
            return b""
        data = self._source.some(min(most, int(self._left))) if self._left < math.inf else self._source.some(most)
        if self._chunked and not data:
            raise CutOffError(f"{self._url}: the answer is incomplete: it ends within a chunk")
        self._left -= len(data)
        return data

    def _next_chunk(self) -> bool:
        """Read the size of the next chunk; False after the last."""
        if not self._first_chunk and self._chunk_line() != b"":
            raise ProtocolError(f"{self._url}: the answer is damaged at the end of a chunk", code="protocol.http.chunk")
        self._first_chunk = False
        line = self._chunk_line()
        if not (found := _CHUNK_SIZE.fullmatch(line)):
            raise ProtocolError(
                f"{self._url}: the answer is damaged: expected a chunk size; found {line[:40]!r}",
                code="protocol.http.chunk",
            )
        self._left = int(found[1], 16)
        if not self._left:
            self._fields()  # the trailer
            self._chunked = False
        return self._left > 0

    def _chunk_line(self) -> bytes:
        line = self._source.line()
        if line is None:
            raise CutOffError(f"{self._url}: the answer is incomplete: it ends between two chunks")
        return line

    def _length(self) -> float:
        if self.status in (204, 304) or self._chunked:
            return 0
        text = self.headers.get("content-length")
        if text is None:
            return math.inf
        if not re.fullmatch("[0-9]{1,18}", text):
            raise ProtocolError(
                f"{self._url}: expected the length of the body; found '{text[:40]}'", code="protocol.http.length"
            )
        return int(text)

    def _status_line(self) -> tuple[int, int]:
        line = self._source.line()
        if line is None:
            raise EOFError
        match = _STATUS_LINE.fullmatch(line.decode("latin-1"))
        if not match:
            raise ProtocolError(f"{self._url}: expected an HTTP answer; found {line[:80]!r}", code="protocol.http.form")
        return int(match[1]), int(match[2])

    def _fields(self) -> dict[str, str]:
        return header_fields(self._source.line, self._url)


def header_fields(next_line: Callable[[], bytes | None], url: str) -> dict[str, str]:
    """Return the fields of a head up to its empty line, by lower-case name.

    Raises
    ------
    ProtocolError
        There are more than `MAX_HEAD_LINES` lines or two different lengths, or the connection ended.
    """
    fields: dict[str, str] = {}
    for _ in range(MAX_HEAD_LINES + 1):
        line = next_line()
        if line is None:
            raise ProtocolError(
                f"{url}: the connection ended within the head of an answer or part", code="protocol.http.incomplete"
            )
        if not line:
            return fields
        name, _, value = line.decode("latin-1").partition(":")
        key, text = name.strip().lower(), value.strip()
        if key == "content-length" and fields.get(key, text) != text:
            raise ProtocolError(
                f"{url}: two lengths of the body, '{fields[key][:20]}' and '{text[:20]}'", code="protocol.http.length"
            )
        fields[key] = text
    raise ProtocolError(f"{url}: a head of more than {MAX_HEAD_LINES} lines", code="protocol.http.head")


class Lines:
    """The body of a multipart answer, as lines and blocks of stated size."""

    def __init__(self, answer: Head, url: str) -> None:
        self._answer, self._url = answer, url
        self._buffer = bytearray()

    def line(self) -> bytes | None:
        """Return the next line without its line end; None at the end of the body."""
        start = 0
        while (end := self._buffer.find(b"\n", start)) < 0:
            start = len(self._buffer)
            if start > MAX_PART_LINE_BYTES:
                raise ProtocolError(
                    f"{self._url}: expected a header line of a part; found {bytes(self._buffer[:80])!r}",
                    code="protocol.http.head",
                )
            if not self._more(MAX_PART_LINE_BYTES):
                return None  # an incomplete line is ignored
        line = bytes(self._buffer[:end]).rstrip(b"\r")
        del self._buffer[: end + 1]
        return line

    def block(self, size: int) -> bytes | None:
        """Return exactly ``size`` bytes; None if the body ends before."""
        while len(self._buffer) < size:
            if not self._more(max(MAX_PART_LINE_BYTES, size - len(self._buffer))):
                return None
        data = bytes(self._buffer[:size])
        del self._buffer[:size]
        return data

    def _more(self, most: int) -> bool:
        """Wait for bytes; return False at the end of the body, or of the connection, which may end during a stream."""
        try:
            data = self._answer.some(most)
        except CutOffError:
            return False
        self._buffer += data
        return bool(data)
