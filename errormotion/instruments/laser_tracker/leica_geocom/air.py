"""Conversion of the air between the wet temperature of a station and the relative humidity of this project."""

from __future__ import annotations

import math

PSYCHROMETER = 6.62e-4
"""1/K; psychrometer constant divided by the pressure (Sprung), over water."""
REFERENCE_INDEX_PPM = 286.34
"""1e6 (n - 1) at which the station's atmospheric correction is 0 ppm; assumption for all models."""


def vapour_pressure(temperature: float) -> float:
    """Return the saturation pressure of water vapour, Pa, at a temperature in degC (Magnus)."""
    return 611.2 * math.exp(17.62 * temperature / (243.12 + temperature))


def humidity(dry: float, wet: float, pressure: float) -> float:
    """Return the relative humidity, %, for dry and wet temperature (degC) and pressure (Pa); NaN if not possible."""
    if not (-60.0 < wet <= dry < 80.0):
        return math.nan
    vapour = vapour_pressure(wet) - PSYCHROMETER * pressure * (dry - wet)
    return 100.0 * vapour / vapour_pressure(dry) if vapour >= 0.0 else math.nan


def wet_temperature(dry: float, relative: float, pressure: float) -> float:
    """Return the wet temperature, degC, for a dry one (degC), relative humidity (%) and pressure (Pa)."""
    goal = relative / 100.0 * vapour_pressure(dry)
    low, high = dry - 60.0, dry
    for _ in range(60):
        middle = (low + high) / 2.0
        if vapour_pressure(middle) - PSYCHROMETER * pressure * (dry - middle) < goal:
            low = middle
        else:
            high = middle
    return high


def refraction_index(ppm: float) -> float:
    """Return the index by which the station divides the optical path, for its atmospheric correction in ppm."""
    return 1.0 + (REFERENCE_INDEX_PPM - ppm) * 1e-6
