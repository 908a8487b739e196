"""Figures of merit of any error dataset, and those that several methods state in the same way."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from errormotion import plugins
from errormotion.plugins import FigureOfMerit

if TYPE_CHECKING:
    import xarray as xr
    from numpy.typing import NDArray


def is_planned(errors: xr.Dataset) -> bool:
    """Return whether a dataset is a plan, with an expected covariance instead of measured errors."""
    return "planned" in str(errors.attrs.get("reference", ""))


def figures_of(errors: xr.Dataset) -> list[FigureOfMerit]:
    """Return the figures of merit: those of the plugin that made the dataset, else the last values over time.

    A plan has none.
    """
    if is_planned(errors):
        return []
    owner = plugins.owner_of_method(str(errors.attrs.get("method")))
    stated = None if owner is None else owner().figures(errors)
    return last_values(errors) if stated is None else list(stated)


def states_figures(errors: xr.Dataset) -> bool:
    """Return whether the plugin that made a dataset states its figures of merit."""
    owner = plugins.owner_of_method(str(errors.attrs.get("method")))
    return owner is not None and plugins.states(owner, "figures")


def stored(figure: FigureOfMerit) -> dict[str, Any]:
    """Return a figure for a JSON file, SI; unknown numbers are None."""
    numbers = {"value": figure.value, "expanded_uncertainty": figure.expanded_uncertainty, "limit": figure.limit}
    known = {
        key: None if number is None or not np.isfinite(number) else float(number) for key, number in numbers.items()
    }
    return {"name": figure.name, **known, "unit": figure.unit}


def of_reference(errors: xr.Dataset) -> NDArray[np.bool_]:
    """Return which points belong to the reference state, whose errors are 0 by definition, over `em.dims`."""
    at_reference = np.zeros(tuple(errors.sizes[dim] for dim in errors.em.dims), bool)
    if "time" in errors.em.dims and "time" in errors.coords and "reference_interval" in errors.attrs:
        first, last = np.asarray(errors.attrs["reference_interval"], dtype=float)
        time = np.asarray(errors["time"].values, dtype=float)
        inside = (time >= first - 1e-6) & (time <= last + 1e-6)
        shape = [-1 if dim == "time" else 1 for dim in errors.em.dims]
        at_reference |= inside.reshape(shape)
    return at_reference


def last_values(errors: xr.Dataset) -> list[FigureOfMerit]:
    """Return every estimate at its last known time, with U (k = 2); empty for a dataset over other dimensions.

    An estimate of which only the reference state is known is unknown (NaN).
    """
    values = []
    covariance = errors.em.covariance().values
    reference = of_reference(errors)
    for k, name in enumerate(errors.em.names):
        error = errors[name]
        known = np.flatnonzero(np.isfinite(np.asarray(error.values, dtype=float)))
        if error.dims != ("time",) or known.size == 0:
            continue
        last = int(known[-1])
        minutes = float(errors["time"].values[last]) / 60.0
        value, U = float(error.values[last]), 2.0 * float(np.sqrt(covariance[last, k, k]))
        if reference[known].all():
            value = U = np.nan
        values.append(FigureOfMerit(f"{name} after {minutes:.1f} min", value, U, error.attrs["units"]))
    return values


def beam_errors(errors: xr.Dataset) -> list[FigureOfMerit]:
    """Return every known freedom of every beam against nominal; empty for a dataset over other dimensions."""
    if errors["EX"].dims != ("beam",):
        return []
    return [
        _freedom(errors, k, str(name), i, f"{name} of {beam} against nominal")
        for i, beam in enumerate(errors["beam"].values)
        for k, name in enumerate(errors["dof"].values)
        if np.isfinite(errors[str(name)].values[i])
    ]


def _freedom(errors: xr.Dataset, k: int, name: str, index: int, label: str) -> FigureOfMerit:
    variance = float(errors["covariance"].values[index, k, k])
    unit = str(errors[name].attrs["units"])
    return FigureOfMerit(label, float(errors[name].values[index]), 2.0 * float(np.sqrt(variance)), unit)
