"""Changes of an error dataset with propagation of its covariance: another reference state, a mean."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from errormotion.arrays import Array, filled, products
from errormotion.datasets.schemas import DOF, INDEX
from errormotion.datasets.timing import between
from errormotion.errors import DatasetError
from errormotion.estimation.low_rank import root_of

REFERENCE = "reference state"
"""Group of the sources of the uncertainty of a reference state."""


def since(ds: xr.Dataset, time: float | tuple[float, float]) -> xr.Dataset:
    """Return the changes of the errors since an instant, or since the mean over an interval.

    The uncertainty of the reference state is one draw for all values: it is an additional source for each known freedom
    (and for each place, if the errors have further dimensions). The influences of all other sources are differences, so
    that effects that the reference state and a value share cancel.

    Parameters
    ----------
    ds : Dataset
        Error dataset over ``time`` and possibly further dimensions.
    time : float or tuple of float
        One of the instants of the dataset, or first and last time of the interval, s. It is time 0 of the result (the
        middle of an interval).

    Returns
    -------
    Dataset
        Without the further results of the method, which are relative to its own reference.

    Raises
    ------
    DatasetError
        Errors without ``time``, or along one direction only; no known value in the interval.
    """
    _freedoms_over(ds, "time")
    t = np.asarray(ds["time"].values, dtype=float)
    first, last = (time, time) if isinstance(time, (int, float)) else time
    inside = (t >= first - TOLERANCE) & (t <= last + TOLERANCE)
    axis = ds["EX"].dims.index("time")
    E = np.moveaxis(np.stack([ds[name].values for name in DOF], axis=-1), axis, 0)
    C = np.moveaxis(np.asarray(ds["covariance"].values, dtype=float), axis, 0)
    F = np.moveaxis(influence_of(ds), axis + 1, 1)
    seen = ~np.isnan(E).all(axis=0)
    inside = inside.reshape(-1, *[1] * (E.ndim - 1)) & (~np.isnan(E) | ~seen).all(axis=-1, keepdims=True)
    used = np.broadcast_to(inside[..., 0], E.shape[:-1])
    count = used.sum(axis=0)
    if not (count > 0)[seen.any(axis=-1)].all():
        raise DatasetError(
            f"No known errors from {first:g} s to {last:g} s for a reference state; times are "
            f"{t[0]:g} s to {t[-1]:g} s",
            code="errors.reference.no_errors",
        )
    changed, total, influence, further = changes(E, C, F, used)
    zero = (first + last) / 2
    values = np.moveaxis(changed, 0, axis)
    return rebuilt(
        ds,
        values,
        np.moveaxis(total, 0, axis),
        np.moveaxis(influence, 1, axis + 1),
        further,
        {"time": ("time", t - zero, dict(ds["time"].attrs))},
        reference=f"mean of the errors from {first:g} s to {last:g} s",
        reference_interval=np.array([first - zero, last - zero]),
        **_started(ds, zero),
    )


def changes(E: Array, C: Array, F: Array, used: NDArray[np.bool_]) -> tuple[Array, Array, Array, list[str]]:
    """Return the changes of errors since the mean of some of them, with their covariance; see `since`.

    Parameters
    ----------
    E, C, F : ndarray, (n, ..., 6), (n, ..., 6, 6), (source, n, ..., 6)
        Errors, total covariance, influence.
    used : ndarray of bool, (n, ...)
        Whether the reference state includes each error.

    Returns
    -------
    E, C, F : ndarray
    further : list of str
        Names of the sources that are the uncertainty of the reference state, the last ones of F.
    """
    m = np.maximum(used.sum(axis=0), 1)
    own = filled(C - products(F))
    E_ref = np.where(used[..., None], filled(E), 0.0).sum(axis=0) / m[..., None]
    F_ref = np.where(used[None, ..., None], filled(F), 0.0).sum(axis=1) / m[None, ..., None]
    own_ref = np.where(used[..., None, None], own, 0.0).sum(axis=0) / (m**2)[..., None, None]
    rows = _sources_of(own_ref)  # (part, ..., 6)
    rows = np.broadcast_to(rows[:, None], (len(rows), *E.shape)).copy()
    rows[:, used] = 0.0  # values of the reference state share its noise
    share = used[..., None, None]
    own = np.where(share, own * (1 - 2 / m)[None, ..., None, None] + own_ref, own)
    own = np.where(share & (m == 1)[None, ..., None, None], 0.0, own)
    shifted = F - F_ref[:, None]
    influence = np.concatenate([shifted, rows])
    nan = np.isnan(E)
    influence[:, nan] = np.nan
    own[nan[..., :, None] | nan[..., None, :]] = np.nan
    total = own + products(influence)
    return E - E_ref, total, influence, [f"{REFERENCE}, part {k + 1}" for k in range(len(rows))]


def mean(ds: xr.Dataset, dim: str) -> xr.Dataset:
    """Return the mean over a dimension, with its covariance; NaN are left out.

    Parameters
    ----------
    ds : Dataset
        Error dataset of the six freedoms.
    dim : str
        One of its dimensions.

    Raises
    ------
    DatasetError
        No such dimension, or errors along one direction only.
    """
    _freedoms_over(ds, dim)
    axis = ds["EX"].dims.index(dim)
    E = np.stack([ds[name].values for name in DOF], axis=-1)
    known = ~np.isnan(E)
    count = known.sum(axis=axis)
    weight = np.where(known, 1.0, 0.0) / np.maximum(np.expand_dims(count, axis), 1)
    F = filled(influence_of(ds))
    own = filled(np.asarray(ds["covariance"].values) - products(F))
    value = (weight * filled(E)).sum(axis=axis)
    value[count == 0] = np.nan
    influence = (weight[None] * F).sum(axis=axis + 1)
    influence[:, count == 0] = np.nan
    own = (own * weight[..., :, None] * weight[..., None, :]).sum(axis=axis)
    total = own + products(influence)
    total[np.isnan(value)[..., :, None] | np.isnan(value)[..., None, :]] = np.nan
    rest = ds.isel({dim: 0}, drop=True).drop_vars(f"{dim}{INDEX}", errors="ignore")
    return rebuilt(rest, value, total, influence, [], {})


def change(after: xr.Dataset, before: xr.Dataset) -> xr.Dataset:
    """Return the changes of errors since another measurement of the same places, such as a warm minus a cold volume.

    Parameters
    ----------
    after, before : Dataset
        Error datasets of one component over ``position`` or ``target``; both state ``start``. Places of ``after`` that
        are not in ``before`` are left out.

    Returns
    -------
    Dataset
        Sources with the same ``source_id`` are one draw. Without the further results of the method.

    Raises
    ------
    DatasetError
        Another machine, component, frame or functional point; no start; no common places.
    """
    for name in ("machine", "component", "frame"):
        if after.attrs[name] != before.attrs[name]:
            raise DatasetError(
                f"A change needs one {name}; found '{after.attrs[name]}' and '{before.attrs[name]}' (before)",
                code="change.attribute.differs",
            )
    dims = after["EX"].dims
    if dims != before["EX"].dims or dims not in (("position",), ("target",)):
        raise DatasetError(
            "A change of places needs errors over position or target in both datasets; found "
            f"{', '.join(map(str, dims)) or 'none'} and {', '.join(map(str, before['EX'].dims)) or 'none'} (before)",
            code="change.places.dims",
        )
    silent = [name for name, ds in (("after", after), ("before", before)) if not ds.attrs.get("start")]
    if silent:
        raise DatasetError(
            f"A change needs the attribute 'start' of both datasets; {' and '.join(silent)}: none",
            code="change.start.missing",
        )
    _freedoms_over(after, str(dims[0]))
    _freedoms_over(before, str(dims[0]))
    before = before.em.at(after.attrs["functional_point"])
    axes = [name for name in "xyz" if name in after.variables and name in before.variables]
    places = [np.stack([ds[name].values for name in axes], axis=-1) if axes else None for ds in (after, before)]
    if places[0] is None or places[1] is None:
        raise DatasetError(
            "A change of places needs the commanded x, y or z in both datasets; found none in common",
            code="change.places.coordinates",
        )
    nearest = np.array([np.abs(places[1] - each).max(axis=1).argmin() for each in places[0]])
    rows = np.flatnonzero(np.abs(places[0] - places[1][nearest]).max(axis=1) <= SAME_PLACE)
    if not rows.size:
        raise DatasetError(
            f"The datasets have no place in common (within {SAME_PLACE * 1e6:g} um)", code="change.places.none_common"
        )
    a, b = after.isel({dims[0]: rows}), before.isel({dims[0]: nearest[rows]})
    F, G = influence_of(a), influence_of(b)
    own = [ds["covariance"].values - np.einsum("snj,snk->njk", f, f) for ds, f in ((a, F), (b, G))]
    ids = [list(ds["source_id"].values) if "source_id" in ds.coords else [""] * len(f) for ds, f in ((a, F), (b, G))]
    shared = [ids[0].index(each) if each and each in ids[0] else -1 for each in ids[1]]
    value = np.stack([a[name].values - b[name].values for name in DOF], axis=-1)
    F = F.copy()
    for k, mine in enumerate(shared):
        if mine >= 0:
            F[mine] -= G[k]
    own_only = [k for k, mine in enumerate(shared) if mine < 0]
    gone = np.isnan(value)
    F = np.concatenate([F, -G[own_only]])
    F[:, gone] = np.nan
    total = own[0] + own[1] + np.einsum("snj,snk->njk", F, F)
    total[gone[:, :, None] | gone[:, None, :]] = np.nan
    names = [f"{b['source'].values[k]} (before)" for k in own_only]
    away = -between(str(before.attrs["start"]), str(after.attrs["start"]))
    changed = rebuilt(
        a, value, total, F, names, {}, reference=f"the state measured from {before.attrs['start']}",
        reference_interval=np.array([away, away]),
    )  # fmt: skip
    if len(names):
        known = changed["source_id"].values.astype(object)
        known[-len(names) :] = [ids[1][k] for k in own_only]
        changed = changed.assign_coords(source_id=("source", known.astype(str)))
    return changed


SAME_PLACE = 1e-6
"""Distance below which two commanded positions count as equal, m."""
TOLERANCE = 1e-9
"""Rounding of a time, s."""


def rebuilt(
    ds: xr.Dataset,
    values: Array,
    covariance: Array,
    influence: Array,
    further: Sequence[str],
    coords: dict[str, Any],
    **attrs: Any,
) -> xr.Dataset:
    """Return an error dataset with the attributes of ``ds`` and other values; ``further`` are reference sources."""
    dims = ds["EX"].dims
    kept = ds.drop_vars(
        [name for name in ds.variables if name not in _KEPT and not _is_place(ds, name, dims)], errors="ignore"
    ).drop_dims("source", errors="ignore")
    out = kept.assign({name: (dims, values[..., k], dict(ds[name].attrs)) for k, name in enumerate(DOF)})
    out["covariance"] = ((*dims, "dof", "dof_"), covariance, dict(ds["covariance"].attrs))
    if len(influence):
        out["influence"] = (("source", *dims, "dof"), influence, {"long_name": "of one standard uncertainty"})
        out = out.assign_coords(_source_coords(ds, further))
    return out.assign_coords(coords).assign_attrs(**attrs)


_KEPT = {*DOF, "covariance", "dof", "dof_"}


def _is_place(ds: xr.Dataset, name: Any, dims: Sequence[Any]) -> bool:
    """Return whether a variable states position or time of the errors, or numbers them."""
    along = set(ds.variables[name].dims) <= set(dims)
    return along and (name in ds.coords or str(name).endswith(INDEX))


def _source_coords(ds: xr.Dataset, further: Sequence[str]) -> dict[str, Any]:
    size = ds.sizes.get("source", 0)

    def of(name: str, default: list[Any], more: list[Any]) -> list[Any]:
        return [*(ds[name].values.tolist() if name in ds.coords else default), *more]

    references = of("source_reference", [0] * size, [1] * len(further))
    return {
        "source": of("source", [], list(further)),
        "source_group": ("source", of("source_group", [""] * size, [REFERENCE] * len(further))),
        "source_id": ("source", of("source_id", [""] * size, [""] * len(further))),
        "source_reference": ("source", np.array(references, dtype=np.int8)),
    }


def _sources_of(covariance: Array) -> Array:
    """Return sources (part, ..., 6) whose products sum to covariances (..., 6, 6); one for each rank and place."""
    flat = covariance.reshape(-1, 6, 6)
    rows = []
    for i, matrix in enumerate(flat):
        for part in root_of(matrix).T:
            row = np.zeros_like(flat[:, 0])
            row[i] = part
            rows.append(row.reshape(covariance.shape[:-1]))
    return np.array(rows) if rows else np.zeros((0, *covariance.shape[:-1]))


def influence_of(ds: xr.Dataset) -> Array:
    """Return the influence of an error dataset, (source, ..., 6), possibly without sources."""
    if "influence" in ds.variables:
        return np.asarray(ds["influence"].values, dtype=float)
    return np.zeros((0, *ds["EX"].shape, 6))


def _freedoms_over(ds: xr.Dataset, dim: str) -> None:
    if "deviation" in ds.variables:
        raise DatasetError(
            "The errors are known along one direction only; the six freedoms are needed here",
            code="errors.freedoms.one_direction",
        )
    if dim not in ds["EX"].dims:
        raise DatasetError(
            f"Expected errors over '{dim}'; found {', '.join(map(str, ds['EX'].dims)) or 'no dims'}",
            code="errors.dim.missing",
        )


def _started(ds: xr.Dataset, seconds: float) -> dict[str, str]:
    from errormotion.datasets.timing import later

    return {"start": later(ds.attrs["start"], seconds)} if "start" in ds.attrs else {}
