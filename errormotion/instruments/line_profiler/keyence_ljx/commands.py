"""Exchange of commands: one request, its reply, and recovery after a late reply."""

from __future__ import annotations

import time

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.line_profiler.keyence_ljx import codec
from errormotion.instruments.line_profiler.keyence_ljx.codec import Reply
from errormotion.instruments.transports import Transport
from errormotion.instruments.transports.quiet import after_others, discard_input

SYNCHRONISING: tuple[int, ...] = (codec.GET_STATUS, codec.GET_TEMPERATURE, codec.GET_COUNTS)
"""Opcodes that only read: after a timeout, the reply to one of them shows that all earlier replies have arrived."""
MAX_STALE_REPLIES = 16
"""Largest number of replies to other commands that are skipped before the reply to a request."""
_HEAD = 4  # bytes of a reply that state its length


class CommandLine:
    """Requests and replies on one connection.

    Unread bytes are discarded before a request, as by the manufacturer's client. A reply states its command, so that a
    late reply is not mistaken for the reply to a later request. After a timeout, the next exchange is preceded by a
    reading request of another opcode; once its reply has arrived, no earlier reply is outstanding. If the device does
    not state the command, or does not answer this request either, the connection is lost and must be opened again.

    Parameters
    ----------
    transport : Transport
    name : str
        Name of the instrument, for messages.
    generation : str
        Generation of the controller, one of `codec.GENERATIONS`.
    timeout : float
        Time limit for one reply, s.

    Attributes
    ----------
    lost : InstrumentError or None
        Why replies can no longer be assigned to requests.
    """

    def __init__(self, transport: Transport, name: str, generation: str, timeout: float) -> None:
        self._transport, self._name, self._generation, self._timeout = transport, name, generation, timeout
        self._unanswered: list[int] = []
        self._partial = b""
        self.lost: InstrumentError | None = None

    @property
    def answers(self) -> bool:
        """Whether the last request was answered."""
        return self.lost is None and not self._unanswered

    def usable(self) -> bool:
        """Return whether replies can be assigned to requests; synchronise first if necessary."""
        if self.lost is None and self._unanswered:
            self._synchronise()
        return self.lost is None

    def command(self, opcode: int, arguments: bytes = b"") -> Reply:
        """Send a request and return the reply.

        Raises
        ------
        InstrumentError
            The profiler refuses, or the connection is lost.
        InstrumentTimeoutError
            The profiler does not answer.
        ProtocolError
            The bytes are not a reply to this request.
        """
        if not self.usable():
            raise InstrumentError(
                f"The connection to {self._name} is lost ({self.lost}); close the stream", code="connection.lost"
            )
        reply = self._exchange(opcode, arguments)
        if reply.code:
            raise codec.refusal(opcode, reply.code)
        return reply

    def _synchronise(self) -> None:
        """Skip the replies to earlier requests; ``lost`` states why this failed."""
        opcode = next(opcode for opcode in SYNCHRONISING if opcode not in self._unanswered)
        try:
            self._exchange(opcode)
        except InstrumentError as error:
            self.lost = error

    def _exchange(self, opcode: int, arguments: bytes = b"") -> Reply:
        if not self._unanswered:
            discard_input(self._transport)
        try:
            self._transport.write(codec.request(opcode, arguments, generation=self._generation))
            self._unanswered.append(opcode)
            reply = self._reply(opcode)
        except InstrumentTimeoutError:
            raise
        except InstrumentError as error:
            self.lost = error
            raise
        self._unanswered.clear()
        return reply

    def _reply(self, opcode: int) -> Reply:
        for others in range(MAX_STALE_REPLIES + 1):
            try:
                reply = codec.parse_reply(self._frame())
            except InstrumentTimeoutError as error:
                raise after_others(error, others, f"command {opcode:02X}") from None
            if reply.command == opcode or (not reply.command and self._unanswered == [opcode]):
                return reply
            if not reply.command:
                raise ProtocolError(
                    f"{self._transport.url}: a reply without the number of its command after a reply was missed",
                    code="protocol.reply.number",
                )
        raise ProtocolError(
            f"{self._transport.url}: more than {MAX_STALE_REPLIES} replies to other commands",
            code="protocol.reply.stale",
        )

    def _frame(self) -> bytes:
        """Return one reply; the bytes of an incomplete reply are kept for the next call."""
        head = self._collect(0, _HEAD)
        size = codec.reply_length(head)
        frame = self._collect(_HEAD, size)
        self._partial = b""
        return frame

    def _collect(self, start: int, stop: int) -> bytes:
        """Return the first ``stop`` bytes of the reply; those before ``start`` have been received."""
        end = time.monotonic() + self._timeout
        while len(self._partial) < stop:
            try:
                self._partial += self._transport.read(
                    stop - len(self._partial), timeout=max(end - time.monotonic(), 0.0)
                )
            except InstrumentTimeoutError:
                raise InstrumentTimeoutError(
                    f"{self._transport.url}: expected {stop - start} bytes within {self._timeout:g} s; received "
                    f"{len(self._partial) - start}",
                    code="instrument.no_answer",
                ) from None
        return self._partial[:stop]
