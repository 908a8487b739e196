"""Tool tables of LinuxCNC (.tbl), as LinuxCNC reads them."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from errormotion.arrays import Array
from errormotion.compensation.program.reading.files import UNITS, text_of
from errormotion.errors import ProgramError

MAX_ENTRY = 256
"""Length of a line that LinuxCNC reads as two, characters."""

_LETTERS = set("TPDXYZABCUVWIJQ")
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_START = re.compile(_NUMBER)
_WHOLE = re.compile(r"[-+]?\d+")
_OTHER = re.compile(r"[-+]?0[xX]|[-+]?(?:\d+\.?\d*|\.\d+)[eE](?![-+]?\d)")  # hexadecimal numbers, incomplete exponents
_WORD = re.compile(rf"[DXYZABCUVWIJ]{_NUMBER}|[TPQ][-+]?\d+")
_SHOWN = 40  # characters of a line in a message


@dataclass(frozen=True)
class Cutter:
    """What a tool table states besides the offset in X, Y and Z.

    Attributes
    ----------
    diameter : float
        m; 0 where the line has no D, as for LinuxCNC.
    front, back : float
        Angles of a lathe tool, degrees.
    orientation : int
        Of a lathe tool.
    others : tuple of float
        Offsets in A, B, C, degrees, and in U, V, W, m.
    """

    diameter: float = 0.0
    front: float = 0.0
    back: float = 0.0
    orientation: int = 0
    others: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Table:
    """A tool table.

    Attributes
    ----------
    offsets : dict of int to array (3,)
        Offset of each tool in X, Y, Z, m.
    cutters : dict of int to Cutter
    text : str
        The file.
    notes : tuple of str
        Lines that LinuxCNC reads otherwise than they look.
    """

    offsets: dict[int, Array]
    cutters: dict[int, Cutter]
    text: str
    notes: tuple[str, ...]


def read_tools(path: Path, unit: str = "mm") -> dict[int, Array]:
    """Return the offsets of the tools of a LinuxCNC tool table, m.

    Raises
    ------
    ProgramError
        Not such a file.
    """
    return read_table(path, unit).offsets


def read_table(path: Path, unit: str = "mm") -> Table:
    """Return the tools of a LinuxCNC tool table.

    The words of a line are separated by spaces; LinuxCNC reads the number at the start of a word and ignores the rest
    of the word. A line without P replaces the line without P before it. Of several lines of one tool, the first
    applies, and one without P before all others.

    Parameters
    ----------
    path : Path
    unit : str
        ``mm`` or ``inch``: the unit of the machine and of the file.

    Raises
    ------
    ProgramError
        Not such a file, or a line that LinuxCNC does not read as a tool.
    """
    text = text_of(path)
    scale = UNITS[unit]
    rows: list[tuple[int, int, Array, Cutter]] = []
    loose: tuple[int, int, Array, Cutter] | None = None
    notes: list[str] = []
    for number, line in enumerate(re.findall(r"[^\n]*\n|[^\n]+", text), 1):
        plain = line.partition(";")[0]
        words = {token[0].upper(): token[1:] for token in plain.rstrip("\n").split(" ") if token}
        if not plain.strip():
            if len(plain) > 1 and not words:
                loose = None  # LinuxCNC stores an empty tool in its place
            continue
        values = {letter: _number(path, number, line, letter, text) for letter, text in words.items()}
        if "T" not in values or len(line) >= MAX_ENTRY:
            raise _unread(path, number, line)
        if any(not math.isfinite(value) for value in values.values()):
            raise ProgramError(
                f"{path}, line {number}: expected finite numbers; found '{line.strip()[:_SHOWN]}'",
                code="program.tools.form",
            )
        for letter, rest in words.items():
            if not _WORD.fullmatch(letter + rest.strip()):
                notes.append(
                    f"{path.name}, line {number}: LinuxCNC reads '{(letter + rest).strip()[:_SHOWN]}' as "
                    f"{letter}{values[letter]:g}, because only spaces separate words"
                )
        offset = scale * np.array([values.get(axis, 0.0) for axis in "XYZ"])
        a, b, c = (values.get(axis, 0.0) for axis in "ABC")
        u, v, w = (scale * values.get(axis, 0.0) for axis in "UVW")
        cutter = Cutter(
            scale * values.get("D", 0.0),
            values.get("I", 0.0),
            values.get("J", 0.0),
            int(values.get("Q", 0.0)),
            (a, b, c, u, v, w),
        )
        row = (number, int(values["T"]), offset, cutter)
        if "P" in values:
            rows.append(row)
        else:
            replaced = f", and replaces line {loose[0]}" if loose is not None else ""
            notes.append(
                f"{path.name}, line {number}: LinuxCNC reads no pocket (P){replaced}; it loses this tool when another "
                "one is changed"
            )
            loose = row
    offsets: dict[int, Array] = {}
    cutters: dict[int, Cutter] = {}
    first: dict[int, int] = {}
    for number, tool, offset, cutter in [*rows, *([loose] if loose is not None else [])]:
        if tool in offsets:
            notes.append(
                f"{path.name}, line {number}: not used, because line {first[tool]} states tool {tool}, as in LinuxCNC"
            )
            continue
        offsets[tool], cutters[tool], first[tool] = offset, cutter, number
    return Table(offsets, cutters, text, tuple(notes))


def _number(path: Path, number: int, line: str, letter: str, text: str) -> float:
    """Return the number at the start of the text behind a letter, as LinuxCNC reads it."""
    plain = text.lstrip()
    found = (_WHOLE if letter in "TPQ" else _START).match(plain)
    if letter not in _LETTERS or found is None or _OTHER.match(plain):
        raise _unread(path, number, line)
    return float(found[0])


def _unread(path: Path, number: int, line: str) -> ProgramError:
    return ProgramError(
        f"{path}, line {number}: expected a tool, such as 'T1 P1 Z80.25', with spaces between the words; found "
        f"'{line.strip()[:_SHOWN]}'",
        code="program.tools.form",
    )
