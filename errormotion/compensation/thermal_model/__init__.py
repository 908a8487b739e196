"""Thermal model: prediction of the six errors with their uncertainty from temperatures and working parameters.

`fit` determines a `ThermalModel` from error datasets of warm-ups. The model predicts an error dataset, states the
uncertainty of the prediction, and is stored as a dataset (schema ``errormotion.model.thermal/1``).
"""

from errormotion.compensation.thermal_model.check import Check, check
from errormotion.compensation.thermal_model.fitting import fit
from errormotion.compensation.thermal_model.model import SCHEMA, ThermalModel
from errormotion.compensation.thermal_model.settings import ThermalModelSettings

__all__ = ["SCHEMA", "Check", "ThermalModel", "ThermalModelSettings", "check", "fit"]
