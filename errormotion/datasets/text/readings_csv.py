"""Readings in a text file: a short header and tables with units become a raw dataset.

The names are those of the raw schema, so that every schema can be written like this::

    # schema = errormotion.raw.NAME/1
    # nominal_direction = 0.342 0 0.940
    # distance_noise = 0.1 um
    plane,distance [mm],stage_x [mm],stage_y [mm],stage_z [mm]
    1,-2.004,100.000,50.000,20.000
    1,-1.508,101.000,50.000,20.000
    2,...

A line ``# key = value unit`` holds one value, or the few values of a vector separated by blanks; other lines that start
with ``#`` are remarks. A column holds one variable, with its unit in brackets; the name of a component of a vector ends
with the component (``stage_x [mm]``). A column without a unit is the number or name of an element of a dimension, such
as a plane or a channel; the last dimension, here the readings of a plane, needs no column. An empty line starts another
table, with its own names.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.datasets.schemas import Row, raw_schemas, variants
from errormotion.datasets.text.csv_text import Table, blocks
from errormotion.datasets.text.log_reader import Complaints
from errormotion.datasets.tomlfile import nearest
from errormotion.datasets.units import convert
from errormotion.datasets.validation import violations
from errormotion.errors import DatasetError

TEXTS = ("schema", "machine", "sensor", "source", "title", "start")
"""Keys of the header that are kept as attributes."""

_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_COLUMN = re.compile(r"([^\W\d]\w*)\s*(?:\[([^\]]*)\])?")
_EMPTY = ("", "NaN", "nan")


def read_csv(path: str | Path) -> xr.Dataset:
    """Read a raw dataset from text.

    Parameters
    ----------
    path : str or Path
        UTF-8 text; fields are separated by comma, semicolon or tabulator, the decimal sign is a point.

    Returns
    -------
    Dataset
        Of the schema that the header names, in SI. Empty cells are NaN, and counted in the attribute
        ``missing_values`` (JSON, variable to count); so are the places that fill short rows up, uncounted.

    Raises
    ------
    DatasetError
        The file cannot be read, or breaks its schema: every mistake with line, column, what was expected and what
        came.
    """
    path = Path(path)
    header, tables = blocks(path)
    complaints = Complaints(path)
    if "schema" not in header:
        known = ", ".join(sorted({raw.id for raw in raw_schemas()}))
        raise DatasetError(
            f"{path}: expected a line '# schema = ...' that names one of {known}; found none. "
            "Logs of other software come in by 'errormotion import'."
        )
    line, schema = header["schema"]
    names = _Names.of(schema)
    if names is None:
        raise DatasetError(
            f"{path}, line {line}: schema '{schema}' is not known; {nearest(schema, {raw.id for raw in raw_schemas()})}"
        )
    found = _Found()
    for key, (line, text) in header.items():
        if key not in TEXTS:
            _value(key, line, text, names, found, complaints)
    for table in tables:
        _read_table(table, names, found, complaints)
    complaints.raise_any()
    attrs = {key: text for key, (_, text) in header.items() if key in TEXTS}
    raw = found.dataset(attrs, names)
    broken = violations(raw)
    if broken:
        raise DatasetError(f"{path}: breaks {schema}:", broken)
    return raw


@dataclass(frozen=True)
class _Names:
    """What a schema calls its variables and the labels of its dimensions."""

    rows: Mapping[str, Row]
    labels: Mapping[str, tuple[str, ...]]
    sizes: Mapping[str, int]
    aliases: Mapping[str, str]

    @classmethod
    def of(cls, schema: str) -> _Names | None:
        """Return the names of all variants of a schema; None if it is unknown."""
        known = variants(schema)
        if not known:
            return None
        rows = {row.name: row for raw in reversed(known) for row in raw.rows}
        labels = {dim: found for raw in known for dim, found in raw.labels.items()}
        sizes = {dim: size for raw in known for dim, size in raw.sizes.items()}
        return cls(rows, labels, sizes, {short: name for raw in known for short, name in raw.aliases.items()})

    def columns(self) -> dict[str, tuple[Row, int | None]]:
        """Return every possible column: its variable, and which component it is (None for a whole)."""
        found: dict[str, tuple[Row, int | None]] = {}
        for row in self.rows.values():
            dim = self.component_dim(row)
            if dim is None:
                found[row.name] = (row, None)
            else:
                found |= {f"{row.name}_{label}": (row, k) for k, label in enumerate(self.labels[dim])}
        short = {short: found[name] for short, name in self.aliases.items() if name in found}
        return short | found

    def component_dim(self, row: Row) -> str | None:
        """Return the dimension of a variable that stands side by side in columns."""
        return next((dim for dim in reversed(row.dims) if dim in self.labels), None)

    def record_dims(self, row: Row) -> tuple[str, ...]:
        """Return the dimensions of a variable that stand below one another."""
        return tuple(dim for dim in row.dims if dim != self.component_dim(row))


@dataclass
class _Found:
    """Variables and labels of dimensions, as they come."""

    variables: dict[str, xr.Variable] = field(default_factory=dict)
    labels: dict[str, list[str]] = field(default_factory=dict)
    places: dict[str, int] = field(default_factory=dict)
    sizes: dict[str, tuple[int, int]] = field(default_factory=dict)
    missing: dict[str, int] = field(default_factory=dict)

    def dataset(self, attrs: Mapping[str, str], names: _Names) -> xr.Dataset:
        """Return everything as one dataset."""
        coords: dict[str, object] = {
            dim: list(labels)
            for dim, labels in names.labels.items()
            if any(dim in variable.dims for variable in self.variables.values())
        }
        coords |= {dim: _whole_numbers(labels) for dim, labels in self.labels.items() if dim not in names.labels}
        missing = {name: count for name, count in self.missing.items() if count}
        return xr.Dataset(self.variables, coords, {**attrs, "missing_values": json.dumps(missing)})


def _whole_numbers(labels: list[str]) -> list[int] | list[str]:
    return [int(label) for label in labels] if all(re.fullmatch("-?[0-9]{1,9}", label) for label in labels) else labels


def _value(key: str, line: int, text: str, names: _Names, found: _Found, complaints: Complaints) -> None:
    """Read one line of the header."""
    row = names.rows.get(key)
    if row is None:
        known = [*TEXTS, *(row.name for row in names.rows.values() if len(row.dims) < 2)]
        complaints.add(line, f"{key}: unknown key; {nearest(key, known)}. (A remark has no '=' behind its first word)")
        return
    if len(row.dims) > 1:
        complaints.add(line, f"{key}: expected in a table, because it has dims ({', '.join(row.dims)}); found a value")
        return
    words = text.split()
    count = next((k for k, word in enumerate(words) if not _NUMBER.fullmatch(word)), len(words))
    numbers, unit = [float(word) for word in words[:count]], " ".join(words[count:])
    length = names.sizes.get(row.dims[0], len(names.labels.get(row.dims[0], ()))) if row.dims else 1
    if not numbers or (length and len(numbers) != length):
        many = "one number" if length == 1 else f"{length} numbers" if length else "numbers"
        comma = " (the decimal sign is a point; blanks separate numbers)" if "," in text else ""
        complaints.add(line, f"{key}: expected {many}{_in(row)}; found '{text}'{comma}")
        return
    inside = _converted(np.array(numbers), unit, row, f"{key}", line, complaints)
    if inside is not None and _plausible(inside, np.full(len(inside), line), row, key, unit, complaints):
        values = _unit_vectors(inside, row, np.array([line]), complaints) if row.dims else inside[0]
        found.variables[key] = xr.Variable(row.dims, values, _units(row))


def _in(row: Row) -> str:
    return f" and a unit such as {row.unit}" if row.unit not in ("", "1") else ""


def _units(row: Row) -> dict[str, str]:
    return {"units": row.unit} if row.unit else {}


def _converted(values: Array, unit: str, row: Row, place: str, line: int, complaints: Complaints) -> Array | None:
    """Return values in the schema's unit, or None and a complaint."""
    if row.unit in ("", "1") and unit in ("", "1"):
        return values
    if not unit:
        complaints.add(line, f"{place}: expected a unit, such as {row.unit}; found none")
        return None
    try:
        return np.asarray(convert(values, unit, row.unit or "1"), dtype=float)
    except DatasetError as error:
        complaints.add(line, f"{place}: expected a unit of the kind of {row.unit or '1'}; found '{unit}': {error}")
        return None


def _plausible(
    inside: Array,
    lines: NDArray[np.int64],
    row: Row,
    place: str,
    unit: str,
    complaints: Complaints,
) -> bool:
    outside = np.flatnonzero((inside < row.low) | (inside > row.high))
    if outside.size:
        first = outside[0]
        complaints.add(
            int(lines[first]),
            f"{place}: makes {row.name} = {inside[first]:.6g} {row.unit}; expected {row.low:g}..{row.high:g} "
            f"{row.unit}. Is the unit '{unit}' right? ({outside.size} such values)",
        )
    return not outside.size


def _unit_vectors(values: Array, row: Row, lines: NDArray[np.int64], complaints: Complaints) -> Array:
    """Return directions of length 1: four digits, as people write them, leave them a little long or short."""
    if row.unit != "1" or row.dims[-1] != "direction":
        return values
    norms = np.linalg.norm(values, axis=-1)
    wrong = np.flatnonzero(~(np.abs(norms - 1) <= 0.01) & ~np.isnan(norms))
    if wrong.size:
        complaints.add(
            int(lines.flat[0]), f"{row.name}: expected a vector of length 1; found {norms.flat[wrong[0]]:.4g}"
        )
        return values
    directions: Array = values / norms[..., None]
    return directions


def _read_table(table: Table, names: _Names, found: _Found, complaints: Complaints) -> None:
    """Read one table into ``found``."""
    line, titles = table.head
    before = complaints.count
    columns, keys = _columns(table, names, found, complaints)
    if complaints.count > before or not columns:
        return
    record = names.record_dims(next(iter(columns.values()))[0])
    cells = _cells(table, columns, titles, complaints)
    places = _places(table, record, keys, names, found, complaints)
    if complaints.count > before:
        return
    lines = np.array([number for number, _ in table.rows])
    shape = tuple(found.sizes[dim][0] for dim in record)
    arrays: dict[str, Array] = {}
    for place, (row, component, unit) in columns.items():
        inside = _converted(cells[place], unit, row, f"column '{titles[place]}'", line, complaints)
        if inside is None or not _plausible(inside, lines, row, f"column '{titles[place]}'", unit, complaints):
            continue
        if component is None:
            arrays[row.name] = _filled(shape, places, inside)
            found.missing[row.name] = int(np.isnan(inside).sum())
        else:
            side = len(names.labels[str(names.component_dim(row))])
            array = arrays.setdefault(row.name, np.full((*shape, side), np.nan))
            array[..., component] = _filled(shape, places, inside)
    for name, array in arrays.items():
        row = names.rows[name]
        side_by_side = names.component_dim(row)
        dims = (*record, side_by_side) if side_by_side else record
        array = _unit_vectors(array, row, lines, complaints)
        found.variables[name] = xr.Variable(dims, array, _units(row)).transpose(*row.dims)


def _filled(shape: tuple[int, ...], places: tuple[NDArray[np.int64], ...], inside: Array) -> Array:
    array = np.full(shape, np.nan)
    array[places] = inside
    return array


def _columns(
    table: Table, names: _Names, found: _Found, complaints: Complaints
) -> tuple[dict[int, tuple[Row, int | None, str]], dict[str, int]]:
    """Return variable, component and unit of each column by its place, and the places of the key columns by dimension.

    Complains of unknown and doubled names, missing units and components, and variables that do not go together.
    """
    line, titles = table.head
    known = names.columns()
    dims = {dim for row in names.rows.values() for dim in names.record_dims(row)}
    columns: dict[int, tuple[Row, int | None, str]] = {}
    keys: dict[str, int] = {}
    seen: dict[str, int] = {}
    for place, title in enumerate(titles):
        match = _COLUMN.fullmatch(title)
        told = f"column {place + 1} '{title}'"
        if match is None:
            complaints.add(line, f"{told}: expected a name and its unit in brackets, such as 'distance [mm]'")
            continue
        name, unit = match[1], (match[2] or "").strip()
        variable = known.get(name)
        own = f"{variable[0].name} {variable[1]}" if variable else name
        if own in seen:
            complaints.add(line, f"{told}: comes again; column {seen[own] + 1} is '{titles[seen[own]]}'")
        elif variable is not None and (match[2] is not None or name not in dims or name in names.aliases):
            if match[2] is None or (not unit and variable[0].unit):
                example = f"{name} [{variable[0].unit or '1'}]"
                complaints.add(line, f"{told}: expected its unit in brackets, such as '{example}'; found none")
            elif variable[0].name in found.variables:
                complaints.add(line, f"{told}: {variable[0].name} stands further up already")
            columns[place] = (*variable, unit)
        elif name in dims and match[2] is None:
            keys[name] = place
        else:
            complaints.add(line, f"{told}: unknown column; {nearest(name, [*known, *dims])}")
        seen.setdefault(own, place)
    complaints_of_kind = _incomplete(columns, keys, names)
    for text in complaints_of_kind:
        complaints.add(line, text)
    return columns, keys


def _incomplete(
    columns: Mapping[int, tuple[Row, int | None, str]], keys: Mapping[str, int], names: _Names
) -> Iterator[str]:
    """Yield what a table lacks as a whole."""
    if not columns:
        yield "expected the names of columns, such as 'distance [mm]'; found none"
        return
    rows = {row.name: row for row, _, _ in columns.values()}
    for row in rows.values():
        dim = names.component_dim(row)
        there = {component for other, component, _ in columns.values() if other is row}
        lacking = [f"{row.name}_{label}" for k, label in enumerate(names.labels[dim]) if k not in there] if dim else []
        if lacking:
            yield f"{row.name}: expected all its components; missing {', '.join(lacking)}"
    records = {names.record_dims(row): row.name for row in reversed(rows.values())}
    if len(records) > 1:
        kinds = " and ".join(f"{name} ({', '.join(dims) or 'one value'})" for dims, name in reversed(records.items()))
        yield f"expected variables of one kind in a table; found {kinds}. Put an empty line and a table between them"
        return
    (record,) = records
    if not record:
        name = next(iter(rows))
        yield f"{name}: expected in the header, as '# {name} = ...'; found a column"
        return
    yield from (f"expected a column '{dim}' (number or name, without unit)" for dim in record[:-1] if dim not in keys)
    yield from (f"column '{dim}': no variable of this table has it" for dim in keys if dim not in record)


def _cells(
    table: Table, columns: Mapping[int, tuple[Row, int | None, str]], titles: list[str], complaints: Complaints
) -> dict[int, Array]:
    """Return the numbers of each column; complains of every cell that is none."""
    if not table.rows:
        complaints.add(table.head[0], "expected lines of numbers below the column names; found none")
    found = {place: np.full(len(table.rows), np.nan) for place in columns}
    for k, (line, texts) in enumerate(table.rows):
        if len(texts) != len(titles):
            comma = " (the decimal sign is a point)" if len(texts) > len(titles) else ""
            complaints.add(line, f"expected {len(titles)} fields; found {len(texts)}{comma}")
            continue
        for place, (_, component, _) in columns.items():
            text, told = texts[place], f"column '{titles[place]}'"
            if text in _EMPTY and component is None:
                continue
            if not _NUMBER.fullmatch(text) or not np.isfinite(float(text)):
                comma = " (the decimal sign is a point)" if "," in text else ""
                came = f"'{text}'" if text else "nothing"
                complaints.add(line, f"{told}: expected a number; found {came}{comma}")
                continue
            found[place][k] = float(text)
    return found


def _places(
    table: Table,
    record: tuple[str, ...],
    keys: Mapping[str, int],
    names: _Names,
    found: _Found,
    complaints: Complaints,
) -> tuple[NDArray[np.int64], ...]:
    """Return where each line belongs along each dimension of the table."""
    places = np.zeros((len(record), len(table.rows)), dtype=int)
    counts: dict[tuple[int, ...], int] = {}
    seen: dict[tuple[int, ...], int] = {}
    settled = set(found.labels)
    for k, (line, texts) in enumerate(table.rows):
        if len(texts) != len(table.head[1]):
            continue  # told already
        for axis, dim in enumerate(record):
            if dim in keys:
                places[axis, k] = _label(texts[keys[dim]], dim, dim in settled, line, names, found, complaints)
            else:
                leading = tuple(places[:axis, k])
                places[axis, k] = counts[leading] = counts.get(leading, -1) + 1
        place = tuple(places[:, k])
        if place in seen:
            told = ", ".join(f"{dim} '{texts[keys[dim]]}'" for dim in record)
            complaints.add(line, f"{told}: comes again; line {seen[place]} has it already")
        seen.setdefault(place, line)
    for axis, dim in enumerate(record):
        size = len(found.labels[dim]) if dim in keys else int(places[axis].max(initial=-1)) + 1
        known, where = found.sizes.setdefault(dim, (size, table.head[0]))
        if size != known:
            complaints.add(
                table.head[0], f"expected {known} along {dim}, as in the table of line {where}; found {size}"
            )
    return tuple(places)


def _label(text: str, dim: str, settled: bool, line: int, names: _Names, found: _Found, complaints: Complaints) -> int:
    """Return the place of a label along its dimension; a new one is added unless another table settled them all."""
    labels = found.labels.setdefault(dim, list(names.labels.get(dim, ())))
    if text in labels:
        return labels.index(text)
    if not text:
        complaints.add(line, f"column '{dim}': expected a number or name; found nothing")
    elif settled or dim in names.labels:
        complaints.add(line, f"column '{dim}': expected one of {', '.join(labels)}; found '{text}'")
    labels.append(text)
    return len(labels) - 1
