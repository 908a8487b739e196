"""Settings of a tracker with an emScon server."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from errormotion.datasets.units import Frequency, Length, Temperature, Time
from errormotion.plugins import PluginSettings


class EmSconSettings(PluginSettings):
    """Settings of ``leica_emscon``."""

    tracker: Literal["AT901", "AT4xx"] = Field(
        default="AT901",
        description="AT901: LT or AT901, with an interferometer; AT4xx: absolute distances, point by point",
    )
    reflector: str | None = Field(
        default=None, description="name of the reflector, as defined in the tracker; default: unchanged"
    )
    initialise: Literal["if_needed", "always", "never"] = Field(
        default="if_needed", description="when to initialise the tracker on opening; it moves for a minute"
    )
    meteo: Literal["refraction", "read", "manual"] = Field(
        default="refraction",
        description="weather station: sets the refraction index, is only read, or is absent and the values are given",
    )
    temperature: Temperature = Field(
        default=20.0, description="temperature of the air, with meteo = manual", ge=0, le=50
    )
    pressure: float = Field(
        default=101325.0, description="pressure of the air in Pa, with meteo = manual", ge=5e4, le=1.1e5
    )
    humidity: float = Field(default=50.0, description="relative humidity in %, with meteo = manual", ge=0, le=100)
    refraction_index: float | None = Field(
        default=None,
        description="refraction index that the tracker uses; default: that of the tracker; 1: distances in vacuum",
        ge=1.0,
        le=1.0005,
    )
    measuring_time: Time = Field(default=0.5, description="duration of a single measurement", ge=0.1, le=100.0)
    rate: Frequency = Field(default=100.0, description="points per second of a stream", gt=0, le=1000.0)
    search_radius: Length = Field(
        default=0.05, description="radius of the search for a reflector around a target", gt=0
    )
    reacquire: int = Field(default=1, description="number of searches for the reflector after a broken beam", ge=0)
    noise: Length = Field(default=0.5e-6, description="standard deviation of a single distance", ge=0)
    timeout: Time = Field(default=3.0, description="time limit for an answer", gt=0)
    motion_timeout: Time = Field(default=30.0, description="time limit for a motion or a search", gt=0)
    initialise_timeout: Time = Field(default=180.0, description="time limit for the initialisation", gt=0)
    busy_timeout: Time = Field(default=5.0, description="time limit for retries while the tracker is busy", ge=0)

    @property
    def interval(self) -> int:
        """Interval between the points of a stream, ms."""
        return round(1000.0 / self.rate)

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if abs(self.interval * self.rate / 1000.0 - 1.0) > 1e-6:
            raise ValueError(
                f"expected a rate whose interval is a multiple of 1 ms; {self.rate:g} points/s are "
                f"{1000.0 / self.rate:g} ms apart. Choose 1000, 500, 250, 200, 125, 100, 50, ... points/s"
            )
        if self.refraction_index is not None and self.meteo == "refraction":
            raise ValueError(
                "with meteo = refraction the tracker sets its refraction index itself; expected meteo = read or manual "
                "with refraction_index"
            )
        return self
