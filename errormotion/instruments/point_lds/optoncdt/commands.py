"""Commands of the optoNCDT and their answers, as text.

A command is a line of ASCII: its name and parameters, separated by spaces, ended by CR LF (LF is enough). Without
parameters it requests the present setting, and the answer can be sent as a command (2300 p. 122, 1320 p. 82). The
answer ends with the prompt ``->``. With ECHO ON, the default, the sensor repeats the command, with ``ok`` if it was
executed (2300 p. 129, 1420 p. 98). Before the prompt, an error starts with E and its number, a warning with W.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from errormotion.errors import InstrumentError, ProtocolError

PROMPT = b"->"
LINE_END = b"\r\n"
MAX_ANSWER = 1 << 15
"""Bytes of text; the longest answers, HELP and PRINT, have about a hundred lines."""
MAX_LINES = 2048
"""Lines of an answer."""

DONE = "ok"
USER_HINT = ". Its user level may be USER, which can only read: log in on its web page, or set STDUSER PROFESSIONAL"
_ERROR = re.compile(r"(?:^|\s)(E\d{2,4}\b.*)")
_RANGE = re.compile(r"\s*(\d{1,6}(?:\.\d{1,9})?)\s*mm\s*", re.IGNORECASE)
_UNPRINTABLE = bytes(byte for byte in range(256) if byte not in b"\r\n\t" and not 0x20 <= byte < 0x7F)
_WORD = re.compile(r"[A-Z][A-Z0-9_]*")

DISTANCE, COUNTER = "DIST1", "COUNTER"
_NO_VALUES = frozenset({"GETOUTINFO_RS422", "OK", "NONE"})


class RefusedCommandError(InstrumentError):
    """The sensor has answered a command with an error."""

    code = "instrument.refused"


def parse_answer(command: str, text: bytes) -> list[str]:
    """Return the lines of an answer, without the repeated command and the prompt.

    Raises
    ------
    RefusedCommandError
        The sensor refused the command; the message contains its error text.
    ProtocolError
        The answer is longer than any answer that the manuals describe.
    """
    if len(text) > MAX_ANSWER:
        raise ProtocolError(
            f"The answer to '{command}' has {len(text)} bytes; expected {MAX_ANSWER} at most",
            code="protocol.reply.too_long",
        )
    words = text.translate(None, _UNPRINTABLE).decode("ascii").replace(PROMPT.decode(), "\n")
    if words.count("\n") + words.count("\r") > 2 * MAX_LINES:
        raise ProtocolError(
            f"The answer to '{command}' has more than {MAX_LINES} lines", code="protocol.reply.too_long"
        )
    lines = [_without_echo(command, line.strip()) for line in words.splitlines()]
    for line in lines:
        match = _ERROR.search(line.partition(":")[0])
        if match:
            reason = line[match.start(1) :]
            hint = USER_HINT if "denied" in reason.lower() else ""
            raise RefusedCommandError(f"The sensor refuses '{command}': {reason}{hint}")
    return [line for line in lines if line]


def _without_echo(command: str, line: str) -> str:
    """Return a line without the repeated command and its ``ok``; unchanged if only the name of a query is repeated."""
    if line in (command, f"{command} {DONE}"):
        return ""
    if " " in command and line.startswith(f"{command} E"):
        return line[len(command) + 1 :]
    return line.removesuffix(f" {DONE}")


def setting(command: str, answer: Sequence[str]) -> str:
    """Return the answer to a query as a command that restores it, ``MEASRATE 4``; empty if it is none."""
    for line in answer:
        start = line.rfind(command)
        if start >= 0 and len(line) > start + len(command) + 1 and line[start + len(command)] == " ":
            return line[start:]
    return ""


def parse_info(lines: Sequence[str]) -> dict[str, str]:
    """Return the facts of an answer to GETINFO by their names in lower case: ``measuring range``."""
    parts = [line.partition(":") for line in lines]
    return {key.strip().lower(): value.partition("//")[0].strip() for key, mark, value in parts if mark}


def reported_range(facts: Mapping[str, str]) -> float | None:
    """Return the measuring range that the sensor reports, m; None if it reports none.

    Raises
    ------
    ProtocolError
        The reported range is not a length in mm.
    """
    stated = facts.get("measuring range")
    if stated is None:
        return None
    match = _RANGE.fullmatch(stated)
    if not match or not 0 < float(match[1]) < 1e5:
        raise ProtocolError(
            f"Expected a measuring range such as '20.00mm' from GETINFO; found '{stated[:40]}'",
            code="protocol.reply.range",
        )
    return float(match[1]) * 1e-3


@dataclass(frozen=True)
class Layout:
    """Sequence of the values of one sample on the line.

    Attributes
    ----------
    values : tuple of str
        Names of the values.
    """

    values: tuple[str, ...]

    @property
    def counter(self) -> bool:
        """Whether each sample has its counter."""
        return COUNTER in self.values

    @property
    def counter_first(self) -> bool:
        """Whether the counter precedes the distance."""
        return self.values[:1] == (COUNTER,)


def parse_layout(lines: Sequence[str], *, counter: bool) -> Layout:
    """Return the sequence of values from the answer to GETOUTINFO_RS422.

    Raises
    ------
    InstrumentError
        The sensor sends other values than the distance, and the counter if it was requested.
    """
    words = [word for line in lines for word in _WORD.findall(line.upper())]
    values = tuple(word for word in words if word not in _NO_VALUES)
    wanted = {DISTANCE, COUNTER} if counter else {DISTANCE}
    if set(values) != wanted or len(values) != len(wanted):
        raise InstrumentError(
            f"Expected the sensor to send {' and '.join(sorted(wanted, reverse=True))}; GETOUTINFO_RS422 lists "
            f"'{' '.join(lines)[:200]}'. Switch the other values off on its web page, or restore its presets",
            code="sensor.output.form",
        )
    return Layout(values)
