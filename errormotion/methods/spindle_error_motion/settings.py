"""Settings of the method: the test to plan or to simulate, and the evaluation."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from errormotion.datasets.units import Angle, Frequency, Length, Speed
from errormotion.plugins import PluginSettings

Sensors = Literal["X", "XY", "XYZ", "Z", "XYXYZ"]


class SpindleErrorMotionSettings(PluginSettings):
    """The test to plan or to simulate, the evaluation, and the limits of the figures."""

    # The test
    axis: Literal["A", "B", "C"] = Field(default="C", description="the axis of rotation of the spindle")
    sensors: Sensors = Field(
        default="XYXYZ",
        description="sensors: across the axis (X, Y, named as for a vertical spindle), along it (Z), and a second pair "
        "at another height, for tilts",
    )
    height: Length = Field(default=0.05, gt=0, description="distance of the two pairs along the axis")
    artefact_radius: Length = Field(default=12.5e-3, gt=0, description="radius of the ball or bar")
    spindle_speed: Speed = Field(default=3000.0, description="negative for the negative sense of rotation")
    turns: int = Field(default=100, ge=4, le=20_000, description="number of whole turns")
    sample_rate: Frequency = Field(default=10_000.0, gt=0, description="readings of each sensor in a second")
    angle_from: Literal["index", "encoder", "eccentricity"] = Field(
        default="index", description="what states the angle: an index pulse, an encoder, or the eccentricity"
    )
    noise: Length = Field(default=5e-9, gt=0, description="standard deviation of one reading by the sensor")
    asynchronous: Length = Field(default=30e-9, ge=0, description="standard deviation of the asynchronous motion")
    eccentricity: Length = Field(default=5e-6, ge=0, description="of the artefact")
    gain_uncertainty: float = Field(default=2e-3, ge=0, description="relative, of each sensor")
    direction_uncertainty: Angle = Field(default=2e-3, ge=0, description="of each sensor")
    position_uncertainty: Length = Field(default=0.1e-3, ge=0, description="of each sensor along the axis")
    roundness: Length = Field(default=20e-9, ge=0, description="roundness deviation of each artefact")

    # Evaluation
    places: int = Field(default=360, ge=24, le=3600, description="angles of the result, and sectors of one turn")
    harmonics: int = Field(
        default=60,
        ge=4,
        description="undulations in one turn up to which the synchronous error motion is determined; at most a "
        "quarter of the angles",
    )
    sensitive_angle: Angle = Field(
        default=0.0, description="angle of the rotating sensitive direction from the first axis at spindle angle 0"
    )

    # Limits of the figures
    radial_limit: Length | None = Field(default=None, gt=0, description="of synchronous radial error motions")
    axial_limit: Length | None = Field(default=None, gt=0, description="of the synchronous axial error motion")
