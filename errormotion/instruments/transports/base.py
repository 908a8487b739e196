"""Base of transports: bytes out, bytes in, a time limit."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod

from errormotion.errors import InstrumentTimeoutError, ProtocolError

CHUNK = 65536
"""Largest number of bytes read at once, as by the reader of a stream."""
LINE_ENDS = (b"\r\n", b"\r", b"\n")
"""Ends of a line of text: that of each protocol, and those that converters and serial servers make of it."""
PIECE = 16384
"""Largest number of bytes read at once by default: a decoder processes them within 10 ms."""


class Transport(ABC):
    """A stream of bytes to and from one device.

    Attributes
    ----------
    url : str
        The address.
    timeout : float
        Time limit for a read without data, s.
    flow_control : bool
        Whether the device waits, or reports lost data, while the driver does not read. A serial line has no flow
        control: bytes are lost without notice.
    simulated : bool
        Whether a simulator is at the other end.
    reconnects : bool
        Whether the next write opens a connection that was lost.
    """

    flow_control = True
    reconnects = False
    simulated = False

    def __init__(self, url: str, timeout: float) -> None:
        self.url = url
        self.timeout = timeout
        self._rest = b""

    def write(self, data: bytes) -> None:
        """Send bytes; InstrumentError if the connection is lost."""
        self._send(data)

    def read(self, max_bytes: int = PIECE, timeout: float | None = None) -> bytes:
        """Return between 1 and ``max_bytes`` bytes, as soon as any are available.

        Raises
        ------
        InstrumentTimeoutError
            No data for ``timeout`` s (default: ``timeout`` of the transport).
        InstrumentError
            The connection is lost.
        """
        if self._rest:
            data, self._rest = self._rest[:max_bytes], self._rest[max_bytes:]
            return data
        return self._receive(max_bytes, self.timeout if timeout is None else timeout)

    def read_until(
        self, terminator: bytes | tuple[bytes, ...], *, limit: int = CHUNK, timeout: float | None = None
    ) -> bytes:
        """Return all bytes up to and with ``terminator``; later bytes remain for the next read.

        Of several terminators the first one in the data ends it, the longer one of two at one place. Where only the
        start of the longer one has arrived, the rest of it follows: empty lines are skipped.

        Raises
        ------
        InstrumentTimeoutError
            No terminator within the time limit; the message shows the received bytes.
        ProtocolError
            ``limit`` bytes without a terminator.
        """
        allowed = self.timeout if timeout is None else timeout
        ends = terminator if isinstance(terminator, tuple) else (terminator,)
        longest = max(map(len, ends))
        end, data, searched = time.monotonic() + allowed, bytearray(), 0
        while not (found := _first(data, ends, searched, skip=len(ends) > 1)):
            if len(data) >= limit:
                start = bytes(data[:32])
                raise ProtocolError(
                    f"{self.url}: {len(data)} bytes without {terminator!r}; they start with {start!r}",
                    code="protocol.reply.too_long",
                )
            searched = max(len(data) - longest + 1, 0) if len(ends) == 1 else 0
            try:
                data += self.read(limit, timeout=max(end - time.monotonic(), 0.0))
            except InstrumentTimeoutError:
                received = f"{bytes(data[:64])!r}" if data else "nothing"
                raise InstrumentTimeoutError(
                    f"{self.url}: expected an answer that ends in {terminator!r} within {allowed:g} s; "
                    f"received {received}",
                    code="instrument.no_answer",
                ) from None
        self._rest = bytes(data[found:]) + self._rest
        return bytes(data[:found])

    def read_exactly(self, size: int, timeout: float | None = None) -> bytes:
        """Return exactly ``size`` bytes.

        Raises
        ------
        InstrumentTimeoutError
            Fewer bytes within the time limit; the message states their number.
        """
        allowed = self.timeout if timeout is None else timeout
        end, data = time.monotonic() + allowed, b""
        while len(data) < size:
            try:
                data += self.read(size - len(data), timeout=max(end - time.monotonic(), 0.0))
            except InstrumentTimeoutError:
                raise InstrumentTimeoutError(
                    f"{self.url}: expected {size} bytes within {allowed:g} s; received {len(data)}",
                    code="instrument.no_answer",
                ) from None
        return data

    def reopen(self) -> bool:
        """Open another connection to the same device: a late answer is lost with the old one.

        Return whether another connection was opened; False for a line without connections, such as a serial line.
        InstrumentError if the device cannot be reached.
        """
        return False

    def report_delivered(self, samples: int) -> None:  # noqa: B027 - without effect for most transports
        """Report the number of samples of the running stream that the caller has received.

        This has no effect for a real device; a virtual clock advances with the samples that its reader has received.
        """

    @abstractmethod
    def _send(self, data: bytes) -> None: ...

    @abstractmethod
    def _receive(self, max_bytes: int, timeout: float) -> bytes: ...

    @abstractmethod
    def close(self) -> None:
        """Close the connection; idempotent."""


def _first(data: bytearray, ends: tuple[bytes, ...], start: int, *, skip: bool) -> int:
    """Return where the first line ends, 0 if it does not; with ``skip`` empty lines at the start are removed."""
    while True:
        found = [(place, -len(each)) for each in ends if (place := data.find(each, start)) >= 0]
        if not found:
            return 0
        place, size = min(found)
        if place or not skip:
            return place - size
        del data[:-size]
