"""Settings of the method, from a campaign file or ``--set``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from errormotion.datasets.units import Angle, Length, Quantity, Temperature, Time
from errormotion.plugins import PluginSettings

HELIUM_NEON = 632.9912e-9
"""Wavelength in vacuum of a red helium-neon laser, m."""
ASSUMED_SCALE = 0.5e-6
"""Relative standard uncertainty of a tracker's lengths that is assumed if none is stated."""
CO2 = 450e-6
"""Carbon dioxide in laboratory air, mole fraction."""

Position = tuple[Length, Length, Length]
Pressure = Annotated[float, Quantity("a pressure", "Pa", "1013.25 hPa")]
Percent = Annotated[float, Quantity("a relative humidity", "%", "50 %")]
Relative = Annotated[float, Quantity("a relative length", "m/m", "0.3 um/m")]
Coefficient = Annotated[float, Quantity("a coefficient of expansion", "1/K", "11.5 um/m/K")]
TemperatureStep = Annotated[float, Quantity("a difference of temperature", "K", "0.2 K")]
Number = Annotated[int, Field(ge=1, le=100)]
"""Number of points of a grid along one axis."""


class Air(PluginSettings):
    """State of the air along the beam, which determines the scale."""

    temperature_uncertainty: TemperatureStep = Field(
        default=0.2, ge=0, description="standard uncertainty of the air temperature along the beam"
    )
    pressure_uncertainty: Pressure = Field(default=50.0, ge=0, description="standard uncertainty of the air pressure")
    humidity_uncertainty: Percent = Field(default=5.0, ge=0, description="standard uncertainty of the humidity")
    co2: Annotated[float, Quantity("a share of carbon dioxide", "m/m", "450 ppm")] = Field(
        default=CO2, ge=0, description="carbon dioxide in the air"
    )
    wavelength: Length = Field(
        default=HELIUM_NEON, gt=0, description="of the interferometer in vacuum, where the data do not state it"
    )
    wavelength_uncertainty: Relative = Field(
        default=2e-8, ge=0, description="relative standard uncertainty of that wavelength"
    )


class Expansion(PluginSettings):
    """Expansion of the machine's scales to the temperature at which errors are stated."""

    coefficient: Coefficient = Field(description="of the scales")
    coefficient_uncertainty: Coefficient = Field(
        default=1e-6, ge=0, description="standard uncertainty of the coefficient"
    )
    temperature: Temperature | None = Field(
        default=None, description="of the scales, where the data do not contain scale_temperature"
    )
    temperature_uncertainty: TemperatureStep = Field(
        default=0.2, ge=0, description="standard uncertainty of the scales' temperature"
    )
    reference: Temperature = Field(default=20.0, description="temperature for which the errors are stated")


class Layout(PluginSettings):
    """The layout that is measured or planned: a grid of targets, and the stations of the tracker."""

    low: Position = Field(default=(-0.2, -0.2, 0.0), description="corner of the box of targets, axis positions")
    high: Position = Field(default=(0.2, 0.2, 0.3), description="opposite corner")
    count: tuple[Number, Number, Number] = Field(default=(5, 5, 4), description="targets along X, Y and Z")
    targets: tuple[Position, ...] = Field(
        default=(), description="axis positions of the targets instead of a grid, as a plan chooses them"
    )
    reflector: Position = Field(default=(0.0, 0.0, 0.0), description="position of the reflector with all axes at zero")
    stations: tuple[Position, ...] = Field(
        default=((-0.5, -0.4, -0.1), (0.5, -0.4, 0.4), (0.5, 0.4, -0.1), (-0.5, 0.4, 0.6)),
        min_length=4,
        description="positions of the tracker: around the volume, alternately below and above it",
    )
    displacement_noise: Length = Field(default=0.5e-6, gt=0, description="standard deviation of one reading")


class Box(PluginSettings):
    """A box along the axes; it has no extent in a direction in which both corners agree."""

    low: Position = Field(description="corner with the smallest coordinates")
    high: Position = Field(description="corner with the largest coordinates")

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if any(a > b for a, b in zip(self.low, self.high, strict=True)):
            raise ValueError(f"expected low <= high in every coordinate; found {self.low} and {self.high}; swap them")
        return self


class Choosing(PluginSettings):
    """Choice of targets from a grid of candidates."""

    count: int | None = Field(default=None, ge=1, description="targets to choose")
    time: Time | None = Field(default=None, gt=0, description="time for one set-up, instead of count")
    time_per_target: Time = Field(default=15.0, gt=0, description="time for the move to a target, wait and reading")
    candidates: tuple[Number, Number, Number] = Field(default=(7, 7, 7), description="candidates along X, Y and Z")
    low: Position | None = Field(
        default=None, description="corner of the box of candidates, axis positions; default: that of the layout"
    )
    high: Position | None = Field(default=None, description="opposite corner")
    travel: Box | None = Field(default=None, description="travel of the axes, within which the candidates must be")
    uncertainty: Literal["axes", "target"] = Field(
        default="axes",
        description="quantity whose uncertainty is minimised anywhere in the box: the error that follows from the "
        "errors of the axes, or that of a target measured there",
    )
    max_order: int = Field(default=4, ge=1, le=15, description="highest order of the error motions that are assumed")
    expected_displacement: Length = Field(default=10e-6, gt=0, description="expected size of displacements of an axis")
    expected_rotation: Angle = Field(default=20e-6, gt=0, description="expected size of rotations of an axis")

    @model_validator(mode="after")
    def _one_budget(self) -> Self:
        if (self.count is None) == (self.time is None):
            raise ValueError("expected either count, the number of targets, or time, the time for a set-up")
        if (self.low is None) != (self.high is None):
            raise ValueError("expected both low and high, the corners of the box of candidates; found only one")
        if min(self.candidates) < 1:
            raise ValueError(f"candidates: expected 1 or more along every axis; found {self.candidates}")
        return self

    @property
    def wanted(self) -> int:
        """Targets to choose."""
        if self.count is not None:
            return self.count
        return int((self.time or 0.0) / self.time_per_target)


class Planning(PluginSettings):
    """Possible positions of the tracker, obstacles, and what is minimised."""

    boxes: tuple[Box, ...] = Field(
        default=(),
        description="possible positions of the tracker: one box for each station, or one for all; default: the box "
        "around the stations of the layout",
    )
    obstacles: tuple[Box, ...] = Field(default=(), description="boxes that block the beam")
    reflector_axis: tuple[float, float, float] | None = Field(
        default=None,
        description="direction of the reflector in machine coordinates; default: turned towards each station, and "
        "the same for all targets",
    )
    acceptance: Angle = Field(
        default=1.0471975511965976,
        gt=0,
        le=3.141592653589793,
        description="largest angle between that direction and the beam",
    )
    nearest: Length = Field(default=0.1, ge=0, description="least distance from tracker to reflector")
    minimise: Literal["largest", "mean"] = Field(
        default="largest", description="uncertainty of the targets that is minimised: the largest one, or their mean"
    )
    targets: Choosing | None = Field(
        default=None, description="choose the targets as well; default: those of the layout"
    )
    write: Path | None = Field(
        default=None, description="new file for the best layout, as settings of a campaign (TOML)"
    )

    @model_validator(mode="after")
    def _has_direction(self) -> Self:
        if self.reflector_axis is not None and not any(self.reflector_axis):
            raise ValueError("reflector_axis: expected a direction; found (0, 0, 0); remove it or state the direction")
        return self


class Measuring(PluginSettings):
    """How the targets are measured."""

    settle: Time = Field(default=0.5, ge=0, description="wait at each target before the reading")
    attempts: int = Field(default=2, ge=0, description="searches for the reflector after a broken beam")
    renewals: int = Field(
        default=2, ge=0, description="repetitions of a set-up because the interferometer lost its count"
    )
    returns: int = Field(
        default=4, ge=0, description="targets visited again at the end of a set-up, from which drift is determined"
    )
    sequence: tuple[int, ...] = Field(
        default=(), description="stations by number in the order of set-ups; a repeated one replaces the earlier one"
    )
    poor: float = Field(default=0.2, ge=0, le=1, description="share of broken beams above which a set-up is repeated")
    repeats: int = Field(default=1, ge=0, description="repetitions of a poor set-up")
    arrival: Length = Field(default=1e-4, gt=0, description="largest distance of the control from a target")
    timeout: Time = Field(default=120.0, gt=0, description="time limit of a move")
    scale_sensors: tuple[str, str, str] | None = Field(
        default=None, description="sensors of the thermometer on the scales of X, Y and Z; default: not recorded"
    )


class MultilaterationSettings(PluginSettings):
    """Settings of ``multilateration``."""

    layout: Layout = Field(default_factory=Layout, description="the layout that is measured or planned")
    planning: Planning = Field(
        default_factory=Planning, description="possible positions of the tracker and lines of sight"
    )
    measuring: Measuring = Field(default_factory=Measuring, description="how the targets are measured")

    # The network
    robust: bool = Field(default=True, description="exclude readings that contradict the others, and name them")
    noise: Literal["auto", "stated"] = Field(
        default="auto", description="the stated noise of the readings, raised where they scatter more (auto)"
    )
    together: bool = Field(
        default=False, description="all stations are read at the same time; false: one tracker, set up in turn"
    )
    repeatability: Length | None = Field(
        default=None,
        ge=0,
        description="of the machine at each positioning, standard deviation of each coordinate; default: determined "
        "from returns",
    )
    repeatability_uncertainty: Length = Field(
        default=0.0, ge=0, description="standard uncertainty of it; 0: used as stated, whatever the returns show"
    )
    drift: Literal["auto", "none"] = Field(
        default="auto", description="estimate the drift during each set-up where targets are visited again"
    )

    # Scale
    scale_uncertainty: Relative | None = Field(
        default=None,
        ge=0,
        description="relative standard uncertainty of the tracker's lengths, without that of the air; if not stated, "
        "0.5 um/m is assumed, with a note",
    )
    air: Air = Field(default_factory=Air, description="the air along the beam")
    expansion: Expansion | None = Field(
        default=None, description="of the machine's scales; default: errors at the temperature of the measurement"
    )

    # From targets to axes
    chain: str | None = Field(
        default=None,
        description="bodies of the machine, such as workpiece-X-Y-bed-Z-spindle-tool, where the data do not state it",
    )
    parametric: bool = Field(default=True, description="error motions of the axes from the errors of the targets")
    max_order: int = Field(default=12, ge=1, le=15, description="highest order of the polynomials of an error motion")
    station_tolerance: Length = Field(
        default=0.1, gt=0, description="distance of a station from its approximate position above which a note is given"
    )

    @property
    def scale_or_assumed(self) -> float:
        """Relative standard uncertainty of the tracker's lengths, stated or assumed."""
        return ASSUMED_SCALE if self.scale_uncertainty is None else self.scale_uncertainty
