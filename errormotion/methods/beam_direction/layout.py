"""Settings for acquisition and planning: the mounted sensor, the gauge, the stage, and the noise of the readings."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from errormotion.datasets.units import Angle, Length
from errormotion.plugins import PluginSettings

Point = tuple[Length, Length, Length]
Vector = tuple[float, float, float]


MIN_COMPONENT = 1e-6
"""Lower limit of the largest component of a vector that states a direction; its reciprocal is the upper limit."""


class Face(PluginSettings):
    """Setting of the sine gauge: inclination of its face, and rotation of its turntable about Z."""

    inclination: Angle = Field(ge=0, lt=1.5707963267948966, description="of the gauge's face to the table")
    rotation: Angle = Field(default=0.0, description="of the turntable; at 0 the face's normal leans towards +X")


class Layout(PluginSettings):
    """Set-up of a measurement or plan."""

    # The sensor
    nominal_origin: Point | None = Field(
        default=None, description="zero point of the beam (reading 0) with the stage at 0, from the drawing"
    )
    nominal_direction: Vector = Field(
        default=(0.0, 0.0, -1.0), description="of the beam, towards the target, from the drawing"
    )
    direction_uncertainty: Angle = Field(
        default=8.7e-3, gt=0, description="standard uncertainty of the nominal direction"
    )
    triangulation_normal: Vector | None = Field(
        default=None,
        description="normal of the plane of emitted and received beam, for the inclination compensation; the setting "
        "receiver states on which side of the laser the receiver is",
    )
    reading_range: tuple[Length, Length] = Field(
        default=(-10e-3, 10e-3),
        description="lowest and highest reading of a plan; a measurement uses the range of the sensor",
    )
    used_range: float = Field(default=0.8, gt=0, le=1, description="share of the range that strokes use")
    average: int = Field(default=8, ge=1, description="readings averaged at each position")
    noise: Length = Field(
        default=0.1e-6, gt=0, description="standard deviation of a reading; used if the sensor's settings state none"
    )
    speckle: Length = Field(
        default=0.0,
        ge=0,
        description="standard deviation of the error caused by the surface texture, constant at one position",
    )
    speckle_length: Length = Field(default=50e-6, gt=0, description="correlation length of that error")
    scale_uncertainty: float = Field(
        default=0.0,
        ge=0,
        description="relative standard uncertainty of the sensor's scale; a compensation contains it",
    )

    # The gauge
    pivot: Point | None = Field(default=None, description="point that lies on the face of the gauge at every setting")
    pivot_uncertainty: Length = Field(
        default=2e-6,
        gt=0,
        description="standard uncertainty of the distance of the face from that point, at each setting",
    )
    inclinations: tuple[Angle, Angle] = Field(
        default=(0.0, 0.7853981633974483), description="least and largest inclination of the gauge"
    )
    rotations: tuple[Angle, Angle] = Field(
        default=(0.0, 6.283185307179586), description="least and largest rotation of the turntable"
    )
    plate: Length = Field(default=60e-3, gt=0, description="longest path of the light spot on the face of the gauge")
    max_inclination: Angle = Field(
        default=0.7853981633974483,
        gt=0,
        lt=1.3962634015954636,
        description="largest angle between beam and normal of a face",
    )

    # The stage
    start: Point | None = Field(
        default=None,
        description="start position of the stage for the search of the face; by default, where the pivot is on the "
        "nominal beam at mid-range",
    )
    search: Length = Field(
        default=20e-3, ge=0, description="range of the search along the beam, in both directions from the start"
    )
    strokes: Literal["longest"] | Point = Field(
        default="longest",
        description="lengths of the strokes along X, Y and Z, or the longest within range, travel and plate",
    )
    travel: Point = Field(default=(40e-3, 40e-3, 40e-3), description="longest strokes along X, Y, Z")
    stage_uncertainty: float = Field(
        default=0.0, ge=0, description="relative standard uncertainty of the scale of each axis of the stage"
    )
    readings: int = Field(
        default=60, ge=9, description="number of positions on each face, evenly distributed to its three strokes"
    )
    path: tuple[Point, ...] = Field(
        default=(), description="stage positions relative to the middle instead of strokes, the same for every face"
    )

    @model_validator(mode="after")
    def _fits(self) -> Layout:
        for name in ("reading_range", "inclinations", "rotations"):
            low, high = getattr(self, name)
            if not low < high:
                raise ValueError(f"{name}: expected the lower limit first; found {low:g} and {high:g}")
        for name in ("nominal_direction", "triangulation_normal"):
            vector = getattr(self, name)
            if vector is not None and not MIN_COMPONENT <= max(map(abs, vector)) <= 1 / MIN_COMPONENT:
                components = ", ".join(f"{component:g}" for component in vector)
                raise ValueError(f"{name}: expected a direction; found ({components})")
        if self.path and len(self.path) < 9:
            raise ValueError(f"path: expected 9 positions or more; found {len(self.path)}")
        return self
