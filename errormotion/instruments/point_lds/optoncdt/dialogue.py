"""Commands and answers over one open connection, synchronised after late answers; settings to be restored."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from typing import TYPE_CHECKING

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.point_lds.optoncdt.codec import text_of
from errormotion.instruments.point_lds.optoncdt.commands import (
    LINE_END,
    PROMPT,
    RefusedCommandError,
    parse_answer,
    setting,
)
from errormotion.instruments.transports import Transport
from errormotion.instruments.transports.quiet import await_quiet

if TYPE_CHECKING:
    from errormotion.instruments.streaming import Reader

QUIET = 0.1
"""Time without data after which no late answer is expected, s."""
RESYNCHRONISATIONS = 3
MAX_BUFFERED_BYTES = 1 << 24
"""Largest number of bytes of text and values up to the end of one answer."""
NOT_RESTORED = ("MASTERMV",)  # sending it would apply the present distance
STREAMING = "OUTPUT RS422"
MARKER = "ECHO"
"""Query that is used for nothing else, so that its answer cannot be mistaken for another one."""
_MARKER_ANSWER = re.compile(rb"\bECHO (?:ON|OFF)\b")


class Dialogue:
    """Commands to one sensor.

    Parameters
    ----------
    exchange : callable
        Context manager that yields the line for one request and its answer: `Driver.exchange`.
    timeout : float
        Time limit of an answer, s.

    Attributes
    ----------
    reader : Reader, optional
        The thread that reads while values arrive; it separates the answers from them.
    lost : InstrumentError, optional
        Why no command can be sent any more.
    """

    def __init__(self, exchange: Callable[[], AbstractContextManager[Transport]], timeout: float) -> None:
        self.timeout = timeout
        self.reader: Reader | None = None
        self.lost: InstrumentError | None = None
        self._exchange = exchange
        self._unanswered = False  # an answer may still arrive, between the values or later
        self._before: dict[str, str] = {}

    def command(self, text: str) -> list[str]:
        """Send a command and return the lines of the answer.

        Raises
        ------
        InstrumentError
            The sensor refuses (`RefusedCommandError`), or the connection is lost.
        InstrumentTimeoutError
            No answer. The next command resynchronises first: a late answer is not mistaken for another one.
        """
        if self.lost is not None:
            raise InstrumentError(
                f"The connection is lost ({self.lost}); close and open it again", code="connection.lost"
            )
        try:
            if self.reader is not None:
                return parse_answer(text, self._answer_in_stream(self.reader, text))
            with self._exchange() as line:
                if self._unanswered:  # since the stream
                    self.synchronise(line)
                answer = self._answer(line, text)
        except InstrumentTimeoutError:
            self._unanswered = True
            raise
        return parse_answer(text, answer)

    def synchronise(self, line: Transport) -> None:
        """Discard late answers until the answer to `MARKER` arrives.

        Raises
        ------
        InstrumentError
            It does not arrive.
        """
        for _ in range(RESYNCHRONISATIONS):
            with suppress(ProtocolError):  # the sensor streams: its values are not answers
                await_quiet(line, QUIET)
            if _MARKER_ANSWER.search(self._answer(line, MARKER)):
                self._unanswered = False
                return
        raise _no_marker()

    def recover(self) -> None:
        """Use the line again after it was lost; late answers are discarded before the next command."""
        self.lost, self._unanswered = None, True

    def _answer(self, line: Transport, text: str) -> bytes:
        line.write(text.encode("ascii") + LINE_END)
        return text_of(line.read_until(PROMPT, limit=MAX_BUFFERED_BYTES, timeout=self.timeout))

    def _answer_in_stream(self, reader: Reader, text: str) -> bytes:
        """Return the answer to a command; discard late answers."""
        for _ in range(RESYNCHRONISATIONS):
            if not self._unanswered:
                return reader.query(text.encode("ascii") + LINE_END, self.timeout)
            seen, end = -1, time.monotonic() + self.timeout
            while seen != reader.stray_bytes and time.monotonic() < end:
                seen = reader.stray_bytes
                time.sleep(QUIET)
            answer = reader.query(MARKER.encode("ascii") + LINE_END, self.timeout)
            self._unanswered = not _MARKER_ANSWER.search(answer)
        if self._unanswered:
            raise _no_marker()
        return reader.query(text.encode("ascii") + LINE_END, self.timeout)

    # ------------------------------------------------------------------ settings

    def remember(self, name: str) -> str:
        """Return a setting at the start of the session, as a command; empty if the sensor states none."""
        if name not in self._before:
            try:
                self._before[name] = setting(name, self.command(name))
            except RefusedCommandError:
                self._before[name] = ""
        return self._before[name]

    def set(self, command: str) -> None:
        """Send a command that changes a setting, which `restore` restores."""
        self.remember(command.split(" ", 1)[0])
        self.command(command)

    def neutralise(self, command: str) -> bool:
        """Give a setting its neutral value, unless it has it; return False if the sensor does not know the setting.

        Raises
        ------
        RefusedCommandError
            The setting has another value, or an unknown one, and the sensor refuses to change it.
        """
        name = command.split(" ", 1)[0]
        try:
            present = setting(name, self.command(name))
        except RefusedCommandError:
            present = None
        words = command.split()
        if present and present.split()[: len(words)] == words:
            return True
        try:
            self.set(command)
        except RefusedCommandError as error:
            if present is None:  # neither read nor set
                return False
            stated = f"'{present}'" if present else "unknown"
            raise RefusedCommandError(
                f"{error}; its setting is {stated}, which may change the values. "
                f"Set '{command}' on its web page, or restore its presets"
            ) from None
        return True

    def restore(self) -> None:
        """Restore the changed settings, except the output of values, which the closed line could not receive."""
        before, self._before = self._before, {}
        for name, command in reversed(before.items()):
            if self.lost is not None or self._unanswered:
                return
            if command and name not in NOT_RESTORED and command != STREAMING:
                with suppress(RefusedCommandError):
                    self.command(command)


def _no_marker() -> ProtocolError:
    return ProtocolError(
        f"No answer to {MARKER} among the late answers of the sensor; close and open the connection again",
        code="protocol.reply.stale",
    )
