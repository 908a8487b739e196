"""Nominal differential expansion: deviations for the reference temperature, usually 20 degC.

A positioning system that is warmer by ``dT_m`` moves too far by the fraction ``alpha_m dT_m`` of the distance; lengths
measured with an artefact that is warmer by ``dT_w`` are too short by the fraction ``alpha_w dT_w``. A deviation along
the axis at the distance ``l`` from the zero of the instrument is therefore too large by
``(alpha_m dT_m - alpha_w dT_w) l``. For an interferometer, ``alpha_w = 0``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.linear_positioning.identification.reading import Readings
from errormotion.methods.linear_positioning.settings import Budget, Settings, Side

SIDES = {"machine": 1.0, "workpiece": -1.0}
"""Sides, and the sign with which they enter a deviation."""


@dataclass(frozen=True)
class Shared:
    """A source whose error is the same in the whole test, with the effect of its standard uncertainty.

    Attributes
    ----------
    name, group : str
    effect : ndarray, (freedom, target)
        On the deviations, m or rad.
    """

    name: str
    group: str
    effect: Array


@dataclass(frozen=True)
class Correction:
    """Effect of expansion on the readings along the axis, (approach, run, target), m, and its sources.

    ``complete`` states whether the expansion of the machine is known, so that the result applies to the reference
    temperature.
    """

    along: Array
    sources: list[Shared]
    complete: bool


def expansion(raw: xr.Dataset, readings: Readings, settings: Settings, notes: list[str]) -> Correction:
    """Return the correction for the temperatures that data or settings state; remarks are appended to ``notes``.

    Raises
    ------
    MethodError
        A coefficient without a temperature, or a temperature without a coefficient.
    """
    shape = readings.x.shape[1:]
    total, sources, complete = np.zeros(shape), list[Shared](), False
    u_T = _scalar(raw, "temperature_uncertainty", settings.uncertainty.temperature)
    for name, sign in SIDES.items():
        side: Side = getattr(settings, name)
        alpha = _scalar(raw, f"{name}_expansion", side.expansion)
        u_alpha = _scalar(raw, f"{name}_expansion_uncertainty", side.expansion_uncertainty) or 0.0
        excess = _excess(readings, name, side, settings.reference_temperature)
        if alpha is None and excess is None:
            continue
        if not (alpha or u_alpha) and excess is None:  # no expansion on this side
            notes.append(f"Assumed: no expansion of the {name} ({name}.expansion = 0).")
            continue
        if alpha is None or excess is None:
            raise MethodError(
                f"Expansion of the {name}: expected its coefficient ({name}_expansion in the data, {name}.expansion in "
                f"the settings) and its temperature ({name}.temperature, or the names of its sensors in "
                f"{name}.sensors); found {'no coefficient' if alpha is None else 'no temperature'}."
            )
        notes += _assumptions(raw, name, side, settings)
        total += sign * alpha * excess * readings.lever
        complete |= name == "machine"
        mean = excess.mean(axis=(0, 1))
        changes = {
            f"coefficient of expansion, {name}": u_alpha * mean * readings.lever,
            f"temperature, {name}": (u_T or 0.0) * alpha * readings.lever,
        }
        sources += [
            Shared(title, "expansion", _along(readings, sign * change))
            for title, change in changes.items()
            if np.abs(change).max() > 0
        ]
    if not complete:
        notes.append(
            "The temperature of the positioning system is not stated: the errors apply to the temperature of the test."
        )
    return Correction(total, sources, complete)


def _assumptions(raw: xr.Dataset, name: str, side: Side, settings: Settings) -> list[str]:
    """Return a note on each uncertainty of a side that has the default of its setting."""
    notes = []
    if f"{name}_expansion_uncertainty" not in raw and side.expansion_uncertainty == Side().expansion_uncertainty:
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


def _along(readings: Readings, change: Array) -> Array:
    effect = np.zeros((len(readings.freedoms), readings.position.size))
    if readings.along in readings.freedoms:
        effect[readings.freedoms.index(readings.along)] = change
    return effect


def _scalar(raw: xr.Dataset, name: str, default: float | None) -> float | None:
    if name not in raw:
        return default
    value = float(raw[name])
    if not np.isfinite(value):
        raise MethodError(f"{name}: expected a number; found NaN. Omit it if it is unknown")
    return value


def _excess(readings: Readings, name: str, side: Side, reference: float) -> Array | None:
    """Return the temperature of a side above the reference at each reading, K; None if it is not stated."""
    shape = readings.x.shape[1:]
    if not side.sensors and name in readings.temperature:
        names: tuple[str, ...] = (name,)
    else:
        names = side.sensors
    if missing := [sensor for sensor in names if sensor not in readings.temperature]:
        known = ", ".join(readings.temperature) or "none"
        raise MethodError(f"{name}.sensors: expected names of {known}; found {', '.join(missing)}")
    if names:
        mean = np.stack([_filled(readings.temperature[sensor], sensor) for sensor in names]).mean(axis=0)
        return np.asarray(mean - reference)
    return None if side.temperature is None else np.full(shape, side.temperature - reference)


def _filled(temperature: Array, sensor: str) -> Array:
    """Return the temperatures of a sensor, missing ones replaced by their mean."""
    if not np.isfinite(temperature).any():
        raise MethodError(f"temperature: expected values of sensor {sensor}; found only NaN. Omit the sensor")
    return np.where(np.isfinite(temperature), temperature, np.nanmean(temperature))
