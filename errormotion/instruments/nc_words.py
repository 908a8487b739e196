"""The words of lines of NC programs (ISO 6983, RS-274), for every reader of programs.

`split` returns the words of a line with their original texts; expressions, variables and control words (``O``) are no
words and raise an error with the number of the line. `words_of` returns the words of a line that may have them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from errormotion.errors import ProgramError

MAX_BLOCK = 250
"""Maximum length of a line that LinuxCNC reads, characters."""

MAX_LINE = 1024
"""Maximum length of a line, characters."""

MAX_LINES = 5_000_000
"""Maximum number of lines of one program."""

COMMENT = re.compile(r"\([^()]*\)|;.*")

STRIDE = 4
"""Number of parts that repeat along a line: text between, letter, number, comment."""

_NUMBER = r"[-+]?(?:\d{1,15}\.?\d{0,15}|\.\d{1,15})"
_PARTS = re.compile(rf"(?:([A-Za-z])[ \t]*({_NUMBER}))|({COMMENT.pattern})", re.ASCII)
_CONTROL = re.compile(r"[\x00-\x08\x0a-\x1f\x7f]")
_OTHER = re.compile(r"#|\[|<")
_PRINTING = re.compile(r"(?:N\d{1,9}\s*)?(POPEN|PCLOS|DPRNT\s*\[((?:[^][]|\[[^][]*\])*)\])", re.ASCII)
_NAME = re.compile(r"<[^<>]*>")
_INSIDE = re.compile(r"\[[^\[\]]*\]")
_VALUE = re.compile(r"[-+]*#+\d*", re.ASCII)
_FUNCTION = re.compile(r"(?:ABS|ACOS|ASIN|ATAN|COS|EXISTS|EXP|FIX|FUP|LN|ROUND|SIN|SQRT|TAN)#(?:/#)?")
_WORD = re.compile(r"([A-Z])([-+]?(?:\d+\.?\d*|\.\d+))?", re.ASCII)
_TITLE = re.compile(r"\s*(?:[nN]\s*\d+\s*)?[oO]\s*\d+\s*(?:\([^()]*\)\s*|;.*)*")


class BlockError(ProgramError):
    """Error of one line of a program.

    Attributes
    ----------
    line : int
    why : str
    """

    def __init__(self, line: int, text: str, why: str, *, code: str) -> None:
        super().__init__(f"line {line} '{text.strip()[:60]}': {why}", code=code)
        self.line, self.why = line, why


class SourceLine(str):
    """A line that an expansion makes of a line of a program.

    Attributes
    ----------
    number : int
        Of the line of the program.
    """

    number: int

    def __new__(cls, text: str, number: int) -> SourceLine:
        """Return a text with the number of its line."""
        made = super().__new__(cls, text)
        made.number = number
        return made


@dataclass(slots=True)
class Block:
    """One line of a program.

    Attributes
    ----------
    line : int
        Number of the line in the file, from 1.
    text : str
        Text without line end.
    parts : list of str or None
        Text between, letter, number, comment, repeated; ends with text.
    words : list of (str, str, int)
        Letter (upper case), number as written, and the index of the number in ``parts``.
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
        The line has other content than words, comments and spaces.
    """
    parts: list[str | None] = _PARTS.split(text)
    between = "".join([part for part in parts[::STRIDE] if part]).strip()
    skippable = False
    if between:
        skippable = between == "/" and (parts[0] or "").strip() == "/"
        if not skippable:
            raise _unknown(line, text, [part.strip() for part in parts[::STRIDE] if part and part.strip()])
    words: list[tuple[str, str, int]] = []
    for k in range(1, len(parts), STRIDE):
        letter = parts[k]
        if letter is not None:
            words.append((letter.upper(), parts[k + 1] or "", k + 1))
    return Block(line, text, parts, words, skippable)


def _unknown(line: int, text: str, pieces: list[str]) -> BlockError:
    """Return the error of a line with other pieces of text than words and comments."""
    if any(_OTHER.search(piece) for piece in pieces) or text.lstrip().lower().startswith("o"):
        return refusal(
            line,
            text,
            "an expression, a variable or a control word (O), not supported by the plain reader",
            code="program.line.not_plain",
        )
    return refusal(
        line,
        text,
        f"expected words (letter and number) and comments; found '{pieces[0][:20]}'",
        code="program.line.form",
    )


def code_of(text: str) -> str:
    """Return a line as a control reads it: in upper case, without comments and spaces."""
    return re.sub(r"\s", "", COMMENT.sub("", text)).upper()


def words_of(text: str) -> list[tuple[str, str]]:
    """Return letter and number of each word of a line with expressions; the number is empty if it is computed."""
    rest = _NAME.sub("", code_of(text))
    while (shorter := _INSIDE.sub("#", rest)) != rest:
        rest = shorter
    return _WORD.findall(_VALUE.sub("#", _FUNCTION.sub("#", _VALUE.sub("#", rest))))


def codes_of(text: str) -> list[str]:
    """Return the codes G and M of a line with expressions, such as ``G43.1`` and ``M3``; ``G`` if it is computed."""
    return [letter + (f"{float(number):g}" if number else "") for letter, number in words_of(text) if letter in "GM"]


def printing(text: str) -> tuple[str, str] | None:
    """Return command and template of a line that prints: ``POPEN``, ``PCLOS`` or ``DPRNT``; None for other lines."""
    match = _PRINTING.fullmatch(COMMENT.sub(" ", text).strip().upper())
    return (match[1][:5], match[2] or "") if match is not None else None


def is_title(text: str) -> bool:
    """Return whether a line is a program number, such as ``O0001``."""
    return _TITLE.fullmatch(text) is not None


def refusal(line: int, text: str, why: str, *, code: str) -> BlockError:
    """Return the error of a line."""
    return BlockError(line, text, why, code=code)


def lines_of(source: Iterable[str]) -> Iterator[tuple[int, str]]:
    """Yield number and text of each line of a program; a `SourceLine` has the number of its source.

    Raises
    ------
    ProgramError
        Too many lines, a line that is too long, or control characters in a line.
    """
    for count, line in enumerate(source, 1):
        if count > MAX_LINES:
            raise ProgramError(f"expected a program of at most {MAX_LINES} lines", code="program.too_long")
        number = line.number if isinstance(line, SourceLine) else count
        text = line.rstrip("\r\n")
        if len(text) > MAX_LINE:
            raise ProgramError(
                f"line {number}: expected at most {MAX_LINE} characters; found {len(text)}",
                code="program.line.too_long",
            )
        if not text.isprintable() and _CONTROL.search(text):
            raise ProgramError(
                f"line {number}: expected text; found control characters", code="program.line.control_characters"
            )
        yield number, text
