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
from errormotion.datasets.tables.mistakes import Mistakes
from errormotion.datasets.units import convert
from errormotion.errors import DatasetError
from errormotion.kinematics.iso import DOF
from errormotion.kinematics.volumes import is_rotation

FREEDOM = "freedom"
"""Dimension of errors that are lengths or angles."""


@dataclass(frozen=True)
class Cells:
    """Columns of a table.

    Attributes
    ----------
    head : (int, list of str)
        Line and names of the columns.
    lines : ndarray, (n,)
        Line of each row.
    texts : mapping of int to sequence of str
        Cells of the columns with labels of a dimension, (n,) each.
    numbers : mapping of int to ndarray
        Cells of the columns with values, (n,) each; NaN for empty ones.
    """

    head: tuple[int, list[str]]
    lines: NDArray[np.int64]
    texts: Mapping[int, Sequence[str]]
    numbers: Mapping[int, Array]


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


def unit_of_freedom(row: Row, freedom: str) -> str:
    """Return the unit of a variable for an error such as EXX, m or rad; empty if the name does not decide.

    The names are those of ISO 230-1: EA, EB and EC are rotations.
    """
    if freedom[:2] not in DOF or not {"m", "rad"} <= set(row.units):
        return ""
    return "rad" if is_rotation(freedom) else "m"


def converted(
    values: Array, unit: str, row: Row, place: str, line: int, mistakes: Mistakes, freedom: str = ""
) -> Array | None:
    """Return values in the unit of the schema; None and a mistake if that is not possible.

    ``freedom`` is the error of these values, where its kind decides between lengths and angles.
    """
    if row.unit in ("", "1") and unit in ("", "1"):
        return values
    if not unit:
        mistakes.add(line, f"{place}: expected a unit, such as {row.unit}; found none")
        return None
    decided = unit_of_freedom(row, freedom)
    inside = (decided,) if decided else row.units or (row.unit or "1",)
    place = f"{place}: {freedom}" if decided else place
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
    table: Cells,
    columns: Mapping[int, Column],
    keys: Mapping[str, int],
    names: Names,
    found: Found,
    mistakes: Mistakes,
) -> None:
    """Read one table into ``found``.

    Parameters
    ----------
    table : Cells
        Columns with labels and values.
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
    lines = table.lines
    _require_rows(table, columns, mistakes)
    places = _places(table, record, keys, names, found, mistakes)
    if mistakes.count > before:
        return
    shape = tuple(found.sizes[dim][0] for dim in record)
    arrays: dict[str, Array] = {}
    for number, column in columns.items():
        row, component, title = column.row, column.component, f"column '{titles[number]}'"
        freedom = _freedom(table, row, component, keys, names, title, mistakes)
        if freedom is None:
            continue
        inside = converted(table.numbers[number], column.unit, row, title, line, mistakes, freedom)
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


def _freedom(
    table: Cells, row: Row, component: int | None, keys: Mapping[str, int], names: Names, title: str, mistakes: Mistakes
) -> str | None:
    """Return an error of a column whose kind decides on the unit; empty for none, None and a mistake for both kinds."""
    if component is not None and names.component_dim(row) == FREEDOM:
        return names.labels[FREEDOM][component]
    if FREEDOM not in row.dims or FREEDOM not in keys:
        return ""
    labels = table.texts[keys[FREEDOM]]
    first: dict[str, int] = {}
    for k, label in enumerate(labels):
        first.setdefault(unit_of_freedom(row, label), k)
    if len(first) > 1:
        m, rad = (f"{labels[k]} in line {table.lines[k]}" for _, k in sorted(first.items()))
        mistakes.add(
            table.head[0], f"{title}: expected lengths and angles in columns or tables of their own; found {m}, {rad}"
        )
        return None
    return next((labels[k] for k in first.values()), "")


def _require_rows(table: Cells, columns: Mapping[int, Column], mistakes: Mistakes) -> None:
    """Report a table without rows, and empty cells where there must be a number."""
    if not table.lines.size:
        mistakes.add(table.head[0], "expected lines of numbers below the column names; found none")
    for number, column in columns.items():
        if not column.may_be_empty:
            for k in np.flatnonzero(np.isnan(table.numbers[number])):
                title = f"column '{table.head[1][number]}'"
                mistakes.add(int(table.lines[k]), f"{title}: expected a number; found nothing")


def _places(
    table: Cells,
    record: tuple[str, ...],
    keys: Mapping[str, int],
    names: Names,
    found: Found,
    mistakes: Mistakes,
) -> tuple[NDArray[np.int64], ...]:
    """Return the index of each line along each dimension of the table."""
    n = len(table.lines)
    places: list[NDArray[np.int64]] = []
    leading = np.zeros(n, dtype=np.int64)  # one number for each combination of the indices so far
    settled = set(found.labels)
    for dim in record:
        if dim in keys:
            at = _labels(table.texts[keys[dim]], dim, dim in settled, table.lines, names, found, mistakes)
        else:
            at = _counted(leading)
        places.append(at)
        leading = np.unique(leading * (int(at.max(initial=0)) + 1) + at, return_inverse=True)[1].reshape(n)
    _, first, inverse = np.unique(leading, return_index=True, return_inverse=True)
    for k in np.flatnonzero(first[inverse] != np.arange(n)):
        label = ", ".join(f"{dim} '{table.texts[keys[dim]][int(k)]}'" for dim in record)
        before = int(table.lines[first[inverse[k]]])
        mistakes.add(int(table.lines[k]), f"{label}: duplicate; first given in line {before}", "duplicate")
    for dim, at in zip(record, places, strict=True):
        size = len(found.labels.get(dim, ())) if dim in keys else int(at.max(initial=-1)) + 1
        known, where = found.sizes.setdefault(dim, (size, table.head[0]))
        if size != known:
            mistakes.add(table.head[0], f"expected {known} along {dim}, as in the table of line {where}; found {size}")
    return tuple(places)


def _counted(leading: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return how many lines with the same indices are above each line."""
    order = np.argsort(leading, kind="stable")
    grouped = leading[order]
    starts = np.flatnonzero(np.diff(grouped, prepend=grouped[:1] - 1))
    lengths = np.diff(starts, append=len(grouped))
    at = np.empty(len(leading), dtype=np.int64)
    at[order] = np.arange(len(leading)) - np.repeat(starts, lengths)
    return at


def _labels(
    texts: Sequence[str],
    dim: str,
    settled: bool,
    lines: NDArray[np.int64],
    names: Names,
    found: Found,
    mistakes: Mistakes,
) -> NDArray[np.int64]:
    """Return the index of each label along its dimension; new ones are added unless another table states all labels."""
    labels = found.labels.setdefault(dim, list(names.labels.get(dim, ())))
    known = {label: k for k, label in enumerate(labels)}
    expected = list(labels)
    for line, text in zip(lines, texts, strict=True):
        if text in known:
            continue
        if not text:
            mistakes.add(int(line), f"column '{dim}': expected a number or name; found nothing")
        elif settled or dim in names.labels:
            mistakes.add(int(line), f"column '{dim}': expected one of {', '.join(expected)}; found '{text}'")
        known[text] = len(labels)
        labels.append(text)
    return np.array([known[text] for text in texts], dtype=np.int64)
