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


def final_errors(errors: xr.Dataset) -> list[FigureOfMerit]:
    """Return every known freedom at its last known instant of a drift; empty for a dataset over other dimensions."""
    if errors["EX"].dims != ("time",):
        return []
    found = []
    for k, name in enumerate(errors["dof"].values):
        known = np.flatnonzero(np.isfinite(errors[str(name)].values))
        if known.size:
            minutes = float(errors["time"].values[known[-1]]) / 60.0
            found.append(_freedom(errors, k, str(name), int(known[-1]), f"{name} after {minutes:.1f} min"))
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
