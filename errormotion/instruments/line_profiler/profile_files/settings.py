"""Settings of scans in files."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from errormotion.datasets.units import Frequency, Length
from errormotion.plugins import PluginSettings


class ProfileFileSettings(PluginSettings):
    """Settings of scans in files: values that the files do not state."""

    unit: Literal["m", "mm", "um", "inch"] | None = Field(
        default=None, description="unit of lengths in the files; required, except for NetCDF files, which state it"
    )
    x_pitch: Length | None = Field(default=None, description="distance between the columns of a CSV height map", gt=0)
    y_pitch: Length | None = Field(default=None, description="distance between the rows of a CSV height map", gt=0)
    delimiter: str = Field(
        default=",", description="separator of the cells of a CSV height map", min_length=1, max_length=1
    )
    no_value: float | None = Field(default=None, description="number that means no height, in the unit of the file")
    rate: Frequency = Field(default=1000.0, description="profiles per second of the scan", gt=0)
    noise: Length = Field(default=0.5e-6, description="standard deviation of the height of one point", ge=0)
