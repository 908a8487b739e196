"""Printing by a control: the grammar of ``DPRNT[...]`` and the characters that controls of two manufacturers send.

Sources: Haas 96-8000 rev. AC, May 2010, p. 116 (text, formats, rounding, leading spaces, growing fields); NCT 2000M/99M
Programmer's Manual, p. 193 (digits before and after the point, ISO code with even parity, line feed). The format of
FANUC is from memory; the page of the touch probe that reads these lines lists the assumptions.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from errormotion.errors import InstrumentError

MAX_DIGITS = 8  # largest number of digits, before and after the point together

Control = Literal["haas", "fanuc"]
Zeros = Literal["blank", "none"]

_NUMBER = re.compile(r"#(\d+)\s*\[\s*(\d)(\d)\s*\]")
_TEXT = re.compile(r"[A-Z0-9+\-/* ]*")


@dataclass(frozen=True)
class Number:
    """A variable of a block: its value, and its digits before and after the point."""

    value: float
    whole: int
    decimals: int


@dataclass(frozen=True)
class Block:
    """One ``DPRNT[...]``: texts and numbers in their order."""

    parts: tuple[str | Number, ...]

    def text(self, control: Control = "haas", zeros: Zeros = "blank") -> str:
        """Return the characters that a control sends, without the end of the block.

        ``zeros`` is for FANUC: leading zeros as blanks, with a blank for the sign, or omitted.
        """
        return "".join(
            part.replace("*", " ") if isinstance(part, str) else _written(part, control, zeros) for part in self.parts
        )


PortCommand = Block | Literal["POPEN", "PCLOS"]


def parse_block(template: str, value_of: Callable[[str], float]) -> Block:
    """Return the block between the brackets of ``DPRNT[...]``.

    Parameters
    ----------
    template : str
        Such as ``X#5061[53]*Y#5062[53]``.
    value_of : callable
        Returns the value of a variable, given its number; may raise an InstrumentError.

    Raises
    ------
    InstrumentError
        A character that a control cannot print, a variable without a format, or a format with no or too many digits.
    """
    parts: list[str | Number] = []
    k = 0
    while k < len(template):
        if number := _NUMBER.match(template, k):
            parts.append(_number(number, value_of))
            k = number.end()
        elif (found := _TEXT.match(template, k)) and (text := found[0]):
            parts.append(text)
            k += len(text)
        elif template[k] == "#":
            raise InstrumentError(
                f"'{template[k:][:12]}': expected a variable with its format, such as #5061[53]",
                code="machine.print.form",
            )
        else:
            raise InstrumentError(
                f"'{template[k]}' cannot be printed; expected letters, digits, + - / and *", code="machine.print.form"
            )
    return Block(tuple(parts))


def _number(match: re.Match[str], value_of: Callable[[str], float]) -> Number:
    whole, decimals = int(match[2]), int(match[3])
    if not 0 < whole + decimals <= MAX_DIGITS:
        raise InstrumentError(
            f"'{match[0]}': expected 1 to {MAX_DIGITS} digits in all; found {whole + decimals}",
            code="machine.print.digits",
        )
    return Number(value_of(match[1]), whole, decimals)


def _written(number: Number, control: Control, zeros: Zeros) -> str:
    magnitude = f"{abs(number.value):.{number.decimals}f}"
    if not number.decimals:
        magnitude = str(math.trunc(abs(number.value)))  # the printed example: 1.5436 with [40] is 1
    negative = number.value < 0 and float(magnitude) != 0
    if control == "haas":
        width = number.whole + (number.decimals + 1 if number.decimals else 0)
        return ("-" * negative + magnitude).rjust(width)
    digits, point, fraction = magnitude.partition(".")
    digits = (digits[-number.whole :] if number.whole else digits[-1]).lstrip("0") or "0"
    if zeros == "none":
        return "-" * negative + digits + point + fraction
    return ("-" if negative else " ") + digits.rjust(number.whole) + point + fraction


def in_iso_code(text: bytes) -> bytes:
    """Return characters in ISO code: seven bits, and an eighth for even parity."""
    return bytes(code | (code.bit_count() & 1) << 7 for code in text)
