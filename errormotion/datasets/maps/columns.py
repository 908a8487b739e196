"""Columns of a table by content: dates, numbers, labels and their units, whatever they mean."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from errormotion.arrays import Array
from errormotion.datasets.maps.units import fitting_unit, orders, stated_unit
from errormotion.datasets.maps.words import is_no_reading
from errormotion.datasets.schemas import Row
from errormotion.datasets.tables.dates import ELAPSED, Clock
from errormotion.datasets.tables.mistakes import Mistakes
from errormotion.datasets.tables.numbers import no_value
from errormotion.datasets.tables.table import Table

DATES, NUMBERS, TEXTS, EMPTY = "dates", "numbers", "texts", "empty"
_FIRST = 2000
"""Number of rows from which a map is proposed."""
_READABLE = 0.95
"""Smallest share of numbers among the cells of a column of numbers; the others are refused when it is read."""


@dataclass(frozen=True)
class Content:
    """A column, or two of date and time of day.

    Attributes
    ----------
    table : Table
    places : tuple of int
        Index of the column; those of date and time of day.
    kind : str
        `DATES`, `NUMBERS`, `TEXTS` or `EMPTY`.
    dates : tuple of str
        Units with which all cells can be read as dates.
    """

    table: Table
    places: tuple[int, ...]
    kind: str
    dates: tuple[str, ...] = ()

    @property
    def index(self) -> int:
        """Index of the (first) column."""
        return self.places[0]

    @property
    def title(self) -> str:
        """Name of the column."""
        return self.table.titles[self.index]

    @property
    def unit(self) -> str:
        """Unit in the file; empty if none is stated."""
        return stated_unit(self.table, self.index)

    @cached_property
    def texts(self) -> list[str]:
        """Cells, (n,)."""
        return self.table.texts(self.places)

    @cached_property
    def values(self) -> Array:
        """Numbers in the unit of the file, (n,); NaN for other cells."""
        found: Array = self.table.numbers({self.index: self.title}, Mistakes(self.table.path))[self.index]
        return found

    def seconds(self, unit: str, count: int) -> Array:
        """Return the first dates that can be read with a unit, at most ``count``, as seconds since the first one."""
        clock, found = Clock(unit, repeats=True), []
        for text in self.texts[:count]:
            with suppress(ValueError):
                found.append(clock.seconds(text))
        return np.array(found)

    @property
    def whole(self) -> bool:
        """Whether all numbers are whole."""
        known = self.values[~np.isnan(self.values)]
        return bool(known.size) and bool((known == np.round(known)).all())

    def unit_for(self, row: Row, freedom: str = "") -> str:
        """Return the stated unit in the form that fits a variable; empty for none, or for one of another kind."""
        return fitting_unit(self.unit, row, freedom) if self.unit else ""

    def may_be(self, row: Row) -> bool:
        """Return whether neither the title nor the stated unit, if there is one, contradicts a variable."""
        if is_no_reading(self.title, row.name):
            return False
        if not self.unit:
            return True
        return bool(self.unit_for(row)) if row.unit or row.units else False


def contents(table: Table) -> list[Content]:
    """Return the columns of a table; a column with dates and one beside it with times of day are one.

    Their content is that of the first rows; only dates whose order these leave open are read completely.
    """
    whole, table = table, replace(table, cells=table.cells.top(_FIRST))
    found = [_content(table, k, table.texts([k])) for k in range(len(table.titles))]
    joined: list[Content] = []
    for each in found:
        before = joined[-1] if joined else None
        if before is not None and _is_day(before) and each.dates == (ELAPSED,):
            places = (before.index, each.index)
            if dates := tuple(orders(table.texts(places))):
                joined[-1] = Content(table, places, DATES, dates)
                continue
        joined.append(each)
    return [
        replace(each, dates=tuple(orders(whole.texts(each.places))) or each.dates) if len(each.dates) > 1 else each
        for each in joined
    ]


def _content(table: Table, place: int, texts: Sequence[str]) -> Content:
    filled = [text for text in texts if not no_value(text, table.form.missing)]
    if not filled:
        return Content(table, (place,), EMPTY)
    column = Content(table, (place,), NUMBERS)
    known = np.count_nonzero(~np.isnan(column.values))
    if known >= _READABLE * len(filled) or (known > 1 and len(filled) - known == 1):
        return column
    dates = tuple(orders(filled))
    return Content(table, (place,), DATES if dates else TEXTS, dates)


def _is_day(column: Content) -> bool:
    """Return whether the cells are dates without a time of day."""
    return bool(column.dates) and ELAPSED not in column.dates and not any(":" in text for text in column.texts[:100])
