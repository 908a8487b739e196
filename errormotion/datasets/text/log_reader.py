"""Columns of a text log, read strictly: every mistake is reported with its line."""

from __future__ import annotations

import csv
from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.datasets.files.tomlfile import nearest
from errormotion.datasets.text.log_format import Format
from errormotion.errors import DatasetError

T = TypeVar("T")

_MAX_REPORTED = 20
"""Largest number of mistakes that are reported with their text."""
_UTF16_MARKS = (b"\xff\xfe", b"\xfe\xff")


@dataclass
class Mistakes:
    """Mistakes in a file: the first ones with their text, the others counted."""

    path: Path
    texts: list[tuple[int, str]] = field(default_factory=list)
    count: int = 0

    def add(self, line: int, text: str) -> None:
        """Add one mistake; ``line`` 0 is the file as a whole."""
        self.count += 1
        if len(self.texts) < _MAX_REPORTED:
            self.texts.append((line, text))

    def raise_any(self) -> None:
        """Raise DatasetError if there are any."""
        if self.count:
            shown = [f"line {line}: {text}" if line else text for line, text in sorted(self.texts)]
            more = [f"and {self.count - len(shown)} more"] if self.count > len(shown) else []
            number = "1 mistake" if self.count == 1 else f"{self.count} mistakes"
            raise DatasetError(f"{self.path}: {number}; nothing was imported", [*shown, *more])


@dataclass(frozen=True)
class Columns:
    """Wanted columns of a log.

    Attributes
    ----------
    values : dict of str to ndarray, (n,)
        By the caller's key, in the log's units; NaN where a cell is empty. Dates are in s from the first line on.
    lines : ndarray, (n,)
        Line of each value.
    start : str
        Date and time of the first line, if the log has dates.
    """

    values: dict[str, Array]
    lines: NDArray[np.int64]
    start: str = ""


def read_columns(
    wanted: Mapping[str, str | int], time: str, form: Format, mistakes: Mistakes, *, dates: bool = False
) -> Columns:
    """Read columns of the log ``mistakes.path``.

    Parameters
    ----------
    wanted : mapping of str to str or int
        Column of each key: its name in the header, or its number from 1.
    time : str
        Key of the time, where no cell may be empty.
    form : Format
        Format of the text.
    mistakes : Mistakes
        Receives the mistakes in the cells.
    dates : bool
        Whether the time is given as dates.

    Raises
    ------
    DatasetError
        No file, wrong encoding, unbalanced quotes, missing columns, no lines.
    """
    (_, titles), remaining, places = columns_of(wanted, form, mistakes)
    width = len(titles)
    cells = {key: array("d") for key in wanted}
    lines = array("q")
    start: datetime | None = None
    for line, row in remaining:
        if len(row) != width:
            mistakes.add(line, f"expected {width} fields; found {len(row)}")
            continue
        lines.append(line)
        for key, place in places.items():
            text = row[place].strip()
            if key == time and dates:
                start, value = seconds(text, start, f"{key}, field {place + 1}", line, mistakes)
            elif key == time and not text:
                mistakes.add(line, f"{key}, field {place + 1}: expected a number; found an empty cell")
                value = np.nan
            else:
                value = _number(text, f"{key}, field {place + 1}", form, line, mistakes)
            cells[key].append(value)
    if not lines and not mistakes.count:
        raise DatasetError(f"{mistakes.path}: expected lines of numbers below the header; found none")
    return Columns(
        {key: np.array(values, dtype=float) for key, values in cells.items()},
        np.array(lines, dtype=np.int64),
        start.isoformat() if start else "",
    )


def columns_of(
    wanted: Mapping[str, str | int], form: Format, mistakes: Mistakes
) -> tuple[tuple[int, list[str]], Iterator[tuple[int, list[str]]], dict[str, int]]:
    """Find columns of the log ``mistakes.path``.

    Returns
    -------
    (int, list of str)
        Line and fields of the header, or of the first line where the log has no header.
    iterator of (int, list of str)
        Lines of numbers.
    dict of str to int
        Number of the field of each wanted column, from 0.

    Raises
    ------
    DatasetError
        No file, wrong encoding, unbalanced quotes, missing columns, no lines.
    """
    remaining = _rows(mistakes.path, form)
    head = next(remaining, None)
    if head is None:
        raise DatasetError(f"{mistakes.path}: expected lines of numbers; found none")
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
        with log.open("rb") as binary:
            marked = binary.read(2) in _UTF16_MARKS
            if marked and not encoding.startswith(("utf-16", "utf-32")):
                raise DatasetError(
                    f"{log}, line 1: starts with the byte order mark of UTF-16; set format.encoding = 'utf-16' "
                    "in the map"
                )
            binary.seek(0)
            if encoding.startswith(("utf-16", "utf-32")):
                with log.open(encoding=encoding, newline="") as text:
                    for number, line in enumerate(text, 1):
                        yield number, line
                return
            for number, raw in enumerate(binary, 1):
                yield number, raw.decode("utf-8-sig" if encoding == "utf-8" and number == 1 else encoding)
    except UnicodeDecodeError as error:
        byte = error.object[error.start]
        raise DatasetError(
            f"{log}, line {max(number, 1)}: byte 0x{byte:02x} is not {encoding}; set format.encoding in the map to "
            "the encoding of the log, such as 'cp1252'"
        ) from error
    except UnicodeError as error:
        raise DatasetError(f"{log}, line {number + 1}: is not {encoding}: {error}") from error
    except OSError as error:
        raise DatasetError(f"{log}: cannot be read: {error.strerror}") from error


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
        raise DatasetError(f"{log}, line {current}: cannot be split into fields: {error}") from error


def _chain(first: T, rest: Iterator[T]) -> Iterator[T]:
    yield first
    yield from rest


def _places(
    row: list[str], line: int, wanted: Mapping[str, str | int], form: Format, mistakes: Mistakes
) -> dict[str, int]:
    """Return the index of each key's column in a row, from the header or by number."""
    names = [name.strip() for name in row] if form.header else []
    places = {}
    for key, column in wanted.items():
        if isinstance(column, int):
            if column > len(row):
                mistakes.add(line, f"{key}: expected a column {column}; found only {len(row)}")
            places[key] = column - 1
        elif not form.header:
            mistakes.add(line, f"{key}: a log without header has no column '{column}'; give its number in the map")
        elif column not in names:
            mistakes.add(line, f"{key}: no column '{column}'; {nearest(column, names)}")
        elif names.count(column) > 1:
            mistakes.add(line, f"{key}: column '{column}' occurs {names.count(column)} times; give its number instead")
        else:
            places[key] = names.index(column)
    return places


def _number(text: str, place: str, form: Format, line: int, mistakes: Mistakes) -> float:
    """Return a cell as a number; NaN for an empty one."""
    if not text or text in form.missing:
        return np.nan
    plain = text.replace(",", ".") if form.decimal == "," and "." not in text else text
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


def seconds(
    text: str, start: datetime | None, place: str, line: int, mistakes: Mistakes
) -> tuple[datetime | None, float]:
    """Return the first date of the log, and the seconds since then."""
    try:
        now = datetime.fromisoformat(text)
        return start or now, (now - (start or now)).total_seconds()
    except (ValueError, TypeError):  # TypeError: some dates with a time zone and some without
        mistakes.add(line, f"{place}: expected a date and time such as 2024-05-31T14:05:09.5; found '{text}'")
        return start, np.nan
