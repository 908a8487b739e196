"""Columns of a log that a map requires, as numbers in the units of the log; every mistake has its line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.datasets.tables.dates import ELAPSED, Clock, fitting, instant, is_date
from errormotion.datasets.tables.format import Format
from errormotion.datasets.tables.mistakes import Mistakes
from errormotion.datasets.tables.numbers import no_value
from errormotion.datasets.tables.reading import read_table
from errormotion.datasets.tables.table import Place, Table

NOTES = "import_notes"
"""Attribute of an imported dataset with notes, JSON list of sentences."""

_MIN_INTERVALS = 4
"""Smallest number of intervals with which a usual one is determined."""
_SHARE_OF_USUAL = 0.7
"""Smallest fraction of usual intervals with which a longer one counts as a hole."""


@dataclass(frozen=True)
class Columns:
    """Required columns of a log.

    Attributes
    ----------
    values : dict of str to ndarray, (n,)
        By the caller's key, in the units of the log; NaN for no value. Dates are in s since the first line.
    lines : ndarray, (n,)
        Line of each value.
    time_unit : str
        Unit of the times: s for dates, else that of the map.
    start : str
        Date and time of the first line, if the log has dates.
    notes : list of str
        Notes on the data: local times that occur twice, lines that are not read.
    """

    values: dict[str, Array]
    lines: NDArray[np.int64]
    time_unit: str
    start: str = ""
    notes: list[str] = field(default_factory=list)


def read_columns(wanted: Mapping[str, Place], time: str, unit: str, form: Format, mistakes: Mistakes) -> Columns:
    """Read columns of the log ``mistakes.path``.

    Parameters
    ----------
    wanted : mapping of str to str, int or two of them
        Column of each key: its name in the header, or its number from 1; two for date and time of day.
    time : str
        Key of the time, whose cells must not be empty.
    unit : str
        Unit of the time, or the one of dates (`errormotion.datasets.tables.dates`).
    form : Format
        Format of the table.
    mistakes : Mistakes
        Receives the mistakes in the cells.

    Raises
    ------
    DatasetError
        No file, wrong encoding, unbalanced quotes, missing columns, no lines.
    """
    table = read_table(mistakes.path, form)
    places = places_of(table, wanted, mistakes)
    names = {key: f"{key}, field {where[0] + 1}" for key, where in places.items()}
    dates = unit if is_date(unit) else clocked(table, places[time])
    numeric = {where[0]: names[key] for key, where in places.items() if not (key == time and dates)}
    found = table.numbers(numeric, mistakes)
    values = {key: found[where[0]] for key, where in places.items() if where[0] in found and len(where) == 1}
    start, notes = "", list(table.notes)
    if dates:
        values[time], clock = table.seconds(places[time], dates, names[time], mistakes, repeats=False)
        start = clock.start.isoformat() if clock.start else ""
        values[time], equal = spread(values[time])
        notes += [*clock_notes(clock), *equal]
    elif first := instant(float(values[time][0]), unit):
        start = first.isoformat()
        values[time] = values[time] - values[time][0]
        notes.append(f"the times are dates as numbers, the first one is {start}")
    unknown = np.flatnonzero(np.isnan(values[time]))
    texts = table.texts(places[time]) if unknown.size else []
    for k in unknown:
        if no_value(texts[k], form.missing):
            mistakes.add(int(table.lines[k]), f"{names[time]}: expected a number; found an empty cell")
    return Columns(values, table.lines, "s" if dates else unit, start, notes)


def places_of(table: Table, wanted: Mapping[str, Place], mistakes: Mistakes) -> dict[str, list[int]]:
    """Return the indices of the columns of each key: one, or two for date and time of day.

    Raises
    ------
    DatasetError
        Columns are missing.
    """
    places = {
        key: [table.place(column, key, mistakes) for column in (place if isinstance(place, list) else [place])]
        for key, place in wanted.items()
    }
    mistakes.raise_any()
    table.report(mistakes)
    return places


def clocked(table: Table, column: Sequence[int]) -> str:
    """Return the unit of times such as 00:05:09 where a unit of numbers is stated; empty for numbers."""
    shown = [text for text in table.texts(column)[:5] if text]
    return ELAPSED if shown and ELAPSED in fitting(shown) else ""


def clock_notes(clock: Clock) -> list[str]:
    """Return the note on local times that occur twice."""
    if not clock.resolved:
        return []
    return [f"{clock.resolved} times of the hour that occurs twice in {clock.zone} were resolved by their order"]


def spread(times: Array) -> tuple[Array, list[str]]:
    """Return times of whole seconds with rows of the same second spread over it evenly, and a note.

    Loggers that are faster than their clock write several rows with one time. ``times`` are in s, (n,); those with
    parts of a second, or that decrease, are returned as they are.
    """
    if times.size < 2 or np.isnan(times).any() or (times % 1 != 0).any() or (np.diff(times) < 0).any():
        return times, []
    second, first, count = np.unique(times, return_index=True, return_counts=True)
    if second.size < 2 or count.max() == 1:
        return times, []
    inside = np.arange(times.size) - np.repeat(first, count)
    note = f"the clock of the log has whole seconds; up to {count.max()} rows of one second are spread over it evenly"
    return times + inside / np.repeat(count, count), [note]


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
