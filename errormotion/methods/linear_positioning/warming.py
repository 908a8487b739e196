"""Readings that a test of a moving axis is expected to give: its screw expands in motion and contracts at rest."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.kinematics.iso import DOF, direction_of, iso_names
from errormotion.methods.linear_positioning.moving import cycles, ends, moving_of
from errormotion.methods.linear_positioning.schema import SCHEMA

if TYPE_CHECKING:
    from errormotion.methods.linear_positioning.settings import LinearPositioningSettings

GROWTH, SHIFT = 30e-6, 8e-6
"""Final relative expansion of the screw, 1, and displacement of its bearing, m (rad for rotations)."""
TIME_CONSTANT = 2400.0
"""Of the warm-up of the screw, s."""
COLD_INTERVAL = 30.0
"""Interval of the cold readings, s."""


def expected_moving(settings: LinearPositioningSettings, scatter: float) -> xr.Dataset:
    """Return readings at both ends of the stroke without noise, with the standard deviation ``scatter``, m or rad."""
    plan = list(cycles(settings))
    cold = sum(cycle.cold for cycle in plan)
    interval = moving_of(settings).interval
    time = np.array(
        [COLD_INTERVAL * (i + 1 - cold) if i < cold else interval * (i + 1 - cold) for i in range(len(plan))]
    )
    moving = np.array([cycle.moving for cycle in plan])
    P, along = np.array(ends(settings)), direction_of(settings.axis)
    shape = np.array([GROWTH * (P - P[0]) * (name == DOF[along]) + SHIFT for name in settings.freedoms])
    metre = {"units": "m"}
    variables: dict[str, Any] = {
        "end_deviation": (("freedom", "cycle", "end"), _warmth(time, moving)[None, :, None] * shape[:, None, :]),
        "end_position": ("end", P, metre),
        "reading_time": ("cycle", time, {"units": "s"}),
        "moving": ("cycle", moving.astype(float), {"units": "1"}),
        "functional_point": ("direction", np.zeros(3), metre),
        "length_uncertainty": ((), settings.uncertainty.length_or_assumed, {"units": "1"}),
        "reading_scatter": ("freedom", np.full(len(shape), scatter)),
    }
    names = iso_names(settings.axis)
    coords = {"freedom": [names[name] for name in settings.freedoms], "direction": list("xyz")}
    return xr.Dataset(variables, coords, {"schema": SCHEMA, "axis": settings.axis})


def _warmth(time: Array, moving: Array) -> Array:
    """Return the state of the screw at each reading, from 0 (cold) to 1."""
    state, states = 0.0, np.zeros_like(time)
    for i in range(1, time.size):
        step = 1.0 - np.exp(-(max(time[i], 0.0) - max(time[i - 1], 0.0)) / TIME_CONSTANT)
        state += step * (float(moving[i]) - state)
        states[i] = state
    return states
