"""The map of files of others, ``errormotion.map/2``: columns of tables for the variables of any raw schema."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, Self

from pydantic import Field, ValidationInfo, field_validator, model_validator

from errormotion.datasets.files.tomlfile import nearest
from errormotion.datasets.schemas import RawSchema, Row, raw_schemas, variants
from errormotion.datasets.tables.dates import is_date
from errormotion.datasets.tables.format import Column, Format, LogTable
from errormotion.datasets.text.log_map import MappedColumn, MappedLabels, MappedValue, base_key

MAP_SCHEMA = "errormotion.map/2"
SEQUENCE = ("run", "approach", "target")
"""Dimensions that follow from the positions of readings in the order of measurement."""


class MapColumn(MappedColumn):
    """A column whose unit may be stated in the file."""

    @model_validator(mode="after")
    def _two_columns_are_dates(self) -> Self:
        if isinstance(self.column, list) and self.unit and not is_date(self.unit):
            raise ValueError(
                "column: two columns are date and time of day; expected the unit 'iso8601' or 'dd.mm.yyyy'"
            )
        return self


class MapTable(LogTable):
    """A table of a file: where it is, and the meaning of its columns.

    ``columns`` has variables of the raw schema by name. Each is the name or number of a column; a list of them, for the
    components in the order of the schema, or for date and time of day; a table with the columns by component; a table
    with ``column`` and what is known of it; or a table with ``columns`` and the labels of each.
    """

    file: str = Field("", description="pattern for the name of the file, such as '*temperatures*'")
    format: Format = Field(default_factory=lambda: Format.model_validate({}))
    labels: dict[str, MappedLabels] = Field(default_factory=dict, description="columns with labels, by dimension")
    sequence: Column | None = Field(None, description="column with the positions, in the order of measurement")
    columns: dict[str, MapColumn] = Field(default_factory=dict, description="columns by variable")
    units: dict[str, str] = Field(default_factory=dict, description="units that the file does not state, by variable")

    @field_validator("units")
    @classmethod
    def _of_columns(cls, units: dict[str, str], info: ValidationInfo) -> dict[str, str]:
        keys = {base_key(key) for key in info.data.get("columns", {})}
        known = keys | {key.partition(".")[0] for key in keys}
        for name in units:
            if name not in known:
                raise ValueError(f"'{name}' has no column; {nearest(name, known)}")
        return units


class MapFile(MapTable):
    """A map file for ``errormotion import``."""

    schema_: Literal["errormotion.map/2"] = Field(alias="schema", description=f"'{MAP_SCHEMA}'")
    raw: str = Field(description="raw schema of the dataset, such as 'errormotion.raw.NAME/1'")
    variant: str = Field("", description="variant of the schema, if it has several")
    machine: str = Field("", description="name of the machine")
    attributes: dict[str, str | float] = Field(default_factory=dict, description="further attributes of the dataset")
    values: dict[str, MappedValue] = Field(default_factory=dict, description="values by variable")
    tables: list[MapTable] = Field(default_factory=list, description="further sheets or files")
    kind: str = Field("", description="identity of the columns and units of the files the map was made for")

    @model_validator(mode="before")
    @classmethod
    def _expanded(cls, data: Any) -> Any:
        """Convert the short forms of columns, labels and values to tables."""
        if not isinstance(data, dict) or data.get("schema") != MAP_SCHEMA or not isinstance(data.get("raw"), str):
            return data
        schemas = [each for each in variants(data["raw"]) if data.get("variant") in (None, "", each.variant)]
        found = _table_expanded(data, schemas)
        if isinstance(data.get("tables"), list):
            found["tables"] = [
                _table_expanded(each, schemas) if isinstance(each, dict) else each for each in data["tables"]
            ]
        if isinstance(data.get("values"), dict):
            found["values"] = {
                name: entry if isinstance(entry, dict) else {"value": entry} for name, entry in data["values"].items()
            }
        return found

    @model_validator(mode="after")
    def _known(self) -> Self:
        known = variants(self.raw)
        if not known:
            ids = {table.id for table in raw_schemas()}
            raise ValueError(f"raw: expected a raw schema; {nearest(self.raw, ids)}; found '{self.raw}'")
        if self.variant and self.variant not in {each.variant for each in known}:
            names = {each.variant for each in known}
            raise ValueError(f"variant: {nearest(self.variant, names)}; found '{self.variant}'")
        if not self.columns:
            raise ValueError("columns: expected columns of variables; found none")
        return self

    @property
    def parts(self) -> list[MapTable]:
        """All tables, the first one of which is the map itself."""
        return [self, *self.tables]


def _table_expanded(data: Mapping[str, Any], schemas: Sequence[RawSchema]) -> dict[str, Any]:
    found = dict(data)
    if isinstance(data.get("labels"), dict):
        found["labels"] = {
            dim: entry if isinstance(entry, dict) else {"column": entry} for dim, entry in data["labels"].items()
        }
    if isinstance(data.get("units"), dict):  # units.deviation.EXX
        pairs = [
            (f"{name}.{part}" if part else name, unit)
            for name, entry in data["units"].items()
            for part, unit in (entry.items() if isinstance(entry, dict) else [("", entry)])
        ]
        found["units"] = dict(pairs)
    if not isinstance(data.get("columns"), dict):
        return found
    stated = {*found.get("labels", {}), *(SEQUENCE if data.get("sequence") is not None else ()), "time"}
    found["columns"] = {}
    for name, entry in data["columns"].items():
        row, dim = along(name, schemas, stated)
        found["columns"] |= dict(_entries(name, entry, row, dim, schemas))
    return found


def along(name: str, schemas: Sequence[RawSchema], stated: set[str]) -> tuple[Row | None, str]:
    """Return a variable, and the dimension along which it has columns side by side; empty for none.

    That is the dimension whose labels the schema states, else the last one whose labels are not ``stated``.
    """
    row = next((row for raw in schemas for row in (*raw.rows, *raw.stated) if row.name == name), None)
    if row is None or not row.dims:
        return row, ""
    fixed = {dim for raw in schemas for dim in raw.labels}
    for dims in ([dim for dim in row.dims if dim in fixed], [dim for dim in row.dims if dim not in stated]):
        if dims:
            return row, dims[-1]
    return row, row.dims[-1]


def _labels(dim: str, schemas: Sequence[RawSchema]) -> tuple[str, ...]:
    return next((raw.labels[dim] for raw in schemas if dim in raw.labels), ())


def _is_place(entry: Any) -> bool:
    return isinstance(entry, str | int) and not isinstance(entry, bool)


def _entries(
    name: str, entry: Any, row: Row | None, dim: str, schemas: Sequence[RawSchema]
) -> Iterator[tuple[str, Any]]:
    """Yield the columns of a variable with the keys of `errormotion.datasets.text.log_map.LogMap`.

    These are ``variable``, ``variable.component`` and, of several columns with their labels, ``variable[1]``.
    """
    if isinstance(entry, list) and entry and all(map(_is_place, entry)):
        labels = _labels(dim, schemas)
        dates = row is not None and row.unit == "s" and len(entry) == 2 and not labels
        if dates:
            yield name, {"column": entry}
            return
        if labels and len(labels) != len(entry):
            raise ValueError(f"columns.{name}: expected {len(labels)} columns ({' '.join(labels)}); found {len(entry)}")
        others = [f"'{at}' for {own}" for own, at in zip(labels, entry, strict=False) if at in labels and at != own]
        if others:
            order = " ".join(labels)
            raise ValueError(f"columns.{name}: expected columns in the order {order}; found {', '.join(others)}")
        yield from _components(name, dict(zip(labels or map(str, entry), entry, strict=True)), row, dim, schemas)
    elif _is_place(entry):
        yield name, {"column": entry}
    elif isinstance(entry, list):
        yield from ((f"{name}[{k}]", each) for k, each in enumerate(entry, 1))
    elif not isinstance(entry, dict) or "column" in entry:
        yield name, entry
    elif "columns" in entry:
        yield from _several(name, entry)
    else:
        chosen = next((key for key in entry if row is not None and len(entry) == 1 and key in row.dims), "")
        parts = entry[chosen] if chosen and isinstance(entry[chosen], dict) else entry
        yield from _components(name, parts, row, chosen if parts is not entry else dim, schemas)


def _several(name: str, entry: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield several columns of one variable: ``columns`` and, for each dimension in ``labels``, as many labels."""
    columns, labels = entry["columns"], entry.get("labels", {})
    rest = {key: value for key, value in entry.items() if key not in ("columns", "labels")}
    if not isinstance(columns, list) or not isinstance(labels, dict):
        raise ValueError(f"columns.{name}: expected arrays in 'columns' and 'labels'; found {entry}")
    for dim, each in labels.items():
        if not isinstance(each, list) or len(each) != len(columns):
            count = len(each) if isinstance(each, list) else 1
            raise ValueError(
                f"columns.{name}.labels.{dim}: expected {len(columns)} labels, one for each column; found {count}"
            )
    for k, column in enumerate(columns):
        yield f"{name}[{k + 1}]", {"column": column, "labels": {dim: each[k] for dim, each in labels.items()}, **rest}


def _components(
    name: str, parts: Mapping[str, Any], row: Row | None, dim: str, schemas: Sequence[RawSchema]
) -> Iterator[tuple[str, Any]]:
    """Yield the columns of the components of a variable along a dimension."""
    if row is not None and row.dims and dim != _own(row, schemas):
        for k, (label, part) in enumerate(parts.items(), 1):
            table = part if isinstance(part, dict) else {"column": part}
            yield f"{name}[{k}]", {**table, "labels": {**table.get("labels", {}), dim: label}}
        return
    for label, part in parts.items():
        key = f"{name}.{label}"
        if label == "?":
            raise ValueError(f"columns.{key}: expected the name of the error in place of '?', such as EXX")
        if isinstance(part, dict) and "columns" in part:
            yield from _several(key, part)
        elif isinstance(part, list) and not all(map(_is_place, part)):
            yield from ((f"{key}[{k}]", each) for k, each in enumerate(part, 1))
        else:
            yield key, part if isinstance(part, dict) else {"column": part}


def _own(row: Row, schemas: Sequence[RawSchema]) -> str:
    """Return the dimension that is meant by ``variable.component``."""
    fixed = {dim for raw in schemas for dim in raw.labels}
    return next((dim for dim in reversed(row.dims) if dim in fixed), row.dims[-1])
