"""Figures of merit: the errors of the beam, and the check bar measured with it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from errormotion.datasets.results.merit import beam_errors, is_planned
from errormotion.plugins import FigureOfMerit

if TYPE_CHECKING:
    import xarray as xr


def figures(errors: xr.Dataset) -> list[FigureOfMerit]:
    """Return the known errors of the beam, and radius and residual of a check bar; none for a plan."""
    if is_planned(errors):
        return []
    merits = beam_errors(errors)
    if "bar_radius_fitted" in errors:
        radius, u = float(errors["bar_radius_fitted"]), float(errors["bar_radius_u"])
        used = errors["bar_residual"].values[errors["bar_left_out"].values == 0]
        rms = float(np.sqrt(np.nanmean(used**2)))
        merits += [
            FigureOfMerit("radius of the check bar", radius, 2.0 * u, "m"),
            FigureOfMerit("residual on the check bar, root mean square", rms, float("nan"), "m"),
        ]
    return merits
