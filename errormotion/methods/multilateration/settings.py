"""Settings of the method: what a campaign file or ``--set`` may say."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from errormotion.datasets.units import Length, Quantity, Temperature
from errormotion.methods.multilateration.acquisition.measure import Measuring
from errormotion.methods.multilateration.identification.refraction import CO2, HELIUM_NEON
from errormotion.methods.multilateration.planning.box import Place
from errormotion.methods.multilateration.planning.sight import Planning
from errormotion.plugins import PluginSettings

Pressure = Annotated[float, Quantity("a pressure", "Pa", "1013.25 hPa")]
Percent = Annotated[float, Quantity("a relative humidity", "%", "50 %")]
Relative = Annotated[float, Quantity("a relative length", "m/m", "0.3 um/m")]
Coefficient = Annotated[float, Quantity("a coefficient of expansion", "1/K", "11.5 um/m/K")]
TemperatureStep = Annotated[float, Quantity("a difference of temperature", "K", "0.2 K")]


class Air(PluginSettings):
    """What is known of the air, and how well: the scale of everything."""

    temperature_uncertainty: TemperatureStep = Field(
        default=0.2, ge=0, description="standard uncertainty of the air's temperature along the beam"
    )
    pressure_uncertainty: Pressure = Field(default=50.0, ge=0, description="standard uncertainty of its pressure")
    humidity_uncertainty: Percent = Field(default=5.0, ge=0, description="standard uncertainty of its humidity")
    co2: Annotated[float, Quantity("a share of carbon dioxide", "m/m", "450 ppm")] = Field(
        default=CO2, ge=0, description="carbon dioxide in it"
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
    coefficient_uncertainty: Coefficient = Field(default=1e-6, ge=0, description="standard uncertainty of it")
    temperature: Temperature | None = Field(
        default=None, description="of the scales, where the data do not hold scale_temperature"
    )
    temperature_uncertainty: TemperatureStep = Field(
        default=0.2, ge=0, description="standard uncertainty of the scales' temperature"
    )
    reference: Temperature = Field(default=20.0, description="temperature that the errors are stated for")


class Layout(PluginSettings):
    """The set-up that is measured, or planned: a grid of targets and the places of the tracker."""

    low: Place = Field(default=(-0.2, -0.2, 0.0), description="corner of the box of targets, commanded axis positions")
    high: Place = Field(default=(0.2, 0.2, 0.3), description="opposite corner")
    count: tuple[int, int, int] = Field(default=(5, 5, 4), description="targets along X, Y and Z")
    targets: tuple[Place, ...] = Field(
        default=(), description="axis positions of the targets in place of a grid, as a plan chooses them"
    )
    reflector: Place = Field(default=(0.0, 0.0, 0.0), description="where the reflector is with all axes at zero")
    stations: tuple[Place, ...] = Field(
        default=((-0.5, -0.4, -0.1), (0.5, -0.4, 0.4), (0.5, 0.4, -0.1), (-0.5, 0.4, 0.6)),
        min_length=4,
        description="places of the tracker: around the volume, below and above it by turns",
    )
    displacement_noise: Length = Field(default=0.5e-6, gt=0, description="standard deviation of one reading")


class Settings(PluginSettings):
    """Settings of ``multilateration``."""

    layout: Layout = Field(default_factory=Layout, description="the set-up that is measured, or planned")

    planning: Planning = Field(default_factory=Planning, description="where the tracker may stand, and what it sees")
    measuring: Measuring = Field(default_factory=Measuring, description="how the targets are measured")

    # The network
    start: Literal["nominal", "distances"] = Field(
        default="nominal", description="where stations are looked for first: their rough places, or anywhere"
    )
    alternating: bool = Field(
        default=False, description="also go the published way, stations and targets by turns, and set it beside"
    )
    robust: bool = Field(default=True, description="leave out readings that contradict the others, and name them")
    noise: Literal["auto", "stated"] = Field(
        default="auto", description="the stated noise of the readings, raised where they scatter more (auto)"
    )
    together: bool = Field(
        default=False, description="all stations read at one moment; false: one tracker, set up in turn"
    )
    repeatability: Length | None = Field(
        default=None,
        ge=0,
        description="of the machine, each time that it comes to a place, standard deviation of each coordinate; "
        "without: what returns show",
    )
    repeatability_uncertainty: Length = Field(
        default=0.0, ge=0, description="standard uncertainty of it; 0: taken as stated, whatever returns show"
    )
    drift: Literal["auto", "none"] = Field(
        default="auto", description="estimate the drift during each set-up where places are visited again"
    )

    # Scale
    scale_uncertainty: Relative = Field(
        default=0.0, ge=0, description="relative standard uncertainty of the tracker's lengths beyond air's"
    )
    air: Air = Field(default_factory=Air, description="the air that the beam passes")
    expansion: Expansion | None = Field(
        default=None, description="of the machine's scales; default: errors at the temperature as measured"
    )

    # From targets to axes
    chain: str | None = Field(
        default=None,
        description="bodies of the machine, such as workpiece-X-Y-bed-Z-spindle-tool, where the data do not say",
    )
    parametric: bool = Field(default=True, description="error motions of the axes from the targets' errors")
    max_order: int = Field(default=8, ge=1, le=15, description="highest order of the polynomials of an error motion")
    station_tolerance: Length = Field(
        default=0.1, gt=0, description="a station found further from its rough place is remarked upon"
    )
