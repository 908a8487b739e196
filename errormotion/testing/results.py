"""An error dataset as plain arrays over its places, and the truth at those places."""

from __future__ import annotations

import numpy as np
import xarray as xr

from errormotion.kinematics import twists
from errormotion.kinematics.iso import DOF
from errormotion.testing.kit import require


def place_dims(errors: xr.Dataset) -> tuple[str, ...]:
    """Return the dimensions over which the errors are given."""
    return tuple(str(dim) for dim in errors["EX"].dims)


def values(errors: xr.Dataset) -> np.ndarray:
    """Return the six freedoms, (place, 6), SI; NaN is unknown."""
    return np.stack([errors[name].transpose(*place_dims(errors)).values.ravel() for name in DOF], axis=-1)


def covariance(errors: xr.Dataset) -> np.ndarray:
    """Return the covariance at every place, (place, 6, 6), SI."""
    full = errors["covariance"].transpose(*place_dims(errors), "dof", "dof_").values
    blocks: np.ndarray = np.reshape(full, (-1, 6, 6))
    return blocks


def sigma(errors: xr.Dataset) -> np.ndarray:
    """Return the standard uncertainties, (place, 6), SI."""
    u: np.ndarray = np.sqrt(np.einsum("pii->pi", covariance(errors)))
    return u


def influence(errors: xr.Dataset) -> np.ndarray:
    """Return the effects of the shared sources, (place, source, 6), SI; no source where none is stated."""
    if "influence" not in errors:
        return np.zeros((len(values(errors)), 0, 6))
    full = errors["influence"].transpose(*place_dims(errors), "source", "dof").values
    return np.reshape(full, (-1, full.shape[-2], 6))


def functional_point(errors: xr.Dataset) -> np.ndarray:
    """Return the point whose displacement the errors tell, (3,), m."""
    return np.asarray(errors.attrs["functional_point"], dtype=float)


def truth_at_places(errors: xr.Dataset, truth: xr.Dataset) -> np.ndarray:
    """Return the true errors, (place, 6), at the places and at the functional point of a result."""
    dims = place_dims(errors)
    require(place_dims(truth) == dims, f"the truth is given over {place_dims(truth)}, the result over {dims}")
    known = truth[list(DOF)]
    for dim in dims:
        if errors[dim].dtype.kind in "fiu":
            low, high = float(truth[dim].min()), float(truth[dim].max())
            inside = bool(((errors[dim] >= low) & (errors[dim] <= high)).all())
            require(inside, f"the truth covers {dim} from {low:g} to {high:g} only")
            known = known.interp({dim: errors[dim].values})
        else:
            known = known.sel({dim: errors[dim].values})
    return twists.move(values(known), functional_point(errors) - functional_point(truth))
