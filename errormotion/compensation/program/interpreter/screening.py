"""Detection of codes whose effect the interpreter does not print.

Every other code than those with plain code raises an error with its line, whether it is executed or not.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

from errormotion.compensation.program.reading.words import refusal

_G = {
    *(0, 1, 2, 3, 4, 10, 17, 18, 19, 20, 21, 28, 30, 40, 41, 42, 43, 49, 53, 54, 55, 56, 57, 58, 59, 61, 64, 73, 80),
    *(81, 82, 83, 84, 85, 86, 87, 88, 89, 90, 91, 92, 93, 94, 95, 97, 98, 99, 38.2, 38.3, 38.4, 38.5, 41.1, 42.1),
    *(43.1, 59.1, 59.2, 59.3, 61.1, 90.1, 91.1, 92.1, 92.2, 92.3),
}
_M = {*range(10), 19, 30, *range(48, 54), *range(60, 66), 67, 68, 98, 99}
_COMMENT = re.compile(r"\(([^()]*)\)|;.*")
_LOST = re.compile(r"\s*(PRINT|LOG\w*)\s*,?", re.IGNORECASE)
_INSIDE = re.compile(r"\[[^\[\]]*\]")
_NAME = re.compile(r"#\s*<[^<>]*>")
_CODE = re.compile(r"([GM])\s*(\d*\.?\d*)")
_CONTROL = re.compile(r"^\s*/?\s*(N\s*\d+)?\s*O", re.IGNORECASE)


def screen(source: Iterable[str]) -> None:
    """Raise an error for a program whose expansion would differ in its effect.

    Raises
    ------
    ProgramError
        The message contains the number of the line.
    """
    for line, text in enumerate(source, 1):
        for comment in _COMMENT.finditer(text):
            if comment[1] and _LOST.match(comment[1]):
                raise refusal(line, text, "prints or logs values, which are unknown before the program runs")
        plain = _COMMENT.sub(" ", text)
        if not _CONTROL.match(plain):
            _codes(line, text, plain)


def _codes(line: int, text: str, plain: str) -> None:
    found = _NAME.sub("#1", plain.upper())
    while (shorter := _INSIDE.sub(" ", found)) != found:
        found = shorter
    for letter, number in _CODE.findall(found):
        if not number.strip("."):
            raise refusal(line, text, f"a computed code ({letter})")
        value = float(number)
        if value not in (_G if letter == "G" else _M):
            raise refusal(line, text, f"{letter}{value:g} cannot be expanded")
        if value == 10 and letter == "G" and not re.search(r"L\s*0*(2|20)(?![\d.])", found):
            raise refusal(line, text, "expected G10 L2 or L20")
