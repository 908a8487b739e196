"""CiA 404, measuring devices: the objects of an analogue input, the meaning of its unit and its status.

A node has one or several of the objects of the process value: a float, or a whole number with a number of decimal
digits. The documentation of the device states the sources.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

from errormotion.errors import InstrumentError, ProtocolError
from errormotion.instruments.thermometer.sensors import FAULTY, GOOD, OUT_OF_RANGE

DEVICE_TYPE, NAME, IDENTITY = 0x1000, 0x1008, 0x1018
UNIT = 0x6131
"""Physical unit: prefix, numerator, denominator, reserved; one byte each, most significant byte first (CiA 303-2)."""
DIGITS = 0x6132
"""Number of decimal digits of a process value that is a whole number."""
STATUS = 0x6150
PROFILE = 404
CELSIUS, KELVIN = 0x002D0000, 0x00050000
FAHRENHEIT = 0x00AC0000  # assumption: CiA 303-2, from memory
FAULTY_SENSOR, OVER, UNDER = 1, 2, 4
"""Bits of the status: sensor faulty or missing (also with one of the others), above its range, below its range."""
MAX_DIGITS = 9
MAX_NUMBER = 4  # bytes
_ZEROS = {CELSIUS: (0.0, 1.0), KELVIN: (273.15, 1.0), FAHRENHEIT: (32.0, 5 / 9)}
"""0 degC in a unit, and K per unit."""


@dataclass(frozen=True)
class Number:
    """A format of the process value.

    Attributes
    ----------
    index : int
        Index of its object.
    form : str
        Format of `struct`.
    whole : bool
        Whether another object has its number of decimal digits.
    """

    index: int
    form: str
    whole: bool

    @property
    def size(self) -> int:
        """Number of bytes."""
        return struct.calcsize(self.form)

    def decode(self, data: bytes) -> float:
        """Return the number; ProtocolError for another number of bytes.

        A node that does not state the size of its entries sends 4 bytes for a number of 2 bytes.
        """
        if len(data) not in (self.size, MAX_NUMBER):
            what = f"{'a whole number' if self.whole else 'a float'} of {self.size} bytes"
            raise ProtocolError(
                f"0x{self.index:04X}: expected {what}; found {data.hex(' ') or 'none'}", code="protocol.value.form"
            )
        (value,) = struct.unpack_from(self.form, data)
        return float(value)


NUMBERS = {
    "float": Number(0x6130, "<f", whole=False),
    "integer 32": Number(0x9130, "<i", whole=True),
    "integer 16": Number(0x7130, "<h", whole=True),
}
"""Formats in the order in which they are tried."""


@dataclass(frozen=True)
class Scale:
    """Conversion of a number to degC: (number x 10^exponent - zero) x factor.

    Attributes
    ----------
    exponent : int
    zero : float
        0 degC in the unit.
    factor : float
        K per unit.
    """

    exponent: int
    zero: float = 0.0
    factor: float = 1.0

    def celsius(self, number: float) -> float:
        """Return the temperature, degC."""
        shifted = number * 10.0**self.exponent if self.exponent >= 0 else number / 10.0**-self.exponent
        return (shifted - self.zero) * self.factor


def scale_of(unit: int, digits: int = 0) -> Scale:
    """Return the conversion of a unit to degC; ``digits`` is the number of decimal digits of a whole number.

    Raises
    ------
    InstrumentError
        Not a unit of temperature.
    ProtocolError
        An impossible number of digits.
    """
    if not 0 <= digits <= MAX_DIGITS:
        raise ProtocolError(
            f"0x{DIGITS:04X}: expected 0 to {MAX_DIGITS} decimal digits; found {digits}", code="protocol.reply.decimals"
        )
    exponent = (unit >> 24 ^ 0x80) - 0x80 - digits  # the prefix is signed
    if unit & 0x00FFFFFF not in _ZEROS:
        raise InstrumentError(
            f"The unit of the input is 0x{unit:08X}; expected degC (0x{CELSIUS:08X}), K (0x{KELVIN:08X}) or degF "
            f"(0x{FAHRENHEIT:08X}), with a prefix. If the code is wrong, state the unit in the setting 'unit'",
            code="thermometer.unit.unknown",
        )
    return Scale(exponent, *_ZEROS[unit & 0x00FFFFFF])


def flag_of(status: int, value: float) -> str:
    """Return the flag of an input: beyond its range, or its sensor faulty (broken, shorted or missing)."""
    if status & (OVER | UNDER):
        return OUT_OF_RANGE
    if status & FAULTY_SENSOR:
        return FAULTY
    return GOOD if math.isfinite(value) else OUT_OF_RANGE
