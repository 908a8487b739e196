"""Requests and replies of GeoCOM in ASCII: ``%R1Q,<call>,<number>:<parameters>`` and ``%R1P,...``."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from errormotion.errors import InstrumentError, ProtocolError
from errormotion.instruments.laser_tracker.leica_geocom import codes

LINE_END = b"\r\n"
MAX_REPLY = 1024
"""Bytes, line end included."""
MAX_TRANSACTION = 7
"""Transaction numbers are 1 to this; a reply to a request without a number has 0."""

_REPLY = re.compile(r"%R1P,(\d{1,5})(?:,(\d{1,5}))?:(\d{1,5})(?:,(.*))?", re.ASCII | re.DOTALL)
_NUMBER = re.compile(r"[+-]?\d{1,40}(?:\.\d{0,40})?(?:[eE][+-]?\d{1,3})?", re.ASCII)
_WHOLE = re.compile(r"[+-]?\d{1,18}", re.ASCII)
_HEX = re.compile(r"0[xX][0-9a-fA-F]{1,16}", re.ASCII)
_BYTE = re.compile(r"'([0-9a-fA-F]{2})'", re.ASCII)
_GSI_WORD = r"\d\d[\d.]{4}[+-](?:[0-9A-Za-z.\-+]{16}|[0-9A-Za-z.\-+]{8})"
_GSI = re.compile(rf"\*?{_GSI_WORD}(?: +{_GSI_WORD})*", re.ASCII)
_FIELD = re.compile(r'"[^"\\]*+(?:\\.[^"\\]*+)*+"|[^,"]*', re.DOTALL)  # possessive: no backtracking
_ESCAPE = re.compile(r"\\(?:[xX]([0-9a-fA-F]{2})|(.))", re.DOTALL)


@dataclass(frozen=True)
class Reply:
    """One reply.

    Attributes
    ----------
    communication : int
        Return code of the communication; 0: the call was executed.
    transaction : int
        Number of the request; 0 if it had none.
    code : int
        Return code of the call.
    values : tuple of str
        Values after the code, as received.
    """

    communication: int
    transaction: int
    code: int
    values: tuple[str, ...] = ()

    def number(self, index: int) -> float:
        """Return a finite value; ProtocolError if it is invalid."""
        text = self._value(index)
        if _HEX.fullmatch(text):
            return float(int(text, 16))
        value = float(text) if _NUMBER.fullmatch(text) else math.nan
        if not math.isfinite(value):
            raise ProtocolError(
                f"Value {index + 1} of a GeoCOM reply: expected a number; found {text[:40]!r}",
                code="protocol.reply.number_form",
            )
        return value

    def whole(self, index: int) -> int:
        """Return an integer, also of a byte or in hexadecimal; ProtocolError if it is invalid."""
        text = self._value(index)
        if byte := _BYTE.fullmatch(text):
            return int(byte[1], 16)
        if _HEX.fullmatch(text):
            return int(text, 16)
        if not _WHOLE.fullmatch(text):
            raise ProtocolError(
                f"Value {index + 1} of a GeoCOM reply: expected a whole number; found {text[:40]!r}",
                code="protocol.reply.number_form",
            )
        return int(text)

    def text(self, index: int) -> str:
        """Return a string without its quotation marks; ProtocolError if it is invalid."""
        text = self._value(index)
        if len(text) < 2 or text[0] != '"' or text[-1] != '"':
            raise ProtocolError(
                f"Value {index + 1} of a GeoCOM reply: expected a string; found {text[:40]!r}",
                code="protocol.reply.form",
            )
        return _ESCAPE.sub(lambda found: chr(int(found[1], 16)) if found[1] else found[2], text[1:-1])

    def _value(self, index: int) -> str:
        if index >= len(self.values):
            raise ProtocolError(
                f"A GeoCOM reply has {len(self.values)} values; expected at least {index + 1}",
                code="protocol.reply.length",
            )
        return self.values[index]


def request(call: int, transaction: int, *parameters: int | float) -> bytes:
    """Return a request; floats have as many digits as necessary.

    Raises
    ------
    InstrumentError
        A parameter is not finite.
    """
    if not all(math.isfinite(each) for each in parameters):
        raise InstrumentError(
            f"GeoCOM call {call}: expected finite parameters; found {parameters}", code="request.not_finite"
        )
    values = ",".join(str(each) if isinstance(each, int) else _decimal(each) for each in parameters)
    return f"%R1Q,{call},{transaction}:{values}".encode("ascii") + LINE_END


def _decimal(value: float) -> str:
    text = f"{value:.15f}".rstrip("0")
    return text + "0" if text.endswith(".") else text


def is_gsi(line: bytes) -> bool:
    """Whether a line has data words of the GSI interface, which the station sends when its operator records a point.

    A word has an index of two digits, four characters of information, a sign, and 8 or 16 characters of data; the
    first word of a line with 16 follows an asterisk.
    """
    return _GSI.fullmatch(line.decode("latin-1").strip()) is not None


def reply(line: bytes) -> Reply:
    """Return one reply, given with or without its line end.

    Raises
    ------
    ProtocolError
        The line is not a GeoCOM reply, or is longer than ``MAX_REPLY``.
    """
    if len(line) > MAX_REPLY:
        raise ProtocolError(
            f"A GeoCOM reply of {len(line)} bytes; expected at most {MAX_REPLY}", code="protocol.reply.too_long"
        )
    text = line.decode("latin-1").rstrip("\r\n").lstrip("\n")
    match = _REPLY.fullmatch(text)
    if match is None:
        raise ProtocolError(
            f"Expected a GeoCOM reply, '%R1P,code,number:code,...'; found {text[:60]!r}. Check that the interface of "
            "the station is set to GeoCOM",
            code="protocol.reply.form",
        )
    communication, transaction, code, values = match.groups()
    return Reply(int(communication), int(transaction or 0), int(code), _fields(values))


def _fields(values: str | None) -> tuple[str, ...]:
    if values is None:
        return ()
    fields, start = [], 0
    while True:
        match = _FIELD.match(values, start)
        end = start if match is None else match.end()
        if match is None or (end < len(values) and values[end] != ","):
            raise ProtocolError(
                f"A GeoCOM reply has an incomplete value: {values[start : start + 40]!r}", code="protocol.reply.form"
            )
        fields.append(match[0])
        if end == len(values):
            return tuple(fields)
        start = end + 1


def check(call: int, answer: Reply) -> None:
    """Raise InstrumentError if the communication failed: the call was not executed."""
    if answer.communication:
        raise InstrumentError(
            f"GeoCOM call {codes.name(call)} failed: code {answer.communication}, {codes.text(answer.communication)}",
            code="instrument.refused",
        )
