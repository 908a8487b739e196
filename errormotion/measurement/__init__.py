"""A method as a measurement model: unknowns, constants with their uncertainty, an equation, and errors, stated once.

A model states in `Observed` what raw data mean. From this one statement follow the identification, the plan (the
identification of expected data), the budget by sources, the Monte Carlo evaluation, simulated data and the redundancy
of every reading. `ModelMethod` is the base class of a method that has such a model; a method that needs another
estimator replaces a part of it. The estimation itself, on arrays, is in `errormotion.estimation`; the classes in which
a model is stated can be imported from here.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from errormotion.measurement.method import ModelMethod
from errormotion.measurement.observed import Model, Observed

if TYPE_CHECKING:
    from errormotion.estimation.blocks import Block, Constant, Noise
    from errormotion.estimation.datum import Datum
    from errormotion.estimation.problem import Problem
    from errormotion.estimation.sources import Places

__all__ = ["Block", "Constant", "Datum", "Model", "ModelMethod", "Noise", "Observed", "Places", "Problem"]

_LATER = {
    "Block": "blocks",
    "Constant": "blocks",
    "Noise": "blocks",
    "Datum": "datum",
    "Places": "sources",
    "Problem": "problem",
}
"""Where the classes of the estimation are; it is imported at their first use, since it needs scipy."""


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(import_module(f"errormotion.estimation.{_LATER[name]}"), name)
