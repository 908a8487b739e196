"""Correction of a program file."""

from __future__ import annotations

import os
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

from errormotion.compensation.program.interpreter import agreement, canonical
from errormotion.compensation.program.interpreter.expanding import Expansion
from errormotion.compensation.program.interpreter.screening import screen
from errormotion.compensation.program.reading.frames import Triple
from errormotion.compensation.program.reading.offsets import Offsets
from errormotion.compensation.program.reading.reader import Reader
from errormotion.compensation.program.reading.words import MAX_LINE, lines_of
from errormotion.compensation.program.writing.dividing import Correcting
from errormotion.compensation.program.writing.rewriting import Rewriting, Summary
from errormotion.datasets.files.reading import require_regular
from errormotion.errors import ProgramError

MAX_PROGRAM = 1 << 29
"""Maximum size of a program file, bytes."""

ROUTES = ("auto", "plain", "interpreter")
"""Reader of the program: the plain reader and, for unsupported programs, LinuxCNC's interpreter, or only one."""

_COMMENT = 70  # characters


@dataclass(frozen=True)
class Settings:
    """Settings of the reading and correction of a program.

    Attributes
    ----------
    tolerance, step : float
        Largest distance from the corrected path, and between two points at which it is examined, m.
    unit : str
        ``mm`` or ``inch``, of the program before its first G20 or G21.
    start : (x, y, z), optional
        Position of the machine axes before the program starts, m.
    deleted : bool, optional
        Whether blocks that start with ``/`` are skipped; None: they raise an error.
    route : str
        One of `ROUTES`.
    check : bool
        Whether the new program is compared with the moves of LinuxCNC's interpreter.
    """

    tolerance: float = 1e-6
    step: float = 2e-3
    unit: str = "mm"
    start: Triple | None = None
    deleted: bool | None = None
    route: str = "auto"
    check: bool = False


@dataclass(frozen=True)
class Outcome:
    """Result of the correction of a program.

    Attributes
    ----------
    summary : Summary
    route : str
        ``plain`` or ``interpreter``.
    why : str
        Why the plain reader was not used; empty if it was.
    checked : int
        Moves of the new program that agree with LinuxCNC's interpreter; 0 without the check.
    digest : str
        SHA-256 of the program that was read.
    """

    summary: Summary
    route: str
    why: str
    checked: int
    digest: str


def compensate(
    program: Path,
    out: Path,
    correcting: Correcting,
    offsets: Offsets,
    settings: Settings | None = None,
    *,
    head: Sequence[str] = (),
) -> Outcome:
    """Write the corrected program of a program.

    Parameters
    ----------
    program, out : Path
        Original and corrected program; ``out`` appears when it is complete.
    correcting : callable
    offsets : Offsets
        Offsets of the control before the program starts.
    settings : Settings, optional
    head : sequence of str
        Comments at the start of the new program.

    Raises
    ------
    ProgramError
        A line is not supported by any of the readers, or its effect is not determined. Then no file is written.
    """
    chosen = settings or Settings()
    if chosen.route not in ROUTES:
        raise ProgramError(f"reader '{chosen.route}': expected one of {', '.join(ROUTES)}")
    if require_regular(program).st_size > MAX_PROGRAM:
        raise ProgramError(f"{program}: expected a file of at most {MAX_PROGRAM} bytes")
    why = ""
    beside = out.with_name(out.name + ".part")
    try:
        if chosen.route != "interpreter":
            try:
                return _written(program, None, beside, out, correcting, offsets, chosen, head, why)
            except ProgramError as error:
                if chosen.route == "plain" or canonical.interpreter() is None:
                    raise
                why = str(error)
        try:
            expanded = _expanded(program, offsets, chosen)
            return _written(program, expanded, beside, out, correcting, offsets, chosen, head, why)
        except ProgramError as error:
            raise ProgramError(f"{error}" + (f"\nThe plain reader: {why}" if why else "")) from error
    finally:
        beside.unlink(missing_ok=True)


def _expanded(program: Path, offsets: Offsets, settings: Settings) -> Generator[str]:
    if settings.unit != "mm":
        raise ProgramError("LinuxCNC's interpreter starts in mm: state the unit in the program (G20)")
    source = [text for _, text in lines_of(_lines(program))]
    screen(source)
    with closing(canonical.commands(source, offsets, deleted=settings.deleted)) as commands:
        yield from Expansion(source, offsets, settings.tolerance).lines(commands)


def _written(
    program: Path,
    expanded: Generator[str] | None,
    beside: Path,
    out: Path,
    correcting: Correcting,
    offsets: Offsets,
    settings: Settings,
    head: Sequence[str],
    why: str,
) -> Outcome:
    unit = settings.unit if expanded is None else "mm"
    reader = Reader(offsets, unit=unit, start=settings.start, deleted=settings.deleted)
    rewriting = Rewriting(reader, correcting, tolerance=settings.tolerance, step=settings.step)
    source = _lines(program) if expanded is None else expanded
    end = _line_end(program)
    with closing(source), beside.open("w", encoding="latin-1", newline="") as file:
        for text in _with_head(rewriting.lines(source), head):
            file.write(text + end)
    checked = 0
    if settings.check:
        with beside.open(encoding="latin-1", newline="") as file:
            new = [text for _, text in lines_of(file)]
        checked = agreement.check(
            new, offsets, Reader(offsets, unit=unit, start=settings.start, deleted=settings.deleted)
        )
    os.replace(beside, out)
    return Outcome(rewriting.summary, "plain" if expanded is None else "interpreter", why, checked, _digest(program))


def _with_head(lines: Iterable[str], head: Sequence[str]) -> Iterator[str]:
    """Yield lines with comments before the first, or after it if it is ``%``."""
    comments = [f"({_plain(sentence)})" for sentence in head]
    for number, text in enumerate(lines):
        if number == 0 and text.strip() != "%":
            yield from comments
        yield text
        if number == 0 and text.strip() == "%":
            yield from comments


def _plain(sentence: str) -> str:
    """Return a sentence as the text of a comment in a program."""
    text = sentence.encode("ascii", "replace").decode("ascii").replace("(", "[").replace(")", "]").replace("\n", " ")
    return text if len(text) <= _COMMENT else text[: _COMMENT - 3] + "..."


def _lines(path: Path) -> Generator[str]:
    """Yield the lines of a file, read up to a length that `lines_of` rejects."""
    with path.open(encoding="latin-1", newline="") as file:
        while line := file.readline(MAX_LINE + 3):
            yield line


def _line_end(path: Path) -> str:
    with path.open("rb") as file:
        return "\r\n" if b"\r\n" in file.read(4096) else "\n"


def _digest(path: Path) -> str:
    found = sha256()
    with path.open("rb") as file:
        while part := file.read(1 << 20):
            found.update(part)
    return found.hexdigest()
