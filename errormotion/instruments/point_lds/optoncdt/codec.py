"""Protocol of the optoNCDT: bytes to values and back. Facts marked (m) are from memory; each is one line to correct.

A value has 18 bits and travels as three bytes, tagged in their upper bits: ``L = 00 D5..D0``, ``M = 01 D11..D6``,
``H = 10 D17..D12``. With more than one value a sample, those behind the first have ``H = 11 D17..D12`` (m). Distances
use 16 bits, error codes lie above. Answers to commands are ASCII text between the values and end with ``->``; no
character of a text has the top bit that every ``H`` has, so the two can always be distinguished.

The bulk of the work is done by the compiled functions of `kernels`; this module holds the facts and the small cases.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from errormotion.errors import InstrumentError, ProtocolError

PROMPT = b"->"
LINE_END = b"\r\n"

SCALE = 1.02 / 65520  # x = (raw * SCALE - OFFSET) * range, from the start of the range
OFFSET = 0.01
LOWEST, HIGHEST = 643, 64876  # the measuring range
MAX_DISTANCE_CODE = 65535
COUNTER_BITS = 18
BITS_PER_BYTE = 10  # 8N1
BYTES_PER_VALUE = 3

ERROR_CODES: Mapping[int, str] = {
    262073: "scaling underflow",
    262074: "scaling overflow",
    262075: "baud rate overflow",
    262076: "no peak",
    262077: "before range",
    262078: "after range",
    262079: "error 262079",  # (m) no name known
    262080: "not calculable",  # (m)
    262081: "peak too wide",  # (m)
    262082: "laser off",
}
NO_PEAK, BEFORE_RANGE, AFTER_RANGE = 262076, 262077, 262078

# Why a sample has no value. The position in this list is the code that the compiled functions use; 0 = it has one.
REASONS: tuple[str, ...] = (
    "",
    "lost",
    "garbled",
    "below range",
    "above range",
    "unknown code",
    "overrun",
    *ERROR_CODES.values(),
)
LOST, GARBLED, BELOW, ABOVE, UNKNOWN, OVERRUN = range(1, 7)
FIRST_ERROR_CODE = min(ERROR_CODES)
FIRST_ERROR_REASON = 7

_VALUE = re.compile(rb"[\x00-\x3f][\x40-\x7f][\x80-\xff]")
_ERROR = re.compile(r"E\d{2,4}\b.*")


@dataclass(frozen=True)
class Model:
    """A sensor family: its rates in Hz, ranges in m, baud rates, and the rate that MEASRATE names for each."""

    name: str
    rates: tuple[float, ...]
    ranges: tuple[float, ...]
    baudrates: tuple[int, ...]


MODELS: Mapping[str, Model] = {
    "ILD1420": Model(
        "ILD1420",
        (250.0, 500.0, 1000.0, 2000.0, 4000.0),  # (m)
        (10e-3, 25e-3, 50e-3, 100e-3, 200e-3, 500e-3),  # (m)
        (9600, 19200, 38400, 56000, 115200, 128000, 230400, 256000, 460800, 691200, 921600, 1000000),  # (m)
    ),
    "ILD2300": Model(
        "ILD2300",
        (1500.0, 2500.0, 5000.0, 10000.0, 20000.0, 30000.0, 49140.0),  # (m) but the last
        (2e-3, 5e-3, 10e-3, 20e-3, 40e-3, 50e-3, 100e-3, 200e-3, 300e-3),  # (m) but the first
        (9600, 115200, 230400, 460800, 691200, 921600, 1500000, 2000000, 2500000, 3000000, 3500000, 4000000),  # (m)
    ),
}


def distance(raw: int, measuring_range: float) -> float:
    """Return the distance of a raw value from the start of the range, in the unit of ``measuring_range``."""
    return (raw * SCALE - OFFSET) * measuring_range


def reason(raw: int) -> str:
    """Return why a raw value is no distance inside the measuring range; empty where it is one."""
    if raw in ERROR_CODES:
        return ERROR_CODES[raw]
    if raw > MAX_DISTANCE_CODE:
        return REASONS[UNKNOWN]
    if raw < LOWEST:
        return REASONS[BELOW]
    return REASONS[ABOVE] if raw > HIGHEST else ""


def encode_value(raw: int, *, first: bool = True) -> bytes:
    """Return the three bytes of an 18-bit value; ``first`` of its sample or behind the first."""
    if not 0 <= raw < 1 << COUNTER_BITS:
        raise ProtocolError(f"A value has 18 bits; found {raw}")
    return bytes((raw & 0x3F, 0x40 | raw >> 6 & 0x3F, (0x80 if first else 0xC0) | raw >> 12))


def decode_value(triple: bytes) -> int:
    """Return the 18-bit value of three bytes; ProtocolError where their tags are wrong."""
    if len(triple) != BYTES_PER_VALUE or not _VALUE.fullmatch(triple):
        raise ProtocolError(f"Expected three bytes tagged 00, 01, 1x; found {triple.hex(' ')}")
    low, middle, high = triple
    return low | (middle & 0x3F) << 6 | (high & 0x3F) << 12


def text_of(data: bytes) -> bytes:
    """Return what is left of a stretch of bytes without the values in it."""
    return _VALUE.sub(b"", data)


def parse_reply(command: str, text: bytes) -> list[str]:
    """Return the lines of an answer, without echo and prompt.

    Raises
    ------
    InstrumentError
        The sensor refused the command; the message has its error text.
    """
    printable = bytes(byte for byte in text if byte in b"\r\n\t" or 0x20 <= byte < 0x7F)
    words = printable.decode("ascii").replace(PROMPT.decode(), "\n")
    lines = [line.strip() for line in words.splitlines()]
    lines = [line for line in lines if line and line != command]
    for line in lines:
        if found := _ERROR.search(line):
            raise InstrumentError(f"The sensor refuses '{command}': {found[0]}")
    return lines


def rate_text(rate: float) -> str:
    """Return a measuring rate (Hz) as MEASRATE takes it, in kHz."""
    return f"{rate / 1000:.10g}"


def bytes_per_second(rate: float, *, counter: bool) -> float:
    """Return the bytes per second of a stream."""
    return rate * BYTES_PER_VALUE * (2 if counter else 1)


def check_line(rate: float, baudrate: int, *, counter: bool) -> None:
    """Refuse a rate (Hz) whose bytes do not fit through a serial line.

    Raises
    ------
    InstrumentError
        With the arithmetic.
    """
    needed = bytes_per_second(rate, counter=counter) * BITS_PER_BYTE
    if needed > baudrate:
        values = "2 values (distance and counter)" if counter else "1 value"
        raise InstrumentError(
            f"{rate / 1000:g} kHz does not fit through {baudrate} baud: {rate:g} samples/s x {values} x 3 bytes "
            f"x 10 bits (8N1) = {needed:.0f} bit/s. Lower the rate, raise the baud rate"
            + (", or do without the counter" if counter else "")
        )
