"""The scale of everything: air along the beam, the tracker's own scale, and the machine's scales at 20 degC.

A correction or an uncertainty of scale is a change of the readings that all of them share, (station, target) in m. The
network gives the effect of such a change on the targets.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.multilateration.identification.refraction import (
    index_uncertainty,
    refractive_index,
    sensitivities,
)

if TYPE_CHECKING:
    import xarray as xr

    from errormotion.methods.multilateration.settings import Air, Expansion

_AIR = ("air_temperature", "air_pressure", "relative_humidity")


@dataclass(frozen=True)
class Shared:
    """One standard uncertainty of something that many readings share, as a change of the readings, m, (n, m)."""

    name: str
    group: str
    change: Array


def air_scale(raw: xr.Dataset, air: Air, notes: list[str]) -> tuple[Array | float, dict[str, float]]:
    """Return by what displacements are multiplied, and relative standard uncertainties of the scale by cause.

    Parameters
    ----------
    raw : Dataset
        Raw data; ``air_temperature``, ``air_pressure``, ``relative_humidity`` (station, target) where known, and
        ``refractive_index``, which the displacements were computed with.
    air : Air
    notes : list of str
        Added to.

    Raises
    ------
    MethodError
        An index to be replaced, but the air is not known.
    """
    missing = [name for name in _AIR if name not in raw]
    if missing:
        if "refractive_index" in raw:
            raise MethodError(
                "The data state the refractive index of the displacements, so these are corrected again. This needs "
                f"{', '.join(missing)} (station, target). Add them, or leave refractive_index out."
            )
        notes.append(
            "The state of the air is not in the data: displacements are taken as compensated, and the scale as "
            "uncertain as scale_uncertainty says. One kelvin of air is 1 um/m."
        )
        return 1.0, {}
    T, p, h = (np.asarray(raw[name].transpose("station", "target").values, dtype=float) for name in _AIR)
    _refuse_unknown_air(raw, {"air_temperature": T, "air_pressure": p, "relative_humidity": h})
    wavelength = float(raw["vacuum_wavelength"]) if "vacuum_wavelength" in raw else air.wavelength
    factor: Array | float = 1.0
    if "refractive_index" in raw:
        used = np.asarray(raw["refractive_index"].transpose("station", "target").values, dtype=float)
        factor = used / refractive_index(T, p, h, air.co2, wavelength)
    mean_T, mean_p, mean_h = (float(np.nanmean(value)) for value in (T, p, h))
    derivatives = sensitivities(mean_T, mean_p, mean_h, air.co2, wavelength)
    stated = {
        "temperature": air.temperature_uncertainty,
        "pressure": air.pressure_uncertainty,
        "humidity": air.humidity_uncertainty / 100,
    }
    causes = {f"air {name}": abs(float(u)) for name, u in index_uncertainty(derivatives, stated).items()}
    return factor, causes | {"wavelength": air.wavelength_uncertainty}


def _refuse_unknown_air(raw: xr.Dataset, air: dict[str, Array]) -> None:
    """Refuse a state of the air that is not known where it decides: nowhere at all, or where lengths need it."""
    read = np.isfinite(np.asarray(raw["displacement"].transpose("station", "target").values, dtype=float))
    if "refractive_index" in raw:
        index = np.asarray(raw["refractive_index"].transpose("station", "target").values, dtype=float)
        air = {"refractive_index": index, **air}
    for name, value in air.items():
        lost = read & ~np.isfinite(value)
        if "refractive_index" in raw and lost.any():
            j, i = (int(k) for k in np.argwhere(lost)[0])
            first = [
                str(raw[dim].values[k]) if dim in raw.coords else f"{dim} {k + 1}"
                for dim, k in (("station", j), ("target", i))
            ]
            raise MethodError(
                f"{name}: expected its value with every reading, since displacements are corrected again for the air; "
                f"found NaN at {int(lost.sum())} of {int(read.sum())}, first at {first[0]}, {first[1]}. Add them, or "
                "leave refractive_index out."
            )
        if not np.isfinite(value).any():
            raise MethodError(f"{name}: expected numbers; found NaN only. Leave it out if it is not known.")


def scale_strain(raw: xr.Dataset, expansion: Expansion) -> tuple[Array, Array]:
    """Return how far the scales of X, Y, Z are from their reference temperature, K, and their strain; (station, 3).

    Raises
    ------
    MethodError
        No temperature of the scales, in the data or in the settings.
    """
    if "scale_temperature" in raw:
        T = np.asarray(raw["scale_temperature"].transpose("station", "direction").values, dtype=float)
    elif expansion.temperature is not None:
        T = np.full((raw.sizes["station"], 3), expansion.temperature)
    else:
        raise MethodError(
            "Expansion of the scales: expected their temperature, scale_temperature(station, direction) in the data or "
            "expansion.temperature in the settings; found neither."
        )
    if np.isnan(T).any():
        station = str(raw["station"].values[np.argwhere(np.isnan(T))[0, 0]]) if "station" in raw.coords else "one"
        raise MethodError(f"Expansion of the scales: their temperature at station {station} is not known.")
    warmer = T - expansion.reference
    return warmer, expansion.coefficient * warmer


def along_beams(strain: Array, position: Array, e: Array) -> Array:
    """Return what a strain (n, 3) of the axes at positions (m, 3), m, adds to readings with beams e (n, m, 3), m."""
    return np.asarray(np.einsum("jta,ja,ta->jt", e, strain, position))


def expansion_sources(warmer: Array, position: Array, e: Array, expansion: Expansion) -> list[Shared]:
    """Return what is not known of the scales' expansion: its coefficient, and each axis's temperature."""
    centred = position - np.nanmean(position, axis=0)
    changes = [
        Shared(
            "coefficient of expansion",
            "scales",
            along_beams(expansion.coefficient_uncertainty * warmer, centred, e),
        )
    ]
    for k, axis in enumerate("XYZ"):
        strain = np.zeros_like(warmer)
        strain[:, k] = expansion.coefficient * expansion.temperature_uncertainty
        changes.append(Shared(f"scale temperature {axis}", "scales", along_beams(strain, centred, e)))
    return [shared for shared in changes if np.nanmax(np.abs(shared.change)) > 0]
