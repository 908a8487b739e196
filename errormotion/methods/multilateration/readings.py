"""The readings of a raw dataset as arrays, and what is assumed because neither data nor settings state it.

Assumed uncertainties contribute to those of the result; nothing that is assumed changes a value.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.multilateration.settings import ASSUMED_SCALE

if TYPE_CHECKING:
    import xarray as xr

    from errormotion.methods.multilateration.settings import Air, Expansion, MultilaterationSettings

_NAMED = 8


@dataclass(frozen=True)
class Readings:
    """Raw data as arrays.

    Attributes
    ----------
    displacement : ndarray (n, m)
        m; NaN for a broken beam.
    noise : float
        Standard deviation of one reading, m.
    nominal : ndarray (m, 3)
        Commanded positions of the reflector, m.
    reflector : ndarray (m, 3)
        Position of the reflector with all axes at zero, m; 0 if the data do not state it.
    station : ndarray (n, 3) or None
        Approximate positions, m.
    time : ndarray (n, m)
        Of each reading, s; its number if the data do not state times.
    timed : bool
        Whether the data state times.
    stations, targets : list of str
        Names.
    """

    displacement: Array
    noise: float
    nominal: Array
    reflector: Array
    station: Array | None
    time: Array
    timed: bool
    stations: list[str]
    targets: list[str]

    def named(self, k: int) -> str:
        """Return the name of a reading, by its number."""
        station, target = divmod(k, len(self.targets))
        return f"{self.stations[station]} to {self.targets[target]}"

    @property
    def position(self) -> Array:
        """Commanded axis positions (m, 3), m."""
        return self.nominal - self.reflector


def latest(raw: xr.Dataset) -> xr.Dataset:
    """Return raw data with only the last set-up of each station; unchanged without names of stations."""
    if "station" not in raw.coords:
        return raw
    last = {str(name): j for j, name in enumerate(raw["station"].values)}
    kept = sorted(last.values())
    return raw if len(kept) == raw.sizes["station"] else raw.isel(station=kept)


def read(raw: xr.Dataset, notes: list[str]) -> Readings:
    """Return the readings of a raw dataset.

    Raises
    ------
    MethodError
        A noise that is not positive; a station without readings; NaN for the position of the reflector.
    """
    d = _array(raw, "displacement", "station", "target")
    n, m = d.shape
    nominal = _array(raw, "target_nominal", "target", "direction")
    noise = float(raw["displacement_noise"])
    if not noise > 0:
        raise MethodError(
            f"displacement_noise: expected a positive standard deviation; found {noise:g} m. State that of "
            "the tracker.",
            code="raw.noise.not_positive",
        )
    if not np.isfinite(d).any():
        raise MethodError(
            "displacement: expected readings; found only NaN. Check that the beam was not broken.",
            code="network.no_readings",
        )
    names = {dim: _names(raw, dim, letter) for dim, letter in (("station", "S"), ("target", "T"))}
    empty = [name for name, row in zip(names["station"], d, strict=True) if not np.isfinite(row).any()]
    if empty:
        raise MethodError(
            f"displacement: expected readings of every station; found none of {', '.join(empty)}. Remove the station, "
            "or measure from it.",
            code="network.station.no_readings",
        )
    few = np.flatnonzero(np.count_nonzero(np.isfinite(d), axis=0) < 3)
    if few.size:
        notes.append(
            f"{few.size} of {m} targets have fewer than three readings and are unknown: {listed(names['target'], few)}."
        )
    station = None
    if "station_nominal" in raw:
        station = _array(raw, "station_nominal", "station", "direction")
        if np.isnan(station).any():
            station = None
            notes.append(
                "Not every station has an approximate position (station_nominal): all are determined by the distances."
            )
    if "reflector" in raw:
        reflector = _array(raw, "reflector", "target", "direction")
        if np.isnan(reflector).any():
            raise MethodError(
                "reflector: expected a position for every target; found NaN. Omit it if it is unknown.",
                code="network.reflector.unknown",
            )
    else:
        reflector = np.zeros_like(nominal)
    timed = "reading_time" in raw
    time = _array(raw, "reading_time", "station", "target") if timed else np.tile(np.arange(m, dtype=float), (n, 1))
    return Readings(d, noise, nominal, reflector, station, time, timed, names["station"], names["target"])


def _array(raw: xr.Dataset, name: str, *dims: str) -> Array:
    return np.array(raw[name].transpose(*dims).values, dtype=np.float64)


def _names(raw: xr.Dataset, dim: str, letter: str) -> list[str]:
    if dim in raw.coords and raw[dim].dtype.kind in "UOT":
        return [str(name) for name in raw[dim].values]
    return [f"{letter}{i + 1}" for i in range(raw.sizes[dim])]


def listed(names: list[str], which: Iterable[int]) -> str:
    """Return the names of some: the first ones, and the number of the others."""
    some = [names[k] for k in which]
    return ", ".join(some[:_NAMED]) + (f" and {len(some) - _NAMED} more" if len(some) > _NAMED else "")


def assumptions(raw: xr.Dataset, settings: MultilaterationSettings) -> list[str]:
    """Return a note on each quantity that is assumed."""
    notes = []
    if settings.scale_uncertainty is None:
        notes.append(
            "Assumed, because it is not stated: an uncertainty of the tracker's lengths of "
            f"{1e6 * ASSUMED_SCALE:g} um/m (scale_uncertainty). It contributes to the uncertainties only."
        )
    notes += _of_air(settings.air)
    if settings.expansion is None:
        notes.append(
            "The errors are those at the temperature of the measurement: the expansion of the scales is not stated "
            "(expansion)."
        )
    else:
        notes += _of_scales(settings.expansion)
    if "reflector" not in raw:
        notes.append(
            "Assumed, because it is not stated: with all axes at zero the reflector is at zero (reflector). The errors "
            "of the axes depend on it; those of the targets do not."
        )
    of_data = raw.attrs.get("chain")
    if settings.parametric and settings.chain and of_data and settings.chain != of_data:
        notes.append(f"The data state the chain {of_data}; the setting {settings.chain} is used.")
    return notes


def _of_air(air: Air) -> list[str]:
    sizes = {
        "temperature_uncertainty": f"{air.temperature_uncertainty:g} K of its temperature",
        "pressure_uncertainty": f"{air.pressure_uncertainty:g} Pa of its pressure",
        "humidity_uncertainty": f"{air.humidity_uncertainty:g} % of its humidity",
    }
    unstated = [name for name in sizes if name not in air.model_fields_set]
    if not unstated:
        return []
    what, where = ", ".join(sizes[name] for name in unstated), ", ".join(f"air.{name}" for name in unstated)
    return [
        f"Assumed, because it is not stated: an uncertainty of the air of {what} ({where}). "
        "It contributes to the uncertainties only."
    ]


def _of_scales(expansion: Expansion) -> list[str]:
    notes = []
    if "coefficient_uncertainty" not in expansion.model_fields_set:
        notes.append(
            "Assumed, because it is not stated: an uncertainty of the coefficient of expansion of the scales of "
            f"{1e6 * expansion.coefficient_uncertainty:g} um/m/K (expansion.coefficient_uncertainty)."
        )
    if "temperature_uncertainty" not in expansion.model_fields_set:
        notes.append(
            "Assumed, because it is not stated: an uncertainty of the temperature of the scales of "
            f"{expansion.temperature_uncertainty:g} K (expansion.temperature_uncertainty)."
        )
    return notes


def target_names(count: int) -> list[str]:
    """Return the names of targets: T001, T002 and so on."""
    digits = max(3, len(str(count)))
    return [f"T{i + 1:0{digits}}" for i in range(count)]


def station_names(count: int) -> list[str]:
    """Return the names of stations: S1, S2 and so on."""
    return [f"S{j + 1}" for j in range(count)]
