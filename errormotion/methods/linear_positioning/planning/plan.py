"""Expected uncertainty of a planned test."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from errormotion.datasets import provenance
from errormotion.datasets.units import format_quantity
from errormotion.kinematics.iso import iso_names
from errormotion.methods.linear_positioning.identification.identify import build, evaluate
from errormotion.methods.linear_positioning.identification.moving import identify_moving
from errormotion.methods.linear_positioning.planning.targets import positions, seconds
from errormotion.methods.linear_positioning.schema import APPROACHES, READINGS, SCHEMA
from errormotion.methods.linear_positioning.warming import simulate_moving

if TYPE_CHECKING:
    from errormotion.methods.linear_positioning.settings import Settings
    from errormotion.plugins import MethodInfo

SCATTER, DRIFT = 0.5e-6, 1.0e-6
"""Defaults of the standard deviation of a reading and of the range by drift during a run, m or rad."""


def plan(settings: Settings, info: MethodInfo) -> xr.Dataset:
    """Return an error dataset of zeros at the targets, with the expected covariance."""
    if settings.moving is not None:
        return _plan_moving(settings, info)
    P = positions(settings)
    names = iso_names(settings.axis)
    raw = xr.Dataset(
        {
            "deviation": (READINGS, np.zeros((len(settings.freedoms), settings.runs, 2, P.size))),
            "target_position": ("target", P, {"units": "m"}),
        },
        {"freedom": [names[name] for name in settings.freedoms], "approach": list(APPROACHES)},
        {"schema": SCHEMA, "axis": settings.axis, "machine": "plan"},
    )
    assumed, scatter, drift = assumed_scatter(settings)
    notes: list[str] = []
    evaluated = evaluate(raw, assumed, notes, planned=True)
    errors = build(evaluated, raw, info, provenance.make(assumed, None, None, steps=["plan"]), {})
    for name in settings.freedoms:
        errors[name] = errors[name].copy(data=np.zeros(P.size))
    k = [str(name) for name in errors["dof"].values].index(settings.freedoms[0])
    u = np.sqrt(errors["covariance"].values[:, k, k])
    unit = "um" if k < 3 else "arcsec"
    notes.append(
        f"{P.size} targets, {settings.runs} runs in both directions, about {seconds(settings) / 60:.0f} min. With a "
        f"scatter of {format_quantity(scatter, 'um', 2)} and a drift of {format_quantity(drift, 'um', 2)} the standard "
        f"uncertainty of {names[settings.freedoms[0]]} is {format_quantity(float(u.min()), unit, 2)} to "
        f"{format_quantity(float(u.max()), unit, 2)}."
    )
    return errors.assign_attrs(reference="planned, not measured", notes=notes)


def assumed_scatter(settings: Settings) -> tuple[Settings, float, float]:
    """Return settings that state scatter and drift, by default the assumed ones, and the two values."""
    stated = settings.uncertainty
    scatter = SCATTER if stated.scatter is None else stated.scatter
    drift = DRIFT if stated.drift is None else stated.drift
    update = {"uncertainty": stated.model_copy(update={"scatter": scatter, "drift": drift})}
    return settings.model_copy(update=update), scatter, drift


def _plan_moving(settings: Settings, info: MethodInfo) -> xr.Dataset:
    scatter = SCATTER if settings.uncertainty.scatter is None else settings.uncertainty.scatter
    raw, _ = simulate_moving(settings, 0)
    zeros = raw.assign(end_deviation=0.0 * raw["end_deviation"]).assign_attrs(machine="plan")
    errors = identify_moving(zeros, settings, info, scatter)
    origin = json.dumps(provenance.make(settings, None, None, steps=["plan"]))
    k = [str(name) for name in errors["dof"].values].index(settings.freedoms[0])
    u = float(np.sqrt(errors["covariance"].values[-1, -1, k, k]))
    note = (
        f"{errors.sizes['time'] - 1} readings of both ends in {float(errors['time'][-1]) / 60:.0f} min. With a scatter "
        f"of {format_quantity(scatter, 'um', 2)} the standard uncertainty of a change at the upper end is "
        f"{format_quantity(u, 'um' if k < 3 else 'arcsec', 2)}."
    )
    return errors.assign_attrs(reference="planned, not measured", provenance=origin, notes=[note])
