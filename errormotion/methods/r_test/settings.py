"""Settings of the method: the test that is planned or simulated. Identification needs none of them."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from errormotion.datasets.units import Angle, Length
from errormotion.plugins import PluginSettings


class RTestSettings(PluginSettings):
    """A test with spheres on a circle about the axis, for the plan."""

    axis: Literal["A", "B", "C"] = Field(default="C", description="the rotary axis, on the workpiece side")
    angles: int = Field(default=36, ge=4, description="number of angles, evenly over one revolution")
    spheres: int = Field(default=3, ge=1, description="number of spheres; a single one is on the axis")
    radius: Length = Field(default=0.12, gt=0, description="distance of the spheres from the axis")
    height: Length = Field(default=0.1, description="of the spheres above the point of the axis")
    inclination: Angle = Field(default=0.9553, gt=0, lt=1.5, description="of three sensors to the axis of the nest, Z")
    noise: Length = Field(default=0.15e-6, gt=0, description="standard deviation of one displacement")
    gain_uncertainty: float = Field(default=2e-3, ge=0, description="relative, of each sensor")
    direction_uncertainty: Angle = Field(default=2e-3, ge=0, description="of each sensor")
    position_uncertainty: Length = Field(default=0.1e-3, ge=0, description="of each coordinate of a sphere's place")
    nest_uncertainty: Length = Field(default=1e-6, ge=0, description="of the zero point of the nest, each coordinate")
