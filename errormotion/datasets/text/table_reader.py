"""Conversion of tables of text with variables of a raw schema to arrays in the units of the schema."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.datasets.schemas import RawSchema, Row
from errormotion.datasets.text.csv_text import NUMBER, Table
from errormotion.datasets.text.mistakes import Mistakes
from errormotion.datasets.units import convert
from errormotion.errors import DatasetError

_EMPTY = ("", "NaN", "nan")


@dataclass(frozen=True)
class Names:
    """Variables of a schema, and labels and sizes of its dimensions."""

    rows: Mapping[str, Row]
    labels: Mapping[str, tuple[str, ...]]
    sizes: Mapping[str, int]
    aliases: Mapping[str, str]

    @classmethod
    def of(cls, tables: Sequence[RawSchema], labels: Mapping[str, tuple[str, ...]] | None = None) -> Names:
        """Return the names of the variants of a schema; of rows with the same name the first one is used.

        ``labels`` are further labels of dimensions.
        """
        rows = {row.name: row for raw in reversed(tables) for row in raw.rows}
        known = {dim: found for raw in tables for dim, found in raw.labels.items()}
        sizes = {dim: size for raw in tables for dim, size in raw.sizes.items()}
        aliases = {short: name for raw in tables for short, name in raw.aliases.items()}
        return cls(rows, {**(labels or {}), **known}, sizes, aliases)

    def columns(self) -> dict[str, tuple[Row, int | None]]:
        """Return every possible column: its variable, and its component (None for a scalar)."""
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
        """Return the dimension of a variable whose values are in adjacent columns."""
        return next((dim for dim in reversed(row.dims) if dim in self.labels), None)

    def record_dims(self, row: Row) -> tuple[str, ...]:
        """Return the dimensions of a variable whose values are in successive lines."""
        return tuple(dim for dim in row.dims if dim != self.component_dim(row))


@dataclass
class Found:
    """Variables and labels of dimensions that have been read."""

    variables: dict[str, xr.Variable] = field(default_factory=dict)
    labels: dict[str, list[str]] = field(default_factory=dict)
    places: dict[str, int] = field(default_factory=dict)
    sizes: dict[str, tuple[int, int]] = field(default_factory=dict)
    missing: dict[str, int] = field(default_factory=dict)

    def dataset(self, attrs: Mapping[str, str | float], names: Names) -> xr.Dataset:
        """Return the variables as one dataset."""
        coords: dict[str, object] = {
            dim: list(labels)
            for dim, labels in names.labels.items()
            if any(dim in variable.dims for variable in self.variables.values())
        }
        coords |= {
            dim: _whole_numbers(labels)
            for dim, labels in self.labels.items()
            if dim not in names.labels and dim not in self.variables
        }
        missing = {name: count for name, count in self.missing.items() if count}
        return xr.Dataset(self.variables, coords, {**attrs, "missing_values": json.dumps(missing)})


def _whole_numbers(labels: list[str]) -> list[int] | list[str]:
    return [int(label) for label in labels] if all(re.fullmatch("-?[0-9]{1,9}", label) for label in labels) else labels


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes
    ----------
    row : Row
        Its variable.
    component : int or None
        Index of the component of a vector.
    unit : str
        Unit of the cells.
    scale, offset : float
        Factor of a cell, and value in the unit of the schema that is added afterwards.
    may_be_empty : bool
        Whether a cell without a number is allowed; it is NaN.
    """

    row: Row
    component: int | None
    unit: str
    scale: float = 1.0
    offset: float = 0.0
    may_be_empty: bool = False


def units_of(row: Row) -> dict[str, str]:
    """Return the attribute ``units`` of a variable."""
    return {"units": row.unit} if row.unit else {}


def converted(values: Array, unit: str, row: Row, place: str, line: int, mistakes: Mistakes) -> Array | None:
    """Return values in the unit of the schema; None and a mistake if that is not possible."""
    if row.unit in ("", "1") and unit in ("", "1"):
        return values
    if not unit:
        mistakes.add(line, f"{place}: expected a unit, such as {row.unit}; found none")
        return None
    inside = row.units or (row.unit or "1",)
    reasons = []
    for goal in inside:
        try:
            return np.asarray(convert(values, unit, goal), dtype=float)
        except DatasetError as error:
            reasons.append(str(error))
    mistakes.add(line, f"{place}: expected a unit of the kind of {' or '.join(inside)}; found '{unit}': {reasons[0]}")
    return None


def plausible(
    inside: Array,
    lines: NDArray[np.int64],
    row: Row,
    place: str,
    unit: str,
    mistakes: Mistakes,
) -> bool:
    """Return whether all values are within the plausible range; if not, add a mistake at the first such line."""
    outside = np.flatnonzero((inside < row.low) | (inside > row.high))
    if outside.size:
        first = outside[0]
        mistakes.add(
            int(lines[first]),
            f"{place}: makes {row.name} = {inside[first]:.6g} {row.unit}; expected {row.low:g}..{row.high:g} "
            f"{row.unit}. Is the unit '{unit}' right? ({outside.size} such values)",
        )
    return not outside.size


def unit_vectors(values: Array, row: Row, lines: NDArray[np.int64], mistakes: Mistakes) -> Array:
    """Return directions normalised to length 1; rounding in the file changes their length slightly."""
    if row.unit != "1" or row.dims[-1:] != ("direction",):
        return values
    norms = np.linalg.norm(values, axis=-1)
    wrong = np.flatnonzero(~(np.abs(norms - 1) <= 0.01) & ~np.isnan(norms))
    if wrong.size:
        mistakes.add(int(lines.flat[0]), f"{row.name}: expected a vector of length 1; found {norms.flat[wrong[0]]:.4g}")
        return values
    directions: Array = values / norms[..., None]
    return directions


def read_table(
    table: Table,
    columns: Mapping[int, Column],
    keys: Mapping[str, int],
    names: Names,
    found: Found,
    mistakes: Mistakes,
) -> None:
    """Read one table into ``found``.

    Parameters
    ----------
    table : Table
        Column titles and cells.
    columns : mapping of int to Column
        Variables by the number of their column, from 0.
    keys : mapping of str to int
        Number of the column with the labels of a dimension.
    names : Names
        Of the schema.
    found : Found
        Receives the variables.
    mistakes : Mistakes
        Receives every mistake, with its line.
    """
    line, titles = table.head
    before = mistakes.count
    record = names.record_dims(next(iter(columns.values())).row)
    cells = _cells(table, columns, titles, mistakes)
    places = _places(table, record, keys, names, found, mistakes)
    if mistakes.count > before:
        return
    lines = np.array([number for number, _ in table.rows])
    shape = tuple(found.sizes[dim][0] for dim in record)
    arrays: dict[str, Array] = {}
    for number, column in columns.items():
        row, component, title = column.row, column.component, f"column '{titles[number]}'"
        inside = converted(cells[number], column.unit, row, title, line, mistakes)
        if inside is None:
            continue
        with np.errstate(over="ignore"):  # infinite values are refused as implausible
            inside = inside * column.scale + column.offset
        if not plausible(inside, lines, row, title, column.unit, mistakes):
            continue
        found.missing[row.name] = found.missing.get(row.name, 0) + int(np.isnan(inside).sum())
        if component is None:
            arrays[row.name] = _filled(shape, places, inside)
        else:
            side = len(names.labels[str(names.component_dim(row))])
            array = arrays.setdefault(row.name, np.full((*shape, side), np.nan))
            array[..., component] = _filled(shape, places, inside)
    for name, array in arrays.items():
        row = names.rows[name]
        side_by_side = names.component_dim(row)
        dims = (*record, side_by_side) if side_by_side else record
        array = unit_vectors(array, row, lines, mistakes)
        found.variables[name] = xr.Variable(dims, array, units_of(row)).transpose(*row.dims)


def _filled(shape: tuple[int, ...], places: tuple[NDArray[np.int64], ...], inside: Array) -> Array:
    array = np.full(shape, np.nan)
    array[places] = inside
    return array


def incomplete(columns: Mapping[int, Column], keys: Mapping[str, int], names: Names) -> Iterator[str]:
    """Yield the mistakes of a table as a whole."""
    if not columns:
        yield "expected the names of columns, such as 'distance [mm]'; found none"
        return
    rows = {column.row.name: column.row for column in columns.values()}
    for row in rows.values():
        dim = names.component_dim(row)
        there = {column.component for column in columns.values() if column.row is row}
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
    yield from (f"column '{dim}': no variable of this table has this dimension" for dim in keys if dim not in record)


def _cells(table: Table, columns: Mapping[int, Column], titles: list[str], mistakes: Mistakes) -> dict[int, Array]:
    """Return the numbers of each column; every other cell is a mistake."""
    if not table.rows:
        mistakes.add(table.head[0], "expected lines of numbers below the column names; found none")
    found = {place: np.full(len(table.rows), np.nan) for place in columns}
    for k, (line, texts) in enumerate(table.rows):
        if len(texts) != len(titles):
            comma = " (the decimal sign is a point)" if len(texts) > len(titles) else ""
            mistakes.add(line, f"expected {len(titles)} fields; found {len(texts)}{comma}")
            continue
        for place, column in columns.items():
            text, title = texts[place], f"column '{titles[place]}'"
            if text in _EMPTY and column.may_be_empty:
                continue
            if not NUMBER.fullmatch(text) or not np.isfinite(float(text)):
                comma = " (the decimal sign is a point)" if "," in text else ""
                shown = f"'{text}'" if text else "nothing"
                mistakes.add(line, f"{title}: expected a number; found {shown}{comma}")
                continue
            found[place][k] = float(text)
    return found


def _places(
    table: Table,
    record: tuple[str, ...],
    keys: Mapping[str, int],
    names: Names,
    found: Found,
    mistakes: Mistakes,
) -> tuple[NDArray[np.int64], ...]:
    """Return the index of each line along each dimension of the table."""
    places = np.zeros((len(record), len(table.rows)), dtype=int)
    counts: dict[tuple[int, ...], int] = {}
    seen: dict[tuple[int, ...], int] = {}
    settled = set(found.labels)
    for k, (line, texts) in enumerate(table.rows):
        if len(texts) != len(table.head[1]):
            continue  # reported already
        for axis, dim in enumerate(record):
            if dim in keys:
                places[axis, k] = _label(texts[keys[dim]], dim, dim in settled, line, names, found, mistakes)
            else:
                leading = tuple(places[:axis, k])
                places[axis, k] = counts[leading] = counts.get(leading, -1) + 1
        place = tuple(places[:, k])
        if place in seen:
            label = ", ".join(f"{dim} '{texts[keys[dim]]}'" for dim in record)
            mistakes.add(line, f"{label}: duplicate; first given in line {seen[place]}", "duplicate")
        seen.setdefault(place, line)
    for axis, dim in enumerate(record):
        size = len(found.labels.get(dim, ())) if dim in keys else int(places[axis].max(initial=-1)) + 1
        known, where = found.sizes.setdefault(dim, (size, table.head[0]))
        if size != known:
            mistakes.add(table.head[0], f"expected {known} along {dim}, as in the table of line {where}; found {size}")
    return tuple(places)


def _label(text: str, dim: str, settled: bool, line: int, names: Names, found: Found, mistakes: Mistakes) -> int:
    """Return the index of a label along its dimension; a new one is added unless another table states all labels."""
    labels = found.labels.setdefault(dim, list(names.labels.get(dim, ())))
    if text in labels:
        return labels.index(text)
    if not text:
        mistakes.add(line, f"column '{dim}': expected a number or name; found nothing")
    elif settled or dim in names.labels:
        mistakes.add(line, f"column '{dim}': expected one of {', '.join(labels)}; found '{text}'")
    labels.append(text)
    return len(labels) - 1
