"""Settings of all touch probes."""

from __future__ import annotations

import logging
import math
from pathlib import Path

from pydantic import Field

from errormotion.datasets.calibrations.owner import compare
from errormotion.datasets.calibrations.pretravel import PretravelMap
from errormotion.datasets.files.folders import folders_beside
from errormotion.datasets.units import Length
from errormotion.plugins import PluginSettings

log = logging.getLogger(__name__)


class ProbeSettings(PluginSettings):
    """The probe itself."""

    tip_radius: Length = Field(default=3e-3, description="radius of the tip", gt=0)
    noise: Length | None = Field(
        default=None,
        description="standard deviation of one touch, the mean of its contacts; unknown if not given",
        gt=0,
    )
    pretravel: str = Field(default="", description="file of the pre-travel map that corrects the contacts")
    serial_number: str = Field(default="", description="serial number of the probe; unknown if not given")
    allow_other_sensor: bool = Field(
        default=False, description="use the pre-travel map of a probe with another serial number"
    )

    @property
    def touch_noise(self) -> float:
        """Standard deviation of one touch, m; NaN where unknown."""
        return math.nan if self.noise is None else self.noise

    def pretravel_map(self) -> PretravelMap | None:
        """Load the pre-travel map, taken from the folder of the bench or from the working folder; None without one.

        Raises
        ------
        DatasetError
            The file is missing, it is not a map, or it belongs to a probe with another serial number.
        """
        if not self.pretravel:
            return None
        paths = [base / self.pretravel for base in (*folders_beside(), Path.cwd())]
        found = PretravelMap.load(next((path for path in paths if path.exists()), Path(self.pretravel)))
        allowed = self.allow_other_sensor
        for note in compare(self.pretravel, found.serial_number, self.serial_number, allow_other_sensor=allowed):
            log.warning(note)
        return found
