"""Detection of codes whose effect the interpreter does not print.

Every other code than those with plain code raises an error with its line, whether it is executed or not.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

from errormotion.instruments.nc_words import COMMENT, codes_of, refusal, words_of

_G = {
    *(0, 1, 2, 3, 4, 10, 17, 18, 19, 20, 21, 28, 30, 40, 41, 42, 43, 49, 53, 54, 55, 56, 57, 58, 59, 61, 64, 73, 80),
    *(81, 82, 83, 84, 85, 86, 87, 88, 89, 90, 91, 92, 93, 94, 95, 97, 98, 99, 38.2, 38.3, 38.4, 38.5, 41.1, 42.1),
    *(43.1, 59.1, 59.2, 59.3, 61.1, 90.1, 91.1, 92.1, 92.2, 92.3),
}
_M = {*range(10), 19, 30, *range(48, 54), *range(60, 66), 67, 68, 98, 99}
_LOST = re.compile(r"\(\s*(PRINT|LOG\w*)\s*,?", re.IGNORECASE)
_CONTROL = re.compile(r"^\s*/?\s*(N\s*\d+)?\s*O", re.IGNORECASE)


def screen(source: Iterable[str]) -> None:
    """Raise an error for a program whose expansion would differ in its effect.

    Raises
    ------
    ProgramError
        The message contains the number of the line.
    """
    for line, text in enumerate(source, 1):
        for comment in COMMENT.finditer(text):
            if _LOST.match(comment[0]):
                raise refusal(
                    line,
                    text,
                    "prints or logs values, which are unknown before the program runs",
                    code="program.prints_unknown",
                )
        if not _CONTROL.match(COMMENT.sub(" ", text)):
            _check_codes(line, text)


def _check_codes(line: int, text: str) -> None:
    for code in codes_of(text):
        letter, number = code[0], code[1:]
        if not number:
            raise refusal(line, text, f"a computed code ({letter})", code="program.code.computed")
        if float(number) not in (_G if letter == "G" else _M):
            raise refusal(line, text, f"{code} cannot be expanded", code="program.code.not_supported")
        if code == "G10" and not {float(number) for letter, number in words_of(text) if letter == "L" and number} & {
            2,
            20,
        }:
            raise refusal(line, text, "expected G10 L2 or L20", code="program.g10.form")
