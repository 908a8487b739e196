"""Strict reading of the columns of a text log; every mistake is reported with its line."""

from __future__ import annotations

import csv
from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import IO, AnyStr, TypeVar

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.datasets.files.reading import require_regular
from errormotion.datasets.files.tomlfile import nearest
from errormotion.datasets.text.dates import Clock, zone_of
from errormotion.datasets.text.log_format import Format
from errormotion.datasets.text.mistakes import Mistakes
from errormotion.errors import DatasetError

T = TypeVar("T")
Place = str | int | list[str | int]
"""Name or number of a column, or those of the columns of date and time of day."""

NOTES = "import_notes"
"""Attribute of an imported dataset with notes, JSON list of sentences."""

_MIN_INTERVALS = 4
"""Smallest number of intervals with which a usual one is determined."""
_SHARE_OF_USUAL = 0.7
"""Smallest fraction of usual intervals with which a longer one counts as a hole."""
MAX_LINE = 1 << 20
"""Largest number of characters of a line."""
_UTF16_MARKS = (b"\xff\xfe", b"\xfe\xff")


@dataclass(frozen=True)
class Columns:
    """Required columns of a log.

    Attributes
    ----------
    values : dict of str to ndarray, (n,)
        By the caller's key, in the units of the log; NaN for empty cells. Dates are in s since the first line.
    lines : ndarray, (n,)
        Line of each value.
    start : str
        Date and time of the first line, if the log has dates.
    notes : list of str
        Notes on the data: local times that occur twice.
    """

    values: dict[str, Array]
    lines: NDArray[np.int64]
    start: str = ""
    notes: list[str] = field(default_factory=list)


def read_columns(
    wanted: Mapping[str, Place], time: str, form: Format, mistakes: Mistakes, *, dates: str = ""
) -> Columns:
    """Read columns of the log ``mistakes.path``.

    Parameters
    ----------
    wanted : mapping of str to str, int or two of them
        Column of each key: its name in the header, or its number from 1; two for date and time of day.
    time : str
        Key of the time, whose cells must not be empty.
    form : Format
        Format of the text.
    mistakes : Mistakes
        Receives the mistakes in the cells.
    dates : str
        Unit of dates (`errormotion.datasets.text.dates`), if the times are dates.

    Raises
    ------
    DatasetError
        No file, wrong encoding, unbalanced quotes, missing columns, no lines.
    """
    (_, titles), remaining, places = columns_of(wanted, form, mistakes)
    width = len(titles)
    cells = {key: array("d") for key in wanted}
    lines = array("q")
    clock = clock_of(form, dates) if dates else None
    for line, row in remaining:
        if len(row) != width:
            mistakes.add(line, f"expected {width} fields; found {len(row)}")
            continue
        lines.append(line)
        for key, place in places.items():
            text = " ".join(row[each].strip() for each in place)
            where = f"{key}, field {place[0] + 1}"
            if key == time and clock is not None:
                value = seconds(text, clock, where, line, mistakes)
            elif key == time and not text:
                mistakes.add(line, f"{where}: expected a number; found an empty cell")
                value = np.nan
            else:
                value = _number(text, where, form, line, mistakes)
            cells[key].append(value)
    if not lines and not mistakes.count:
        raise DatasetError(
            f"{mistakes.path}: expected lines of numbers below the header; found none", code="log.no_numbers"
        )
    values = {key: np.array(column, dtype=float) for key, column in cells.items()}
    found = np.array(lines, dtype=np.int64)
    start = clock.start.isoformat() if clock and clock.start else ""
    return Columns(values, found, start, clock_notes(clock) if clock else [])


def clock_of(form: Format, unit: str, *, repeats: bool = False) -> Clock:
    """Return the clock of a log with dates."""
    return Clock(unit, zone_of(form.zone) if form.zone else None, repeats)


def clock_notes(clock: Clock) -> list[str]:
    """Return the note on local times that occur twice."""
    if not clock.resolved:
        return []
    return [f"{clock.resolved} times of the hour that occurs twice in {clock.zone} were resolved by their order"]


def holes(times: Array, lines: NDArray[np.int64]) -> list[str]:
    """Return a note on missing rows: intervals of more than 1.5 times the usual one, if most are usual.

    ``times`` are in s, with their ``lines``.
    """
    known = ~np.isnan(times)
    t, at = times[known], lines[known]
    steps = np.diff(t)
    at = at[1:][steps > 0]
    steps = steps[steps > 0]
    if steps.size < _MIN_INTERVALS:
        return []
    usual = float(np.median(steps))
    wide = np.flatnonzero(steps > 1.5 * usual)
    if not wide.size or np.mean(np.abs(steps - usual) < 0.2 * usual) < _SHARE_OF_USUAL:
        return []
    longest = wide[np.argmax(steps[wide])]
    number = "1 hole" if wide.size == 1 else f"{wide.size} holes"
    return [
        f"{number} in the rows, where the usual interval is {usual:.4g} s; the longest, of {steps[longest]:.6g} s, "
        f"ends in line {at[longest]}"
    ]


def columns_of(
    wanted: Mapping[str, Place], form: Format, mistakes: Mistakes
) -> tuple[tuple[int, list[str]], Iterator[tuple[int, list[str]]], dict[str, tuple[int, ...]]]:
    """Find columns of the log ``mistakes.path``.

    Returns
    -------
    (int, list of str)
        Line and fields of the header, or of the first line of a log without header.
    iterator of (int, list of str)
        Lines of numbers.
    dict of str to tuple of int
        Numbers of the fields of each required column, from 0: one, or two for date and time of day.

    Raises
    ------
    DatasetError
        No file, wrong encoding, unbalanced quotes, missing columns, no lines.
    """
    remaining = _rows(mistakes.path, form)
    head = next(remaining, None)
    if head is None:
        raise DatasetError(f"{mistakes.path}: expected lines of numbers; found none", code="log.no_numbers")
    places = _places(head[1], head[0], wanted, form, mistakes)
    mistakes.raise_any()
    return head, remaining if form.header else _chain(head, remaining), places


def top_lines(log: Path, form: Format) -> Iterator[str]:
    """Yield the lines of a log above its header: those that are skipped, and comments."""
    for number, line in _lines(log, form.encoding):
        text = line.strip(" \r\n")
        if number > form.skip and text and not (form.comment and text.startswith(form.comment)):
            return
        yield text


def _lines(log: Path, encoding: str) -> Iterator[tuple[int, str]]:
    """Yield the lines of a text with their numbers; DatasetError names the line that cannot be decoded."""
    number = 0
    try:
        require_regular(log)
        with log.open("rb") as binary:
            marked = binary.read(2) in _UTF16_MARKS
            if marked and not encoding.startswith(("utf-16", "utf-32")):
                raise DatasetError(
                    f"{log}, line 1: starts with the byte order mark of UTF-16; set format.encoding = 'utf-16' "
                    "in the map",
                    code="text.encoding",
                )
            binary.seek(0)
            if encoding.startswith(("utf-16", "utf-32")):
                with log.open(encoding=encoding, newline="") as text:
                    for number, line in _bounded(text, log):
                        yield number, line
                return
            for number, raw in _bounded(binary, log):
                yield number, raw.decode("utf-8-sig" if encoding == "utf-8" and number == 1 else encoding)
    except UnicodeDecodeError as error:
        byte = error.object[error.start]
        raise DatasetError(
            f"{log}, line {max(number, 1)}: byte 0x{byte:02x} is not {encoding}; set format.encoding in the map to "
            "the encoding of the log, such as 'cp1252'",
            code="text.encoding",
        ) from error
    except UnicodeError as error:
        raise DatasetError(f"{log}, line {number + 1}: is not {encoding}: {error}", code="text.encoding") from error
    except OSError as error:
        raise DatasetError(f"{log}: cannot be read: {error.strerror}", code="file.unreadable") from error


def _bounded(file: IO[AnyStr], log: Path) -> Iterator[tuple[int, AnyStr]]:
    """Yield the lines of a file with their numbers; DatasetError names one that is too long."""
    for number, line in enumerate(iter(partial(file.readline, MAX_LINE + 1), file.read(0)), 1):
        if len(line) > MAX_LINE:
            raise DatasetError(
                f"{log}, line {number}: expected at most {MAX_LINE} characters; it is longer", code="text.line.too_long"
            )
        yield number, line


def _rows(log: Path, form: Format) -> Iterator[tuple[int, list[str]]]:
    """Yield the fields of every line that is neither skipped, empty nor a comment, with its number."""
    current = 0

    def kept() -> Iterator[str]:
        nonlocal current
        for current, line in _lines(log, form.encoding):
            text = line.strip(" \r\n")
            if current > form.skip and text and not (form.comment and text.startswith(form.comment)):
                yield line.strip(" ") if form.delimiter == " " else line

    lines = kept()
    first = next(lines, None)
    if first is None:
        return
    delimiter = form.delimiter
    if delimiter == "auto":
        delimiter = "\t" if "\t" in first else ";" if ";" in first or form.decimal == "," else ","
    reader = csv.reader(_chain(first, lines), delimiter=delimiter, skipinitialspace=True, strict=True)
    try:
        for row in reader:
            yield current, row
    except csv.Error as error:
        raise DatasetError(f"{log}, line {current}: cannot be split into fields: {error}", code="csv.fields") from error


def _chain(first: T, rest: Iterator[T]) -> Iterator[T]:
    yield first
    yield from rest


def _places(
    row: list[str], line: int, wanted: Mapping[str, Place], form: Format, mistakes: Mistakes
) -> dict[str, tuple[int, ...]]:
    """Return the indices of each key's columns in a row, from the header or by number."""
    names = [name.strip() for name in row] if form.header else []
    places = {}
    for key, place in wanted.items():
        columns = place if isinstance(place, list) else [place]
        places[key] = tuple(_place(key, column, row, names, line, form, mistakes) for column in columns)
    return places


def _place(
    key: str, column: str | int, row: list[str], names: list[str], line: int, form: Format, mistakes: Mistakes
) -> int:
    if isinstance(column, int):
        if column > len(row):
            mistakes.add(line, f"{key}: expected a column {column}; found only {len(row)}")
        return column - 1
    if not form.header:
        mistakes.add(line, f"{key}: a log without header has no column '{column}'; give its number in the map")
    elif column not in names:
        mistakes.add(line, f"{key}: no column '{column}'; {nearest(column, names)}")
    elif names.count(column) > 1:
        mistakes.add(line, f"{key}: column '{column}' occurs {names.count(column)} times; give its number instead")
    else:
        return names.index(column)
    return 0


def _number(text: str, place: str, form: Format, line: int, mistakes: Mistakes) -> float:
    """Return a cell as a number; NaN for an empty one."""
    if not text or text in form.missing:
        return np.nan
    try:
        plain = form.plain(text)
    except ValueError as error:
        mistakes.add(line, f"{place}: {error}", f"{place}: thousands")
        return np.nan
    try:
        value = float(plain)
    except ValueError:
        value = np.nan
    if np.isfinite(value) and "_" not in plain:  # Python reads 1_000 as a number
        return value
    comma = form.decimal == "." and text.count(",") == 1 and "." not in text
    hint = "; for decimal commas set format.decimal = ',' in the map" if comma else ""
    mistakes.add(line, f"{place}: expected a number; found '{text}'{hint}")
    return np.nan


def seconds(text: str, clock: Clock, place: str, line: int, mistakes: Mistakes) -> float:
    """Return the seconds since the first date of the log; NaN and a mistake if the text is not a date."""
    try:
        return clock.seconds(text)
    except ValueError as error:
        mistakes.add(line, f"{place}: {error}", f"{place}: {str(error).partition('; found')[0].replace(text, '')}")
        return np.nan
