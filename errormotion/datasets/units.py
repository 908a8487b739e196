"""Quantities with units: conversion of texts such as ``"5 mm"`` to numbers in SI.

``Length``, ``Angle``, ``Time`` and the others are types for pydantic models. The value is a float in SI (spindle
speed in 1/min, temperature in degC). A string such as ``"5 mm"`` is accepted everywhere. A number without unit is SI
in Python, and refused in a file or on the command line (validation context ``{"edge": True}``).
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from difflib import get_close_matches
from fractions import Fraction
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from errormotion.errors import DatasetError

if TYPE_CHECKING:
    import pint

EDGE = {"edge": True}
"""Validation context of files and of the command line, where units are compulsory."""

_USUAL = {
    "m": ("mm", "um", "nm", "m", "inch"),
    "rad": ("arcsec", "arcmin", "deg", "rad", "mrad", "urad"),
    "s": ("s", "min", "h", "ms", "us"),
    "1/min": ("/min", "rpm", "1/min", "rev/min", "/s"),
    "degC": ("degC", "K", "degF"),
    "Hz": ("Hz", "kHz", "MHz", "1/s"),
    "m/s": ("mm/min", "m/min", "mm/s", "m/s"),
    "m/K": ("um/K", "nm/K", "mm/K", "m/K"),
}
"""Suggested units, by the SI unit."""

ArrayLike = float | np.ndarray

LONGEST = 100
"""Longest text of a quantity or a unit, characters."""

_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,2}(?![0-9]))?")
# A name and its exponent in the forms of pint (m^2, m**2), CF and UDUNITS (m2, s-1), and with superscripts (m²).
_TERM = re.compile(r"([^\W\d_]+(?:_[^\W\d_]+)*|°C?|%)(?:(?:\^|\*\*)?([+-]?[0-9]{1,2})(?![0-9]))?")
_LEAD = re.compile(r"1?/\s*")
_SEPARATOR = re.compile(r"\s*[*·⋅/.]\s*|\s+")
_SUPERSCRIPTS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁺⁻", "0123456789+-")
# Names of UDUNITS that pint does not have.
_CELSIUS = ("degree_C", "degrees_C", "degreesC", "degree_c", "degree_celsius", "degrees_celsius", "degrees_Celsius")
_NAMES = {**dict.fromkeys((*_CELSIUS, "Celsius", "degree_Celsius"), "degC"), "arc_second": "arcsecond"}
_NAMES |= {"arc_minute": "arcminute", "arc_degree": "degree"}

# pint's rpm contains a factor 2 pi; spindle speeds therefore have a separate table, in 1/min.
_PER_MINUTE = {
    **dict.fromkeys(("/min", "1/min", "min^-1", "min-1", "rpm", "rev/min", "U/min"), Fraction(1)),
    **dict.fromkeys(("/s", "1/s", "s^-1", "s-1", "rps", "rev/s"), Fraction(60)),
}


# The usual units as (inside unit, factor): loading pint takes 0.2 s. Pi has the digits that pint gives it.
_PI = Fraction("3.1415926535897932384626433832795028841971693993751")
_EXACT = {
    **{unit: ("m", Fraction(1, n)) for unit, n in (("m", 1), ("mm", 10**3), ("um", 10**6), ("nm", 10**9))},
    **{unit: ("rad", Fraction(1, n)) for unit, n in (("rad", 1), ("mrad", 10**3), ("urad", 10**6))},
    **{unit: ("rad", _PI / n) for unit, n in (("deg", 180), ("arcmin", 180 * 60), ("arcsec", 180 * 3600))},
    **{unit: ("s", Fraction(1, n)) for unit, n in (("s", 1), ("ms", 10**3), ("us", 10**6))},
    **{unit: ("s", Fraction(n)) for unit, n in (("min", 60), ("h", 3600))},
    **{unit: ("Hz", Fraction(n)) for unit, n in (("Hz", 1), ("kHz", 10**3), ("MHz", 10**6))},
    **{unit: ("m/s", Fraction(1, n)) for unit, n in (("m/s", 1), ("mm/s", 10**3), ("m/min", 60), ("mm/min", 60_000))},
    **{unit: ("m/K", Fraction(1, n)) for unit, n in (("m/K", 1), ("mm/K", 10**3), ("um/K", 10**6), ("nm/K", 10**9))},
}


_SLOPES = {"mm/m": Fraction(1, 10**3), "um/m": Fraction(1, 10**6), "µm/m": Fraction(1, 10**6)}
"""Slopes that levels and angular optics state for angles, rad; to 1 mm/m the angle differs by less than 1e-6 of it."""


@dataclass(frozen=True)
class Quantity:
    """Pydantic annotation of a float that has a unit.

    Parameters
    ----------
    kind : str
        Name with its article: "a length".
    unit : str
        Unit of the value.
    example : str
        An example as text.
    """

    kind: str
    unit: str
    example: str

    def parse(self, text: str) -> float:
        """Return the value of a text such as ``"5 mm"``; ValueError states what was expected."""
        shown = text if len(text) <= LONGEST else text[:LONGEST] + "..."
        expected = f"expected {self.kind} with its unit, such as '{self.example}'; found '{shown}'"
        plain = text.strip() if len(text) <= LONGEST else ""
        match = _NUMBER.match(plain)
        if match is None or match.end() == len(plain):
            raise ValueError(expected)
        unit = plain[match.end() :].strip()
        try:
            factor, offset = _linear(unit, self.unit)
            return float(Fraction(match[0]) * factor + offset)
        except DatasetError as error:
            hint = " (the decimal sign is a point)" if re.match(r",[0-9]", unit) else f": {error}{self._near(unit)}"
            raise ValueError(expected + hint) from error
        except OverflowError:
            raise ValueError(f"{expected}: the number is too large") from None

    def _near(self, unit: str) -> str:
        """Return a suggestion for a unit that is unknown or of another kind; empty if there is none."""
        usual = _USUAL.get(self.unit, ())
        plain = unit.replace(" ", "")
        similar = [known for known in usual if known.lower() == plain.lower()] or get_close_matches(
            plain, usual, 3, 0.5
        )
        return f"; did you mean {' or '.join(repr(each) for each in similar)}?" if similar else ""

    def _validate(self, value: Any, info: core_schema.ValidationInfo) -> Any:
        if isinstance(value, str):
            try:
                return self.parse(value)
            except ValueError as error:
                raise _refusal(str(error)) from error
        if isinstance(value, bool) or not isinstance(value, (int, float, np.number)):
            raise _refusal(f"expected {self.kind} with its unit, such as '{self.example}'; found {value!r}")
        if (info.context or {}).get("edge"):
            raise _refusal(f"expected {self.kind} with its unit, such as '{self.example}'; found {value}")
        if not math.isfinite(value):
            raise _refusal(f"expected {self.kind} in {self.unit}, a finite number; found {value}")
        return float(value)

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.with_info_before_validator_function(self._validate, handler(source))

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return {**handler(schema), "unit": self.unit, "examples": [self.example]}


def _refusal(message: str) -> PydanticCustomError:
    return PydanticCustomError("quantity", "{message}", {"message": message})


LENGTH = Quantity("a length", "m", "5 mm")
ANGLE = Quantity("an angle", "rad", "3 arcsec")
TIME = Quantity("a time", "s", "104 min")
SPEED = Quantity("a spindle speed", "1/min", "15000 /min")
TEMPERATURE = Quantity("a temperature", "degC", "20 degC")
FREQUENCY = Quantity("a frequency", "Hz", "20 kHz")
VELOCITY = Quantity("a velocity", "m/s", "1500 mm/min")
EXPANSION = Quantity("an expansion", "m/K", "2.1 um/K")
KINDS = (LENGTH, ANGLE, TIME, SPEED, TEMPERATURE, FREQUENCY, VELOCITY, EXPANSION)

Length = Annotated[float, LENGTH]
Angle = Annotated[float, ANGLE]
Time = Annotated[float, TIME]
Speed = Annotated[float, SPEED]
Temperature = Annotated[float, TEMPERATURE]
Frequency = Annotated[float, FREQUENCY]
Velocity = Annotated[float, VELOCITY]
Expansion = Annotated[float, EXPANSION]


@cache
def _registry() -> pint.UnitRegistry[Any]:
    import pint  # 0.2 s to load: only for units that are not in the table

    return pint.UnitRegistry(non_int_type=Fraction)  # exact: 25 um is 2.5e-5 m to the last bit


@cache
def _unit(text: str) -> pint.Unit:
    import pint

    expression = _expression(text)
    try:
        return _registry().parse_units(expression)
    # errors of pint, and those of Python that pint raises for names such as 'nan'
    except (pint.PintError, ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise DatasetError(f"'{text}' is not a known unit", code="unit.unknown") from error


def _expression(text: str) -> str:
    """Return a unit as an expression of pint; factors are evaluated from left to right, as in UDUNITS.

    Raises
    ------
    DatasetError
        The text is not a sequence of names with whole exponents, and signs between them.
    """
    if len(text) > LONGEST:
        raise DatasetError(f"'{text[:LONGEST]}...' is not a known unit", code="unit.unknown")
    plain = text.strip().translate(_SUPERSCRIPTS)
    if plain == "1":
        return ""
    lead = _LEAD.match(plain)
    sign, position = (-1, lead.end()) if lead else (1, 0)
    factors: list[str] = []
    while match := _TERM.match(plain, position):
        factors.append(f"{_NAMES.get(match[1], match[1])}**({sign * int(match[2] or 1)})")
        if match.end() == len(plain):
            return " * ".join(factors)
        between = _SEPARATOR.match(plain, match.end())
        if between is None:
            break
        sign, position = (-1 if "/" in between[0] else 1), between.end()
    raise DatasetError(f"'{text}' is not a known unit", code="unit.unknown")


@cache
def _linear(source: str, target: str) -> tuple[Fraction, Fraction]:
    """Return (factor, offset) such that ``target = factor * source + offset``."""
    if source == target:
        return Fraction(1), Fraction(0)
    if target in _PER_MINUTE and source in _PER_MINUTE:
        return _PER_MINUTE[source] / _PER_MINUTE[target], Fraction(0)
    if source in _SLOPES and _EXACT.get(target, ("",))[0] == "rad":
        return _SLOPES[source] / _EXACT[target][1], Fraction(0)
    if source in _EXACT and target in _EXACT:
        (kind, factor), (other, unit) = _EXACT[source], _EXACT[target]
        if kind != other:
            raise DatasetError(f"'{source}' is not convertible to '{target}'", code="unit.not_convertible")
        return factor / unit, Fraction(0)
    registry = _registry()
    from_, to = _unit(source), _unit(target)
    # Compared in base units, not in dimensions, since a per cent is not an angle.
    if registry.get_base_units(from_)[1] != registry.get_base_units(to)[1]:
        raise DatasetError(f"'{source}' is not convertible to '{target}'", code="unit.not_convertible")
    try:
        zero, one, two = (Fraction(registry.Quantity(Fraction(n), from_).to(to).magnitude) for n in (0, 1, 2))
        factor = one - zero
        float(factor), float(1 / factor), float(zero)
    except (ArithmeticError, TypeError, ValueError) as error:  # logarithmic units, overflow
        raise DatasetError(f"'{source}' is not convertible to '{target}'", code="unit.not_convertible") from error
    if two - one != factor:
        raise DatasetError(
            f"'{source}' is not convertible to '{target}' by a factor and an offset", code="unit.not_convertible"
        )
    return factor, zero


def convert(values: ArrayLike, source: str, target: str) -> ArrayLike:
    """Convert numbers from one unit to another.

    Parameters
    ----------
    values : float or ndarray
        Numbers in ``source``.
    source, target : str
        Units; ``degC`` is a temperature, not a difference.

    Returns
    -------
    float or ndarray
        Numbers in ``target``; infinite after an overflow.

    Raises
    ------
    DatasetError
        A unit is unknown, or the units are of different kinds.
    """
    factor, offset = _linear(source, target)
    # Divided if the factor is 1/n: 25 um is then 2.5e-5 m to the last bit.
    with np.errstate(over="ignore"):
        scaled = values / float(1 / factor) if factor.numerator == 1 else values * float(factor)
        return scaled + float(offset) if offset else scaled


def si_unit(unit: str) -> str:
    """Return the SI unit (m, rad, s, 1/min, degC, Hz, m/s, m/K) of the kind of ``unit``."""
    if unit in _PER_MINUTE:
        return SPEED.unit
    if unit in _EXACT:
        return _EXACT[unit][0]
    for kind in (kind for kind in KINDS if kind is not SPEED):
        try:
            _linear(unit, kind.unit)
        except DatasetError:
            continue
        return kind.unit
    _unit(unit)
    raise DatasetError(f"'{unit}' measures none of {', '.join(kind.kind for kind in KINDS)}", code="unit.kind.unknown")


def format_quantity(value: float, unit: str, digits: int = 4) -> str:
    """Return a value in SI as a text in a field unit, ``"19.3 um"``; NaN is ``"unknown"``.

    Parameters
    ----------
    value : float
        In m, rad, s, 1/min or degC.
    unit : str
        Unit of the text.
    digits : int
        Significant digits.
    """
    if math.isnan(value):
        return "unknown"
    number = float(convert(float(value), si_unit(unit), unit))
    text = np.format_float_positional(number, precision=digits, fractional=False, trim="-")
    return f"{'0' if text == '-0' else text} {unit}"
