"""The plugins of the calibrations: their schemas and validators."""

from __future__ import annotations

from typing import ClassVar

from errormotion.plugins import DatasetInfo, DatasetPlugin, lazy


class InclinationCalibrationDataset(DatasetPlugin):
    """Calibration of the inclination error of a point sensor."""

    info: ClassVar[DatasetInfo] = DatasetInfo(
        id="inclination_calibration",
        summary="Calibration of the inclination error of a point sensor",
        schemas=("errormotion.calibration.inclination/1",),
    )
    violations = lazy("errormotion.datasets.calibrations.inclination:violations")


class PretravelMapDataset(DatasetPlugin):
    """Pre-travel map of a touch probe."""

    info: ClassVar[DatasetInfo] = DatasetInfo(
        id="pretravel_calibration",
        summary="Pre-travel of a touch probe by direction",
        schemas=("errormotion.calibration.pretravel/1",),
    )
    violations = lazy("errormotion.datasets.calibrations.pretravel:violations")
