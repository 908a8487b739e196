"""Values of the optoNCDT on RS422: bytes to values and back.

A value has 18 bits and is sent as three bytes, tagged in their upper bits: ``L = 00 D5..D0``, ``M = 01 D11..D6``, ``H =
10 D17..D12`` (1420 p. 84). If a sample has several values, those after the first have ``H = 11 D17..D12``. Distances
use 16 bits; error values are higher. Answers to commands are ASCII text between the values and end with ``->``. No
character of a text has the top bit, which every ``H`` has, so that the two can always be distinguished.

The compiled functions of `kernels` process streams; this module has the constants and the functions for single values.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from errormotion.errors import InstrumentError, ProtocolError

SCALE = 1.02 / 65520  # x = (raw * SCALE - OFFSET) * range, from the start of the range: 2300 p. 94, 1420 p. 65
OFFSET = 0.01
LOWEST = 643  # first value of the measuring range; the last one depends on the model, see `models`
MAX_DISTANCE_CODE = 65520  # end of the reserve after the range: 1420 p. 65; 65519 on the 2300, p. 94
COUNTER_BITS = 18  # 2300 p. 86, 1420 p. 66
BITS_PER_BYTE = 10  # 8N1
BYTES_PER_VALUE = 3

ERROR_CODES: Mapping[int, str] = {  # 1420 p. 66
    262075: "baud rate overflow",
    262076: "no peak",
    262077: "before range",
    262078: "after range",
    262080: "not calculable",
    262081: "peak too wide",
    262082: "laser off",
}

# Why a sample has no value. The position in this list is the code in the compiled functions; 0: it has a value.
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
FIRST_ERROR_CODE, LAST_ERROR_CODE = min(ERROR_CODES), max(ERROR_CODES)
ERROR_REASONS: tuple[int, ...] = tuple(
    REASONS.index(ERROR_CODES[code]) if code in ERROR_CODES else UNKNOWN
    for code in range(FIRST_ERROR_CODE, LAST_ERROR_CODE + 1)
)
"""Position in `REASONS` of each code from the first to the last."""

_VALUE = re.compile(rb"[\x00-\x3f][\x40-\x7f][\x80-\xff]")


def distance(raw: int, measuring_range: float) -> float:
    """Return the distance of a raw value from the start of the range, in the unit of ``measuring_range``."""
    return (raw * SCALE - OFFSET) * measuring_range


def reason(raw: int, highest: int) -> str:
    """Return why a raw value is not a distance within the measuring range, up to ``highest``; empty if it is."""
    if raw in ERROR_CODES:
        return ERROR_CODES[raw]
    if raw > MAX_DISTANCE_CODE:
        return REASONS[UNKNOWN]
    if raw < LOWEST:
        return REASONS[BELOW]
    return REASONS[ABOVE] if raw > highest else ""


def encode_value(raw: int, *, first: bool = True) -> bytes:
    """Return the three bytes of an 18-bit value; ``first``: it is the first one of its sample."""
    if not 0 <= raw < 1 << COUNTER_BITS:
        raise ProtocolError(f"A value has 18 bits; found {raw}", code="sensor.value.outside")
    return bytes((raw & 0x3F, 0x40 | raw >> 6 & 0x3F, (0x80 if first else 0xC0) | raw >> 12))


def text_of(data: bytes) -> bytes:
    """Return bytes without the values in them."""
    return _VALUE.sub(b"", data)


def bytes_per_second(rate: float, *, counter: bool) -> float:
    """Return the bytes per second of a stream."""
    return rate * BYTES_PER_VALUE * (2 if counter else 1)


def check_line(rate: float, baudrate: int, *, counter: bool) -> None:
    """Refuse a rate (Hz) that exceeds the capacity of a serial line.

    Raises
    ------
    InstrumentError
        The line is too slow; the message has the calculation.
    """
    needed = bytes_per_second(rate, counter=counter) * BITS_PER_BYTE
    if needed > baudrate:
        values = "2 values (distance and counter)" if counter else "1 value"
        raise InstrumentError(
            f"{rate / 1000:g} kHz exceeds {baudrate} baud: {rate:g} samples/s x {values} x 3 bytes "
            f"x 10 bits (8N1) = {needed:.0f} bit/s. Lower the rate, raise the baud rate"
            + (", or set counter = false" if counter else ""),
            code="sensor.rate.too_high",
        )
