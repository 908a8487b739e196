"""Features, in which the errors are linear: temperatures, present or lagged, and first-order responses.

All features are 0 in the reference state, so that the model has no constant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from errormotion.arrays import Array
from errormotion.compensation.thermal_model.record import Inputs
from errormotion.errors import DatasetError


@dataclass(frozen=True)
class Feature:
    """One column of the model.

    Attributes
    ----------
    source : str
        Name of a temperature sensor, or of a working parameter.
    parameter : bool
        Whether it is a working parameter.
    power : int
        Power of the working parameter: friction depends on the speed and on its square.
    lag : float
        Lag, s.
    time_constant : float
        Of the first-order response, s; 0: the value itself.
    """

    source: str
    parameter: bool = False
    power: int = 1
    lag: float = 0.0
    time_constant: float = 0.0

    @property
    def name(self) -> str:
        """Name in messages and reports."""
        text = self.source if self.power == 1 else f"{self.source}^{self.power}"
        text += f", {self.lag / 60:g} min ago" if self.lag else ""
        return text + (f", time constant {self.time_constant / 60:g} min" if self.time_constant else "")


def lagged(sensors: Sequence[str], lags: Sequence[float]) -> tuple[Feature, ...]:
    """Return present and lagged temperatures."""
    return tuple(Feature(sensor, lag=lag) for sensor in sensors for lag in (0.0, *lags))


def dynamics(sensors: Sequence[str], time_constants: Sequence[float], parameters: Sequence[str]) -> tuple[Feature, ...]:
    """Return temperatures, and first-order responses to them, to working parameters and to their squares."""
    temperatures = [Feature(s, time_constant=tau) for s in sensors for tau in (0.0, *time_constants)]
    responses = [
        Feature(name, True, power, time_constant=tau)
        for name in parameters
        for power in (1, 2)
        for tau in time_constants
    ]
    return (*temperatures, *responses)


def matrix(inputs: Inputs, features: Sequence[Feature]) -> Array:
    """Return the value of each feature at each time, shape (n, feature).

    An unknown value is NaN at its own time; for lags and responses it is interpolated from its neighbours.

    Raises
    ------
    DatasetError
        An input of a feature is missing.
    """
    return (
        np.column_stack([_column(inputs, feature) for feature in features])
        if features
        else np.empty((inputs.time.size, 0))
    )


def _column(inputs: Inputs, feature: Feature) -> Array:
    available: dict[str, Array] = inputs.parameter if feature.parameter else inputs.temperature
    if feature.source not in available:
        names = ", ".join(available) or "none"
        what = "the working parameter" if feature.parameter else "the temperature"
        raise DatasetError(
            f"The model requires {what} '{feature.source}'; found {names}.", code="model.reading.missing"
        )
    values: Array = available[feature.source] ** feature.power
    known = np.isfinite(values)
    if not known.any():
        return np.full(values.size, np.nan)
    filled = np.interp(inputs.time, inputs.time[known], values[known])
    if feature.lag:
        filled = np.interp(inputs.time - feature.lag, inputs.time, filled, left=0.0)
    if feature.time_constant:
        filled = first_order(inputs.time, filled, feature.time_constant, held=feature.parameter)
    return np.where(known, filled, np.nan)


def first_order(time: Array, values: Array, time_constant: float, *, held: bool) -> Array:
    """Return x of ``time_constant dx/dt = u - x`` from rest at the first time.

    Parameters
    ----------
    time, values : (n,)
        Times, s, and values of u.
    time_constant : float
        s.
    held : bool
        Whether ``values[k]`` applies since the previous time; else u is linear between the times.
    """
    out = np.zeros(values.size)
    steps = np.diff(time) / time_constant
    decay = np.exp(-steps)
    for k in range(1, values.size):
        if held:
            out[k] = out[k - 1] * decay[k - 1] + values[k] * (1 - decay[k - 1])
        else:  # exact response to a ramp from u0 to u1
            ramp = (values[k] - values[k - 1]) / steps[k - 1]
            out[k] = values[k] - ramp + (out[k - 1] - values[k - 1] + ramp) * decay[k - 1]
    return out
