"""An error dataset as arrays over its points (positions or times), and the truth at these points."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import xarray as xr

from errormotion.kinematics import twists
from errormotion.kinematics.iso import DOF
from errormotion.plugins import MethodSubject
from errormotion.testing.kit import require


def raw_data(subject: MethodSubject) -> xr.Dataset:
    """Return a copy of the raw data of seed 0; they are simulated once for all checks."""
    return _simulated(subject).copy(deep=True)


@lru_cache(maxsize=4)
def _simulated(subject: MethodSubject) -> xr.Dataset:
    return subject.make(0)[0]


def place_dims(errors: xr.Dataset) -> tuple[str, ...]:
    """Return the dimensions of the errors."""
    return tuple(str(dim) for dim in errors.variables["EX"].dims)


def names(errors: xr.Dataset) -> tuple[str, ...]:
    """Return the names of the estimates: the six freedoms, or only ``deviation``."""
    return tuple(errors.em.names)


def values(errors: xr.Dataset) -> np.ndarray:
    """Return the estimates, (place, n), SI; NaN is unknown."""
    dims = place_dims(errors)
    full = np.stack([errors.variables[name].transpose(*dims).values for name in names(errors)], axis=-1)
    return full.reshape(-1, full.shape[-1])


def covariance(errors: xr.Dataset) -> np.ndarray:
    """Return the covariance of the estimates at each point, (place, n, n), SI."""
    n, dims = len(names(errors)), place_dims(errors)
    if n == 1:
        return errors.variables["deviation_variance"].transpose(*dims).values.reshape(-1, 1, 1)
    return errors.variables["covariance"].transpose(*dims, "dof", "dof_").values.reshape(-1, n, n)


def sigma(errors: xr.Dataset) -> np.ndarray:
    """Return the standard uncertainties, (place, n), SI."""
    u: np.ndarray = np.sqrt(np.einsum("pii->pi", covariance(errors)))
    return u


def influence(errors: xr.Dataset) -> np.ndarray:
    """Return the effects of the shared sources, (place, source, n), SI; may contain no source."""
    n = len(names(errors))
    name = "influence" if n > 1 else "deviation_influence"
    if name not in errors:
        return np.zeros((len(values(errors)), 0, n))
    full = errors[name].transpose(*place_dims(errors), "source", ...).values
    return np.reshape(full, (-1, errors.sizes["source"], n))


def functional_point(errors: xr.Dataset) -> np.ndarray:
    """Return the point whose displacement the errors state, (3,), m."""
    return np.asarray(errors.attrs["functional_point"], dtype=float)


def truth_at_places(errors: xr.Dataset, truth: xr.Dataset) -> np.ndarray:
    """Return the true values, (place, n), at the points and for the functional point of a result."""
    dims = place_dims(errors)
    require(place_dims(truth) == dims, f"the truth has the dimensions {place_dims(truth)}, the result {dims}")
    seen = ("deviation",) if "deviation" in truth else DOF
    require(seen == DOF or names(errors) == seen, "the truth is a deviation, but the result is not")
    array = np.stack([truth.variables[name].transpose(*dims).values for name in seen], axis=-1)
    for axis, dim in enumerate(dims):
        given, wanted = truth[dim].values, errors[dim].values
        if wanted.dtype.kind in "fiu":
            low, high = float(given.min()), float(given.max())
            inside = bool(((wanted >= low) & (wanted <= high)).all())
            require(inside, f"the truth covers {dim} from {low:g} to {high:g} only")
            array = _interpolated(array, axis, given, wanted)
        elif not np.array_equal(given, wanted):
            places = truth.get_index(dim).get_indexer(wanted)
            require(bool((places >= 0).all()), f"the truth lacks values of {dim} that the result has")
            array = np.take(array, places, axis)
    true = array.reshape(-1, len(seen))
    if seen != DOF:
        return true
    moved = twists.move(true, functional_point(errors) - functional_point(truth))
    if names(errors) == DOF:
        return moved
    sensitivity = errors["sensitivity"].broadcast_like(errors["deviation"]).transpose(*dims, "dof").values
    return np.asarray(np.einsum("pi,pi->p", sensitivity.reshape(-1, 6), moved))[:, None]


def _interpolated(array: np.ndarray, axis: int, given: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return an array with values at other coordinates along an axis, by linear interpolation."""
    if np.array_equal(given, wanted):
        return array
    order = np.argsort(given)
    given, array = given[order].astype(float), np.take(array, order, axis)
    after = np.clip(np.searchsorted(given, wanted), 1, max(1, len(given) - 1)) % len(given)
    before = np.maximum(after - 1, 0)
    span = np.where(given[after] > given[before], given[after] - given[before], 1.0)
    share = np.reshape((wanted - given[before]) / span, [-1 if k == axis else 1 for k in range(array.ndim)])
    low, high = np.take(array, before, axis), np.take(array, after, axis)
    return np.where(share == 0.0, low, np.where(share == 1.0, high, low + share * (high - low)))
