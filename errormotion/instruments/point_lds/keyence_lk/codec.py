"""Protocol of LK-G and LK-H controllers over RS-232C: lines of ASCII that end with a carriage return.

A request is a command and its identifiers, separated by commas; the answer starts with the request, followed by the
value: ``MS,01`` is answered by ``MS,01,+01.2345``. A refusal is ``ER,command,code``. One request at a time. A value has
eight characters: a sign and seven digits with a decimal point, or one of three texts that mean no value. The text does
not state whether it is in mm or um: this depends on a setting of the controller, its smallest displayed unit.

Formats, modes and errors of the LK-G3000 are from the manufacturer's manual (LK-G-M-NO5-E, pages 5-5 and 5-6), errors
of the LK-G5000 from other clients. Facts marked (m) are from memory; each is a single line to correct.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from errormotion.errors import InstrumentError, ProtocolError

LINE_END = b"\r"
MAX_LINE_BYTES = 256
"""Longest line of an answer."""
BITS_PER_BYTE = 10  # 8N1
MEASURING, SETTING = "R0", "Q0"  # commands that change the mode; also used as names of the modes
ERROR = "ER"

WIDTH = 8  # characters of a value
NO_VALUE, OVER, UNDER = "XXXXXXXX", "+FFFFFFF", "-FFFFFFF"

#: Why a reading has no value. The position in this list is its code; 0: it has a value.
REASONS: tuple[str, ...] = ("", "no value", "over range", "under range", "garbled")
ABSENT, ABOVE, BELOW, GARBLED = range(1, 5)
_TEXTS: Mapping[str, int] = {NO_VALUE: ABSENT, OVER: ABOVE, UNDER: BELOW}
_NUMBER = re.compile(r"[+-](?=.{7}\Z)[0-9]+\.([0-9]+)")

#: Error "not possible in this mode": of the LK-G3000 and of the LK-G5000.
STATE_ERRORS = ("01", "51")
_MEANINGS = (
    (("00", "50"), "unknown command; check the setting 'controller'"),
    (STATE_ERRORS, "not possible in this mode: measuring and setting are different modes"),
    (("20", "60"), "wrong length of the command"),
    (("21", "61"), "wrong number of parameters"),
    (("22", "62"), "a parameter is out of range; check the setting 'output'"),
    (("88",), "timeout in the controller; retry"),
    (("99",), "another error; see the display of the controller"),
)
#: Meanings of errors. Codes of the LK-G3000 start at 00 (its manual), of the LK-G5000 at 50 (other clients).
ERRORS: Mapping[str, str] = {code: meaning for codes, meaning in _MEANINGS for code in codes}


@dataclass(frozen=True)
class Controller:
    """A generation of controllers: how a value is requested, and how its outputs are numbered."""

    measure: str
    output: str
    outputs: int
    zero_off: str

    def measure_request(self, output: int) -> str:
        """Return the request for the value of one output."""
        return self.measure + self.output.format(output)

    def zero_off_request(self, output: int) -> str:
        """Return the request that cancels a zero set on the panel."""
        return self.zero_off + self.output.format(output)


#: The LK-G5000 is for heads LK-H and LK-G, the LK-G3000 for heads LK-G.
CONTROLLERS: Mapping[str, Controller] = {
    "LK-G5000": Controller("MS,", "{:02d}", 12, "WS,"),  # (m) zero
    "LK-G3000": Controller("M", "{:d}", 2, "W"),  # (m) zero
}


@dataclass(frozen=True)
class Display:
    """A smallest displayed unit: its number in the controller's settings, decimals of a value, and their unit in m."""

    number: int
    decimals: int
    unit: float

    @property
    def step(self) -> float:
        """One unit of the last digit, m."""
        return self.unit / 10.0**self.decimals

    @property
    def largest(self) -> float:
        """The largest value that the seven characters can represent, m."""
        return (10.0 ** (WIDTH - 2) - 1) * self.step


#: Displays by the unit of the last digit. The numbers are from memory (m).
DISPLAYS: Mapping[str, Display] = {
    "0.01 mm": Display(0, 2, 1e-3),
    "0.001 mm": Display(1, 3, 1e-3),
    "0.0001 mm": Display(2, 4, 1e-3),
    "0.00001 mm": Display(3, 5, 1e-3),
    "0.1 um": Display(4, 1, 1e-6),
    "0.01 um": Display(5, 2, 1e-6),
    "0.001 um": Display(6, 3, 1e-6),  # LK-G5000 only
}

DISPLAY_SETTING = "OI"  # (m) inferred from its position in the list of settings
OFFSET_SETTING = "OF"
NO_OFFSET = "+000000"

#: Measuring range of the heads about the middle of their range, m; lowest and highest reading. All (m) but LK-H050.
HEADS: Mapping[str, tuple[float, float]] = {
    "LK-H008": (-0.5e-3, 0.5e-3),
    "LK-H020": (-3e-3, 3e-3),
    "LK-H050": (-10e-3, 10e-3),
    "LK-H080": (-18e-3, 18e-3),
    "LK-H150": (-40e-3, 40e-3),
    "LK-G10": (-1e-3, 1e-3),
    "LK-G15": (-1e-3, 1e-3),
    "LK-G30": (-5e-3, 5e-3),
    "LK-G80": (-15e-3, 15e-3),
    "LK-G150": (-40e-3, 40e-3),
    "LK-G400": (-100e-3, 100e-3),
}


#: Sign of a reading by the side on which the controller's readings are positive; default of the manufacturer: near (m).
SIGNS: Mapping[str, float] = {"near": -1.0, "far": 1.0}


def encode(text: str) -> bytes:
    """Return a request or an answer as bytes, with its line end."""
    return text.encode("ascii") + LINE_END


def decode(line: bytes) -> str:
    """Return the text of a line without its line end.

    Raises
    ------
    ProtocolError
        The line contains other bytes than printable ASCII.
    """
    body = line.rstrip(b"\r\n")
    if not all(0x20 <= byte < 0x7F for byte in body):
        raise ProtocolError(f"Expected a line of ASCII; found {line!r}", code="protocol.text.form")
    return body.decode("ascii")


def parse_answer(request: str, text: str, header: str | None = None) -> str:
    """Return the part of an answer after its header; may be empty.

    Parameters
    ----------
    request : str
        The request.
    text : str
        The answer without its line end.
    header : str, optional
        Start of the answer; default: the request.

    Raises
    ------
    InstrumentError
        The controller refuses; the message states the error.
    ProtocolError
        The text is not the answer to this request.
    """
    if (code := error_code(request, text)) is not None:
        meaning = ERRORS.get(code, "unknown code")
        raise InstrumentError(
            f"The controller refuses '{request}' with error {code}: {meaning}", code="instrument.refused"
        )
    expected = request if header is None else header
    if text == expected:
        return ""
    if not text.startswith(f"{expected},"):
        raise ProtocolError(
            f"'{request}': expected an answer that starts with '{expected}'; found '{text}'", code="protocol.reply.form"
        )
    return text[len(expected) + 1 :]


def error_code(request: str, text: str) -> str | None:
    """Return the code of an error that answers a request; None if it is not an error, or answers another request.

    The error repeats the first word of the request, or the name of the setting after it.
    """
    match text.split(","):
        case [word, command, code] if word == ERROR and command and code:
            words = request.split(",")
            return code if command in (request, *words[:2]) else None
    return None


def parse_value(text: str, display: Display) -> tuple[float, int]:
    """Return a value in m, and the position in `REASONS` of the reason if it is NaN.

    Raises
    ------
    ProtocolError
        The value has another number of decimals than the display: its unit is unknown.
    """
    if reason := _TEXTS.get(text, 0):
        return float("nan"), reason
    number = _NUMBER.fullmatch(text)
    if number is None:
        return float("nan"), GARBLED
    if len(number[1]) != display.decimals:
        raise ProtocolError(
            f"Expected a value with {display.decimals} decimals, as in the settings; found '{text}'. The setting "
            "'display' must be the smallest displayed unit of the controller",
            code="protocol.reply.decimals",
        )
    return float(text) * display.unit, 0


def check_rate(rate: float, baudrate: int, controller: Controller) -> None:
    """Refuse a rate (Hz) that exceeds the capacity of the line.

    Raises
    ------
    InstrumentError
        The line is too slow; the message has the calculation.
    """
    request = len(encode(controller.measure_request(1)))
    answer = request + 1 + WIDTH
    needed = rate * (request + answer) * BITS_PER_BYTE
    if needed > baudrate:
        raise InstrumentError(
            f"{rate:g} readings/s exceed {baudrate} baud: each takes {request} bytes of request and "
            f"{answer} of answer, x 10 bits (8N1) = {needed:.0f} bit/s. Lower the rate or raise the baud rate",
            code="sensor.rate.too_high",
        )
