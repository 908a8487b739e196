"""Reading of files with a map ``errormotion.map/2``."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from datetime import datetime
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
import xarray as xr

from errormotion.datasets.files.tomlfile import load_model
from errormotion.datasets.maps.form import MapFile, MapTable
from errormotion.datasets.maps.units import fitting_unit, is_unclear, orders, stated_unit
from errormotion.datasets.schemas import Row, variants
from errormotion.datasets.tables.dates import is_date
from errormotion.datasets.tables.mistakes import Mistakes
from errormotion.datasets.tables.numbers import NUMERIC
from errormotion.datasets.tables.reading import read_table
from errormotion.datasets.tables.table import Table, same
from errormotion.datasets.text.log_import import checked_columns, finished, names_of, read_part, read_values
from errormotion.datasets.text.log_map import LogMap, MappedColumn, base_key
from errormotion.datasets.text.table_reader import FREEDOM, Found
from errormotion.errors import DatasetError


def read_map(paths: Sequence[Path], map_file: Path) -> xr.Dataset:
    """Return the raw dataset of files with a map ``errormotion.map/2``.

    Raises
    ------
    DatasetError
        The map or a file is wrong; all mistakes of each are reported together.
    """
    settings = load_model(map_file, MapFile)
    files = assigned(settings, paths, map_file)
    tables = [read_table(path, part.format) for part, path in zip(settings.parts, files, strict=True)]
    return dataset_of(settings, tables, map_file)


def dataset_of(settings: MapFile, tables: Sequence[Table], map_file: Path) -> xr.Dataset:
    """Return the raw dataset of the tables of a map, one for each of its parts."""
    mistakes = Mistakes(map_file)
    maps = [_log_map(settings, part, table, mistakes) for part, table in zip(settings.parts, tables, strict=True)]
    for part, table in zip(settings.parts, tables, strict=True):
        for key, entry in part.columns.items():
            _check_difference(key, entry, table, mistakes)
    mistakes.raise_any()
    names = names_of(maps, mistakes)
    columns = [checked_columns(each, names, mistakes) for each in maps]
    mistakes.raise_any()
    found = Found()
    read_values(maps[0], tables[0], names, found, mistakes)
    mistakes.raise_any()
    start, notes = "", list[str]()
    for table, each, known in zip(tables, maps, columns, strict=True):
        if "time" in each.columns and "time" in found.variables:
            own = Found()
            began, further = read_part(table, each, known, names, own)
            further += _interpolated(own, began, found, start, table)
        else:
            began, further = read_part(table, each, known, names, found)
            start = start or began
        notes += further
    return finished(maps[0], names, found, start, notes)


def assigned(settings: MapFile, paths: Sequence[Path], map_file: Path) -> list[Path]:
    """Return the file of each part of a map: by its pattern, else in their order, else the only one.

    Raises
    ------
    DatasetError
        A part has no file, or a file no part.
    """
    mistakes = Mistakes(map_file)
    parts = settings.parts
    rest = list(paths)
    chosen: dict[int, Path] = {}
    for k, part in enumerate(parts):
        if not part.file:
            continue
        matching = [path for path in paths if fnmatch(path.name.lower(), part.file.lower())]
        where = f"tables[{k - 1}].file" if k else "file"
        if len(matching) != 1:
            names = ", ".join(f"'{path.name}'" for path in matching or paths)
            mistakes.add(0, f"{where}: expected one file with a name like '{part.file}'; found {names}")
            continue
        chosen[k] = matching[0]
        rest = [path for path in rest if path != matching[0]]
    for k in range(len(parts)):
        if k not in chosen and len(paths) == 1:
            chosen[k] = paths[0]
            rest = []
        elif k not in chosen and rest:
            chosen[k] = rest.pop(0)
    mistakes.raise_any()
    if len(chosen) < len(parts) or rest:
        raise DatasetError(
            f"{map_file}: expected {len(parts)} files, one for each table of the map; found {len(paths)}",
            code="map.files",
        )
    return [chosen[k] for k in range(len(parts))]


def kind_of(tables: Sequence[Table]) -> str:
    """Return the identity of the columns and units of tables; empty if one has no names of columns."""
    if any(table.form.header is False for table in tables):
        return ""
    content = sorted([*map(same, table.titles), "", *map(same, table.units)] for table in tables)
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:16]


def _log_map(settings: MapFile, part: MapTable, table: Table, mistakes: Mistakes) -> LogMap:
    """Return a part of a map with the units of its table, which are stated in the file, by the map, or are dates."""
    rows = {row.name: row for raw in reversed(variants(settings.raw)) for row in (*raw.stated, *raw.rows)}
    labelled = _labelled(part, rows)
    columns = {
        key: entry.model_copy(update={"unit": _unit(key, entry, part, table, rows, labelled, mistakes)})
        for key, entry in part.columns.items()
    }
    return LogMap.model_construct(
        schema_=settings.raw,
        variant=settings.variant,
        format=part.format,
        machine=settings.machine,
        attributes=settings.attributes,
        labels=part.labels,
        sequence=part.sequence,
        columns=columns,
        values=settings.values,
    )


def _labelled(part: MapTable, rows: Mapping[str, Row]) -> set[str]:
    """Return the variables whose component is a freedom."""
    names = {base_key(key).partition(".")[0] for key in part.columns}
    return {name for name in names if name in rows and FREEDOM in rows[name].dims}


def _unit(
    key: str,
    entry: MappedColumn,
    part: MapTable,
    table: Table,
    rows: Mapping[str, Row],
    labelled: set[str],
    mistakes: Mistakes,
) -> str:
    base = base_key(key)
    name, _, label = base.partition(".")
    row = rows.get(name)
    freedom = label if name in labelled else ""
    stated = entry.unit or _of_map(key, part, table, row, freedom, mistakes)
    if row is None:
        return stated
    if stated:
        return stated if is_date(stated) else fitting_unit(stated, row, freedom) or stated
    places = entry.column if isinstance(entry.column, list) else [entry.column]
    before = mistakes.count
    where = [table.place(place, f"columns.{key}", mistakes) for place in places]
    if mistakes.count > before:
        return row.unit
    if row.unit == "s":
        found = date_units(table, where)
        if len(found) == 1:
            return found[0]
        if found:
            shown = next(text for text in table.texts(where) if text)
            mistakes.add(
                0,
                f"units.{base}: the order of dates such as '{shown}' in {table.path.name} is not known; expected "
                f"{' or '.join(repr(each) for each in found)}; found none",
            )
            return row.unit
    unit = stated_unit(table, where[0])
    if not unit or is_unclear(unit):
        if row.unit in ("", "1") and not row.units:
            return ""
        goals = " or ".join(row.units or (row.unit,))
        mistakes.add(
            0,
            f"units.{base}: {table.path.name} states no unit for column '{table.titles[where[0]]}'; expected a unit of "
            f"the kind of {goals}; found {repr(unit) if unit else 'none'}",
        )
        return row.unit
    return fitting_unit(unit, row, freedom) or unit


def _of_map(key: str, part: MapTable, table: Table, row: Row | None, freedom: str, mistakes: Mistakes) -> str:
    """Return the unit of a column by ``units`` of a map; empty for a column whose unit the file states.

    Another unit than that of the file is a mistake if ``units`` serves no column without one.
    """
    base = base_key(key)
    name = base if base in part.units else base.partition(".")[0]
    stated = part.units.get(name, "")
    if not stated or row is None or is_date(stated):
        return stated
    own = _of_file(key, part, table, row, freedom)
    if not own or own == fitting_unit(stated, row, freedom):
        return stated
    served = [each for each in part.columns if base_key(each) == name or base_key(each).partition(".")[0] == name]
    if all(_of_file(each, part, table, row, freedom) for each in served):
        mistakes.add(
            0, f"units.{name}: {table.path.name} states the unit {own}; expected no other one; found '{stated}'"
        )
    return ""


def _of_file(key: str, part: MapTable, table: Table, row: Row, freedom: str) -> str:
    """Return the unit that a file states for a column, if it is one of the variable; else empty."""
    place = part.columns[key].column
    before = Mistakes(table.path)
    where = table.place(place[0] if isinstance(place, list) else place, key, before)
    return "" if before.count else fitting_unit(stated_unit(table, where), row, freedom)


def _check_difference(key: str, entry: MappedColumn, table: Table, mistakes: Mistakes) -> None:
    """Add a mistake if a column and the one that is subtracted have different units in the file."""
    if entry.minus is None or isinstance(entry.column, list):
        return
    before = mistakes.count
    places = [table.place(each, f"columns.{key}", mistakes) for each in (entry.column, entry.minus)]
    own, other = (stated_unit(table, place) for place in places)
    if mistakes.count == before and own != other:
        mistakes.add(0, f"columns.{key}.minus: expected a column in {own or 'no unit'}; found {other or 'no unit'}")


def date_units(table: Table, columns: Sequence[int]) -> list[str]:
    """Return the units with which a column, or two, can be read as dates; empty for numbers."""
    texts = table.texts(columns)
    first = next((text for text in texts if text), "")
    return [] if not first or NUMERIC.fullmatch(first) else orders(texts)


def _interpolated(own: Found, began: str, found: Found, start: str, table: Table) -> list[str]:
    """Add the variables of another file to those of the readings, at the times of the readings; return a note.

    They are linear between the times of the file. Values beyond the times of the file are NaN.

    Raises
    ------
    DatasetError
        One of the files has dates and the other has not.
    """
    if bool(began) != bool(start) or (began and _aware(began) != _aware(start)):
        raise DatasetError(
            f"{table.path}: expected times that can be compared with those of the readings: dates in both files, or "
            f"seconds since one beginning in both; found {began or 'no dates'} beside {start or 'no dates'}",
            code="map.times",
        )
    shift = (datetime.fromisoformat(began) - datetime.fromisoformat(start)).total_seconds() if began else 0.0
    t = np.asarray(own.variables.pop("time").values, dtype=float) + shift
    at = np.asarray(found.variables["time"].values, dtype=float)
    if t.size < 2 or not (np.diff(t) > 0).all():
        raise DatasetError(f"{table.path}: expected times that increase, in at least two rows", code="map.times")
    left = np.clip(np.searchsorted(t, at, side="right") - 1, 0, t.size - 2)
    weight = (at - t[left]) / (t[left + 1] - t[left])
    inside = (weight >= 0) & (weight <= 1)
    for name, variable in own.variables.items():
        if "time" not in variable.dims:
            found.variables[name] = variable
            continue
        values = np.moveaxis(np.asarray(variable.values, dtype=float), variable.dims.index("time"), -1)
        low, high = values[..., left], values[..., left + 1]
        # at an instant of the file its own value, whatever is beside it
        between = np.where(weight == 0, low, np.where(weight == 1, high, (1 - weight) * low + weight * high))
        between = np.where(inside, between, np.nan)
        moved = np.moveaxis(between, -1, variable.dims.index("time"))
        found.variables[name] = xr.Variable(variable.dims, moved, variable.attrs)
        found.missing[name] = int(np.isnan(moved).sum())
    outside = int((~inside).sum())
    beyond = f"; {outside} of them are beyond its times, where the values are unknown" if outside else ""
    names = ", ".join(own.variables)
    return [f"{names} of {table.path.name} interpolated to the times of the readings{beyond}"]


def _aware(text: str) -> bool:
    return datetime.fromisoformat(text).tzinfo is not None
