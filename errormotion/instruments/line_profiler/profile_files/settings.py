"""Settings of scans in files."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from errormotion.datasets.units import Frequency, Length
from errormotion.plugins import PluginSettings


class ProfileFileSettings(PluginSettings):
    """What the files do not state themselves."""

    unit: Literal["m", "mm", "um", "inch"] | None = Field(
        default=None, description="of the lengths in the files; NetCDF files name their own, all others need it"
    )
    x_pitch: Length | None = Field(default=None, description="distance of the columns of a CSV height map", gt=0)
    y_pitch: Length | None = Field(default=None, description="distance of the rows of a CSV height map", gt=0)
    delimiter: str = Field(default=",", description="between the cells of a CSV height map", min_length=1, max_length=1)
    no_value: float | None = Field(default=None, description="number that means no height, in the file's unit")
    rate: Frequency = Field(default=1000.0, description="profiles per second at which they were scanned", gt=0)
    noise: Length = Field(default=0.5e-6, description="standard deviation of the height of one point", ge=0)
