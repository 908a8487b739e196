"""Command lines of an optoNCDT: words, and the forms of parameters as the manual writes them.

A form is a sequence of parameters. ``A|B`` is one of these words, ``<1..9>`` a whole number, ``<number>`` any number,
``<text>`` any word, ``[A|B]`` an optional parameter, ``{A B C}`` one or more of these words in any order.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

MAX_LINE = 255
"""Characters of a command line; assumption."""

_WORD = re.compile(r'"([^"]*)"|(\S+)')
_PARAMETER = re.compile(r"\{[^}]*\}|\S+")
_NUMBER = re.compile(r"[+-]?\d{1,12}(\.\d{1,12})?")


class RefusalError(Exception):
    """A command that the sensor refuses; ``reason`` is a key of the model's errors."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


def split(line: str) -> list[str]:
    """Return the words of a command line; text in quotation marks is one word."""
    return [quoted or plain for quoted, plain in _WORD.findall(line)]


@dataclass(frozen=True)
class Command:
    """One command.

    Attributes
    ----------
    forms : sequence of str
        Forms of its parameters; empty: it takes none.
    default : str or None
        Setting as delivered; None: it is not a setting.
    writes : bool
        Whether only the level PROFESSIONAL may set it.
    """

    forms: Sequence[str] = ()
    default: str | None = None
    writes: bool = True

    def check(self, words: Sequence[str]) -> None:
        """Raise ``RefusalError`` if the parameters match no form.

        The reason is that of the form which matches the most words: ``count``, ``parameter`` or ``range``.
        """
        misfits = [_misfit(form, words) for form in self.forms] or [(0, "count")]
        found = [misfit for misfit in misfits if misfit is not None]
        if len(found) == len(misfits):
            raise RefusalError(max(found, key=lambda misfit: (misfit[0], _ORDER.index(misfit[1])))[1])


_ORDER = ("count", "parameter", "range")


def _misfit(form: str, words: Sequence[str]) -> tuple[int, str] | None:
    """Return the number of words that match a form and the reason of the mismatch; None if all match."""
    parameters = _PARAMETER.findall(form)
    if parameters and parameters[0].startswith("{"):
        return _misfit_of_set(parameters[0][1:-1].split(), words)
    for number, (parameter, word) in enumerate(zip(parameters, words, strict=False)):
        if reason := _misfit_of_parameter(parameter.strip("[]"), word):
            return number, reason
    least = sum(not parameter.startswith("[") for parameter in parameters)
    return None if least <= len(words) <= len(parameters) else (min(len(words), len(parameters)), "count")


def _misfit_of_set(flags: Sequence[str], words: Sequence[str]) -> tuple[int, str] | None:
    for number, word in enumerate(words):
        if word not in flags or word in words[:number]:
            return number, "parameter"
    return None if words else (0, "count")


def _misfit_of_parameter(parameter: str, word: str) -> str | None:
    if parameter == "<text>":
        return None
    reason = "parameter"
    for each in parameter.split("|"):
        if each == word:
            return None
        if each.startswith("<") and _NUMBER.fullmatch(word):
            if each == "<number>":
                return None
            least, most = (int(part) for part in each[1:-1].split(".."))
            if "." not in word and least <= int(word) <= most:
                return None
            reason = "range"
    if reason == "parameter" and parameter[0].isdigit() and _NUMBER.fullmatch(word):
        return "range"
    return reason
