"""Thermal model: from temperatures and working parameters to the six errors, with an interval.

`fit` makes a `ThermalModel` of error datasets of warm-ups; the model predicts an error dataset of its own, says how far
it can be trusted, and is saved as a dataset (schema ``errormotion.model.thermal/1``).
"""

from errormotion.compensation.thermal_model.check import Check, check
from errormotion.compensation.thermal_model.fitting import fit
from errormotion.compensation.thermal_model.model import SCHEMA, ThermalModel
from errormotion.compensation.thermal_model.settings import Settings

__all__ = ["SCHEMA", "Check", "Settings", "ThermalModel", "check", "fit"]
