"""CiA 404, measuring devices: the objects of an analogue input as a float, the meaning of its unit and status.

All of it is from memory (m) and kept in this one file.
"""

from __future__ import annotations

import math
import struct

from errormotion.errors import InstrumentError, ProtocolError
from errormotion.instruments.thermometer.sensors import GOOD, OPEN, OUT_OF_RANGE, SHORTED

DEVICE_TYPE, NAME, HEARTBEAT, IDENTITY = 0x1000, 0x1008, 0x1017, 0x1018
VALUE = 0x6130
"""Process value as a float, one subindex an input."""
UNIT = 0x6131
"""Physical unit: prefix, numerator, denominator, reserved, a byte each from the top (CiA 303-2)."""
STATUS = 0x6150
PROFILE = 404
CELSIUS, KELVIN = 0x002D0000, 0x00050000
NOT_VALID, POSITIVE, NEGATIVE = 1, 2, 4
"""Bits of the status: no valid value; overload above, below."""
ZERO_CELSIUS = 273.15  # K


def decode_value(data: bytes) -> float:
    """Return a process value."""
    if len(data) != 4:
        raise ProtocolError(f"0x{VALUE:04X}: expected a float of 4 bytes; found {data.hex(' ') or 'none'}")
    (value,) = struct.unpack("<f", data)
    return float(value)


def decode_unsigned(data: bytes, index: int) -> int:
    """Return an unsigned number of 1 to 4 bytes."""
    if not 1 <= len(data) <= 4:
        raise ProtocolError(f"0x{index:04X}: expected a number of 1 to 4 bytes; found {len(data)} bytes")
    return int.from_bytes(data, "little")


def to_celsius(unit: int) -> tuple[float, float]:
    """Return scale and offset with which values in a unit become degC.

    Raises
    ------
    InstrumentError
        Not a unit of temperature.
    """
    prefix = (unit >> 24 ^ 0x80) - 0x80  # power of ten, signed
    if unit & 0x00FFFFFF == CELSIUS:
        return 10.0**prefix, 0.0
    if unit & 0x00FFFFFF == KELVIN:
        return 10.0**prefix, -ZERO_CELSIUS
    raise InstrumentError(
        f"The unit of the input is 0x{unit:08X}; expected degC (0x{CELSIUS:08X}) or K (0x{KELVIN:08X}), with a prefix. "
        "If the code is wrong, state the unit in the setting 'unit'"
    )


def flag_of(status: int, value: float) -> str:
    """Return the flag of an input: a broken thermocouple or resistor overloads it above, a short below."""
    if status & POSITIVE:
        return OPEN
    if status & NEGATIVE:
        return SHORTED
    return OUT_OF_RANGE if status & NOT_VALID or not math.isfinite(value) else GOOD
