"""Conversion of readings in a text file, with a short header and tables with units, to a raw dataset.

The names are those of the raw schema. Every schema can be written in this form::

    # schema = errormotion.raw.NAME/1
    # nominal_direction = 0.342 0 0.940
    # distance_noise = 0.1 um
    plane,distance [mm],stage_x [mm],stage_y [mm],stage_z [mm]
    1,-2.004,100.000,50.000,20.000
    1,-1.508,101.000,50.000,20.000
    2,...

A line ``# key = value unit`` states one value, or the values of a vector separated by blanks; other lines that start
with ``#`` are comments. A column contains one variable, with its unit in brackets; the name of a component of a vector
ends with the component (``stage_x [mm]``). A column without a unit is the number or name of an element of a dimension,
such as a plane or a channel; the last dimension, here the readings of a plane, needs no column. An empty line starts
another table, with its own names.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import xarray as xr

from errormotion.datasets.files.tomlfile import nearest
from errormotion.datasets.schemas import Row, raw_schemas, variants
from errormotion.datasets.tables.mistakes import Mistakes
from errormotion.datasets.tables.numbers import NUMBER
from errormotion.datasets.text.csv_text import Table, blocks
from errormotion.datasets.text.table_reader import (
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
from errormotion.datasets.validation import violations
from errormotion.errors import DatasetError

TEXTS = ("schema", "machine", "sensor", "source", "title", "start")
"""Keys of the header that are stored as attributes."""

_EMPTY = ("", "NaN", "nan")
_COLUMN = re.compile(r"([^\W\d]\w*)\s*(?:\[([^\]]*)\])?")


def read_csv(path: str | Path) -> xr.Dataset:
    """Read a raw dataset from text.

    Parameters
    ----------
    path : str or Path
        Text; fields are separated by comma, semicolon or tabulator. The decimal sign of a table is a point or a comma,
        that of the header a point.

    Returns
    -------
    Dataset
        With the schema that the header states, in SI. Empty cells are NaN, and counted in the attribute
        ``missing_values`` (JSON, variable to count). Padding of short rows is NaN and not counted.

    Raises
    ------
    DatasetError
        The file cannot be read, or breaks its schema; every mistake is reported with line, column, expected and
        found value.
    """
    path = Path(path)
    header, tables = blocks(path)
    mistakes = Mistakes(path)
    if "schema" not in header:
        known = ", ".join(sorted({raw.id for raw in raw_schemas()}))
        raise DatasetError(
            f"{path}: expected a line '# schema = ...' that names one of {known}; found none. "
            "Import logs of other software with 'errormotion import'.",
            code="csv.schema.missing",
        )
    line, schema = header["schema"]
    known_variants = variants(schema)
    if not known_variants:
        raise DatasetError(
            f"{path}, line {line}: schema '{schema}' is unknown; {nearest(schema, {raw.id for raw in raw_schemas()})}",
            code="schema.unknown",
        )
    names, found = Names.of(known_variants), Found()
    for key, (line, text) in header.items():
        if key not in TEXTS:
            _value(key, line, text, names, found, mistakes)
    for table in tables:
        before = mistakes.count
        columns, keys = _columns(table, names, found, mistakes)
        if mistakes.count == before and columns:
            read_table(_cells(table, columns, keys, mistakes), columns, keys, names, found, mistakes)
    mistakes.raise_any()
    attrs = {key: text for key, (_, text) in header.items() if key in TEXTS}
    raw = found.dataset(attrs, names)
    broken = violations(raw)
    if broken:
        raise DatasetError(f"{path}: breaks {schema}:", broken, code="schema.violated")
    return raw


def _value(key: str, line: int, text: str, names: Names, found: Found, mistakes: Mistakes) -> None:
    """Read one line of the header."""
    row = names.rows.get(key)
    if row is None:
        known = [*TEXTS, *(row.name for row in names.rows.values() if len(row.dims) < 2)]
        mistakes.add(
            line, f"{key}: unknown key; {nearest(key, known)}. (A comment must have no '=' after its first word)"
        )
        return
    if len(row.dims) > 1:
        mistakes.add(line, f"{key}: expected in a table, because it has dims ({', '.join(row.dims)}); found a value")
        return
    words = text.split()
    count = next((k for k, word in enumerate(words) if not NUMBER.fullmatch(word)), len(words))
    numbers, unit = [float(word) for word in words[:count]], " ".join(words[count:])
    length = names.sizes.get(row.dims[0], len(names.labels.get(row.dims[0], ()))) if row.dims else 1
    if not numbers or (length and len(numbers) != length):
        many = "one number" if length == 1 else f"{length} numbers" if length else "numbers"
        comma = " (the decimal sign is a point; blanks separate numbers)" if "," in text else ""
        mistakes.add(line, f"{key}: expected {many}{_in(row)}; found '{text}'{comma}")
        return
    inside = converted(np.array(numbers), unit, row, f"{key}", line, mistakes)
    if inside is not None and plausible(inside, np.full(len(inside), line), row, key, unit, mistakes):
        values = unit_vectors(inside, row, np.array([line]), mistakes) if row.dims else inside[0]
        found.variables[key] = xr.Variable(row.dims, values, units_of(row))


def _cells(table: Table, columns: Mapping[int, Column], keys: Mapping[str, int], mistakes: Mistakes) -> Cells:
    """Return labels and numbers of a table; every other cell is a mistake."""
    titles, rows = table.head[1], []
    for line, texts in table.rows:
        if len(texts) == len(titles):
            rows.append((line, texts))
            continue
        comma = " (the decimal sign is a point)" if len(texts) > len(titles) else ""
        mistakes.add(line, f"expected {len(titles)} fields; found {len(texts)}{comma}")
    numbers = {place: np.full(len(rows), np.nan) for place in columns}
    for k, (line, texts) in enumerate(rows):
        for place, column in columns.items():
            text, title = texts[place], f"column '{titles[place]}'"
            if text in _EMPTY and column.may_be_empty:
                continue
            try:
                plain = table.form.plain(text)
            except ValueError as error:
                mistakes.add(line, f"{title}: {error}")
                continue
            if not NUMBER.fullmatch(plain) or not np.isfinite(float(plain)):
                comma = " (the decimal sign is a point)" if "," in text else ""
                shown = f"'{text}'" if text else "nothing"
                mistakes.add(line, f"{title}: expected a number; found {shown}{comma}")
                numbers[place][k] = 0.0  # reported; nothing is read from this table
                continue
            numbers[place][k] = float(plain)
    labels = {place: [texts[place] for _, texts in rows] for place in keys.values()}
    return Cells(table.head, np.array([line for line, _ in rows], dtype=np.int64), labels, numbers)


def _in(row: Row) -> str:
    return f" and a unit such as {row.unit}" if row.unit not in ("", "1") else ""


def _columns(table: Table, names: Names, found: Found, mistakes: Mistakes) -> tuple[dict[int, Column], dict[str, int]]:
    """Return variable, component and unit of each column by its index, and the indices of the key columns by dimension.

    Reports unknown and duplicate names, missing units and components, and variables that cannot be in one table.
    """
    line, titles = table.head
    known = names.columns()
    dims = {dim for row in names.rows.values() for dim in names.record_dims(row)}
    columns: dict[int, Column] = {}
    keys: dict[str, int] = {}
    seen: dict[str, int] = {}
    for place, title in enumerate(titles):
        match = _COLUMN.fullmatch(title)
        shown = f"column {place + 1} '{title}'"
        if match is None:
            mistakes.add(line, f"{shown}: expected a name and its unit in brackets, such as 'distance [mm]'")
            continue
        name, unit = match[1], (match[2] or "").strip()
        variable = known.get(name)
        own = f"{variable[0].name} {variable[1]}" if variable else name
        if own in seen:
            mistakes.add(line, f"{shown}: duplicate of column {seen[own] + 1} '{titles[seen[own]]}'")
        elif variable is not None and (match[2] is not None or name not in dims or name in names.aliases):
            if match[2] is None or (not unit and variable[0].unit):
                example = f"{name} [{variable[0].unit or '1'}]"
                mistakes.add(line, f"{shown}: expected its unit in brackets, such as '{example}'; found none")
            elif variable[0].name in found.variables:
                mistakes.add(line, f"{shown}: {variable[0].name} is already given above")
            columns[place] = Column(*variable, unit, may_be_empty=variable[1] is None)
        elif name in dims and match[2] is None:
            keys[name] = place
        else:
            mistakes.add(line, f"{shown}: unknown column; {nearest(name, [*known, *dims])}")
        seen.setdefault(own, place)
    for text in incomplete(columns, keys, names):
        mistakes.add(line, text)
    return columns, keys
