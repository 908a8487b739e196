"""State of an identification: the readings of a raw dataset as arrays, and the results of the steps."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.multilateration.network.model import Sources, directions

if TYPE_CHECKING:
    import xarray as xr

    from errormotion.methods.multilateration.identification.drift import Drift
    from errormotion.methods.multilateration.identification.repeatability import Repeatability
    from errormotion.methods.multilateration.identification.uncertainty import Scatter
    from errormotion.methods.multilateration.network.model import Shared
    from errormotion.methods.multilateration.network.network import Network
    from errormotion.methods.multilateration.settings import Settings


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

    @property
    def position(self) -> Array:
        """Commanded axis positions (m, 3), m."""
        return self.nominal - self.reflector


@dataclass
class State:
    """An identification in progress; see `identify` for the steps.

    Attributes
    ----------
    raw, settings
        Inputs.
    data : Readings
    notes : list of str
        In the order of the steps.
    displacement : ndarray (n, m)
        Readings at the refractive index of the air, less corrections, m; NaN where missing or excluded.
    air : dict of str to float
        Relative standard uncertainty of all lengths by the state of the air, by cause.
    machine : Repeatability
        Of the machine, as far as it is known.
    drift : Drift or None
        None if drift is not determined.
    scales : list of Shared
        Sources of the expansion of the machine's scales.
    network : Network
        The present solution.
    factor : float
        Ratio of the standard deviation of a reading to that of the network's weights.
    scatter : Scatter
        Parts of this standard deviation.
    """

    raw: xr.Dataset
    settings: Settings
    data: Readings
    notes: list[str]
    displacement: Array
    air: dict[str, float]
    machine: Repeatability
    drift: Drift | None = None
    scales: list[Shared] = field(default_factory=list)
    network: Network = field(init=False)
    factor: float = field(init=False, default=1.0)
    scatter: Scatter = field(init=False)

    @property
    def stations(self) -> Array | None:
        """Approximate positions of the stations (n, 3), m."""
        return self.data.station

    @property
    def sources(self) -> Sources:
        """What is uncertain besides the noise of the readings."""
        tracker = {"tracker scale": self.settings.scale_or_assumed}
        return Sources(self.air, tracker, self.scales, [] if self.drift is None else self.drift.sources)

    def noise(self, machine: Repeatability | None = None) -> Array:
        """Return the standard deviation of the readings, the same for all, (n, m), m.

        It includes the repeatability (default: the present one), unless all stations are read at the same time.
        """
        variance = 0.0 if self.settings.together else (machine or self.machine).variance
        return np.broadcast_to(np.sqrt(self.data.noise**2 + variance), self.displacement.shape)

    def beams(self) -> Array:
        """Return unit vectors (n, m, 3) from the stations to the estimated targets, or else to the nominal ones."""
        target = self.network.target
        return directions(np.where(np.isnan(target), self.data.nominal, target), self.network.station)


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
            f"displacement_noise: expected a positive standard deviation; found {noise:g} m. State that of the tracker."
        )
    if not np.isfinite(d).any():
        raise MethodError("displacement: expected readings; found only NaN. Check that the beam was not broken.")
    names = {dim: _names(raw, dim, letter) for dim, letter in (("station", "S"), ("target", "T"))}
    empty = [name for name, row in zip(names["station"], d, strict=True) if not np.isfinite(row).any()]
    if empty:
        raise MethodError(
            f"displacement: expected readings of every station; found none of {', '.join(empty)}. Remove the station, "
            "or measure from it."
        )
    few = np.count_nonzero(np.isfinite(d), axis=0) < 3
    if few.any():
        first = short([name for name, unknown in zip(names["target"], few, strict=True) if unknown])
        notes.append(f"{int(few.sum())} of {m} targets have fewer than three readings and are unknown: {first}.")
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
            raise MethodError("reflector: expected a position for every target; found NaN. Omit it if it is unknown.")
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


def short(names: list[str]) -> str:
    """Return names as text: the first eight, and the number of the others."""
    return ", ".join(names) if len(names) <= 8 else f"{', '.join(names[:8])} and {len(names) - 8} more"
