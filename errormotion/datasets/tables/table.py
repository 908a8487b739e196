"""A table with named columns; its numbers are read strictly, and every mistake has its line."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.datasets.files.tomlfile import nearest
from errormotion.datasets.tables.dates import COUNTED, TIMESTAMP, Clock, fitting, zone_of
from errormotion.datasets.tables.format import Format
from errormotion.datasets.tables.mistakes import Mistakes
from errormotion.datasets.tables.numbers import NUMBER, no_value, plain_spaces, without_overflow

Place = str | int | list[str | int]
"""Name or number of a column, or those of the columns of date and time of day."""

_SHOWN = 5
"""Number of dates whose form is compared with the stated unit."""
_UNIT = re.compile(r"\s*(?:[\[(<]\s*([^\])>]*?)\s*[\])>]|\s/\s*(\S+))\s*$")
_SAME = str.maketrans("\u03bc\u2126\u00a0\u202f\u2007\u2011", "\u00b5\u03a9   -")


class Cells(ABC):
    """The cells of a table, from any kind of file."""

    lines: NDArray[np.int64]
    """Line or row of the file of each row, (n,)."""

    def damaged(self) -> Sequence[tuple[int, str]]:
        """Return line and text of the rows that cannot be read."""
        return ()

    @abstractmethod
    def texts(self, column: int) -> Sequence[str]:
        """Return the cells of a column as text, (n,)."""

    @abstractmethod
    def top(self, count: int) -> Cells:
        """Return the first rows, at most ``count``."""

    @abstractmethod
    def numbers(self, columns: Sequence[int]) -> dict[int, Array]:
        """Return columns that are known to contain numbers and empty cells only, (n,) each; others are left out."""


@dataclass
class Table:
    """A table of a file.

    Attributes
    ----------
    path : Path
        The file.
    form : Format
        Its format, with everything that was recognised.
    titles : list of str
        Names of the columns as in the file; their numbers if it has no header.
    units : list of str
        Unit of each column from the line of units, or from its name; empty if there is none.
    head : int
        Line of the names.
    above : list of str
        Lines above the names, and comments.
    cells : Cells
        The rows.
    notes : list of str
        What was left out, and why.
    """

    path: Path
    form: Format
    titles: list[str]
    units: list[str]
    head: int
    above: list[str]
    cells: Cells
    notes: list[str] = field(default_factory=list)

    @property
    def lines(self) -> NDArray[np.int64]:
        """Line of each row, (n,)."""
        return self.cells.lines

    def report(self, mistakes: Mistakes) -> None:
        """Add the rows that cannot be read to the mistakes."""
        for line, text in self.cells.damaged():
            mistakes.add(line, text)

    def place(self, column: str | int, key: str, mistakes: Mistakes) -> int:
        """Return the index of a column, from its name or its number from 1; 0 and a mistake if there is none."""
        if isinstance(column, int):
            if column > len(self.titles):
                mistakes.add(self.head, f"{key}: expected a column {column}; found only {len(self.titles)}")
                return 0
            return column - 1
        names = [same(title) for title in self.titles]
        bare = [name_of(title) for title in names]
        wanted = same(column)
        for known in (names, bare):
            if known.count(wanted) == 1:
                return known.index(wanted)
            if known.count(wanted) > 1:
                mistakes.add(
                    self.head,
                    f"{key}: column '{column}' occurs {known.count(wanted)} times; give its number instead",
                )
                return 0
        if self.form.header is False:
            mistakes.add(
                self.head, f"{key}: a table without header has no column '{column}'; give its number in the map"
            )
        else:
            mistakes.add(self.head, f"{key}: no column '{column}'; {nearest(column, self.titles)}")
        return 0

    def texts(self, columns: Sequence[int]) -> list[str]:
        """Return the cells of a column, or those of several joined by blanks, (n,)."""
        if len(columns) == 1:
            return list(self.cells.texts(columns[0]))
        # A date in a cell of its own has the time 00:00:00 in spreadsheets.
        first, *rest = (self.cells.texts(column) for column in columns)
        parts = [[text.removesuffix(" 00:00:00") for text in first], *rest]
        return [" ".join(row).strip() for row in zip(*parts, strict=True)]

    def numbers(self, columns: Mapping[int, str], mistakes: Mistakes) -> dict[int, Array]:
        """Return columns of numbers in the units of the file, (n,) each; NaN for no value.

        Parameters
        ----------
        columns : mapping of int to str
            Index of each column, and how it is called in mistakes.
        mistakes : Mistakes
            Receives every cell that is neither a number nor stands for no value.
        """
        found = self.cells.numbers(list(columns))
        for column, name in columns.items():
            if column not in found:
                found[column] = self._strict(column, name, mistakes)
        return {k: without_overflow(values, self.form.missing) for k, values in found.items()}

    def seconds(
        self, columns: Sequence[int], unit: str, name: str, mistakes: Mistakes, *, repeats: bool
    ) -> tuple[Array, Clock]:
        """Return dates as seconds since the first one, (n,), NaN for empty cells; and the clock that has read them."""
        if unit in COUNTED:
            return self._counted(columns[0], unit, name, mistakes)
        texts = self.texts(columns)
        shown = [text for text in texts[:_SHOWN] if text]
        if unit != TIMESTAMP and shown and TIMESTAMP in fitting(shown):  # dates of a spreadsheet, whatever it shows
            unit = TIMESTAMP
        clock = Clock(unit, zone_of(self.form.zone) if self.form.zone else None, repeats)
        fast = clock.many(texts)
        if fast is not None:
            return fast, clock
        values = np.full(len(texts), np.nan)
        for k, text in enumerate(texts):
            if no_value(text, self.form.missing):
                continue
            line = int(self.lines[k])
            try:
                values[k] = clock.seconds(text)
            except ValueError as error:
                mistakes.add(
                    line, f"{name}: {error}", f"{name}: {str(error).partition('; found')[0].replace(text, '')}"
                )
        return values, clock

    def _counted(self, column: int, unit: str, name: str, mistakes: Mistakes) -> tuple[Array, Clock]:
        """Return days of a spreadsheet, or seconds since 1970, as seconds since the first one."""
        values = self.numbers({column: name}, mistakes)[column]
        known = values[~np.isnan(values)]
        clock = Clock(unit)
        origin, second = COUNTED[unit]
        with suppress(OverflowError):
            clock.start = origin + timedelta(seconds=round(float(known[0]) * second, 6)) if known.size else None
        return np.round((values - (known[0] if known.size else 0.0)) * second, 6), clock

    def _strict(self, column: int, name: str, mistakes: Mistakes) -> Array:
        form = self.form
        texts = self.cells.texts(column)
        values = np.full(len(texts), np.nan)
        for k, text in enumerate(texts):
            if no_value(text, form.missing):
                continue
            line = int(self.lines[k])
            try:
                plain = form.plain(text)
            except ValueError as error:
                mistakes.add(line, f"{name}: {error}", f"{name}: thousands")
                continue
            if NUMBER.fullmatch(plain) and np.isfinite(float(plain)):
                values[k] = float(plain)
                continue
            comma = form.decimal == "." and text.count(",") == 1 and "." not in text
            hint = "; for decimal commas set format.decimal = ',' in the map" if comma else ""
            mistakes.add(line, f"{name}: expected a number; found '{text}'{hint}")
        return values


def same(text: str) -> str:
    """Return a name in the form in which names that look equal are equal: micro sign, no-break space, blanks."""
    return " ".join(plain_spaces(text.translate(_SAME)).split())


def name_of(title: str) -> str:
    """Return the name in a title such as ``Weg [um]``."""
    return _UNIT.sub("", title).strip() or title


def unit_of(title: str) -> str:
    """Return the unit in a title such as ``Weg [um]``, ``Weg (um)`` or ``Weg / um``; empty if there is none."""
    match = _UNIT.search(title)
    return same(match[1] if match[1] is not None else match[2]) if match else ""


def stripped(unit: str) -> str:
    """Return a unit of a line of units, without brackets."""
    return same(re.sub(r"^[(\[<]\s*|\s*[)\]>]$", "", unit))


def named(titles: Iterable[str], units: Sequence[str] | None) -> tuple[list[str], list[str]]:
    """Return the names of columns and their units: from the line of units if there is one, else from the names."""
    names = [title.strip() for title in titles]
    if units is None:
        return names, [unit_of(name) for name in names]
    rest = [""] * (len(names) - len(units))
    return names, [stripped(unit) or unit_of(name) for name, unit in zip(names, [*units, *rest], strict=False)]
