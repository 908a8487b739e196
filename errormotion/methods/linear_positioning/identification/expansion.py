"""Nominal differential expansion: deviations for the reference temperature, usually 20 degC.

A positioning system that is warmer by ``dT_m`` moves too far by the fraction ``alpha_m dT_m`` of the distance; lengths
measured with an artefact that is warmer by ``dT_w`` are too short by the fraction ``alpha_w dT_w``. A deviation along
the axis at the distance ``l`` from the zero of the instrument is therefore too large by
``(alpha_m dT_m - alpha_w dT_w) l``. For an interferometer, ``alpha_w = 0``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.linear_positioning.settings import Budget, LinearPositioningSettings
from errormotion.methods.linear_positioning.settings import Side as Stated

SIDES = {"machine": 1.0, "workpiece": -1.0}
"""Sides, and the sign with which they enter a deviation."""


@dataclass(frozen=True, eq=False)
class Side:
    """What expands: the positioning system of the machine, or the artefact that embodies the lengths.

    Attributes
    ----------
    name : str
    sign : float
        With which it enters a deviation.
    coefficient, coefficient_u : float
        Of expansion, and its standard uncertainty, 1/K.
    excess : ndarray, (approach, run, target)
        Temperature above the reference, K.
    temperature_u : float
        Standard uncertainty that all temperatures share, K.
    """

    name: str
    sign: float
    coefficient: float
    coefficient_u: float
    excess: Array
    temperature_u: float


def sides_of(
    raw: xr.Dataset,
    temperature: Mapping[str, Array],
    shape: tuple[int, ...],
    settings: LinearPositioningSettings,
    notes: list[str],
) -> list[Side]:
    """Return the sides whose expansion data or settings state; remarks are appended to ``notes``.

    ``temperature`` contains (approach, run, target) for each sensor, of which ``shape`` is the shape.

    Raises
    ------
    MethodError
        A coefficient without a temperature, or a temperature without a coefficient.
    """
    sides = []
    u_T = _scalar(raw, "temperature_uncertainty", settings.uncertainty.temperature) or 0.0
    for name, sign in SIDES.items():
        side: Stated = getattr(settings, name)
        alpha = _scalar(raw, f"{name}_expansion", side.expansion)
        u_alpha = _scalar(raw, f"{name}_expansion_uncertainty", side.expansion_uncertainty) or 0.0
        excess = _excess(temperature, shape, name, side, settings.reference_temperature)
        if alpha is None and excess is None:
            continue
        if not (alpha or u_alpha) and excess is None:  # no expansion on this side
            notes.append(f"Assumed: no expansion of the {name} ({name}.expansion = 0).")
            continue
        if alpha is None or excess is None:
            raise MethodError(
                f"Expansion of the {name}: expected its coefficient ({name}_expansion in the data, {name}.expansion in "
                f"the settings) and its temperature ({name}.temperature, or the names of its sensors in "
                f"{name}.sensors); found {'no coefficient' if alpha is None else 'no temperature'}.",
                code="expansion.data.incomplete",
            )
        notes += _assumptions(raw, name, side, settings)
        sides.append(Side(name, sign, alpha, u_alpha, excess, u_T))
    if not any(side.name == "machine" for side in sides):
        notes.append(
            "The temperature of the positioning system is not stated: the errors apply to the temperature of the test."
        )
    return sides


def _assumptions(raw: xr.Dataset, name: str, side: Stated, settings: LinearPositioningSettings) -> list[str]:
    """Return a note on each uncertainty of a side that has the default of its setting."""
    notes = []
    if f"{name}_expansion_uncertainty" not in raw and side.expansion_uncertainty == Stated().expansion_uncertainty:
        notes.append(
            f"Assumed: a standard uncertainty of the coefficient of expansion of the {name} of "
            f"{1e6 * side.expansion_uncertainty:g} um/m/K ({name}.expansion_uncertainty)."
        )
    if "temperature_uncertainty" not in raw and settings.uncertainty.temperature == Budget().temperature:
        notes.append(
            f"Assumed: a standard uncertainty of the temperature of the {name} of "
            f"{settings.uncertainty.temperature:g} K (uncertainty.temperature)."
        )
    return notes


def _scalar(raw: xr.Dataset, name: str, default: float | None) -> float | None:
    if name not in raw:
        return default
    value = float(raw[name])
    if not np.isfinite(value):
        raise MethodError(f"{name}: expected a number; found NaN. Omit it if it is unknown", code="raw.value.unknown")
    return value


def _excess(
    temperature: Mapping[str, Array], shape: tuple[int, ...], name: str, side: Stated, reference: float
) -> Array | None:
    """Return the temperature of a side above the reference at each reading, K; None if it is not stated."""
    names = side.sensors or ((name,) if name in temperature else ())
    if missing := [sensor for sensor in names if sensor not in temperature]:
        known = ", ".join(temperature) or "none"
        raise MethodError(
            f"{name}.sensors: expected names of {known}; found {', '.join(missing)}", code="bench.thermometer.channels"
        )
    if names:
        mean = np.stack([_filled(temperature[sensor], sensor) for sensor in names]).mean(axis=0)
        return np.asarray(mean - reference)
    return None if side.temperature is None else np.full((2, *shape[1:]), side.temperature - reference)


def _filled(temperature: Array, sensor: str) -> Array:
    """Return the temperatures of a sensor, missing ones replaced by their mean."""
    if not np.isfinite(temperature).any():
        raise MethodError(
            f"temperature: expected values of sensor {sensor}; found only NaN. Omit the sensor",
            code="expansion.temperature.no_values",
        )
    return np.where(np.isfinite(temperature), temperature, np.nanmean(temperature))
