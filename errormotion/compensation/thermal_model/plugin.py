"""The plugin ``thermal_model``: models that predict errors from temperatures, and their predictions."""

from __future__ import annotations

from typing import ClassVar

from errormotion.plugins import DatasetInfo, DatasetPlugin, lazy


class ThermalModelDataset(DatasetPlugin):
    """Thermal models, and the error datasets that they predict."""

    info: ClassVar[DatasetInfo] = DatasetInfo(
        id="thermal_model",
        summary="Thermal model: errors predicted from temperatures and spindle speed",
        schemas=("errormotion.model.thermal/1",),
        methods=("thermal_model",),
    )
    violations = lazy("errormotion.compensation.thermal_model.model:violations")
    chapters = lazy("errormotion.compensation.thermal_model.report:chapters")
    texts = lazy("errormotion.compensation.thermal_model.report:texts")
    predictor = lazy("errormotion.compensation.thermal_model.predictor:ThermalPredictor")
    figures = lazy("errormotion.compensation.thermal_model.figures:figures")
