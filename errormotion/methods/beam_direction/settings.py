"""Settings of the method, for a campaign file or ``--set``."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from errormotion.datasets.units import Angle
from errormotion.methods.beam_direction.layout import Face, Layout
from errormotion.plugins import PluginSettings


def _three_planes() -> tuple[Face, ...]:
    a = float(np.radians(20.0))
    return tuple(Face(inclination=a, rotation=float(np.radians(b))) for b in (0.0, 90.0, 180.0))


class BeamDirectionSettings(PluginSettings):
    """Settings of ``beam_direction``."""

    beam: str = Field(default="beam", min_length=1, description="name of the beam in the result")

    # Acquisition
    planes: tuple[Face, ...] = Field(
        default_factory=_three_planes, min_length=2, description="settings of the gauge, in the order of measurement"
    )
    layout: Layout = Field(default_factory=Layout, description="set-up of the measurement or plan")

    # Identification
    moves: Literal["sensor", "target"] = Field(
        default="sensor", description="what the stage carries; the attribute moves of a raw dataset takes precedence"
    )
    compensation: str | None = Field(
        default=None, description="calibration of the sensor's inclination error, by path or name; default: none"
    )
    extrapolate: bool = Field(
        default=False, description="compensate also at tilts and readings that the calibration does not cover"
    )
    allow_other_sensor: bool = Field(
        default=False, description="use a calibration of a sensor with another serial number or mid-range"
    )
    receiver: Literal["left", "right"] | None = Field(
        default=None,
        description="side of the receiver, seen from the laser, when one looks along the beam with "
        "triangulation_normal upwards; needed for the compensation; the attribute receiver of a raw dataset takes "
        "precedence",
    )
    triangulation_normal_uncertainty: Angle = Field(
        default=float(np.radians(0.5)),
        ge=0,
        description="standard uncertainty of the angle of the triangulation plane about the beam; used if the data "
        "state none",
    )
    robust: bool = Field(default=True, description="ignore and report outliers")
    ordered: bool = Field(
        default=True,
        description="readings are ordered along strokes; false for stage positions in any order",
    )
    noise: Literal["auto", "stated"] = Field(
        default="auto",
        description="noise of the readings: the stated one, or the observed scatter if it is larger (auto)",
    )
