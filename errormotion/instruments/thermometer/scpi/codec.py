"""Texts of a SCPI data acquisition unit: channel lists, readings, identities, entries of the error queue.

Every function is linear in the length of the text, at most `LONGEST`, and raises only ProtocolError.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

from errormotion.errors import ProtocolError

LINE_END = b"\n"
"""End of a command and of an answer; on a serial line an answer has a carriage return before it."""
LONGEST = 16384
"""Longest answer, bytes; 120 channels with 27 characters each need 3240."""
OVERLOAD = 9.9e37
"""Absolute value of a reading that is beyond the range of its input."""

_NUMBER = re.compile(r"[+-]?(?:[0-9]{1,20}(?:\.[0-9]{0,20})?|\.[0-9]{1,20})(?:[eE][+-]?[0-9]{1,3})?")
_CHANNEL = re.compile(r"[0-9]{3,4}")
_ERROR = re.compile(r'([+-]?[0-9]{1,5}),"([^"]{0,300})"')
_NAME = re.compile(r"[A-Za-z]{2}")  # of a manufacturer; a reading has at most one letter
_BLOCK = re.compile(r"#([1-4])")


def encode(command: str) -> bytes:
    """Return a command as bytes, with its line end."""
    return command.encode("ascii") + LINE_END


def decode(line: bytes) -> str:
    """Return the text of an answer without its line end; ProtocolError if it is not printable ASCII."""
    text = line.rstrip(b"\r\n")
    if len(text) > LONGEST or any(not 0x20 <= byte <= 0x7E for byte in text):
        raise ProtocolError(f"Expected a line of printable ASCII; found {text[:60]!r}", code="protocol.text.form")
    return text.decode("ascii").strip()


def channel_list(channels: Sequence[int]) -> str:
    """Return a channel list such as ``(@101:103,107)``; runs of ascending channels are written as ranges."""
    parts: list[list[int]] = []
    for channel in channels:
        if parts and channel == parts[-1][-1] + 1 and channel // 100 == parts[-1][-1] // 100:
            parts[-1].append(channel)
        else:
            parts.append([channel])
    return "(@" + ",".join(str(run[0]) if len(run) == 1 else f"{run[0]}:{run[-1]}" for run in parts) + ")"


def parse_channels(text: str) -> list[int]:
    """Return the channels of a scan list in a block of definite length, such as ``#214(@101,102,103)``.

    Raises
    ------
    ProtocolError
        The text is not such a block, or its length is wrong.
    """
    match = _BLOCK.match(text)
    digits = text[2 : 2 + int(match[1])] if match else ""
    body = text[2 + len(digits) :]
    if not digits.isascii() or not digits.isdigit() or len(body) != int(digits):
        raise ProtocolError(
            f"Expected a scan list such as '#214(@101,102,103)'; found '{text[:60]}'", code="protocol.scan_list.form"
        )
    if not (body.startswith("(@") and body.endswith(")")):
        raise ProtocolError(
            f"Expected a scan list such as '(@101,102,103)'; found '{body[:60]}'", code="protocol.scan_list.form"
        )
    cells = body[2:-1].split(",") if body != "(@)" else []
    if not all(_CHANNEL.fullmatch(cell) for cell in cells):
        raise ProtocolError(
            f"Expected channels of three or four digits; found '{body[:60]}'", code="protocol.scan_list.form"
        )
    return [int(cell) for cell in cells]


def parse_identity(text: str) -> tuple[str, str, str, str]:
    """Return manufacturer, model, serial number and revision in an answer to ``*IDN?``; else ProtocolError."""
    cells = [cell.strip() for cell in text.split(",")]
    if len(cells) != 4 or not _NAME.search(cells[0]) or not cells[1]:
        raise ProtocolError(
            f"'*IDN?': expected manufacturer, model, serial number and revision; found '{text[:80]}'",
            code="protocol.reply.identity",
        )
    return cells[0], cells[1], cells[2], cells[3]


def parse_error(text: str) -> tuple[int, str]:
    """Return number and text of an entry of the error queue, such as ``-113,"Undefined header"``; number 0: no error.

    Raises
    ------
    ProtocolError
        The answer has another format.
    """
    match = _ERROR.fullmatch(text)
    if match is None:
        raise ProtocolError(
            f"'SYST:ERR?': expected a number and a text in quotes; found '{text[:80]}'", code="protocol.reply.form"
        )
    return int(match[1]), match[2]


def parse_readings(text: str) -> list[tuple[int, float]]:
    """Return channels and readings of a scan, whose format is reading and channel, such as ``+2.1E+01,101``.

    A reading beyond the range is infinite, with its sign.

    Raises
    ------
    ProtocolError
        The answer has another format.
    """
    cells = text.split(",")
    pairs = list(zip(cells[::2], cells[1::2], strict=False))
    if len(cells) % 2 or not all(_NUMBER.fullmatch(a.strip()) and _CHANNEL.fullmatch(b.strip()) for a, b in pairs):
        raise ProtocolError(
            f"'READ?': expected readings, each with its channel, such as '+2.61950000E+01,101'; found '{text[:80]}'",
            code="protocol.reply.number_form",
        )
    return [(int(channel), _reading(float(number))) for number, channel in pairs]


def _reading(number: float) -> float:
    return math.copysign(math.inf, number) if abs(number) >= OVERLOAD * (1 - 1e-9) else number
