"""Commands and answers over one open connection, in step also after a late answer; settings to be restored."""

from __future__ import annotations

import re
import time
from contextlib import suppress
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

if TYPE_CHECKING:
    from errormotion.instruments.streaming import Reader

QUIET = 0.1
"""Time without data after which no late answer is expected, s."""
RESYNCHRONISATIONS = 3
MAX_BUFFERED_BYTES = 1 << 24
"""Bytes of text and values up to the end of one answer."""
NOT_RESTORED = ("MASTERMV",)  # its setting would be taken from the present distance
STREAMING = "OUTPUT RS422"
_ECHO_STATE = re.compile(rb"\bECHO (?:ON|OFF)\b")


class Dialogue:
    """Commands to one sensor.

    Parameters
    ----------
    transport : Transport
    timeout : float
        Time limit of an answer, s.

    Attributes
    ----------
    reader : Reader, optional
        The thread that reads while values arrive; it finds the answers between them.
    lost : InstrumentError, optional
        Why no command can be sent any more.
    """

    def __init__(self, transport: Transport, timeout: float) -> None:
        self.timeout = timeout
        self.reader: Reader | None = None
        self.lost: InstrumentError | None = None
        self._transport = transport
        self._unanswered = False  # an answer may still come
        self._before: dict[str, str] = {}

    def command(self, text: str) -> list[str]:
        """Send a command and return the lines of the answer.

        Raises
        ------
        InstrumentError
            The sensor refuses (`RefusedCommandError`), or the connection is lost.
        InstrumentTimeoutError
            No answer. The next command resynchronises first: a late answer is not taken for another one.
        """
        if self.lost is not None:
            raise InstrumentError(f"The connection is lost ({self.lost}); close and open it again")
        if self._unanswered:
            self._resynchronise()
        return parse_answer(text, self._exchange(text))

    def _exchange(self, text: str) -> bytes:
        """Return the text of the next answer after a command."""
        request = text.encode("ascii") + LINE_END
        try:
            if self.reader is not None:
                return self.reader.query(request, self.timeout)
            self._transport.write(request)
            return text_of(self._transport.read_until(PROMPT, limit=MAX_BUFFERED_BYTES, timeout=self.timeout))
        except InstrumentTimeoutError:
            self._unanswered = True
            raise

    def _resynchronise(self) -> None:
        """Discard late answers, until the answer to ECHO, a query that is used for nothing else, arrives."""
        for _ in range(RESYNCHRONISATIONS):
            self._await_quiet()
            if _ECHO_STATE.search(self._exchange("ECHO")):
                self._unanswered = False
                return
        raise ProtocolError("No answer to ECHO among the late answers of the sensor; close and open it again")

    def _await_quiet(self) -> None:
        end = time.monotonic() + self.timeout
        if self.reader is not None:
            seen = -1
            while seen != self.reader.stray_bytes and time.monotonic() < end:
                seen = self.reader.stray_bytes
                time.sleep(QUIET)
            return
        with suppress(InstrumentTimeoutError):
            while time.monotonic() < end:
                self._transport.read(timeout=QUIET)

    # ------------------------------------------------------------------ settings

    def remember(self, name: str) -> str:
        """Return a setting as it was when the session started, as a command; empty where the sensor states none."""
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

    def restore(self) -> None:
        """Restore the changed settings, except the output of values on this line, which nobody reads any more."""
        before, self._before = self._before, {}
        for name, command in reversed(before.items()):
            if self.lost is not None or self._unanswered:
                return
            if command and name not in NOT_RESTORED and command != STREAMING:
                with suppress(RefusedCommandError):
                    self.command(command)
