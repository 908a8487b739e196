"""Settings of the method, for a campaign file or ``--set``."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from errormotion.datasets.units import Angle, Expansion, Frequency, Length, Speed, Time
from errormotion.plugins import PluginSettings


class Event(PluginSettings):
    """An event of a drift test: a change of the spindle speed, or a compensation switched on or off."""

    at: Time = Field(description="time since the start of the test")
    spindle_speed: Speed | None = Field(default=None, ge=0, description="spindle speed from here on, 1/min")
    compensation: dict[Literal["X", "Y", "Z"], bool] | None = Field(
        default=None, description="thermal compensation of the control by axis, on (true) or off (false)"
    )

    @model_validator(mode="after")
    def _is_not_empty(self) -> Event:
        if self.spindle_speed is None and self.compensation is None:
            raise ValueError("an event needs a spindle_speed or a compensation")
        return self


class Layout(PluginSettings):
    """Set-up of a plan."""

    bar_radius: Length = Field(default=5e-3, gt=0, description="radius of the bar")
    standoff: Length = Field(default=1e-3, gt=0, description="reading of each sensor at the start")
    levels: tuple[Length, Length] = Field(
        default=(0.01, 0.05), description="z of the levels L1 and L2 above the bar's end"
    )
    noise: Length = Field(default=0.3e-6, gt=0, description="standard deviation of one sample")
    rate: Frequency = Field(default=20e3, gt=0, description="samples per second")
    step_noise: Length = Field(
        default=0.6e-6, gt=0, description="standard deviation of one step's mean in a beam detection"
    )
    frame_expansion: tuple[Expansion, Expansion, Expansion] = Field(
        default=(0.0, 0.0, 0.0), description="displacement of the X, Y and Z sensors per kelvin of the frame"
    )
    frame_warming: float = Field(default=1.0, ge=0, description="change of the temperature of the frame, K")


class SpindleDriftSettings(PluginSettings):
    """Settings of ``spindle_drift``."""

    procedure: Literal["drift", "beam_detection"] = Field(
        default="drift", description="what to acquire; the identification is selected by the data"
    )

    # Drift: acquisition
    duration: Time = Field(default=5 * 3600.0, gt=0, description="length of the drift record")
    schedule: tuple[Event, ...] = Field(default=(), description="spindle speeds and compensation over time")

    # Drift: identification
    average: Time = Field(
        default=0.5, gt=0, description="averaging time of one mean; whole turns of the spindle cancel its run-out"
    )
    min_valid: float = Field(
        default=0.5, ge=0, le=1, description="share of valid samples below which a mean is unknown"
    )
    reference_time: Time | None = Field(
        default=None,
        ge=0,
        description="start of the reference state, since the start of the record; default: the first mean, or the "
        "first mean after spin_up where the record starts together with the spindle",
    )
    spin_up: Time = Field(default=1.0, ge=0, description="time in which the spindle reaches another speed")
    reference_average: Time | None = Field(
        default=None, gt=0, description="length of the reference state; default: one mean"
    )
    functional_point: tuple[Length, Length, Length] | None = Field(
        default=None,
        description="functional point of the errors; default: the end of the bar on its axis, rounded to 0.1 mm",
    )
    beams: Literal["raw", "nominal"] = Field(
        default="raw",
        description="beams of the raw dataset (raw), or nominal beams (nominal), to see the effect of the detection",
    )
    nominal_origin_uncertainty: Length = Field(
        default=1e-4, ge=0, description="standard uncertainty of a nominal origin"
    )
    nominal_direction_uncertainty: Angle = Field(
        default=5e-3, ge=0, description="standard uncertainty of a nominal direction"
    )
    noise: Literal["auto", "stated"] = Field(
        default="auto",
        description="noise of the readings: as stated, or the larger of the stated and the observed noise (auto)",
    )
    bar_radius_uncertainty: Length = Field(default=0.0, ge=0, description="standard uncertainty of the bar's radius")
    gain_uncertainty: float = Field(
        default=0.0, ge=0, description="relative standard uncertainty of the gain of each sensor"
    )
    compensate_frame: bool = Field(
        default=True, description="correct the readings for the expansion of the measuring frame, where it is known"
    )
    frame_temperature: str = Field(default="frame", description="name of the temperature sensor on the measuring frame")
    frame_smoothing: Time = Field(
        default=180.0, ge=0, description="length of the moving fit that smooths the temperature of the frame"
    )
    frame_expansion_uncertainty: float = Field(
        default=0.1, ge=0, description="relative standard uncertainty of the expansion of the frame"
    )
    unseen_rotation: Angle = Field(
        default=2e-5,
        ge=0,
        description="standard deviation of the rotation about the spindle axis, which is not measured",
    )
    running_end: Time | None = Field(
        default=None, gt=0, description="end of running; default: the time at which the spindle stops"
    )
    iso_average: Time = Field(default=30.0, gt=0, description="averaging time for ranges and end values")
    iso_temperature: str | None = Field(
        default=None,
        description="temperature sensor for the change per kelvin; default: the sensor with the largest change",
    )

    # Beam detection
    sphere_radius: Length = Field(default=5e-3, gt=0, description="radius of the sphere in the spindle")
    depths: tuple[Length, ...] = Field(
        default=(0.2e-3, 1.0e-3, 1.8e-3), min_length=1, description="readings at which the sphere is scanned"
    )
    scan_length: Length = Field(default=2e-3, gt=0, description="length of one scan")
    steps: int = Field(default=101, ge=5, description="number of rests of one scan, both ends included")
    dwell: Time = Field(default=1.0, gt=0, description="duration of the rest at each step")
    step_average: Time = Field(default=0.3, gt=0, description="averaging time of a rest, from its middle on")

    # Planning
    layout: Layout = Field(default_factory=Layout, description="set-up of a plan")


class TrialSettings(SpindleDriftSettings):
    """Settings of a plan, or of one trial of the Monte Carlo method: without results that do not affect the errors."""

    @classmethod
    def of(cls, settings: SpindleDriftSettings) -> TrialSettings:
        """Return the same settings for a plan or a trial."""
        return cls(**{name: getattr(settings, name) for name in SpindleDriftSettings.model_fields})
