"""Settings of an optoNCDT."""

from __future__ import annotations

import math
from typing import Literal, Self

from pydantic import Field, model_validator

from errormotion.datasets.units import Frequency, Length, Time
from errormotion.errors import InstrumentError
from errormotion.instruments.point_lds.optoncdt.codec import check_line
from errormotion.instruments.point_lds.optoncdt.models import MODELS
from errormotion.instruments.transports import parse_address
from errormotion.plugins import PluginSettings

DEFAULT_BAUDRATE = 921600


class SensorSettings(PluginSettings):
    """Settings that the sensors of one frame have in common."""

    model: Literal["ILD1420", "ILD2300"] = Field(default="ILD2300", description="sensor family")
    rate: Frequency = Field(default=20e3, description="measuring rate; one of those of the model")
    baudrate: int | None = Field(
        default=None,
        description="baud rate of a serial line, also of a serial server; default: 921600 on a line, none on TCP",
    )
    noise: Length = Field(default=0.3e-6, description="standard deviation of a single sample", ge=0)
    timeout: Time = Field(default=1.0, description="time limit without data", gt=0)

    @model_validator(mode="after")
    def _fits_the_model(self) -> Self:
        self._check_model()
        return self

    def _check_model(self) -> None:
        """Check rate, range and baud rate against the model; ValueError states the possible values."""
        model = MODELS[self.model]
        try:
            model.rate_word(self.rate)
        except InstrumentError as error:
            raise ValueError(str(error)) from None
        stated = self.stated_range
        if stated is not None and not any(math.isclose(stated, length, rel_tol=1e-6) for length in model.ranges):
            known = ", ".join(f"{length * 1000:g}" for length in model.ranges)
            raise ValueError(f"the {self.model} has ranges of {known} mm; found {stated * 1000:g} mm")
        if self.baudrate is not None and self.baudrate not in model.baudrates:
            known = ", ".join(str(rate) for rate in model.baudrates)
            raise ValueError(f"the {self.model} has the baud rates {known}; found {self.baudrate}")
        if self.baudrate is not None:
            self._check_line(self.baudrate)

    @property
    def stated_range(self) -> float | None:
        """The measuring range that the settings state, m; None if the sensor reports it."""
        return None

    @property
    def with_counter(self) -> bool:
        """Whether the sensor sends its counter with each distance."""
        return True

    def line_speed(self, address: str) -> int | None:
        """Return the baud rate at an address, None if there is no serial line.

        Raises
        ------
        InstrumentError
            The rate exceeds the capacity of the line.
        """
        parsed = parse_address(address)
        serial = parsed.scheme == "serial" or parsed.params.get("wire") == "pty"
        speed = int(parsed.number("baudrate", self.baudrate or (DEFAULT_BAUDRATE if serial else 0)))
        if not speed:
            return None
        check_line(self.rate, speed, counter=self.with_counter)
        return speed

    def _check_line(self, baudrate: int) -> None:
        try:
            check_line(self.rate, baudrate, counter=self.with_counter)
        except InstrumentError as error:
            raise ValueError(str(error)) from None


class OptoSettings(SensorSettings):
    """Settings of one sensor."""

    range: Length | None = Field(default=None, description="measuring range; default: as reported by the sensor")
    counter: bool = Field(
        default=True, description="whether the sensor sends its sample counter, which shows lost samples"
    )

    @property
    def stated_range(self) -> float | None:
        """The measuring range that the settings state, m; None if the sensor reports it."""
        return self.range

    @property
    def with_counter(self) -> bool:
        """Whether the sensor sends its counter with each distance."""
        return self.counter
