"""Correction of a program file."""

from __future__ import annotations

import codecs
import itertools
import re
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

from errormotion.compensation.program.interpreter import agreement, canonical, paths
from errormotion.compensation.program.interpreter.expanding import Expansion
from errormotion.compensation.program.interpreter.screening import screen
from errormotion.compensation.program.reading.frames import Triple
from errormotion.compensation.program.reading.offsets import Offsets
from errormotion.compensation.program.reading.reader import Reader
from errormotion.compensation.program.writing.dividing import Correcting
from errormotion.compensation.program.writing.rewriting import Rewriting, Summary
from errormotion.datasets.files.reading import require_regular
from errormotion.datasets.files.writing import replacing
from errormotion.errors import ProgramError
from errormotion.instruments.nc_words import MAX_LINE, BlockError, is_title, lines_of, refusal

MAX_PROGRAM = 1 << 29
"""Maximum size of a program file, bytes."""

ROUTES = ("auto", "plain", "interpreter")
"""Reader of the program: the plain reader and, for unsupported programs, LinuxCNC's interpreter, or only one."""

_COMMENT = 70  # characters
_UTF8 = codecs.BOM_UTF8.decode("latin-1")
_ASSIGNED = re.compile(r"#\s*(\d+)\s*=")
_SUBROUTINE = re.compile(r"\s*/?\s*(?:[nN]\s*\d+\s*)?[oO]")


@dataclass(frozen=True)
class ProgramSettings:
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
    notes : tuple of str
        Effects of the program that the new one does not have.
    """

    summary: Summary
    route: str
    why: str
    checked: int
    digest: str
    notes: tuple[str, ...] = ()


def compensate(
    program: Path,
    out: Path,
    correcting: Correcting,
    offsets: Offsets,
    settings: ProgramSettings | None = None,
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
    settings : ProgramSettings, optional
    head : sequence of str
        Comments at the start of the new program.

    Raises
    ------
    ProgramError
        A line is not supported by any of the readers, or its effect is not determined. Then no file is written.
    """
    chosen = settings or ProgramSettings()
    if chosen.route not in ROUTES:
        raise ProgramError(
            f"reader '{chosen.route}': expected one of {', '.join(ROUTES)}", code="program.reader.unknown"
        )
    if require_regular(program).st_size > MAX_PROGRAM:
        raise ProgramError(f"{program}: expected a file of at most {MAX_PROGRAM} bytes", code="program.too_long")
    why = ""
    with replacing(out) as beside:
        if chosen.route != "interpreter":
            try:
                return _written(program, None, beside, correcting, offsets, chosen, head, why)
            except ProgramError as error:
                if chosen.route == "plain" or canonical.interpreter() is None:
                    raise
                why = str(error)
        try:
            if chosen.unit != "mm":
                raise ProgramError(
                    "LinuxCNC's interpreter starts in mm: state the unit in the program (G20)",
                    code="program.unit.unknown",
                )
            source = [text for _, text in lines_of(_lines(program))]
            screen(source)
            return _written(program, source, beside, correcting, offsets, chosen, head, why)
        except ProgramError as error:
            raise ProgramError(f"{error}" + (f"\nThe plain reader: {why}" if why else ""), code=error.code) from error


def _expanded(source: list[str], expansion: Expansion, offsets: Offsets, settings: ProgramSettings) -> Generator[str]:
    with closing(canonical.commands(source, offsets, deleted=settings.deleted)) as commands:
        yield from expansion.lines(commands)


def _written(
    program: Path,
    source: list[str] | None,
    beside: Path,
    correcting: Correcting,
    offsets: Offsets,
    settings: ProgramSettings,
    head: Sequence[str],
    why: str,
) -> Outcome:
    """Write the corrected program of a file, or of lines that the interpreter expands."""
    unit = settings.unit if source is None else "mm"
    reader = Reader(offsets, unit=unit, start=settings.start, deleted=settings.deleted)
    rewriting = Rewriting(reader, correcting, tolerance=settings.tolerance, step=settings.step)
    expansion = None if source is None else Expansion(source, offsets, settings.tolerance)
    lines = _lines(program) if expansion is None else _expanded(source or [], expansion, offsets, settings)
    end = _line_end(program)
    try:
        with closing(lines), beside.open("w", encoding=_written_as(program), newline="") as file:
            for text in _with_head(rewriting.lines(lines), head):
                file.write(text + end)
    except BlockError as error:
        if source is None or not error.line:
            raise
        raise refusal(error.line, source[error.line - 1], error.why, code=error.code) from error
    if expansion is not None and source is not None:
        rewriting.summary.after_end = _after_end(source, expansion.end)
    checked = 0
    if settings.check:
        with beside.open(encoding="latin-1", newline="") as file:
            new = [text for _, text in lines_of(file)]
        try:
            checked = agreement.check(
                new, offsets, Reader(offsets, unit=unit, start=settings.start, deleted=settings.deleted)
            )
            original = [text for _, text in lines_of(_lines(program))]
            paths.compare(
                original,
                new,
                offsets,
                rewriting.summary.largest + settings.tolerance,
                deleted=settings.deleted,
            )
        except ProgramError as error:
            raise ProgramError(f"the check of the new program: {error}", code=error.code) from error
    route = "plain" if source is None else "interpreter"
    notes = _not_kept(source or [], offsets)
    return Outcome(rewriting.summary, route, why, checked, _digest(program), notes)


def _not_kept(source: list[str], offsets: Offsets) -> tuple[str, ...]:
    """Return a note on the parameters that an expanded program sets and the control keeps."""
    found = {int(number) for text in source for number in _ASSIGNED.findall(text)} & offsets.parameters.keys()
    if not found:
        return ()
    names = ", ".join(f"#{number}" for number in sorted(found)[:10])
    return (f"the new program does not set {names}, which the parameter file keeps for other programs",)


def _after_end(source: list[str], end: int) -> tuple[int, int]:
    """Return number and first of the lines that follow the end of an expanded program, except subroutines."""
    first = next((number for number, text in enumerate(source, 1) if text.strip()), 0)
    marks = [number for number, text in enumerate(source, 1) if text.strip() == "%" and number > first]
    ends = ([end] if end else []) + marks[:1]
    if not ends:
        return 0, 0
    after = enumerate(source[min(ends) :], min(ends) + 1)
    main = itertools.takewhile(lambda each: not _SUBROUTINE.match(each[1]), after)
    left = [number for number, text in main if text.strip() not in ("", "%")]
    return len(left), left[0] if left else 0


def _with_head(lines: Iterable[str], head: Sequence[str]) -> Iterator[str]:
    """Yield lines with comments before the first block, after ``%`` and the number of the program."""
    comments: list[str] = [f"({_plain(sentence)})" for sentence in head]
    for text in lines:
        if comments and text.strip() not in ("", "%") and not is_title(text):
            yield from comments
            comments = []
        yield text
    yield from comments


def _plain(sentence: str) -> str:
    """Return a sentence as the text of a comment in a program."""
    text = sentence.encode("ascii", "replace").decode("ascii").replace("(", "[").replace(")", "]").replace("\n", " ")
    return text if len(text) <= _COMMENT else text[: _COMMENT - 3] + "..."


def _lines(path: Path) -> Generator[str]:
    """Yield the lines of a file without a byte order mark, read up to a length that `lines_of` rejects."""
    try:
        with path.open(encoding=_encoding(path), newline="") as file:
            if _encoding(path) == "latin-1" and file.read(len(_UTF8)) != _UTF8:
                file.seek(0)
            while line := file.readline(MAX_LINE + 3):
                yield line
    except UnicodeDecodeError as error:
        raise ProgramError(
            f"{path}: expected text in UTF-16, as its byte order mark states: {error.reason}", code="program.encoding"
        ) from None


def _encoding(path: Path) -> str:
    """Return the encoding of a program: latin-1, whose characters are bytes, or UTF-16 with its mark."""
    with path.open("rb") as file:
        return "utf-16" if file.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE) else "latin-1"


def _written_as(path: Path) -> str:
    """Return the encoding of the new program, which LinuxCNC reads."""
    return "utf-8" if _encoding(path) == "utf-16" else "latin-1"


def _line_end(path: Path) -> str:
    with path.open(encoding=_encoding(path), errors="replace", newline="") as file:
        return "\r\n" if "\r\n" in file.read(4096) else "\n"


def _digest(path: Path) -> str:
    found = sha256()
    with path.open("rb") as file:
        while part := file.read(1 << 20):
            found.update(part)
    return found.hexdigest()
