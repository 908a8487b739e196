"""Figures of merit that several methods state in the same way: the six freedoms at one instant or of one beam."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from errormotion.plugins import FigureOfMerit

if TYPE_CHECKING:
    import xarray as xr


def is_planned(errors: xr.Dataset) -> bool:
    """Return whether a dataset states an expected covariance, and nothing was measured."""
    return "planned" in str(errors.attrs.get("reference", ""))


def last_values(errors: xr.Dataset) -> list[FigureOfMerit]:
    """Return every estimate at its last known time, with U (k = 2); empty for a dataset over other dimensions."""
    found = []
    covariance = errors.em.covariance().values
    for k, name in enumerate(errors.em.names):
        error = errors[name]
        known = np.flatnonzero(np.isfinite(np.asarray(error.values, dtype=float)))
        if error.dims != ("time",) or known.size == 0:
            continue
        last = int(known[-1])
        minutes = float(errors["time"].values[last]) / 60.0
        U = 2.0 * float(np.sqrt(covariance[last, k, k]))
        found.append(
            FigureOfMerit(f"{name} after {minutes:.1f} min", float(error.values[last]), U, error.attrs["units"])
        )
    return found


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
