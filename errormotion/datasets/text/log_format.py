"""Format of a text log: the tables that every map has."""

from __future__ import annotations

import codecs
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

TIMESTAMP = "iso8601"
"""Unit of a time column that holds dates and times of day."""


class LogTable(BaseModel):
    """A table of a map: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def _known_encoding(name: str) -> str:
    try:
        return codecs.lookup(name).name
    except LookupError as error:
        raise ValueError("expected an encoding such as 'utf-8', 'cp1252' or 'utf-16'") from error


Column = Annotated[str | Annotated[int, Field(ge=1)], Field(description="name of the column, or its number from 1")]


class Format(LogTable):
    """Format of the text."""

    encoding: Annotated[str, AfterValidator(_known_encoding)] = "utf-8"
    delimiter: Literal[",", ";", "\t", " ", "auto"] = "auto"
    decimal: Literal[".", ","] = "."
    comment: str = "#"
    header: bool = True
    skip: int = Field(0, ge=0)
    missing: tuple[str, ...] = ("NaN", "nan")

    @model_validator(mode="after")
    def _decimal_is_no_delimiter(self) -> Self:
        if self.decimal == self.delimiter:
            raise ValueError("decimal sign and delimiter are both ','; a log with decimal commas has another delimiter")
        return self
