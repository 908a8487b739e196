"""The words of a block of RS-274 (ISO 6983) code, and their texts, which are kept as they are until one changes.

A line is split into text that stands between words, letters, numbers and comments. Joined, the parts give the line.
Expressions, variables and control words (``O``) are no words: the line is refused with its number.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from errormotion.errors import ProgramError

LONGEST_LINE = 1024
"""Longest line that is read, characters."""

MOST_LINES = 5_000_000
"""Most lines of one program."""

_PARTS = re.compile(r"(?:([A-Za-z])[ \t]*([-+]?(?:\d{1,15}\.?\d{0,15}|\.\d{1,15})))|(\([^()]*\)|;.*)")
_CONTROL = re.compile(r"[\x00-\x08\x0a-\x1f\x7f]")
_OTHER = re.compile(r"#|\[|<")
STRIDE = 4
"""Parts of a line come in fours: text between, letter, number, comment."""


@dataclass(slots=True)
class Block:
    """One line of a program.

    Attributes
    ----------
    line : int
        Its number in the file, from 1.
    text : str
        Without its end.
    parts : list of str or None
        Text between, letter, number, comment, and again; ends with text.
    words : list of (str, str, int)
        Letter (upper case), number as it was written, and the index of the number in ``parts``.
    skippable : bool
        Whether it starts with ``/`` (block delete).
    """

    line: int
    text: str
    parts: list[str | None]
    words: list[tuple[str, str, int]]
    skippable: bool = False


def split(line: int, text: str) -> Block:
    """Return the block of a line.

    Raises
    ------
    ProgramError
        The line has something else than words, comments and spaces.
    """
    parts: list[str | None] = _PARTS.split(text)
    between = "".join([part for part in parts[::STRIDE] if part]).strip()
    skippable = False
    if between:
        skippable = between == "/" and (parts[0] or "").strip() == "/"
        if not skippable:
            raise unknown(line, text, between)
    words: list[tuple[str, str, int]] = []
    for k in range(1, len(parts), STRIDE):
        letter = parts[k]
        if letter is not None:
            words.append((letter.upper(), parts[k + 1] or "", k + 1))
    return Block(line, text, parts, words, skippable)


def unknown(line: int, text: str, what: str) -> ProgramError:
    """Return the refusal of a line that is not understood."""
    if _OTHER.search(what) or text.lstrip().lower().startswith("o"):
        return refusal(line, text, "an expression, a variable or a control word (O), which the plain reader has not")
    return refusal(line, text, f"expected words (letter and number) and comments; found '{what[:20]}'")


def refusal(line: int, text: str, why: str) -> ProgramError:
    """Return the error of a line that is refused."""
    return ProgramError(f"line {line} '{text.strip()[:60]}': {why}")


def lines_of(source: Iterable[str]) -> Iterator[tuple[int, str]]:
    """Yield number and text of each line of a program.

    Raises
    ------
    ProgramError
        Too many lines, a line that is too long, or one with control characters.
    """
    for number, line in enumerate(source, 1):
        if number > MOST_LINES:
            raise ProgramError(f"expected a program of at most {MOST_LINES} lines")
        text = line.rstrip("\r\n")
        if len(text) > LONGEST_LINE:
            raise ProgramError(f"line {number}: expected at most {LONGEST_LINE} characters; found {len(text)}")
        if not text.isprintable() and _CONTROL.search(text):
            raise ProgramError(f"line {number}: has control characters; expected text")
        yield number, text
