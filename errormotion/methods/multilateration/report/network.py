"""The network of a result: its variables, NaN where the dataset lacks one, and what follows from them."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.kinematics.iso import DOF
from errormotion.report.document import Source

AXES = ("X", "Y", "Z")
_READING = ("station", "target")
_VARIABLES: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("target_nominal", "target_place"), ("target", "direction")),
    **dict.fromkeys(("station_place", "station_nominal", "best_place"), ("station", "direction")),
    "station_covariance": ("station", "direction", "direction_"),
    **dict.fromkeys(("dead_path", "dead_path_u"), ("station",)),
    **dict.fromkeys(("residual", "left_out"), _READING),
    **dict.fromkeys(("noise", "sigma0", "freedom", "condition", "repeatability", "repeatability_u", "axes_sigma0"), ()),
}


def network(errors: xr.Dataset) -> xr.Dataset:
    """Return a dataset with all variables of the network, in m.

    It has further: ``position`` and ``error`` (target, direction), of the reflector; ``length`` (target) of the error
    vector; ``variance`` (target, direction, direction_); ``worst_direction`` (target), the standard uncertainty in the
    worst direction; names of targets and stations.
    """
    sizes = {"direction": 3, "direction_": 3, "station": errors.sizes.get("station", 0), **errors.sizes}
    made: dict[str, xr.DataArray] = {}
    for name, dims in _VARIABLES.items():
        if name not in errors or set(errors[name].dims) != set(dims) or errors[name].dtype.kind not in "iufb":
            made[name] = xr.DataArray(np.full([sizes[dim] for dim in dims], np.nan), dims=dims)
        else:
            made[name] = errors[name].transpose(*dims)
        made[name].attrs.setdefault("units", "m")
    position = made["target_nominal"]
    if not np.isfinite(position.values).any() and set("xyz") <= set(errors.coords):
        position = xr.concat([errors[name] for name in "xyz"], "direction").T
    error = np.stack([errors[name].values for name in DOF[:3]], axis=-1)
    variance = errors["covariance"].transpose("target", "dof", "dof_").values[:, :3, :3].astype(float)
    worst, known = np.full(len(variance), np.nan), np.isfinite(variance).all(axis=(1, 2))
    worst[known] = np.sqrt(np.linalg.eigvalsh(variance[known])[:, -1].clip(0))
    names = {
        dim: [str(name) for name in errors[dim].values] if dim in errors.coords else [str(k + 1) for k in range(count)]
        for dim, count in (("target", errors.sizes["target"]), ("station", sizes["station"]))
    }
    metre = {"units": "m"}
    found = errors.drop_vars([name for name in made if name in errors]).assign_coords(names)
    return found.assign(
        {
            **made,
            "position": (("target", "direction"), position.values, metre),
            "error": (("target", "direction"), error, metre),
            "length": ("target", np.linalg.norm(error, axis=1), metre),
            "variance": (("target", "direction", "direction_"), variance),
            "worst_direction": ("target", worst, metre),
        }
    ).assign_coords(direction=list("xyz"), direction_=list("xyz"))


def drawn(net: xr.Dataset) -> NDArray[np.intp]:
    """Return the targets with a known position."""
    return np.flatnonzero(np.isfinite(net["position"].values).all(axis=1))


def longest(net: xr.Dataset) -> int | None:
    """Return the target with the longest error vector; None if none is known."""
    size = net["length"].values
    return int(np.nanargmax(size)) if np.isfinite(size).any() else None


def used(net: xr.Dataset) -> xr.DataArray:
    """Return the residuals of the used readings, (station, target), m; NaN elsewhere."""
    return net["residual"].where(net["left_out"].fillna(0) == 0).assign_attrs(units="m")


def left_out(net: xr.Dataset) -> NDArray[np.int64]:
    """Return the use of the readings, (station, target): 0: used; 1: outlier; 2: the target was excluded."""
    return np.asarray(np.nan_to_num(net["left_out"].values), dtype=np.int64)


def residuals(source: Source) -> Array:
    """Return the residuals, (station, target), m, with those of ignored readings as far as the raw data have them."""
    net, raw = source.errors, source.raw
    found = net["residual"].values.astype(float).copy()
    given = raw["displacement"] if raw is not None and "displacement" in raw else None
    if given is not None and given.dims == _READING and given.shape == found.shape:
        for j, i in np.argwhere((left_out(net) > 0) & np.isnan(found)):
            way = np.linalg.norm(net["target_place"].values[i] - net["station_place"].values[j])
            found[j, i] = float(given[j, i]) - (way - float(net["dead_path"][j]))
    return found


def thinned(indices: NDArray[np.intp], most: int, always: int | None = None) -> NDArray[np.intp]:
    """Return a random sample of at most ``most`` indices, in any case with ``always``."""
    # A sample with a constant step could omit whole rows or layers.
    kept = indices[np.random.default_rng(0).permutation(indices.size)[:most]]
    if always is not None and always in indices:
        kept = np.append(kept, always)
    return np.unique(kept)
