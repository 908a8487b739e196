"""Bases of drivers: opening and closing, settings, requests and their answers."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, Self, TypeVar

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError, ReplayError
from errormotion.instruments.transports import Transport, open_transport
from errormotion.instruments.transports.base import LINE_ENDS
from errormotion.instruments.transports.quiet import after_others, await_quiet, discard_input
from errormotion.plugins import InstrumentInfo, PluginSettings

MAX_OTHER_LINES = 16
"""Number of lines without the answer after which none is expected any more."""

T = TypeVar("T")


class Openable:
    """Base of what is opened and closed, also by a ``with`` block."""

    def open(self) -> None:
        """Open; idempotent."""

    def close(self) -> None:
        """Close; idempotent."""

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
            return
        with suppress(InstrumentError):  # the first error states the cause
            self.close()


class Driver(Openable):
    """Base of drivers with one transport.

    A subclass has ``info`` and ``Settings``, starts the device in ``_start_session``, stops it in ``_end_session``, and
    sends each request, and reads its answer, within ``with self.exchange() as line:``. A driver of a device that sends
    data without requests uses ``self.transport``. Settings called ``timeout`` (s) and ``baudrate`` apply to the
    transport.

    Parameters
    ----------
    address : str
        URL of the device.
    settings : PluginSettings, optional
        The driver's ``Settings``; default: all defaults.
    record : Path, optional
        File to which every frame of the session is recorded.
    """

    info: ClassVar[InstrumentInfo]
    Settings: ClassVar[type[PluginSettings]] = PluginSettings

    def __init__(self, address: str, settings: Any = None, *, record: Path | None = None) -> None:
        self.address = address
        self.settings: Any = self.Settings() if settings is None else settings
        self._record = record
        self._transport: Transport | None = None
        self._failed_at: float | None = None
        self._timed_out = False

    @property
    def transport(self) -> Transport:
        """The open transport; InstrumentError before ``open``."""
        if self._transport is None:
            raise InstrumentError(
                f"The {self.info.id} at {self.address} is not open: use it in a 'with' block, or call open() first",
                code="instrument.not_open",
            )
        return self._transport

    def open(self) -> None:
        """Open the connection and check the device; idempotent.

        Raises
        ------
        InstrumentError
            No device or another device answers.
        """
        if self._transport is not None:
            return
        self._transport = self._connect()
        self._failed_at = None
        try:
            self._start_session()
        except BaseException:
            self._drop()
            raise

    def close(self) -> None:
        """Close the connection and end every thread; idempotent."""
        if self._transport is None:
            return
        try:
            self._end_session()
        finally:
            transport, self._transport = self._transport, None
            transport.close()

    @contextmanager
    def exchange(self) -> Iterator[Transport]:
        """Yield the transport for one request and its answer: the first bytes that are read belong to this request.

        Unread bytes are discarded before the request. If the previous exchange ended with an error, its answer or a
        part of it may still arrive: `resynchronise` is called first. Check and decode an answer within the block, so
        that a wrong answer counts as an error of this exchange. A refusal is a complete answer: raise its error after
        the block, so that the next request is sent without a wait.

        Raises
        ------
        InstrumentError
            The driver is not open, or the device cannot be resynchronised; the next exchange tries again.
        """
        line = self.transport
        try:
            if self._failed_at is None:
                discard_input(line)
            else:
                self.resynchronise()
            yield line
        except BaseException as error:
            self._failed_at, self._timed_out = time.monotonic(), isinstance(error, InstrumentTimeoutError)
            raise
        self._failed_at = None

    def answer_line(
        self, line: Transport, what: str, read: Callable[[bytes], T | None], *, limit: int, within: float | None = None
    ) -> T:
        """Return the answer to a request of a device that answers in lines; lines with other answers are discarded.

        Parameters
        ----------
        line : Transport
        what : str
            The request, for messages.
        read : callable
            Returns the answer in a line, and None if the line answers another request.
        limit : int
            Longest line, bytes.
        within : float, optional
            Time limit of the answer, s; default: that of the transport for each of up to `MAX_OTHER_LINES` lines.

        Raises
        ------
        InstrumentTimeoutError
            No answer within the time limit.
        ProtocolError
            None of `MAX_OTHER_LINES` lines has the answer.
        """
        end, others = time.monotonic() + (within or 0.0), 0
        while within is not None or others < MAX_OTHER_LINES:
            left = None if within is None else max(end - time.monotonic(), 0.0)
            try:
                found = read(line.read_until(LINE_ENDS, limit=limit, timeout=left))
            except InstrumentTimeoutError as error:
                raise after_others(error, others, what) from None
            if found is not None:
                return found
            others += 1
        raise ProtocolError(
            f"{self.address}: expected an answer to {what}; found {others} other lines", code="protocol.reply.other"
        )

    def resynchronise(self) -> None:
        """Ensure, after a failed exchange, that no answer to an earlier request is read as the next one.

        All input is discarded until nothing has arrived for one time limit since the failure. If an answer was missing
        and has not arrived by then, a TCP connection is opened again: the answer is lost with the old one.

        On a serial line or through a serial server, an answer that arrives even later would be read as the next one. A
        driver whose answers have no number overrides this method if the protocol has a request whose answer has a
        unique form: it calls ``super().resynchronise()``, sends this request, and reads until its answer.

        Raises
        ------
        InstrumentError
            The device does not stop sending, or the connection is lost.
        """
        line = self.transport
        try:
            discarded = await_quiet(line, line.timeout, self._failed_at)
        except ProtocolError:
            raise
        except InstrumentError:
            if not line.reconnects:
                raise
            return
        if self._timed_out and not discarded:
            line.reopen()

    def _connect(self) -> Transport:
        given = {name: getattr(self.settings, name) for name in ("timeout", "baudrate") if hasattr(self.settings, name)}
        return open_transport(self.address, simulator=self.info.simulator, recorder=self._record, **given)

    def _start_session(self) -> None:
        """Check the device right after connecting."""

    def _end_session(self) -> None:
        """Stop the device right before closing."""

    def _drop(self) -> None:
        transport, self._transport = self._transport, None
        if transport is not None:
            with suppress(ReplayError):
                transport.close()
