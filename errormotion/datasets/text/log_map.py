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

    @model_validator(mode="after")
    def _two_columns_are_dates(self) -> Self:
        if isinstance(self.column, list) and not is_date(self.unit):
            raise ValueError(
                "column: two columns are date and time of day; expected the unit 'iso8601' or 'dd.mm.yyyy'"
            )
        return self


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


class LogMap(LogTable):
    """A map file for ``errormotion import`` whose key ``schema`` is a raw schema."""

    schema_: str = Field(alias="schema", description="raw schema, such as 'errormotion.raw.NAME/1'")
    variant: str = Field("", description="variant of the schema, if it has several")
    format: Format = Field(default_factory=lambda: Format.model_validate({}))
    machine: str = Field("", description="name of the machine")
    attributes: dict[str, str | float] = Field(default_factory=dict, description="further attributes of the dataset")
    labels: dict[str, Column] = Field(
        default_factory=dict, description="columns with the numbers or names along a dimension"
    )
    columns: dict[str, MappedColumn] = Field(
        min_length=1, description="columns by variable, or by variable and component"
    )
    values: dict[str, MappedValue] = Field(default_factory=dict, description="values by variable")

    @model_validator(mode="before")
    @classmethod
    def _tables_of_components(cls, data: Any) -> Any:
        """Convert ``columns.stage.x`` to the key ``stage.x``, and a plain value to a table."""
        if not isinstance(data, dict):
            return data
        found = dict(data)
        if isinstance(data.get("columns"), dict):
            found["columns"] = {}
            for name, entry in data["columns"].items():
                nested = isinstance(entry, dict) and entry and all(isinstance(part, dict) for part in entry.values())
                found["columns"] |= {f"{name}.{k}": part for k, part in entry.items()} if nested else {name: entry}
        if isinstance(data.get("values"), dict):
            found["values"] = {
                name: entry if isinstance(entry, dict) else {"value": entry} for name, entry in data["values"].items()
            }
        return found
