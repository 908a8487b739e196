"""Commands and answers of a capaNCDT 6200: ASCII on TCP port 23.

Operating instructions of the manufacturer ("6200": capaNCDT 6200; "6500": capaNCDT 6500, of the same family). A command
is ``$``, three letters, parameters, CR LF. The controller echoes what it receives and adds the rest of its answer,
which ends in ``OK`` CR LF (6200 p. 59): ``$STI1200`` is answered ``$STI1200,960OK``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from errormotion.errors import InstrumentError, ProtocolError

COMMAND_PORT = 23
DATA_PORT = 10001

LINE_END = b"\n"
MAX_LINE_BYTES = 512
"""Longest line of an answer."""

SAMPLE_TIME = "STI"
TRIGGER = "TRG"
AVERAGING = "AVT"
AVERAGING_NUMBER = "AVN"
CHANNELS = "CHS"
LINEARISATION = "LIN"
ONE_READING = "GMD"
CONTROLLER = "COI"
VERSION = "VER"

CONTINUOUS = 0
ON_REQUEST = 1
"""Trigger modes of TRG: all samples, or one for each edge of the trigger input and each GMD (6500 p. 37)."""

AVERAGINGS = {"none": 0, "moving": 1, "arithmetic": 2, "median": 3, "dynamic noise rejection": 4}
"""Parameters of AVT (6500 p. 37). The arithmetic average returns only every nth value."""
NUMBERS = (2, 8)
"""Smallest and largest parameter of AVN (6228 p. 55)."""
RATES = (2.5, 3906.25)
"""Lowest and highest data rate, Hz (6200 p. 56)."""

ABSENT, PRESENT, MATHS = 0, 1, 2
"""States of a channel in the answer to CHS (6200 p. 63)."""

ERRORS = ("$UNKNOWN COMMAND", "$WRONG PARAMETER", "$WRONG PASSWORD", "$TIMEOUT")
"""Refusals. An independent driver of the DT6220 reads the first two; the others are assumptions."""

UNITS = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6, "nm": 1e-9}
"""Units of a measuring range, m; the manufacturer's example is ``µm`` (6500 p. 44)."""

_NUMBER = re.compile(r"[+-]?\d{1,12}(?:\.\d{1,9})?")
_FIELD = re.compile(r"([A-Z]{3})(.*)")


def encode(command: str) -> bytes:
    """Return the bytes of a command that is given without its ``$``."""
    return f"${command}\r\n".encode("ascii")


def echoes(command: str, line: bytes) -> bool:
    """Whether a line answers a command, by its echo; others are a greeting, or late answers to other commands."""
    return f"${command}" in decode_text(line)


def answer_to(command: str, line: bytes) -> str:
    """Return the answer to a command from a line, without the echo and the ``OK``.

    Raises
    ------
    InstrumentError
        The controller refuses the command.
    ProtocolError
        The line has no echo of the command, or no ``OK``.
    """
    text = decode_text(line)
    _, echo, rest = text.rpartition(f"${command}")
    for error in ERRORS:
        if error in rest:
            raise InstrumentError(
                f"The controller refuses '${command}': {error[1:].lower()}", code="instrument.refused"
            )
    without_ok = command == VERSION and rest  # the manuals print this answer without OK (6200 p. 66)
    if not echo or not (rest.endswith("OK") or without_ok):
        raise ProtocolError(
            f"Expected an answer to '${command}' that ends in 'OK'; found {text[:80]!r}", code="protocol.reply.form"
        )
    return rest.removesuffix("OK")


def decode_text(line: bytes) -> str:
    """Return a line as text, without control characters; an ``µ`` may be in UTF-8 or in Latin-1."""
    kept = bytes(byte for byte in line if byte >= 0x20)
    try:
        return kept.decode("utf-8")
    except UnicodeDecodeError:
        return kept.decode("latin-1")


def parse_number(command: str, text: str) -> int:
    """Return the whole number that is an answer."""
    if not re.fullmatch(r"\d{1,9}", text):
        raise ProtocolError(
            f"Expected a number as the answer to '${command}'; found {text[:40]!r}", code="protocol.reply.number_form"
        )
    return int(text)


def parse_sample_time(command: str, text: str) -> float:
    """Return the sample time of an answer to STI, s: the actual one, which follows the requested one and a comma."""
    microseconds = parse_number(command, text.rpartition(",")[2])
    if microseconds == 0:
        raise ProtocolError(
            f"Expected a sample time as the answer to '${command}'; found {text[:40]!r}",
            code="protocol.reply.number_form",
        )
    return microseconds * 1e-6


def parse_channels(text: str) -> tuple[int, ...]:
    """Return the state of each channel, from the answer to CHS."""
    return tuple(parse_number(CHANNELS, part) for part in text.split(",")[:32])


def parse_fields(command: str, text: str) -> dict[str, str]:
    """Return the fields of an answer such as ``:ANO123,NAMabc``, by their three letters."""
    fields = {}
    for part in text.removeprefix(":").split(","):
        match = _FIELD.fullmatch(part.strip())
        if match is None:
            raise ProtocolError(
                f"Expected fields such as 'NAM...' as the answer to '${command}'; found {text[:80]!r}",
                code="protocol.reply.form",
            )
        fields[match[1]] = match[2].strip()
    return fields


@dataclass(frozen=True)
class Channel:
    """A channel of the controller.

    Attributes
    ----------
    name, serial_number : str
        Of the demodulator.
    offset, measuring_range : float
        Reading of the lowest value, and difference between highest and lowest reading, m.
    """

    name: str
    serial_number: str
    offset: float
    measuring_range: float


def channel_request(channel: int) -> str:
    """Return the command that requests the description of a channel."""
    return f"CHI{channel}"


def parse_channel(channel: int, text: str) -> Channel:
    """Return the description of a channel, from the answer to CHI (6500 p. 44).

    Raises
    ------
    ProtocolError
        No range, or a range in an unknown unit.
    """
    command = channel_request(channel)
    fields = parse_fields(command, text)
    for name in ("RNG", "UNT"):
        if name not in fields:
            raise ProtocolError(
                f"Expected a field {name} in the answer to '${command}'; found {text[:80]!r}",
                code="protocol.reply.field",
            )
    unit = UNITS.get(fields["UNT"])
    if unit is None:
        raise ProtocolError(
            f"Channel {channel} has its range in {fields['UNT'][:20]!r}; expected one of {', '.join(UNITS)}",
            code="protocol.reply.unit",
        )
    low, span = (_number(command, fields.get(name, "0")) * unit for name in ("OFS", "RNG"))
    if span <= 0:
        raise ProtocolError(
            f"Channel {channel} states a measuring range of {fields['RNG']}; check that a sensor is assigned",
            code="protocol.reply.range",
        )
    return Channel(fields.get("NAM", ""), fields.get("SNO", ""), low, span)


def _number(command: str, text: str) -> float:
    if not _NUMBER.fullmatch(text):
        raise ProtocolError(
            f"Expected a number in the answer to '${command}'; found {text[:40]!r}", code="protocol.reply.number_form"
        )
    return float(text)
