"""Expected uncertainty of a planned test along diagonals."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from errormotion.datasets import provenance
from errormotion.datasets.units import format_quantity
from errormotion.methods.linear_positioning.diagonals.identification import identify_diagonals
from errormotion.methods.linear_positioning.diagonals.planning import seconds
from errormotion.methods.linear_positioning.diagonals.simulation import simulate_diagonals
from errormotion.methods.linear_positioning.planning.plan import assumed_scatter

if TYPE_CHECKING:
    from errormotion.methods.linear_positioning.settings import Settings
    from errormotion.plugins import MethodInfo


def plan_diagonals(settings: Settings, info: MethodInfo) -> xr.Dataset:
    """Return an error dataset of zeros along the diagonals, with the expected covariance."""
    assumed, scatter, drift = assumed_scatter(settings)
    raw, _ = simulate_diagonals(settings, 0)
    zeros = raw.assign(diagonal_deviation=0.0 * raw["diagonal_deviation"]).assign_attrs(machine="plan")
    errors = identify_diagonals(
        zeros.drop_vars(["length_uncertainty", "alignment_uncertainty"]), assumed, info, planned=True
    )
    origin = json.dumps(provenance.make(assumed, None, None, steps=["plan"]))
    u = np.sqrt(errors["deviation_variance"].values)
    square = np.sqrt(np.diagonal(errors["squareness_covariance"].values))
    of_squareness = ", ".join(
        f"{name} {format_quantity(float(each), 'arcsec', 2)}"
        for name, each in zip(errors["squareness_of"].values, square, strict=True)
    )
    smallest, largest = (format_quantity(float(each), "um", 2) for each in (u.min(), u.max()))
    note = (
        f"{errors.sizes['diagonal']} diagonals with {errors.sizes['target']} stops, {settings.runs} runs in both "
        f"directions, about {seconds(settings) / 60:.0f} min. With a scatter of "
        f"{format_quantity(scatter, 'um', 2)} and a drift of {format_quantity(drift, 'um', 2)} the standard "
        f"uncertainty along a diagonal is {smallest} to {largest}"
        f"{', that of squareness ' + of_squareness if of_squareness else ''}."
    )
    zero = {name: 0.0 * errors[name] for name in ("deviation", "squareness")}
    return errors.assign(zero).assign_attrs(reference="planned, not measured", provenance=origin, notes=[note])
