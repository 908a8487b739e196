"""Scale of the lengths: air along the beam, scale of the tracker, and the machine's scales at 20 degC.

A correction or an uncertainty of scale is a change of all readings, (station, target) in m. The effect of such a change
on the targets is computed by the network.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.multilateration.model import Shared
from errormotion.methods.multilateration.refraction import (
    index_uncertainty,
    refractive_index,
    sensitivities,
)

if TYPE_CHECKING:
    import xarray as xr

    from errormotion.methods.multilateration.settings import Air, Expansion

LABORATORY = (20.0, 101325.0, 0.5)
"""Temperature (degC), pressure (Pa) and humidity at which the effect of an unrecorded state of the air is computed."""
_AIR = ("air_temperature", "air_pressure", "relative_humidity")


def air_scale(raw: xr.Dataset, air: Air, notes: list[str]) -> tuple[Array | float, dict[str, float]]:
    """Return the factor for the displacements, and the relative standard uncertainties of the scale by cause.

    Parameters
    ----------
    raw : Dataset
        Raw data; ``air_temperature``, ``air_pressure``, ``relative_humidity`` (station, target) if known, and
        ``refractive_index``, with which the displacements were computed.
    air : Air
    notes : list of str
        To which remarks are appended.

    Raises
    ------
    MethodError
        The refractive index is to be replaced, but the state of the air is unknown.
    """
    missing = [name for name in _AIR if name not in raw]
    if missing:
        if "refractive_index" in raw:
            raise MethodError(
                "The data state the refractive index of the displacements, which are therefore corrected again: "
                f"expected {', '.join(missing)} (station, target). Add them, or omit refractive_index.",
                code="network.air.incomplete",
            )
        notes.append(
            "The state of the air is not in the data: displacements are assumed to be compensated for it. An error of "
            "1 K of the air temperature changes lengths by 1 um/m."
        )
        return 1.0, causes(*LABORATORY, air.wavelength, air)
    T, p, h = (np.asarray(raw[name].transpose("station", "target").values, dtype=float) for name in _AIR)
    _refuse_unknown_air(raw, {"air_temperature": T, "air_pressure": p, "relative_humidity": h})
    wavelength = float(raw["vacuum_wavelength"]) if "vacuum_wavelength" in raw else air.wavelength
    factor: Array | float = 1.0
    if "refractive_index" in raw:
        used = np.asarray(raw["refractive_index"].transpose("station", "target").values, dtype=float)
        factor = used / refractive_index(T, p, h, air.co2, wavelength)
    mean_T, mean_p, mean_h = (float(np.nanmean(value)) for value in (T, p, h))
    return factor, causes(mean_T, mean_p, mean_h, wavelength, air)


def causes(temperature: float, pressure: float, humidity: float, wavelength: float, air: Air) -> dict[str, float]:
    """Return the relative standard uncertainties of lengths in air of this state, by cause."""
    derivatives = sensitivities(temperature, pressure, humidity, air.co2, wavelength)
    stated = {
        "temperature": air.temperature_uncertainty,
        "pressure": air.pressure_uncertainty,
        "humidity": air.humidity_uncertainty / 100,
    }
    causes = {f"air {name}": abs(float(u)) for name, u in index_uncertainty(derivatives, stated).items()}
    return causes | {"wavelength": air.wavelength_uncertainty}


def _refuse_unknown_air(raw: xr.Dataset, air: dict[str, Array]) -> None:
    """Raise MethodError if the state of the air is unknown for all readings, or for one that is corrected with it."""
    read = np.isfinite(np.asarray(raw["displacement"].transpose("station", "target").values, dtype=float))
    if "refractive_index" in raw:
        index = np.asarray(raw["refractive_index"].transpose("station", "target").values, dtype=float)
        air = {"refractive_index": index, **air}
    for name, value in air.items():
        unknown = read & ~np.isfinite(value)
        if "refractive_index" in raw and unknown.any():
            j, i = (int(k) for k in np.argwhere(unknown)[0])
            first = [
                str(raw[dim].values[k]) if dim in raw.coords else f"{dim} {k + 1}"
                for dim, k in (("station", j), ("target", i))
            ]
            raise MethodError(
                f"{name}: expected a value for every reading, since displacements are corrected again for the air; "
                f"found NaN at {int(unknown.sum())} of {int(read.sum())}, first at {first[0]}, {first[1]}. Add the "
                "values, or omit refractive_index.",
                code="network.air.unknown",
            )
        if not np.isfinite(value).any():
            raise MethodError(
                f"{name}: expected numbers; found only NaN. Omit it if it is unknown.", code="raw.value.unknown"
            )


def scale_strain(raw: xr.Dataset, expansion: Expansion) -> tuple[Array, Array]:
    """Return temperatures of the scales of X, Y, Z above the reference, K, and their strains, both (station, 3).

    Raises
    ------
    MethodError
        Neither data nor settings state the temperature of the scales.
    """
    if "scale_temperature" in raw:
        T = np.asarray(raw["scale_temperature"].transpose("station", "direction").values, dtype=float)
    elif expansion.temperature is not None:
        T = np.full((raw.sizes["station"], 3), expansion.temperature)
    else:
        raise MethodError(
            "Expansion of the scales: expected their temperature, scale_temperature(station, direction) in the data or "
            "expansion.temperature in the settings; found neither.",
            code="expansion.temperature.missing",
        )
    if np.isnan(T).any():
        station = str(raw["station"].values[np.argwhere(np.isnan(T))[0, 0]]) if "station" in raw.coords else "one"
        raise MethodError(
            f"Expansion of the scales: expected their temperature at station {station}; found NaN.",
            code="expansion.temperature.missing",
        )
    excess = T - expansion.reference
    return excess, expansion.coefficient * excess


def along_beams(strain: Array, position: Array, e: Array) -> Array:
    """Return the effect of a strain (n, 3) of the axes at positions (m, 3), m, on readings along e (n, m, 3), m."""
    return np.asarray(np.einsum("jta,ja,ta->jt", e, strain, position))


def expansion_sources(excess: Array, position: Array, e: Array, expansion: Expansion) -> list[Shared]:
    """Return the sources of the scales' expansion: its coefficient, and the temperature of each axis."""
    centred = position - np.nanmean(position, axis=0)
    changes = [
        Shared(
            "coefficient of expansion",
            along_beams(expansion.coefficient_uncertainty * excess, centred, e),
        )
    ]
    for k, axis in enumerate("XYZ"):
        strain = np.zeros_like(excess)
        strain[:, k] = expansion.coefficient * expansion.temperature_uncertainty
        changes.append(Shared(f"scale temperature {axis}", along_beams(strain, centred, e)))
    return [shared for shared in changes if np.nanmax(np.abs(shared.change)) > 0]
