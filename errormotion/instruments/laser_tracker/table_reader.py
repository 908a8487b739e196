"""Conversion of exported tables of trackers to lengths by station and target, in SI; reports all mistakes at once.

A table has a line of column names with their units, and a line for each measurement, in any order::

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
from errormotion.datasets.tables.numbers import NUMBER
from errormotion.datasets.text.csv_text import Table, blocks
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
    "length": Quantity("m", "mm", -160.0, 160.0, ("displacement", "distance")),
    "temperature": Quantity("degC", "degC", -20.0, 60.0, ("air_temperature",)),
    "pressure": Quantity("Pa", "hPa", 5e4, 1.2e5, ("air_pressure",)),
    "humidity": Quantity("%", "%", 0.0, 100.0, ("relative_humidity",)),
}
KEYS: Mapping[str, tuple[str, ...]] = {"station": ("tracker",), "target": ("point",)}
AIR = ("temperature", "pressure", "humidity")

MAX_TABLE = 1 << 24
"""Longest table, bytes."""
MAX_LINES = 100_000
"""Largest number of lines of a table: rows take more memory than their bytes."""

_ENDS, _LONG_ENDS = b"\n\r\x0b\x0c\x1c\x1d\x1e", (b"\xc2\x85", b"\xe2\x80\xa8", b"\xe2\x80\xa9")  # line ends of text
_MAX_HINTS = 10  # columns for which a name is suggested
_TITLE = re.compile(r"([^\W\d]\w*(?: \w+)*)\s*(?:[\[(]([^\])]*)[\])]|/\s*(\S.*))?")
_EMPTY = ("", "NaN", "nan", "-", "---")
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
        UTF-8 text, see the module; separated by tabulator, semicolon or comma, the decimal sign is a point.
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
    with suppress(OSError):  # `blocks` reports it
        _refuse_long(path)
    _, tables = blocks(path)
    if len(tables) > 1:
        line = tables[1].head[0]
        raise DatasetError(
            f"{path}, line {line}: expected one table without empty lines; found the start of a second table",
            code="table.lengths.second",
        )
    (table,) = tables
    mistakes = Mistakes(path)
    columns = _columns(table, mistakes)
    mistakes.raise_any()
    rows = [(line, texts) for line, texts in table.rows if _whole(line, texts, table, mistakes)]
    if not rows and not mistakes.count:
        mistakes.add(table.head[0], "expected lines of measurements below the column names; found none")
    values = {name: _numbers(name, column, unit, rows, table, mistakes) for name, (column, unit) in columns.items()}
    keys = {name: [texts[column] for _, texts in rows] for name, (column, _) in columns.items() if name in KEYS}
    names = _names(keys, rows, stations, mistakes)
    mistakes.raise_any()
    found = _arranged(names, keys, values, rows, repeats, mistakes)
    mistakes.raise_any()
    _check_length(path, found.length, table.head[1][columns["length"][0]], least_length)
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
    line, titles = table.head
    others = {other: name for name, quantity in QUANTITIES.items() for other in quantity.names}
    others |= {other: name for name, them in KEYS.items() for other in them}
    found: dict[str, tuple[int, str]] = {}
    for column, title in enumerate(titles):
        match = _TITLE.fullmatch(title)
        name = match[1].lower().replace(" ", "_") if match else ""
        name = others.get(name, name)
        unit = ((match[2] or match[3] or "") if match else "").strip()
        if name in found:
            mistakes.add(line, f"column '{title}': expected one column for the {name}; found a second one")
        elif name in KEYS:
            found[name] = (column, "")
        elif name in QUANTITIES:
            found[name] = (column, _unit(title, name, unit, line, mistakes))
        else:
            near = get_close_matches(name, [*KEYS, *QUANTITIES, *others], n=1) if mistakes.count < _MAX_HINTS else []
            hint = f"; did you mean '{near[0]}'?" if near else ""
            mistakes.add(line, f"column '{title}': expected one of {', '.join([*KEYS, *QUANTITIES])}{hint}")
    for name in ("station", "target", "length"):
        if name not in found and not mistakes.count:
            mistakes.add(line, f"expected a column '{name}'; found {', '.join(titles)}")
    return found


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


def _whole(line: int, texts: list[str], table: Table, mistakes: Mistakes) -> bool:
    wanted = len(table.head[1])
    if len(texts) == wanted:
        return True
    comma = " (the decimal sign is a point)" if len(texts) > wanted else ""
    mistakes.add(line, f"expected {wanted} fields; found {len(texts)}{comma}")
    return False


def _numbers(
    name: str, column: int, unit: str, rows: list[tuple[int, list[str]]], table: Table, mistakes: Mistakes
) -> Array:
    """Return the numbers of a column in SI; NaN where missing. Empty for a column of names."""
    if name in KEYS:
        return np.empty(0)
    quantity, title = QUANTITIES[name], table.head[1][column]
    values = np.full(len(rows), np.nan)
    for k, (line, texts) in enumerate(rows):
        text = texts[column]
        if text in _EMPTY:
            continue
        if not NUMBER.fullmatch(text) or not np.isfinite(float(text)):
            comma = " (the decimal sign is a point)" if "," in text else ""
            mistakes.add(line, f"column '{title}': expected a number; found '{text}'{comma}")
            continue
        values[k] = float(text)
    inside = np.asarray(convert(values, unit, quantity.unit), dtype=float)
    for k in map(int, np.flatnonzero((inside < quantity.low) | (inside > quantity.high))):
        low, high = (convert(limit, quantity.unit, unit) for limit in (quantity.low, quantity.high))
        mistakes.add(
            rows[k][0],
            f"column '{title}': expected {low:.6g} to {high:.6g}; found {values[k]:.9g}. Check its unit, {unit}",
        )
    return inside


def _names(
    keys: dict[str, list[str]],
    rows: list[tuple[int, list[str]]],
    stations: Sequence[str] | None,
    mistakes: Mistakes,
) -> dict[str, tuple[str, ...]]:
    """Return the names of stations in their order, and of targets by number or in the table's order."""
    for name, texts in keys.items():
        for (line, _), text in zip(rows, texts, strict=True):
            if not text:
                mistakes.add(line, f"column '{name}': expected a number or name; found nothing")
    found = {name: tuple(dict.fromkeys(texts)) for name, texts in keys.items()}
    if stations is not None:
        for (line, _), text in zip(rows, keys["station"], strict=True):
            if text and text not in stations:
                mistakes.add(line, f"column 'station': expected one of {', '.join(stations)}; found '{text}'")
        found["station"] = tuple(stations)
    if all(re.fullmatch("[0-9]{1,9}", text) for text in found["target"]):
        found["target"] = tuple(sorted(found["target"], key=int))
    return found


def _arranged(
    names: dict[str, tuple[str, ...]],
    keys: dict[str, list[str]],
    values: dict[str, Array],
    rows: list[tuple[int, list[str]]],
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
                rows[k][0],
                f"station '{station}', target '{target}': expected one line; line {rows[group[0]][0]} is another. "
                "Remove one, or set 'repeats'",
            )
        group.append(k)
    found = {name: np.full(shape, np.nan) for name in QUANTITIES}
    for cell, group in groups.items():
        for name in values.keys() & QUANTITIES.keys():
            taken = values[name][group[-1:] if repeats == "last" else group]
            taken = taken[np.isfinite(taken)]
            found[name][cell] = taken.mean() if taken.size else np.nan
    empty = sum(not np.isfinite(found["length"][cell]) for cell in groups)
    missing = {"empty": int(empty), "no line": shape[0] * shape[1] - len(groups)}
    return Readings(
        names["station"],
        names["target"],
        **found,
        missing={why: count for why, count in missing.items() if count},
        repeated=len(rows) - len(groups),
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
