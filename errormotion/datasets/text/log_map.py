"""The map of a log for any raw schema: assignment of columns and values to variables."""

from __future__ import annotations

from typing import Any, Self

from pydantic import Field, model_validator

from errormotion.datasets.tables.dates import is_date
from errormotion.datasets.tables.format import Column, Format, LogTable, TimeColumn


class MappedColumn(LogTable):
    """A column of the log with a variable, or one component of it."""

    column: TimeColumn
    unit: str = Field(
        "",
        description="unit of the cells, such as 'um'; for dates 'iso8601' or their order, such as 'dd.mm.yyyy'; "
        "empty for pure numbers",
    )
    scale: float = Field(
        1.0, allow_inf_nan=False, description="factor of the cells; -1 if they count in the opposite direction"
    )
    offset: str = Field("", description="added after scaling, with its unit, such as '2 mm'")
    minus: Column | None = Field(
        None, description="column of the same unit that is subtracted, such as the targets from the positions"
    )
    labels: dict[str, str | int] = Field(
        default_factory=dict, description="number or name along each dimension that the readings of this column have"
    )

    @model_validator(mode="after")
    def _two_columns_are_dates(self) -> Self:
        if isinstance(self.column, list) and not is_date(self.unit):
            raise ValueError(
                "column: two columns are date and time of day; expected the unit 'iso8601' or 'dd.mm.yyyy'"
            )
        return self


class MappedLabels(LogTable):
    """A column of the log with the numbers or names along a dimension."""

    column: Column
    names: dict[str, str] = Field(default_factory=dict, description="names in the dataset by the names in the log")


class MappedValue(LogTable):
    """A value without a column: stated in the map (``value``) or in the first lines of the log (``key``)."""

    value: Any = Field(None, description="a number, a text such as '5 mm', or nested arrays of them")
    key: str = Field("", description="text before the value in the log, without the separator")
    unit: str = Field("", description="unit, if none is stated with the value")

    @model_validator(mode="after")
    def _has_one_source(self) -> Self:
        if (self.value is None) == (not self.key):
            raise ValueError("expected either a value, or the key of a value in the first lines of the log")
        return self


def _is_column(part: Any) -> bool:
    """Whether a value of a map is a table of a column, or a list of them."""
    return isinstance(part, dict) or (isinstance(part, list) and all(isinstance(each, dict) for each in part))


def base_key(key: str) -> str:
    """Return the variable and component of a key such as ``deviation.EXX[2]``, the second of several columns."""
    return key.partition("[")[0]


class LogMap(LogTable):
    """A map file for ``errormotion import`` whose key ``schema`` is a raw schema."""

    schema_: str = Field(alias="schema", description="raw schema, such as 'errormotion.raw.NAME/1'")
    variant: str = Field("", description="variant of the schema, if it has several")
    format: Format = Field(default_factory=lambda: Format.model_validate({}))
    machine: str = Field("", description="name of the machine")
    attributes: dict[str, str | float] = Field(default_factory=dict, description="further attributes of the dataset")
    labels: dict[str, MappedLabels] = Field(
        default_factory=dict, description="columns with the numbers or names along a dimension"
    )
    sequence: Column | None = Field(
        None, description="column with positions in the order of measurement: run, approach and target follow from it"
    )
    columns: dict[str, MappedColumn] = Field(
        min_length=1, description="columns by variable, or by variable and component; several with their labels"
    )
    values: dict[str, MappedValue] = Field(default_factory=dict, description="values by variable")

    @model_validator(mode="after")
    def _several_columns_have_labels(self) -> Self:
        for key, entries in self.entries.items():
            dims = [set(entry.labels) for entry in entries]
            if "[" not in next(where for where in self.columns if base_key(where) == key):
                if dims[0]:
                    raise ValueError(f"columns.{key}: labels are those of several columns; expected a list of columns")
            elif not dims[0] or any(each != dims[0] for each in dims):
                raise ValueError(f"columns.{key}: expected labels along the same dimensions for each of the columns")
        return self

    @property
    def entries(self) -> dict[str, list[MappedColumn]]:
        """The columns of each variable, or of its component: one, or several with labels."""
        found: dict[str, list[MappedColumn]] = {}
        for where, entry in self.columns.items():
            found.setdefault(base_key(where), []).append(entry)
        return found

    @model_validator(mode="before")
    @classmethod
    def _tables_of_components(cls, data: Any) -> Any:
        """Convert ``columns.stage.x`` to the key ``stage.x``, and a plain value to a table."""
        if not isinstance(data, dict):
            return data
        found = dict(data)
        if isinstance(data.get("labels"), dict):
            found["labels"] = {
                dim: entry if isinstance(entry, dict) else {"column": entry} for dim, entry in data["labels"].items()
            }
        if isinstance(data.get("columns"), dict):
            found["columns"] = {}
            for name, entry in data["columns"].items():
                nested = isinstance(entry, dict) and entry and all(map(_is_column, entry.values()))
                parts = {f"{name}.{k}": part for k, part in entry.items()} if nested else {name: entry}
                for key, part in parts.items():
                    several = {f"{key}[{k}]": each for k, each in enumerate(part, 1)} if isinstance(part, list) else {}
                    found["columns"] |= several or {key: part}
        if isinstance(data.get("values"), dict):
            found["values"] = {
                name: entry if isinstance(entry, dict) else {"value": entry} for name, entry in data["values"].items()
            }
        return found
