"""The map of a log: meaning and unit of each column, and the beams."""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from errormotion.datasets.tables.dates import TIMESTAMP, is_date
from errormotion.datasets.tables.format import Column, Format, LogTable
from errormotion.datasets.tables.format import TimeColumn as DateColumns
from errormotion.datasets.units import Angle, Length, convert
from errormotion.errors import DatasetError
from errormotion.methods.spindle_drift.schema import CHANNELS

MAP_SCHEMA = "errormotion.map/1"


def _convertible(target: str) -> AfterValidator:
    def check(unit: str) -> str:
        try:
            convert(1.0, unit, target)
        except DatasetError as error:
            raise ValueError(f"expected a unit of the same kind as {target}: {error}") from error
        return unit

    return AfterValidator(check)


def _time_unit(unit: str) -> str:
    if is_date(unit):
        return unit
    try:
        convert(1.0, unit, "s")
    except DatasetError as error:
        raise ValueError(f"expected a unit of time, or '{TIMESTAMP}' for dates: {error}") from error
    return unit


class TimeColumn(LogTable):
    """Column of the time."""

    column: DateColumns
    unit: Annotated[str, AfterValidator(_time_unit)] = Field(
        description="a unit such as 's', 'iso8601', or the order of a date such as 'dd.mm.yyyy'"
    )

    @model_validator(mode="after")
    def _two_columns_are_dates(self) -> Self:
        if isinstance(self.column, list) and not is_date(self.unit):
            raise ValueError(
                "column: two columns are date and time of day; expected the unit 'iso8601' or 'dd.mm.yyyy'"
            )
        return self


class Channel(LogTable):
    """Column of readings, and their beam."""

    column: Column
    unit: Annotated[str, _convertible("m")] = Field(description="unit of the readings, such as 'um'")
    scale: float = Field(1.0, description="factor to the readings; -1 where they count in the opposite direction")
    offset: Length = Field(0.0, description="added to the readings after scaling")
    origin: tuple[Length, Length, Length] = Field(description="position at which the reading is zero, three lengths")
    direction: tuple[float, float, float] = Field(description="from sensor to bar, three numbers")
    origin_uncertainty: Length | None = Field(None, ge=0, description="standard uncertainty of each coordinate")
    direction_uncertainty: Angle | None = Field(None, ge=0, description="standard uncertainty across the beam")

    @model_validator(mode="after")
    def _has_a_unit_direction(self) -> Self:
        if not 0.99 <= math.hypot(*self.direction) <= 1.01:
            length = math.hypot(*self.direction)
            raise ValueError(f"direction: expected a vector of length 1; found {self.direction} of length {length:.4g}")
        if (self.origin_uncertainty is None) != (self.direction_uncertainty is None):
            raise ValueError("expected origin_uncertainty and direction_uncertainty together, or neither")
        if self.scale == 0 or not math.isfinite(self.scale):
            raise ValueError(f"scale: expected a number other than 0; found {self.scale}")
        return self


class Channels(LogTable):
    """The five channels."""

    X1: Channel
    X2: Channel
    Y1: Channel
    Y2: Channel
    Z: Channel

    def __getitem__(self, name: str) -> Channel:
        channel: Channel = getattr(self, name)
        return channel


class TemperatureColumn(LogTable):
    """Column of a temperature sensor."""

    column: Column
    unit: Annotated[str, _convertible("degC")] = Field("degC", description="unit, such as 'degC'")


class SpeedColumn(LogTable):
    """Column of the spindle speed."""

    column: Column
    unit: Annotated[str, _convertible("1/min")] = Field("/min", description="unit, such as '/min'")


class ImportMap(LogTable):
    """A map file for ``errormotion import``."""

    schema_: Literal["errormotion.map/1"] = Field(alias="schema", description=f'"{MAP_SCHEMA}"')
    format: Format = Field(default_factory=lambda: Format.model_validate({}))
    machine: str = Field("", description="which machine")
    bar_radius: Length = Field(gt=0, description="radius of the bar")
    distance_noise: Length = Field(ge=0, description="standard deviation of one reading")
    levels: tuple[Length, Length] = Field(description="z of the levels L1 and L2, two lengths")
    time: TimeColumn
    channels: Channels
    temperatures: dict[str, TemperatureColumn] = Field(default_factory=dict)
    spindle_speed: SpeedColumn | None = None

    @model_validator(mode="after")
    def _knows_all_beams_or_none(self) -> Self:
        missing = [name for name in CHANNELS if self.channels[name].origin_uncertainty is None]
        if 0 < len(missing) < len(CHANNELS):
            raise ValueError(f"expected the uncertainty of every beam or of none; missing for {' '.join(missing)}")
        return self
