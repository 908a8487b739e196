"""Import of logs with a map for any raw schema: conversion of columns of text to a raw dataset."""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets.files.tomlfile import load_model, nearest
from errormotion.datasets.schemas import RawSchema, Row, variants
from errormotion.datasets.tables.dates import Clock, is_date
from errormotion.datasets.tables.mistakes import Mistakes
from errormotion.datasets.tables.numbers import NUMBER
from errormotion.datasets.tables.reading import read_table as read_file
from errormotion.datasets.tables.table import Place, Table
from errormotion.datasets.text.layout import passes, tall
from errormotion.datasets.text.log_map import LogMap, MappedColumn, MappedValue, base_key
from errormotion.datasets.text.log_reader import NOTES, clock_notes, holes, places_of, spread
from errormotion.datasets.text.table_reader import (
    FREEDOM,
    Cells,
    Column,
    Found,
    Names,
    converted,
    incomplete,
    plausible,
    read_table,
    unit_vectors,
    units_of,
)
from errormotion.datasets.units import convert
from errormotion.errors import DatasetError


def read_log(log: Path, map_file: Path) -> xr.Dataset:
    """Return the raw dataset of a log with a map whose schema is a raw schema.

    Raises
    ------
    DatasetError
        The map or the log is wrong; all mistakes are reported together.
    """
    settings = load_model(map_file, LogMap)
    map_mistakes = Mistakes(map_file)
    names = names_of([settings], map_mistakes)
    checked = checked_columns(settings, names, map_mistakes)
    map_mistakes.raise_any()
    table, found = read_file(log, settings.format), Found()
    read_values(settings, table, names, found, map_mistakes)
    map_mistakes.raise_any()
    start, notes = read_part(table, settings, checked, names, found)
    return finished(settings, names, found, start, notes)


def names_of(parts: Sequence[LogMap], mistakes: Mistakes) -> Names:
    """Return the variables of a schema and the labels of the parts of a map, which have one schema and variant."""
    tables = _tables(parts[0], mistakes)
    labels: dict[str, tuple[str, ...]] = {}
    for settings in parts:
        for dim, found in _free_labels(settings).items():
            labels[dim] = (*(each for each in labels.get(dim, ()) if each not in found), *found)
    names = Names.of(tables, labels)
    stated = {row.name: row for table in reversed(tables) for row in table.stated}
    return replace(names, rows={**stated, **names.rows})


def checked_columns(settings: LogMap, names: Names, mistakes: Mistakes) -> dict[str, Column]:
    """Return the columns of a map by variable and component; mistakes for those that the schema does not have."""
    checked = {where: _column(where, entry, names, mistakes) for where, entry in settings.columns.items()}
    dims = {dim for row in names.rows.values() for dim in names.record_dims(row)}
    for where, entry in settings.columns.items():
        last = settings.entries[base_key(where)][-1]
        if (entry.scale, entry.offset) != (last.scale, last.offset):
            mistakes.add(0, f"columns.{where}: expected the scale and offset of the other columns of {base_key(where)}")
    stated = {f"labels.{dim}": dim for dim in settings.labels}
    stated |= {f"columns.{key}.labels.{dim}": dim for key, each in settings.columns.items() for dim in each.labels}
    for where, dim in stated.items():
        if dim not in dims:
            mistakes.add(0, f"{where}: unknown dimension; {nearest(dim, dims)}")
    if settings.sequence is not None and not {"run", "approach", "target"} <= dims:
        mistakes.add(0, "sequence: expected a schema with run, approach and target; found none of them")
    return {base_key(where): column for where, column in checked.items() if column is not None}


def read_values(settings: LogMap, table: Table, names: Names, found: Found, mistakes: Mistakes) -> None:
    """Read the values of a map, and those at the top of a table, into ``found``."""
    for name, value in settings.values.items():
        read_value(name, value, table, names, found, mistakes)


def read_part(
    table: Table, settings: LogMap, columns: Mapping[str, Column], names: Names, found: Found
) -> tuple[str, list[str]]:
    """Read the columns of a table into ``found``; return its first date, and notes.

    Raises
    ------
    DatasetError
        Cells are wrong; all mistakes of the table are reported together.
    """
    mistakes = Mistakes(table.path)
    read = _columns(table, settings, mistakes)
    for part, columns_of_part, keys in _parts(read, columns, settings, names, mistakes):
        for text in incomplete(columns_of_part, keys, names):
            mistakes.add(0, text)
        if not mistakes.count:
            read_table(part, columns_of_part, keys, names, found, mistakes)
    mistakes.raise_any()
    return read.start, read.notes + _missing_rows(read.cells, read.keys)


def finished(settings: LogMap, names: Names, found: Found, start: str, notes: Sequence[str]) -> xr.Dataset:
    """Return what was read as a dataset of the schema."""
    known = {"machine": settings.machine, "start": start, NOTES: json.dumps(notes) if notes else ""}
    attrs = {**settings.attributes, **{name: text for name, text in known.items() if text}}
    raw = found.dataset({"schema": settings.schema_, **attrs}, names)
    tables = [each for each in variants(settings.schema_) if not settings.variant or each.variant == settings.variant]
    table = next((each for each in tables if each.marker in raw.variables or each.marker in raw.dims), tables[0])
    return table.imported(raw) if table.imported is not None else raw


def _tables(settings: LogMap, mistakes: Mistakes) -> Sequence[RawSchema]:
    tables = variants(settings.schema_)
    if not settings.variant:
        return tables
    chosen = [table for table in tables if table.variant == settings.variant]
    if not chosen:
        mistakes.add(0, f"variant: unknown; {nearest(settings.variant, (table.variant for table in tables))}")
    return chosen or tables


def _free_labels(settings: LogMap) -> dict[str, tuple[str, ...]]:
    """Return the labels of the last dimension of variables whose components the map names, such as sensors."""
    tables = variants(settings.schema_)
    rows_of = {row.name: row for table in reversed(tables) for row in table.rows}
    fixed = {dim for table in tables for dim in table.labels}
    found: dict[str, tuple[str, ...]] = {}
    for key in settings.columns:
        name, dot, label = base_key(key).partition(".")
        if dot and name in rows_of and rows_of[name].dims and not fixed & set(rows_of[name].dims):
            dim = rows_of[name].dims[-1]
            found[dim] = (*(each for each in found.get(dim, ()) if each != label), label)
    return found


def _column(key: str, entry: MappedColumn, names: Names, mistakes: Mistakes) -> Column | None:
    """Return a column of the map with its variable; None and a mistake if there is no such variable."""
    name, dot, label = base_key(key).partition(".")
    row = names.rows.get(name)
    if row is None:
        mistakes.add(0, f"columns.{key}: unknown variable; {nearest(name, names.rows)}")
        return None
    dim = names.component_dim(row)
    labels = names.labels[dim] if dim else ()
    if (dim is None) == bool(dot) or (dot and label not in labels):
        expected = " ".join(f"columns.{name}.{each}" for each in labels) or f"columns.{name}"
        mistakes.add(0, f"columns.{key}: expected {expected}")
        return None
    unit = row.unit if is_date(entry.unit) and row.unit == "s" else entry.unit
    where = f"columns.{key}"
    freedom = label if dim == FREEDOM else ""
    if converted(np.ones(1), unit, row, f"{where}.unit", 0, mistakes, freedom) is None:
        return None
    offset = _quantity(entry.offset, row, f"{where}.offset", mistakes) if entry.offset else 0.0
    component = labels.index(label) if dot else None
    return Column(row, component, unit, entry.scale, offset, component is None or row.missing or not row.required)


def _quantity(text: str, row: Row, where: str, mistakes: Mistakes) -> float:
    """Return a difference with its unit in the unit of a variable."""
    number, _, unit = text.strip().partition(" ")
    try:
        zero, value = (float(convert(each, unit.strip(), row.unit or "1")) for each in (0.0, float(number)))
    except (DatasetError, ValueError):
        mistakes.add(0, f"{where}: expected a number and a unit of the kind of {row.unit or '1'}; found '{text}'")
        return 0.0
    return value - zero


def read_value(name: str, entry: MappedValue, table: Table, names: Names, found: Found, mistakes: Mistakes) -> None:
    """Read a variable whose value is in the map, or in the first lines of the log after a key that the map states."""
    row, where = names.rows.get(name), f"values.{name}"
    if row is None:
        mistakes.add(0, f"{where}: unknown variable; {nearest(name, names.rows)}")
        return
    stated = entry.value if not entry.key else _header_text(table, entry.key)
    if stated is None:
        mistakes.add(0, f"{where}: no line with '{entry.key}' and a value at the top of {table.path.name}")
        return
    where += f", '{entry.key}' in {table.path.name}" if entry.key else ""
    parsed = _numbers(stated, entry.unit)
    if parsed is None or parsed[0].ndim != len(row.dims):
        kind = f"an array with the dims ({', '.join(row.dims)})" if row.dims else "one number"
        mistakes.add(0, f"{where}: expected {kind}; found {stated!r}")
        return
    numbers, unit = parsed
    for dim, size in zip(row.dims, numbers.shape, strict=True):
        expected = names.sizes.get(dim, len(names.labels.get(dim, ())) or size)
        if size != expected:
            mistakes.add(0, f"{where}: expected {expected} along {dim}; found {size}")
            return
    inside = converted(numbers, unit, row, where, 0, mistakes)
    if inside is not None and plausible(inside.ravel(), np.zeros(inside.size, np.int64), row, where, unit, mistakes):
        values = unit_vectors(inside, row, np.zeros(1, np.int64), mistakes) if row.dims else inside
        found.variables[name] = xr.Variable(row.dims, values, units_of(row))


def _numbers(stated: Any, unit: str) -> tuple[Array, str] | None:
    """Return numbers and their unit from numbers, texts such as '5 mm', and arrays of them; None for other values."""
    units: set[str] = set()

    def number(value: Any) -> Any:
        if isinstance(value, list):
            return [number(each) for each in value]
        if isinstance(value, str):
            words = value.split()
            count = next((k for k, word in enumerate(words) if not NUMBER.fullmatch(word)), len(words))
            units.add(" ".join(words[count:]) or unit)
            figures = [float(word) for word in words[:count]]
            return figures[0] if len(figures) == 1 else figures
        units.add(unit)
        return None if isinstance(value, bool) else value

    try:
        values = np.array(number(stated), dtype=float)
    except (TypeError, ValueError):
        return None
    return (values, units.pop()) if len(units) == 1 and values.size and np.isfinite(values).all() else None


def _header_text(table: Table, key: str) -> str | None:
    """Return the text after a key in the lines above a table."""
    for line in table.above:
        match = re.fullmatch(rf"\W*{re.escape(key)}\"?\s*[:=;,\t ]\s*(.+)", line.strip())
        if match:
            text = match[1].strip('";, \t')
            return text.replace(",", ".") if table.form.decimal == "," else text
    return None


@dataclass(frozen=True)
class _Columns:
    """What is read of a table: cells, numbers of the columns with labels, and those of each key of the map."""

    cells: Cells
    keys: dict[str, int]
    columns: dict[str, list[int]]
    start: str
    notes: list[str]


def _columns(table: Table, settings: LogMap, mistakes: Mistakes) -> _Columns:
    """Return the required columns of a table with numbers and labels, its first date, and notes."""
    wanted: dict[str, Place] = {f"labels.{dim}": entry.column for dim, entry in settings.labels.items()}
    if settings.sequence is not None:
        wanted["sequence"] = settings.sequence
    wanted |= {f"columns.{key}": entry.column for key, entry in settings.columns.items()}
    subtracted = {key: entry.minus for key, entry in settings.columns.items() if entry.minus is not None}
    wanted |= {f"minus.{key}": place for key, place in subtracted.items()}
    places = places_of(table, wanted, mistakes)
    titles = {key: f"column '{table.titles[where[0]]}'" for key, where in places.items()}
    dated = {f"columns.{key}": entry.unit for key, entry in settings.columns.items() if is_date(entry.unit)}
    cells = [where for where in places if not where.startswith("labels") and where not in dated]
    values = table.numbers({places[where][0]: titles[where] for where in cells}, mistakes)
    clocks: dict[str, Clock] = {}
    notes = list(table.notes)
    numbers: dict[int, Array] = {}
    texts: dict[int, Sequence[str]] = {}
    keys: dict[str, int] = {}
    columns: dict[str, list[int]] = {}
    for k, (where, place) in enumerate(places.items()):
        if where.startswith("labels"):
            dim = where.partition(".")[2]
            keys[dim], names = k, settings.labels[dim].names
            texts[k] = [names.get(text, text) for text in table.texts(place)]
            continue
        if where in dated:
            numbers[k], clocks[where] = table.seconds(place, dated[where], titles[where], mistakes, repeats=True)
            if where == "columns.time" and not settings.labels:
                numbers[k], equal = spread(numbers[k])
                notes += equal
        else:
            numbers[k] = values[place[0]]
        if where.startswith("columns"):
            if minus := places.get(f"minus.{where.partition('.')[2]}"):
                numbers[k] = numbers[k] - values[minus[0]]
            key = where.partition(".")[2]
            if where not in dated:
                numbers[k] = _in_one_unit(key, numbers[k], settings, mistakes)
            columns.setdefault(base_key(key), []).append(k)
    heads = [table.titles[where[0]] for where in places.values()]
    if settings.sequence is not None and not mistakes.count:
        positions = numbers[list(places).index("sequence")]
        for dim, found in zip(("run", "approach", "target"), passes(positions, table.lines, mistakes), strict=True):
            keys[dim] = len(heads)
            texts[len(heads)] = found
            heads.append(dim)
    start = next((clock.start.isoformat() for clock in clocks.values() if clock.start), "")
    notes += [note for clock in clocks.values() for note in clock_notes(clock)]
    if "time" in columns and not mistakes.count:
        unit = "s" if "columns.time" in clocks else settings.columns["time"].unit
        notes += holes(np.asarray(convert(numbers[columns["time"][0]], unit, "s"), dtype=float), table.lines)
    return _Columns(Cells((table.head, heads), table.lines, texts, numbers), keys, columns, start, notes)


def _in_one_unit(key: str, numbers: Array, settings: LogMap, mistakes: Mistakes) -> Array:
    """Return the numbers of a column in the unit of the last one of its variable, with which all of them are read."""
    own, last = settings.columns[key], settings.entries[base_key(key)][-1]
    if own.unit == last.unit:
        return numbers
    try:
        return np.asarray(convert(numbers, own.unit, last.unit), dtype=float)
    except DatasetError:
        mistakes.add(0, f"columns.{key}.unit: expected a unit of the kind of {last.unit}; found '{own.unit}'")
        return numbers


def _missing_rows(table: Cells, keys: Mapping[str, int]) -> list[str]:
    """Return the note on combinations of labels for which the log has no row."""
    texts = [table.texts[number] for number in keys.values()]
    labels = [list(dict.fromkeys(column)) for column in texts]
    there = set(zip(*texts, strict=True))
    lacking = math.prod(map(len, labels)) - len(there) if keys else 0
    if not lacking:
        return []
    first = next(each for each in itertools.product(*labels) if each not in there)
    where = ", ".join(f"{dim} '{label}'" for dim, label in zip(keys, first, strict=True))
    number = "1 combination" if lacking == 1 else f"{lacking} combinations"
    return [f"no row for {number} of the labels, whose values are NaN; the first is {where}"]


def _parts(
    read: _Columns, columns: Mapping[str, Column], settings: LogMap, names: Names, mistakes: Mistakes
) -> Iterator[tuple[Cells, dict[int, Column], dict[str, int]]]:
    """Yield the table once for each set of dimensions, with the columns of its variables and the label columns.

    Variables with fewer dimensions than others have repeated values; one line of each is kept. Variables with several
    columns have a table of their own, with a row for each reading.
    """
    table, keys = read.cells, read.keys
    groups: dict[tuple[str, ...], dict[int, Column]] = {}
    used: set[str] = set()
    for key, numbers in read.columns.items():
        record = names.record_dims(columns[key].row)
        used |= set(record)
        entries = settings.entries[key]
        if not entries[0].labels:
            groups.setdefault(record, {})[numbers[0]] = columns[key]
            continue
        labels = [{dim: str(label) for dim, label in entry.labels.items()} for entry in entries]
        own = {dim: number for dim, number in keys.items() if dim in record}
        width = len(table.head[1])
        further = {dim: width + k for k, dim in enumerate(labels[0])}
        yield tall(table, own, numbers, labels), {width + len(further): columns[key]}, own | further
    widest = max(groups, key=len, default=())
    several = len(groups) < len(read.columns) and any(settings.entries[key][0].labels for key in read.columns)
    for record, group in groups.items():
        own = {dim: number for dim, number in keys.items() if dim in record}
        repeats = (record != widest or several) and set(record) <= set(keys) and bool(record)
        part = _without_repetition(table, list(own.values()), list(group), mistakes) if repeats else table
        yield part, group, own
    for dim in set(keys) - used:
        mistakes.add(0, f"labels.{dim}: no variable of the map has this dimension")


def _without_repetition(table: Cells, keys: Sequence[int], values: Sequence[int], mistakes: Mistakes) -> Cells:
    """Return the first line for each combination of labels; other values in a later line are mistakes."""
    first: dict[tuple[str, ...], int] = {}
    labels = zip(*(table.texts[number] for number in keys), strict=True)
    before = np.array([first.setdefault(label, k) for k, label in enumerate(labels)], dtype=np.int64)
    for number in values:
        column = table.numbers[number]
        for k in np.flatnonzero((column != column[before]) & ~(np.isnan(column) & np.isnan(column[before]))):
            title, at = table.head[1][number], before[k]
            expected, found = ("nothing" if np.isnan(x) else f"{x:.9g}" for x in (column[at], column[k]))
            mistakes.add(
                int(table.lines[k]),
                f"column '{title}': expected {expected} as in line {table.lines[at]}, which has "
                f"the same labels; found {found}",
                f"column '{title}': other values with the same labels",
            )
    kept = np.array(list(first.values()), dtype=np.int64)
    texts = {k: [column[at] for at in kept] for k, column in table.texts.items()}
    return Cells(table.head, table.lines[kept], texts, {k: column[kept] for k, column in table.numbers.items()})
