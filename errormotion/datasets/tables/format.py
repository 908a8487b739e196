"""Format of a table: what is not stated is recognised."""

from __future__ import annotations

import codecs
import re
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from errormotion.datasets.tables.dates import zone_of
from errormotion.datasets.tables.numbers import plain_spaces

_POINT_BETWEEN_THOUSANDS = re.compile(r"[+-]?[0-9]{1,3}(?:\.[0-9]{3})+(?:,[0-9]*)?")


class LogTable(BaseModel):
    """A table of a map: unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def _known_encoding(name: str) -> str:
    if name == "auto":
        return name
    try:
        known = codecs.lookup(name).name
        " ".encode(known)  # refuses codecs of no text, such as 'zip'
    except (LookupError, ValueError) as error:
        raise ValueError("expected an encoding such as 'utf-8', 'cp1252' or 'utf-16'") from error
    return known


def _known_zone(name: str) -> str:
    if name:
        zone_of(name)
    return name


Column = Annotated[str | Annotated[int, Field(ge=1)], Field(description="name of the column, or its number from 1")]

TimeColumn = Annotated[
    Column | Annotated[list[Column], Field(min_length=2, max_length=2)],
    Field(description="name or number of the column, or those of date and time of day, two columns"),
]


class Format(LogTable):
    """Format of a table; ``auto`` and keys without a value are recognised from the file."""

    encoding: Annotated[str, AfterValidator(_known_encoding)] = "auto"
    delimiter: Literal[",", ";", "\t", " ", "|", "auto"] = "auto"
    decimal: Literal[".", ",", "auto"] = "auto"
    thousands: Literal["", ".", ",", " ", "'"] | None = Field(
        None, description="separator of groups of three digits; empty: none; default: recognised"
    )
    zone: Annotated[str, AfterValidator(_known_zone)] = Field(
        "", description="time zone of dates without an offset, such as 'Europe/Berlin'"
    )
    comment: str = "#"
    header: bool | None = Field(None, description="whether a line has the names of the columns; default: recognised")
    skip: int = Field(0, ge=0, description="number of lines above the header that are not read")
    missing: tuple[str, ...] = Field(
        (), description="further texts or numbers that stand for no value, such as '-9999'"
    )
    sheet: str = Field("", description="sheet of a spreadsheet, or group of a file with several tables")

    @model_validator(mode="after")
    def _signs_differ(self) -> Self:
        if self.thousands and self.thousands in (self.decimal, self.delimiter):
            raise ValueError(
                f"thousands: '{self.thousands}' is the decimal sign or the delimiter; expected another sign"
            )
        return self

    def plain(self, text: str) -> str:
        """Return a number without signs between thousands and with a point as decimal sign.

        Raises
        ------
        ValueError
            A point with decimal commas may separate thousands, and the format does not state it; a separator of
            thousands is not between groups of three digits.
        """
        if self.thousands:
            return self._without_thousands(text)
        if self.decimal == "," and self.thousands is None and _POINT_BETWEEN_THOUSANDS.fullmatch(text):
            raise ValueError(
                f"the point in '{text}' may be a decimal sign or separate thousands; set format.thousands = '.' "
                "in the map, or '' if the point is a decimal sign"
            )
        return text.replace(",", ".") if self.decimal == "," and "." not in text else text

    def _without_thousands(self, text: str) -> str:
        sign = str(self.thousands)
        plain = plain_spaces(text)
        whole, decimal, rest = plain.partition(self.decimal)
        if sign not in plain:
            return f"{whole}.{rest}" if decimal else plain
        if not re.fullmatch(rf"[+-]?[0-9]{{1,3}}(?:{re.escape(sign)}[0-9]{{3}})+", whole) or sign in rest:
            raise ValueError(f"expected a number with '{sign}' between groups of three digits; found '{text}'")
        return whole.replace(sign, "") + (f".{rest}" if decimal else "")
