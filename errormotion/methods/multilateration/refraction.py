"""Refractive index of moist air after Ciddor, and its uncertainty.

With the densities rho of dry air and of water vapour, and those of two standard states,

    n - 1 = rho_a / rho_axs (n_axs - 1) + rho_w / rho_ws (n_ws - 1)

References
----------
P. E. Ciddor, Refractive index of air: new equations for the visible and near infrared, Applied Optics 35 (1996)
1566-1573: equations 1 to 5, appendices A and B.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.multilateration.settings import CO2, HELIUM_NEON

MODEL_UNCERTAINTY = 2e-8
"""Standard uncertainty of the equations."""

QUANTITIES = ("temperature", "pressure", "humidity", "co2", "wavelength")
"""Order of the arguments."""

# Range of validity of the equations, in the units of the arguments.
_RANGE: Mapping[str, tuple[float, float, str]] = {
    "temperature": (-40.0, 100.0, "degC"),
    "pressure": (10e3, 140e3, "Pa"),
    "humidity": (0.0, 1.0, "of saturation (0 to 1)"),
    "co2": (0.0, 2000e-6, "mole fraction"),
    "wavelength": (300e-9, 1700e-9, "m"),
}
_STEP = 1e-30  # of the complex-step derivative, which is exact except for rounding

_GAS = 8.314510  # J/(mol K)
_WATER = 0.018015  # kg/mol


def refractive_index(
    temperature: ArrayLike,
    pressure: ArrayLike,
    humidity: ArrayLike,
    co2: ArrayLike = CO2,
    wavelength: ArrayLike = HELIUM_NEON,
) -> Array:
    """Return the phase refractive index of air.

    Parameters
    ----------
    temperature : array_like, (...)
        degC, ITS-90.
    pressure : array_like, (...)
        Pa.
    humidity : array_like, (...)
        Relative, 0 to 1.
    co2 : array_like, (...)
        Mole fraction; 450e-6 is 450 ppm.
    wavelength : array_like, (...)
        In vacuum, m.

    Returns
    -------
    ndarray, (...)
        Broadcast; NaN where an argument is NaN.

    Raises
    ------
    MethodError
        An argument outside the range of the equations, for example in another unit.
    """
    arguments = _checked(temperature, pressure, humidity, co2, wavelength)
    return np.asarray(1.0 + _refractivity(*arguments), dtype=np.float64)


def sensitivities(
    temperature: ArrayLike,
    pressure: ArrayLike,
    humidity: ArrayLike,
    co2: ArrayLike = CO2,
    wavelength: ArrayLike = HELIUM_NEON,
) -> dict[str, Array]:
    """Return the partial derivatives of `refractive_index` by each of ``QUANTITIES``: 1/K, 1/Pa, 1, 1, 1/m."""
    arguments = _checked(temperature, pressure, humidity, co2, wavelength)
    derivatives = {}
    for k, name in enumerate(QUANTITIES):
        stepped = [value + (1j * _STEP if i == k else 0.0) for i, value in enumerate(arguments)]
        derivatives[name] = np.asarray(np.imag(_refractivity(*stepped)) / _STEP)
    return derivatives


def index_uncertainty(derivatives: Mapping[str, Array], uncertainties: Mapping[str, float]) -> dict[str, Array]:
    """Return the standard uncertainty of the index by each cause, and by the ``equations``.

    Parameters
    ----------
    derivatives : mapping
        From `sensitivities`.
    uncertainties : mapping
        Standard uncertainty of each quantity, in its unit; by default 0.
    """
    effects = {name: derivatives[name] * u for name, u in uncertainties.items() if u > 0}
    shape = np.shape(next(iter(derivatives.values())))
    return effects | {"equations": np.full(shape, MODEL_UNCERTAINTY)}


def _checked(*arguments: ArrayLike) -> list[Array]:
    values = [np.asarray(value, dtype=np.float64) for value in arguments]
    for (name, (low, high, unit)), value in zip(_RANGE.items(), values, strict=True):
        wrong = value[(value < low) | (value > high)]
        if wrong.size:
            raise MethodError(
                f"Refraction: expected {name} from {low:g} to {high:g} {unit}; found {float(wrong.flat[0]):g}.",
                code="network.air.outside",
            )
    return values


def _refractivity(t: Any, p: Any, h: Any, co2: Any, wavelength: Any) -> Any:
    """Return n - 1; the arguments may be complex."""
    s2 = (1e-6 / wavelength) ** 2
    xc = co2 * 1e6
    T = t + 273.15
    n_as = 1e-8 * (5792105.0 / (238.0185 - s2) + 167917.0 / (57.362 - s2))
    n_axs = n_as * (1 + 0.534e-6 * (xc - 450.0))
    n_ws = 1.022e-8 * (295.235 + 2.6422 * s2 - 0.032380 * s2**2 + 0.004028 * s2**3)
    M_a = 1e-3 * (28.9635 + 12.011e-6 * (xc - 400.0))
    enhancement = 1.00062 + 3.14e-8 * p + 5.6e-7 * t**2
    x_w = enhancement * h * _saturation(t) / p
    rho_axs = 101325.0 * M_a / (_compressibility(15.0, 101325.0, 0.0) * _GAS * 288.15)
    rho_ws = 1333.0 * _WATER / (_compressibility(20.0, 1333.0, 1.0) * _GAS * 293.15)
    rho = p / (_compressibility(t, p, x_w) * _GAS * T)
    return rho * M_a * (1 - x_w) / rho_axs * n_axs + rho * _WATER * x_w / rho_ws * n_ws


def _saturation(t: Any) -> Any:
    """Return the saturation vapour pressure over water, and below 0 degC over ice, Pa."""
    T = t + 273.15
    water = np.exp(1.2378847e-5 * T**2 - 1.9121316e-2 * T + 33.93711047 - 6.3431645e3 / T)
    ice = 10 ** (-2663.5 / T + 12.537)
    return np.where(np.real(t) < 0, ice, water)


def _compressibility(t: Any, p: Any, x_w: Any) -> Any:
    T = t + 273.15
    first = (
        (1.58123e-6 - 2.9331e-8 * t + 1.1043e-10 * t**2)
        + (5.707e-6 - 2.051e-8 * t) * x_w
        + (1.9898e-4 - 2.376e-6 * t) * x_w**2
    )
    return 1 - p / T * first + (p / T) ** 2 * (1.83e-11 - 0.765e-8 * x_w**2)
