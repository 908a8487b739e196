"""What a plan states in words."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from errormotion.datasets.units import format_quantity
from errormotion.kinematics.iso import iso_names
from errormotion.methods.linear_positioning.diagonals import planning as diagonals
from errormotion.methods.linear_positioning.planning.targets import seconds
from errormotion.methods.linear_positioning.simulation import planned_scatter

if TYPE_CHECKING:
    from errormotion.methods.linear_positioning.settings import LinearPositioningSettings


def summary(planned: xr.Dataset, settings: LinearPositioningSettings) -> str:
    """Return the size of a test, its duration, and the expected standard uncertainties."""
    scatter, drift = (format_quantity(value, "um", 2) for value in planned_scatter(settings))
    if settings.diagonals is not None:
        u = np.sqrt(planned["deviation_variance"].values)
        square = np.sqrt(np.diagonal(planned["squareness_covariance"].values))
        of_squareness = ", ".join(
            f"{name} {format_quantity(float(each), 'arcsec', 2)}"
            for name, each in zip(planned["squareness_of"].values, square, strict=True)
        )
        return (
            f"{planned.sizes['diagonal']} diagonals with {planned.sizes['target']} stops, {settings.runs} runs in both "
            f"directions, about {diagonals.seconds(settings) / 60:.0f} min. With a scatter of {scatter} and a drift of "
            f"{drift} the standard uncertainty along a diagonal is {format_quantity(float(u.min()), 'um', 2)} to "
            f"{format_quantity(float(u.max()), 'um', 2)}"
            f"{', that of squareness ' + of_squareness if of_squareness else ''}."
        )
    k = [str(name) for name in planned["dof"].values].index(settings.freedoms[0])
    u = np.sqrt(planned["covariance"].values[..., k, k])
    unit = "um" if k < 3 else "arcsec"
    if settings.moving is not None:
        return (
            f"{planned.sizes['time'] - 1} readings of both ends in {float(planned['time'][-1]) / 60:.0f} min. With a "
            f"scatter of {scatter} the standard uncertainty of a change at the upper end is "
            f"{format_quantity(float(u[-1, -1]), unit, 2)}."
        )
    return (
        f"{u.size} targets, {settings.runs} runs in both directions, about {seconds(settings) / 60:.0f} min. With a "
        f"scatter of {scatter} and a drift of {drift} the standard uncertainty of "
        f"{iso_names(settings.axis)[settings.freedoms[0]]} is {format_quantity(float(u.min()), unit, 2)} to "
        f"{format_quantity(float(u.max()), unit, 2)}."
    )
