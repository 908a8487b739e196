"""Conversion of exported tables of trackers to lengths by station and target, in SI; reports all mistakes at once.

A table has a line of column names with their units, and a line for each measurement, in any order. Its form is
recognised (`errormotion.datasets.tables`): encoding, delimiter, decimal sign, a line of units, sheets::

    station,target,length [mm],temperature [degC],pressure [hPa],humidity [%]
    S1,1,1523.40712,20.31,1013.2,45
    S1,2,,20.31,1013.2,45

An empty length means a broken beam.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Literal

import numpy as np

from errormotion.datasets.tables.mistakes import Mistakes
from errormotion.datasets.tables.reading import read_table as read_file
from errormotion.datasets.tables.table import Table, name_of, same
from errormotion.datasets.units import convert
from errormotion.errors import DatasetError

Array = np.ndarray[Any, Any]
Repeats = Literal["refuse", "last", "mean"]


@dataclass(frozen=True)
class Quantity:
    """A column of numbers: internal unit, example of a unit, limits of plausible values, and other names."""

    unit: str
    example: str
    low: float
    high: float
    names: tuple[str, ...] = ()


QUANTITIES: Mapping[str, Quantity] = {
    "length": Quantity("m", "mm", -160.0, 160.0, ("displacement", "distance", "länge", "distanz", "abstand")),
    "temperature": Quantity("degC", "degC", -20.0, 60.0, ("air_temperature", "temperatur", "lufttemperatur")),
    "pressure": Quantity("Pa", "hPa", 5e4, 1.2e5, ("air_pressure", "druck", "luftdruck")),
    "humidity": Quantity("%", "%", 0.0, 100.0, ("relative_humidity", "feuchte", "luftfeuchte")),
}
KEYS: Mapping[str, tuple[str, ...]] = {"station": ("tracker", "standort"), "target": ("point", "punkt", "ziel")}
AIR = ("temperature", "pressure", "humidity")

MAX_TABLE = 1 << 24
"""Longest table, bytes."""
MAX_LINES = 100_000
"""Largest number of lines of a table: rows take more memory than their bytes."""

_ENDS, _LONG_ENDS = b"\n\r\x0b\x0c\x1c\x1d\x1e", (b"\xc2\x85", b"\xe2\x80\xa8", b"\xe2\x80\xa9")  # line ends of text
_MAX_HINTS = 10  # columns for which a name is suggested
_UNITS = {"°C": "degC", "C": "degC", "K": "kelvin", "mbar": "mbar", "%RH": "%", "% RH": "%", "%rH": "%"}


@dataclass(frozen=True)
class Readings:
    """The contents of a table.

    Attributes
    ----------
    stations, targets : tuple of str
    length : ndarray, (station, target)
        m; NaN where missing.
    temperature, pressure, humidity : ndarray, (station, target)
        degC, Pa, %; NaN where unknown.
    missing : mapping of str to int
        Number of missing lengths: ``empty`` (a line without a number) and ``no line``.
    repeated : int
        Number of lines replaced by, or averaged with, another line of the same station and target.
    """

    stations: tuple[str, ...]
    targets: tuple[str, ...]
    length: Array
    temperature: Array
    pressure: Array
    humidity: Array
    missing: Mapping[str, int]
    repeated: int = 0


def read_table(
    path: Path, *, stations: Sequence[str] | None = None, repeats: Repeats = "refuse", least_length: float = 0.0
) -> Readings:
    """Read a table of lengths.

    Parameters
    ----------
    path : Path
        Text or spreadsheet, see the module.
    stations : sequence of str, optional
        Stations in the order of the result; default: those of the table, in its order.
    repeats : {"refuse", "last", "mean"}
        Treatment of a second line for the same station and target.
    least_length : float
        Lower limit of the longest length, m; detects wrong units.

    Raises
    ------
    DatasetError
        The file cannot be read, or has mistakes; the message lists them with line, column, expected and found value.
    """
    with suppress(OSError):  # `read_file` reports it
        _refuse_long(path)
    table = read_file(path)
    mistakes = Mistakes(path)
    for note in table.notes:
        mistakes.add(0, f"expected one table of measurements; {note}")
    columns = _columns(table, mistakes)
    mistakes.raise_any()
    table.report(mistakes)
    texts = {name: list(table.cells.texts(column)) for name, (column, _) in columns.items() if name in KEYS}
    shown = {column: f"column '{table.titles[column]}'" for name, (column, _) in columns.items() if name in QUANTITIES}
    numbers = table.numbers(shown, mistakes)
    values = {
        name: _inside(name, numbers[column], unit, shown[column], table, mistakes)
        for name, (column, unit) in columns.items()
        if name in QUANTITIES
    }
    names = _names(texts, table, stations, mistakes)
    mistakes.raise_any()
    found = _arranged(names, texts, values, table, repeats, mistakes)
    mistakes.raise_any()
    _check_length(path, found.length, table.titles[columns["length"][0]], least_length)
    return found


def _refuse_long(path: Path) -> None:
    if (size := path.stat().st_size) > MAX_TABLE:
        raise DatasetError(
            f"{path}: expected a table of at most {MAX_TABLE} bytes; found {size}", code="table.lengths.too_large"
        )
    data = path.read_bytes()
    lines = len(data) - len(data.translate(None, _ENDS)) - data.count(b"\r\n") + sum(map(data.count, _LONG_ENDS))
    if lines > MAX_LINES:
        raise DatasetError(
            f"{path}: expected a table of at most {MAX_LINES} lines; found {lines}", code="table.lengths.too_large"
        )


def _columns(table: Table, mistakes: Mistakes) -> dict[str, tuple[int, str]]:
    """Return index and unit of each known column."""
    line = table.head
    others = {other: name for name, quantity in QUANTITIES.items() for other in quantity.names}
    others |= {other: name for name, them in KEYS.items() for other in them}
    columns: dict[str, tuple[int, str]] = {}
    for column, title in enumerate(table.titles):
        name = name_of(same(title)).lower().replace(" ", "_")
        name = others.get(name, name)
        unit = table.units[column]
        if name in columns:
            mistakes.add(line, f"column '{title}': expected one column for the {name}; found a second one")
        elif name in KEYS:
            columns[name] = (column, "")
        elif name in QUANTITIES:
            columns[name] = (column, _unit(title, name, unit, line, mistakes))
        else:
            near = get_close_matches(name, [*KEYS, *QUANTITIES, *others], n=1) if mistakes.count < _MAX_HINTS else []
            hint = f"; did you mean '{near[0]}'?" if near else ""
            mistakes.add(line, f"column '{title}': expected one of {', '.join([*KEYS, *QUANTITIES])}{hint}")
    for name in ("station", "target", "length"):
        if name not in columns and not mistakes.count:
            mistakes.add(line, f"expected a column '{name}'; found {', '.join(table.titles)}")
    return columns


def _unit(title: str, name: str, unit: str, line: int, mistakes: Mistakes) -> str:
    quantity = QUANTITIES[name]
    unit = _UNITS.get(unit, unit)
    if not unit:
        mistakes.add(line, f"column '{title}': expected its unit, such as '{name} [{quantity.example}]'")
        return quantity.unit
    try:
        convert(1.0, unit, quantity.unit)
    except DatasetError as error:
        mistakes.add(line, f"column '{title}': expected a unit such as {quantity.example}; {error}")
        return quantity.unit
    return unit


def _inside(name: str, values: Array, unit: str, title: str, table: Table, mistakes: Mistakes) -> Array:
    """Return the numbers of a column in SI, (n,); NaN where missing."""
    quantity = QUANTITIES[name]
    inside = np.asarray(convert(values, unit, quantity.unit), dtype=float)
    for k in map(int, np.flatnonzero((inside < quantity.low) | (inside > quantity.high))):
        low, high = (convert(limit, quantity.unit, unit) for limit in (quantity.low, quantity.high))
        mistakes.add(
            int(table.lines[k]),
            f"{title}: expected {low:.6g} to {high:.6g}; found {values[k]:.9g}. Check its unit, {unit}",
        )
    return inside


def _names(
    keys: dict[str, list[str]], table: Table, stations: Sequence[str] | None, mistakes: Mistakes
) -> dict[str, tuple[str, ...]]:
    """Return the names of stations in their order, and of targets by number or in the table's order."""
    for name, texts in keys.items():
        for line, text in zip(table.lines, texts, strict=True):
            if not text:
                mistakes.add(int(line), f"column '{name}': expected a number or name; found nothing")
    names_by_key = {name: tuple(dict.fromkeys(texts)) for name, texts in keys.items()}
    if stations is not None:
        for line, text in zip(table.lines, keys["station"], strict=True):
            if text and text not in stations:
                mistakes.add(int(line), f"column 'station': expected one of {', '.join(stations)}; found '{text}'")
        names_by_key["station"] = tuple(stations)
    if all(re.fullmatch("[0-9]{1,9}", text) for text in names_by_key["target"]):
        names_by_key["target"] = tuple(sorted(names_by_key["target"], key=int))
    return names_by_key


def _arranged(
    names: dict[str, tuple[str, ...]],
    keys: dict[str, list[str]],
    values: dict[str, Array],
    table: Table,
    repeats: Repeats,
    mistakes: Mistakes,
) -> Readings:
    """Return the readings by station and target."""
    shape = len(names["station"]), len(names["target"])
    indices = {name: {text: k for k, text in enumerate(texts)} for name, texts in names.items()}
    groups: dict[tuple[int, int], list[int]] = {}
    for k, (station, target) in enumerate(zip(keys["station"], keys["target"], strict=True)):
        group = groups.setdefault((indices["station"][station], indices["target"][target]), [])
        if group and repeats == "refuse":
            mistakes.add(
                int(table.lines[k]),
                f"station '{station}', target '{target}': expected one line; line {table.lines[group[0]]} is another. "
                "Remove one, or set 'repeats'",
            )
        group.append(k)
    arrays = {name: np.full(shape, np.nan) for name in QUANTITIES}
    for cell, group in groups.items():
        for name in values.keys() & QUANTITIES.keys():
            taken = values[name][group[-1:] if repeats == "last" else group]
            taken = taken[np.isfinite(taken)]
            arrays[name][cell] = taken.mean() if taken.size else np.nan
    empty = sum(not np.isfinite(arrays["length"][cell]) for cell in groups)
    missing = {"empty": int(empty), "no line": shape[0] * shape[1] - len(groups)}
    return Readings(
        names["station"],
        names["target"],
        **arrays,
        missing={why: count for why, count in missing.items() if count},
        repeated=len(table.lines) - len(groups),
    )


def _check_length(path: Path, length: Array, title: str, least: float) -> None:
    if not np.isfinite(length).any():
        raise DatasetError(
            f"{path}: column '{title}': expected lengths; found none. Check that the table is complete",
            code="table.lengths.none",
        )
    longest = float(np.nanmax(np.abs(length)))
    if longest <= least:
        raise DatasetError(
            f"{path}: column '{title}': the longest length is {longest:.4g} m; check its unit. If it is correct, set "
            f"'least_length' below {least:g} m",
            code="table.lengths.unit_implausible",
        )
