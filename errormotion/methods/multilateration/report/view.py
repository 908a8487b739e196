"""View of a result as arrays over targets and stations; missing quantities are NaN."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.report.budget import FREEDOMS

AXES = ("X", "Y", "Z")
_READING = ("station", "target")


@dataclass(frozen=True)
class Network:
    """Targets and stations, m; NaN where unknown.

    Attributes
    ----------
    targets, stations : list of str
    position : (target, 3)
        Commanded position of the reflector; of the axes if that is unknown.
    error : (target, 3)
    covariance : (target, 3, 3)
    station, station_nominal : (station, 3)
    station_u : (station, 3)
    dead_path, dead_path_u : (station,)
    residual : (station, target)
    left_out : (station, target) of int
        0: used; 1: outlier; 2: the target was excluded.
    noise : float
        Standard deviation of a reading.
    """

    targets: list[str]
    stations: list[str]
    position: Array
    error: Array
    covariance: Array
    station: Array
    station_nominal: Array
    station_u: Array
    dead_path: Array
    dead_path_u: Array
    residual: Array
    left_out: NDArray[np.int64]
    noise: float

    @property
    def sigma(self) -> Array:
        """Standard uncertainty of each coordinate, (target, 3), m."""
        variance = np.diagonal(self.covariance, axis1=1, axis2=2)
        return np.sqrt(np.where(variance >= 0, variance, np.nan))

    @property
    def length(self) -> Array:
        """Length of each error vector, (target,), m."""
        return np.asarray(np.linalg.norm(self.error, axis=1))

    @property
    def worst(self) -> int | None:
        """Index of the target with the longest error vector; None if none is known."""
        size = self.length
        return int(np.nanargmax(size)) if np.isfinite(size).any() else None

    @property
    def drawn(self) -> NDArray[np.intp]:
        """Targets that can be drawn."""
        return np.flatnonzero(np.isfinite(self.position).all(axis=1))

    @property
    def worst_direction(self) -> Array:
        """Standard uncertainty in the worst direction of each target, (target,), m."""
        known = np.asarray(np.isfinite(self.covariance).all(axis=(1, 2)))
        found = np.full(len(known), np.nan)
        if known.any():
            found[known] = np.sqrt(np.linalg.eigvalsh(self.covariance[known])[:, -1].clip(0))
        return found

    def named(self, station: int, target: int) -> str:
        """Return the name of a reading."""
        return f"{self.stations[station]} to {self.targets[target]}"


def is_multilateration(errors: xr.Dataset) -> bool:
    """Return whether a dataset is a result of multilateration over targets."""
    return errors.attrs.get("method") == "multilateration" and errors["EX"].dims == ("target",)


def network(errors: xr.Dataset, raw: xr.Dataset | None = None) -> Network:
    """Return the view of a dataset over targets, with the residuals of ignored readings from ``raw``."""
    m, n = errors.sizes["target"], errors.sizes.get("station", 0)
    sizes = {"target": m, "station": n, "direction": 3, "direction_": 3}

    def get(name: str, *dims: str) -> Array:
        shape = tuple(sizes[dim] for dim in dims)
        if name not in errors or set(errors[name].dims) != set(dims) or errors[name].dtype.kind not in "iufb":
            return np.full(shape, np.nan)
        values = np.asarray(errors[name].transpose(*dims).values, float)
        return values if values.shape == shape else np.full(shape, np.nan)

    position = get("target_nominal", "target", "direction")
    if not np.isfinite(position).any():
        position = np.stack([get(name, "target") for name in "xyz"], axis=-1)
    variance = np.diagonal(get("station_covariance", "station", "direction", "direction_"), axis1=1, axis2=2)
    covariance = np.asarray(errors["covariance"].transpose("target", "dof", "dof_").values, float)[:, :3, :3]
    station, dead_path = get("station_place", "station", "direction"), get("dead_path", "station")
    residual = get("residual", "station", "target").copy()  # filled below
    left_out = np.nan_to_num(get("left_out", "station", "target")).astype(np.int64)
    given = raw["displacement"] if raw is not None and "displacement" in raw else None
    if given is not None and given.dims == _READING and given.shape == residual.shape:
        found = get("target_place", "target", "direction")
        for j, i in np.argwhere((left_out > 0) & np.isnan(residual)):
            way = np.linalg.norm(found[i] - station[j]) - dead_path[j]
            residual[j, i] = float(given[j, i]) - way
    return Network(
        _names(errors, "target", m),
        _names(errors, "station", n),
        position,
        np.stack([np.asarray(errors[name].values, float) for name in FREEDOMS[:3]], axis=-1),
        covariance,
        station,
        get("station_nominal", "station", "direction"),
        np.sqrt(np.where(variance >= 0, variance, np.nan)),
        dead_path,
        get("dead_path_u", "station"),
        residual,
        left_out,
        scalar(errors, "noise"),
    )


def scalar(errors: xr.Dataset, name: str) -> float:
    """Return a scalar of the dataset; NaN if it is missing."""
    if name not in errors or errors[name].ndim or errors[name].dtype.kind not in "iuf":
        return math.nan
    return float(errors[name])


def _names(errors: xr.Dataset, dim: str, size: int) -> list[str]:
    if dim in errors.coords:
        return [str(name) for name in errors[dim].values]
    return [str(i + 1) for i in range(size)]


def thinned(indices: NDArray[np.intp], most: int, always: int | None = None) -> NDArray[np.intp]:
    """Return a random sample of at most ``most`` indices, in any case with ``always``."""
    # A sample with a constant step could omit whole rows or layers.
    kept = indices[np.random.default_rng(0).permutation(indices.size)[:most]]
    if always is not None and always in indices:
        kept = np.append(kept, always)
    return np.unique(kept)
