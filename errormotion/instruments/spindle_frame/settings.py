"""Settings of the five-sensor frame: its sensors, their addresses, and their positions around the bar."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from typing import Any, Self

import numpy as np
from pydantic import Field, ValidationInfo, field_validator, model_validator

from errormotion import plugins
from errormotion.datasets.files import tomlfile
from errormotion.datasets.units import Expansion, Length, Temperature
from errormotion.errors import InstrumentError, PluginError
from errormotion.instruments.point_lds.optoncdt.settings import SensorSettings
from errormotion.instruments.transports import parse_address

KIND = "point_lds"
MAX_POLLING_RATE = 1e3
"""Highest rate of sensors that are read one by one, Hz."""
CHANNELS = ("X1", "X2", "Y1", "Y2", "Z")
Vector = tuple[float, float, float]
Point = tuple[Length, Length, Length]

# Nominal beams, mid-range on a bar of 10 mm diameter along z that ends at z = 0, levels at 10 mm and 50 mm.
_STANDOFF, _L1, _L2 = 6e-3, 10e-3, 50e-3
NOMINAL_ORIGIN: dict[str, Point] = {
    "X1": (_STANDOFF, 0.0, _L1),
    "X2": (_STANDOFF, 0.0, _L2),
    "Y1": (0.0, _STANDOFF, _L1),
    "Y2": (0.0, _STANDOFF, _L2),
    "Z": (0.0, 0.0, -1e-3),
}
NOMINAL_DIRECTION: dict[str, Vector] = {
    "X1": (-1.0, 0.0, 0.0),
    "X2": (-1.0, 0.0, 0.0),
    "Y1": (0.0, -1.0, 0.0),
    "Y2": (0.0, -1.0, 0.0),
    "Z": (0.0, 0.0, 1.0),
}


class FrameSettings(SensorSettings):
    """Settings of the frame.

    Without ``sensors`` the channels are five optoNCDT sensors, all with the settings of the frame.
    """

    sensors: dict[str, dict[str, Any]] = Field(
        default_factory=dict,
        description="driver, address and settings of each sensor; default: five optoncdt",
    )

    range: Length = Field(default=2e-3, description="measuring range of the sensors")
    addresses: dict[str, str] = Field(
        default_factory=dict, description="URL of each sensor; default: derived from the address of the frame"
    )
    origin: dict[str, Point] = Field(
        default_factory=lambda: dict(NOMINAL_ORIGIN), description="nominal origins of the beams (x, y, z)"
    )
    direction: dict[str, Vector] = Field(
        default_factory=lambda: dict(NOMINAL_DIRECTION), description="nominal directions of the beams (x, y, z)"
    )
    machine_position: Point = Field(
        default=(0.0, 0.0, 0.0),
        description="machine coordinates (X, Y, Z) of the origin of the frame, for the limits of the bench",
    )
    bar_radius: Length = Field(default=5e-3, description="calibrated radius of the bar", gt=0)
    levels: tuple[Length, Length] = Field(default=(_L1, _L2), description="z of the levels L1 and L2")
    expansion: tuple[Expansion, Expansion, Expansion] = Field(
        default=(2.1e-6, 2.4e-6, 1.3e-6), description="displacement of the X, Y and Z sensors per kelvin of the frame"
    )
    frame_temperature: str = Field(default="frame", description="name of the thermometer channel on the frame")
    reference_temperature: Temperature = Field(default=20.0, description="temperature at which the geometry is valid")
    powered_since: datetime | None = Field(
        default=None,
        description="time with time zone at which the sensors were switched on, for sensors that do not report it",
    )

    @field_validator("addresses", "sensors", "origin", "direction")
    @classmethod
    def _known_channels(cls, value: dict[str, object]) -> dict[str, object]:
        wrong = ", ".join(sorted(set(value) - set(CHANNELS)))
        missing = ", ".join(name for name in CHANNELS if name not in value)
        if wrong or (missing and value):
            raise ValueError(
                f"the channels are {', '.join(CHANNELS)}"
                + (f"; unknown: {wrong}" if wrong else "")
                + (f"; missing: {missing}" if missing else "")
            )
        return value

    @field_validator("sensors")
    @classmethod
    def _known_sensors(cls, value: dict[str, dict[str, Any]], info: ValidationInfo) -> dict[str, dict[str, Any]]:
        """Check the settings of each driver, and keep them in SI units."""
        edge = bool((info.context or {}).get("edge"))
        checked, mistakes = {}, []
        for name, table in value.items():
            try:
                driver = _driver(table)
            except PluginError as error:
                mistakes.append(f"{name}.driver: {error}")
                continue
            try:
                parse_address(str(table.get("address", "")))
            except InstrumentError as error:
                mistakes.append(f"{name}.address: {error}")
            settings, found = tomlfile.check(_own(table), driver.Settings, prefix=(name,), edge=edge)
            mistakes += found
            if settings is not None:
                own = settings.model_dump(mode="json", exclude_unset=True)
                checked[name] = {"driver": table["driver"], "address": table.get("address", ""), **own}
        if mistakes:
            raise ValueError("; ".join(mistakes))
        return checked

    def sensor(self, name: str) -> tuple[Any, Any]:
        """Return the driver and the settings of a channel's sensor, as ``sensors`` states them."""
        driver = _driver(self.sensors[name])
        return driver, driver.Settings(**_own(self.sensors[name]))

    def _check_model(self) -> None:
        """Check the shared settings against the sensors' model; those in ``sensors`` have already been checked."""
        if not self.sensors:
            super()._check_model()
        elif self.addresses:
            raise ValueError(
                "expected the address of each sensor in its own table 'sensors'; found 'addresses' as well"
            )
        elif not self.synchronised and self.rate > MAX_POLLING_RATE:
            raise ValueError(
                f"rate: these sensors are read one by one, at {MAX_POLLING_RATE:g} Hz at most; found {self.rate:g} Hz"
            )

    @property
    def stated_range(self) -> float | None:
        """The measuring range of the sensors, m."""
        return self.range

    @property
    def synchronised(self) -> bool:
        """Whether all sensors are of one driver that samples on one clock."""
        drivers = {table["driver"] for table in self.sensors.values()}
        return not drivers or (len(drivers) == 1 and hasattr(plugins.get("instruments", drivers.pop()), "fill"))

    @model_validator(mode="after")
    def _plausible(self) -> Self:
        if not 0.1e-3 <= self.bar_radius <= 0.1:
            raise ValueError(
                f"expected a bar radius between 0.1 mm and 100 mm; found {self.bar_radius * 1e3:g} mm. "
                "In Python, lengths are in m"
            )
        for name, direction in self.direction.items():
            if not abs(np.linalg.norm(direction) - 1) < 1e-3:
                raise ValueError(f"expected a unit vector as the direction of {name}; found {direction}")
        if self.powered_since is not None and self.powered_since.tzinfo is None:
            raise ValueError("powered_since needs a time zone, such as 2025-03-01T08:00:00+01:00")
        return self


def _driver(table: Mapping[str, Any]) -> Any:
    driver = plugins.get("instruments", str(table.get("driver", "")))
    if driver.info.kind != KIND:
        raise PluginError(
            f"expected an instrument of kind {KIND}; found {driver.info.kind}", code="frame.instrument.kind"
        )
    return driver


def _own(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of the driver in a sensor's table."""
    return {key: value for key, value in table.items() if key not in ("driver", "address")}
