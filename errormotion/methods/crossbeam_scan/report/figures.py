"""Figures of merit of a result: the largest error of each freedom, or the pose of the profiler against nominal."""

from __future__ import annotations

import numpy as np
import xarray as xr

from errormotion.methods.crossbeam_scan.report.view import campaign, is_campaign, is_pose
from errormotion.plugins import FigureOfMerit
from errormotion.report.budget import FREEDOMS


def figures(errors: xr.Dataset) -> list[FigureOfMerit]:
    """Return the figures of merit of a campaign or of a profiler pose, in m and rad; none for a plan."""
    if "planned" in str(errors.attrs.get("reference", "")):
        return []
    if is_campaign(errors):
        return _largest(errors)
    return _of_pose(errors) if is_pose(errors) else []


def _largest(errors: xr.Dataset) -> list[FigureOfMerit]:
    seen, found = campaign(errors), []
    for i, freedom in enumerate(FREEDOMS):
        at, largest = seen.largest(i), seen.extreme(i)
        if at is not None and largest is not None:
            name = f"largest {seen.names[freedom]} at {seen.where(*at)}".replace("\u00a0", " ")
            effects = _effects(errors, freedom, at)
            found.append(FigureOfMerit(name, largest.value, largest.expanded, _unit(i), influence=effects))
    return found


def _effects(errors: xr.Dataset, freedom: str, at: tuple[int, int]) -> dict[str, float] | None:
    """Return the effect of each source on an error at (cycle, artefact)."""
    if "influence" not in errors:
        return None
    there = errors["influence"].isel(time=at[0], position=at[1]).sel(dof=freedom)
    return {str(name): float(F) for name, F in zip(errors["source"].values, there.values, strict=True)}


def _of_pose(errors: xr.Dataset) -> list[FigureOfMerit]:
    variance = np.diagonal(errors["covariance"].transpose("beam", "dof", "dof_").values[0])
    return [
        FigureOfMerit(
            f"{freedom} of the profiler against nominal",
            float(errors[freedom].values[0]),
            2 * float(np.sqrt(variance[i])),
            _unit(i),
        )
        for i, freedom in enumerate(FREEDOMS)
        if np.isfinite(errors[freedom].values[0])
    ]


def _unit(freedom: int) -> str:
    return "m" if freedom < 3 else "rad"
