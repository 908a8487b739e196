"""Format of numbers (JCGM 100:2008, 7.2.6): uncertainty with two digits, value with the same resolution."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from decimal import ROUND_HALF_UP, Decimal

import numpy as np

DASH = "—"
ARCSEC = math.pi / 180 / 3600

#: Unit on the page: name, and size in SI.
UM = ("µm", 1e-6)
MM = ("mm", 1e-3)
SECOND_OF_ARC = ("arcsec", ARCSEC)
MINUTE = ("min", 60.0)

_MICRO = re.compile(r"(?<!\w)u(?=(?:m|rad)(?!\w))")
_CELSIUS = re.compile(r"\bdegC\b")
_DEGREE = re.compile(r"(?:(?<=\d) |(?<= / ))deg\b")
_MINUS = re.compile(r"(?<![\w)\]-])-(?=\d)")
_AND = {"en": "and", "de": "und"}
_LANGUAGE: ContextVar[str] = ContextVar("language", default="en")
_WORDS: ContextVar[Callable[[str], str]] = ContextVar("words", default=str)


@contextmanager
def written_in(language: str, words: Callable[[str], str] = str) -> Iterator[None]:
    """Write numbers and enumerations in this language inside of the block: in German with a decimal comma.

    ``words`` translates texts whose width must be known for the layout: the legends of drawings.
    """
    before = _LANGUAGE.set(language if language in _AND else "en")
    used = _WORDS.set(words)
    try:
        yield
    finally:
        _WORDS.reset(used)
        _LANGUAGE.reset(before)


def laid_out(text: str) -> str:
    """Return a text of a legend in the language of the page, so that its width is known when it is placed."""
    return _WORDS.get()(text)


def signs(text: str) -> str:
    """Return a text of the terminal with the signs of a page: those of micro, minus, degrees and degrees Celsius."""
    return _DEGREE.sub("°", _CELSIUS.sub("°C", _MINUS.sub("−", _MICRO.sub("µ", text))))


def typographic(text: str) -> str:
    """Return a number with a typographic minus and the decimal sign of the language."""
    return text.replace("-", "−").replace(".", "," if _LANGUAGE.get() == "de" else ".")


def rounded(value: float, expanded: float, *, signed: bool = True, digits: int = 4) -> tuple[str, str]:
    """Return value and expanded uncertainty as text, the uncertainty to two significant digits.

    Parameters
    ----------
    value, expanded : float
        In one unit. A value that is not finite gives two dashes; an uncertainty that is not finite or not positive
        gives a dash, and the value then has ``digits`` significant digits.
    signed : bool
        Whether a positive value has a plus sign.
    """
    if not math.isfinite(value):
        return DASH, DASH
    if not (math.isfinite(expanded) and expanded > 0):
        return _decimal(value, _place(value, digits), signed), DASH
    place = _place(expanded, 2)
    return _decimal(value, place, signed), _decimal(expanded, place, signed=False)


def _place(value: float, digits: int) -> int:
    """Power of ten of the last of ``digits`` significant digits, counted after rounding (0.0996 becomes 0.10)."""
    if value == 0 or not math.isfinite(value):
        return 1 - digits
    number = Decimal(repr(float(value)))
    place = number.adjusted() - digits + 1
    return number.quantize(Decimal(1).scaleb(place), rounding=ROUND_HALF_UP).adjusted() - digits + 1


def _decimal(value: float, place: int, signed: bool) -> str:
    number = Decimal(repr(float(value))).quantize(Decimal(1).scaleb(place), rounding=ROUND_HALF_UP)
    if number == 0:
        return typographic(f"{abs(number):f}")
    return typographic(f"{number:{'+' if signed else ''}f}")


def fixed(value: float, decimals: int, *, signed: bool = False) -> str:
    """Return a number with this number of decimals and a typographic minus; a dash for NaN."""
    return _decimal(value, -decimals, signed) if math.isfinite(value) else DASH


def decimals_of(value: float, digits: int) -> int:
    """Return the number of decimals for this number of significant digits; 0 for NaN."""
    return max(-_place(value, digits), 0) if math.isfinite(value) else 0


def significant(value: float, digits: int = 2) -> str:
    """Return a number with this number of significant digits, without exponent; a dash for NaN."""
    return _decimal(value, _place(value, digits), signed=False) if math.isfinite(value) else DASH


def integer(value: float) -> str:
    """Return a whole number in groups of three with narrow spaces; a dash for NaN."""
    return f"{round(value):,}".replace(",", "\u202f").replace("-", "−") if math.isfinite(value) else DASH


def percent(fraction: float) -> str:
    """Return a fraction in per cent that is not rounded to 0 or 100 unless it is exact."""
    if not math.isfinite(fraction):
        return DASH
    if fraction in (0.0, 1.0):
        return f"{fraction:.0%}".replace("%", " %")
    return fixed(min(max(100 * fraction, 0.01), 99.99), 2) + " %"


def minutes(seconds: float) -> str:
    """Return a duration in minutes with one decimal, in seconds below two minutes."""
    if not math.isfinite(seconds):
        return DASH
    return f"{fixed(seconds, 1)} s" if abs(seconds) < 120 else f"{fixed(seconds / 60, 1)} min"


def listed(words: list[str]) -> str:
    """Return words as an enumeration: ``a, b and c``, in the language of the page."""
    return (
        words[0] if len(words) == 1 else f"{', '.join(words[:-1])} {_AND[_LANGUAGE.get()]} {words[-1]}" if words else ""
    )


def finite(reduce: Callable[[np.ndarray], np.floating], values: np.ndarray) -> float:
    """Return a reduction over the finite values; NaN if there are none."""
    kept = values[np.isfinite(values)]
    return float(reduce(kept)) if kept.size else math.nan
