"""Connection to an emScon server: commands and their answers, with unsolicited messages between them."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.laser_tracker.leica_emscon import statuses
from errormotion.instruments.laser_tracker.leica_emscon.codec import (
    CHANGE,
    COMMAND,
    COMMANDS,
    ERROR,
    GET_COORDINATES,
    GET_SYSTEM_STATUS,
    GET_UNITS,
    HEADER,
    POINTS,
    REFLECTOR,
    UNKNOWN,
    Packet,
    decode_header,
    decode_packet,
    encode_command,
)
from errormotion.instruments.transports import Transport
from errormotion.instruments.transports.quiet import after_others

BUSY_INTERVAL = 0.1  # s between two requests to a busy server
MAX_EVENTS = 1000  # largest number of stored events
MAX_EARLY_PACKETS = 100  # largest number of stored packets of points
MARKERS = (GET_SYSTEM_STATUS, GET_UNITS, GET_COORDINATES)
"""Commands whose answer shows that the answers to all earlier ones have arrived; they change nothing."""


class RefusedError(InstrumentError):
    """The server refuses a command; ``status`` is the number of the reason."""

    code = "instrument.refused"

    def __init__(self, message: str, status: int) -> None:
        super().__init__(message)
        self.status = status


@dataclass(frozen=True)
class Event:
    """Messages of the server that were not requested.

    Attributes
    ----------
    kind : str
        ``error`` or ``change``.
    number : int
        Number of the message.
    text : str
        Meaning of the number.
    host_time : float
        ``time.monotonic()`` when it was read, s.
    """

    kind: str
    number: int
    text: str
    host_time: float


class Link:
    """One connection to an emScon server.

    An answer contains the number of its command, but answers to two commands with the same number cannot be
    distinguished, and results of measurements contain none. After a timeout a marker is therefore exchanged before the
    next command: a server processes one command at a time, so that its answer to the marker, other than "busy", follows
    all late answers.

    Parameters
    ----------
    transport : Transport
    timeout, busy_timeout : float
        Time limit for an answer, and for retries while the server is busy, s.

    Attributes
    ----------
    events : deque of Event
        The last messages that were not requested.
    early : deque of Packet
        Points of a continuous measurement received before the answer to the command that starts it.
    broken : bool
        Whether the beam has lost its reflector, as far as the server has reported.
    breaks : int
        Number of broken beams.
    stale_refraction, stale_units : bool
        Whether the refraction index, and units or coordinates, may have changed since they were last read.
    """

    def __init__(self, transport: Transport, timeout: float, busy_timeout: float) -> None:
        self._transport = transport
        self._timeout = timeout
        self._busy_timeout = busy_timeout
        self._lost = ""
        self._waiting = bytearray()
        self._unanswered: set[int] = set()  # commands without an answer in time
        self.events: deque[Event] = deque(maxlen=MAX_EVENTS)
        self.early: deque[Packet] = deque(maxlen=MAX_EARLY_PACKETS)
        self.broken = False
        self.breaks = 0
        self.stale_refraction = self.stale_units = True

    @property
    def url(self) -> str:
        """Address, for messages."""
        return self._transport.url

    def query(self, number: int, /, *, limit: float | None = None, **values: Any) -> Packet:
        """Send a command and return its answer; retry while the server is busy.

        Raises
        ------
        RefusedError
            The server refuses.
        InstrumentTimeoutError
            No answer in time; a late one is not mistaken for the answer to a later command.
        ProtocolError
            An invalid answer: the connection must be opened again.
        """
        return next(self.query_all(number, limit=limit, **values))

    def query_all(
        self,
        number: int,
        /,
        *,
        limit: float | None = None,
        total: Callable[[Packet], int] = lambda _: 1,
        **values: Any,
    ) -> Iterator[Packet]:
        """Send a command and yield its answers; ``total(first)`` is their number, see `query`."""
        allowed = self._timeout if limit is None else limit
        self._check()
        if self._unanswered:
            self._resynchronise()
        yield from self._exchange(number, allowed, total, values)

    def _exchange(
        self, number: int, allowed: float, total: Callable[[Packet], int], values: dict[str, Any]
    ) -> Iterator[Packet]:
        end = time.monotonic() + self._busy_timeout
        while True:
            self._check()
            self._transport.write(encode_command(number, **values))
            packet = self._answer(number, allowed)
            if packet.kind == ERROR or packet.status not in (statuses.OK, statuses.BUSY):
                raise self._refusal(number, packet.status)
            if packet.status == statuses.OK:
                break
            if time.monotonic() >= end:
                raise self._refusal(number, packet.status, f", for {self._busy_timeout:g} s")
            time.sleep(BUSY_INTERVAL)
        yield packet
        for _ in range(total(packet) - 1):
            packet = self._answer(number, allowed)
            if packet.kind == ERROR or packet.status != statuses.OK:
                raise self._refusal(number, packet.status)
            yield packet

    def _resynchronise(self) -> None:
        """Exchange a marker, and ignore what arrives before its answer.

        Raises
        ------
        InstrumentTimeoutError
            No answer to the marker; the next command tries again, with another marker.
        InstrumentError
            The server remains busy, or no marker is left: the connection must be opened again.
        """
        marker = next((each for each in MARKERS if each not in self._unanswered), None)
        if marker is None:
            self._lost = "no answer to several commands"
            self._check()
            return
        try:
            next(self._exchange(marker, self._timeout, lambda _: 1, {}))
        except InstrumentTimeoutError as error:
            raise InstrumentTimeoutError(
                f"{error}, after another command had no answer. Check the server, or close the connection and open it "
                "again",
                code=error.code,
            ) from None
        except RefusedError as error:
            if error.status == statuses.BUSY:
                raise
        self._unanswered.clear()
        self.early.clear()

    def _answer(self, number: int, limit: float) -> Packet:
        return self.await_packet(
            lambda packet: packet.kind in (COMMAND, ERROR) and packet.command == number,
            limit,
            COMMANDS[number].name,
            number,
        )

    def await_packet(self, wanted: Callable[[Packet], bool], limit: float, what: str, number: int) -> Packet:
        """Return the next packet that fulfils ``wanted``, for command ``number``; note the others.

        Raises
        ------
        InstrumentTimeoutError
            No such packet within ``limit`` s. It may arrive later, and is then ignored.
        """
        end, others = time.monotonic() + limit, 0
        while True:
            packet = self.next_packet(max(end - time.monotonic(), 0.0))
            if packet is None:
                self._unanswered.add(number)
                error = InstrumentTimeoutError(
                    f"{self._transport.url}: no answer to {what} within {limit:g} s", code="instrument.no_answer"
                )
                raise after_others(error, others, what)
            if wanted(packet):
                return packet
            others += packet.kind in (COMMAND, ERROR)
            if packet.kind in POINTS:
                self.early.append(packet)

    def next_packet(self, limit: float) -> Packet | None:
        """Return the next packet of any type; None without one within ``limit`` s.

        Raises
        ------
        ProtocolError
            The bytes are not a packet; the connection can no longer be used.
        """
        self._check()
        end = time.monotonic() + limit
        try:
            while (packet := self._take()) is None:
                try:
                    self._waiting += self._transport.read(timeout=max(end - time.monotonic(), 0.0))
                except InstrumentTimeoutError:
                    return None
        except ProtocolError as error:
            self._lost = str(error)
            raise
        self._note(packet)
        return packet

    def _take(self) -> Packet | None:
        """Return the first complete packet of the received bytes."""
        if len(self._waiting) < HEADER.size:
            return None
        size, kind = decode_header(self._waiting[: HEADER.size])
        end = HEADER.size + size
        if len(self._waiting) < end:
            return None
        body = bytes(self._waiting[HEADER.size : end])
        del self._waiting[:end]
        return decode_packet(kind, body)

    def _check(self) -> None:
        if self._lost:
            raise InstrumentError(
                f"The connection to {self._transport.url} cannot be used after this error: {self._lost}. Close it and "
                "open it again",
                code="connection.lost",
            )

    def _note(self, packet: Packet) -> None:
        if packet.kind == CHANGE:
            if packet.status == statuses.MEASURE_NOT_READY:
                self._break()
            elif packet.status in (statuses.MEASURE_READY, statuses.DISTANCE_SET):
                self.broken = False
            elif packet.status == statuses.REFRACTION_CHANGED:
                self.stale_refraction = True
            elif packet.status in statuses.FRAME_CHANGED:
                self.stale_units = True
            self._remember("change", packet.status, statuses.CHANGES.get(packet.status, "unknown change"))
        elif packet.kind == ERROR:
            if packet.command == UNKNOWN:  # not related to a command: an error of the tracker itself
                self._break()
            self._remember("error", packet.status, statuses.result_text(packet.status))
        elif packet.kind == REFLECTOR:
            self.broken = False

    def _break(self) -> None:
        self.breaks += not self.broken
        self.broken = True

    def _remember(self, kind: str, number: int, text: str) -> None:
        self.events.append(Event(kind, number, text, time.monotonic()))

    def _refusal(self, number: int, status: int, more: str = "") -> RefusedError:
        return RefusedError(
            f"{self._transport.url} refuses {COMMANDS[number].name} with status {status}: "
            f"{statuses.result_text(status)}{more}",
            status,
        )
