"""Lines with two wires (RS-485): the echo of what was sent, and zeros while the direction changes.

A converter that does not switch its receiver off returns each request before its answer. While neither end drives the
wires, some receivers see bytes of 0 before an answer.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from errormotion.errors import InstrumentTimeoutError, ProtocolError
from errormotion.instruments.transports.base import Transport


class HalfDuplexTransport(Transport):
    """Removes the echo of each request, and zeros before an answer, from what a line receives.

    Parameters
    ----------
    line : Transport
    echo : bool
        Whether the line returns each request; another byte in its place is an error.
    zeros : bool
        Whether bytes of 0 before an answer are skipped.
    """

    def __init__(self, line: Transport, *, echo: bool, zeros: bool) -> None:
        super().__init__(line.url, line.timeout)
        self.flow_control, self.simulated = line.flow_control, line.simulated
        self._line, self._echo, self._zeros = line, echo, zeros
        self._awaited = b""  # part of the echo that has not arrived
        self._before_answer = False

    def _send(self, data: bytes) -> None:
        self._awaited, self._before_answer = (data if self._echo else b""), self._zeros
        self._line.write(data)

    def _receive(self, max_bytes: int, timeout: float) -> bytes:
        end = time.monotonic() + timeout
        while True:
            try:
                data = self._line.read(max_bytes, timeout=max(end - time.monotonic(), 0.0))
            except InstrumentTimeoutError:
                if not self._awaited:
                    raise
                raise InstrumentTimeoutError(
                    f"{self.url}: expected the echo {self._awaited[:24].hex(' ')} of the request within {timeout:g} s. "
                    "Check the line, or the setting 'echo'",
                    code="instrument.no_answer",
                ) from None
            if data := self._without_zeros(self._without_echo(self._without_zeros(data))):
                return data

    def _without_zeros(self, data: bytes) -> bytes:
        if not self._before_answer or self._awaited[:1] == b"\0":
            return data
        rest = data.lstrip(b"\0")
        self._before_answer = not rest or bool(self._awaited)
        return rest

    def _without_echo(self, data: bytes) -> bytes:
        size = min(len(data), len(self._awaited))
        awaited, self._awaited = self._awaited[:size], self._awaited[size:]
        if data[:size] != awaited:
            self._awaited = b""
            raise ProtocolError(
                f"{self.url}: expected the echo {awaited[:24].hex(' ')} of the request; found {data[:24].hex(' ')}. "
                "Check the line, or the setting 'echo'",
                code="protocol.echo",
            )
        return data[size:]

    def reopen(self) -> bool:
        """Open another connection of the line."""
        self._awaited = b""
        return self._line.reopen()

    def close(self) -> None:
        """Close the line; idempotent."""
        self._line.close()


def half_duplex(connect: Callable[[], Transport], *, echo: bool, zeros: bool) -> Callable[[], Transport]:
    """Return a function that opens a line with two wires; ``connect`` itself where it needs no corrections."""
    if not (echo or zeros):
        return connect
    return lambda: HalfDuplexTransport(connect(), echo=echo, zeros=zeros)
