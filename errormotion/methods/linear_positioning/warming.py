"""Simulated raw data of a moving axis with known errors: its screw expands in motion and contracts at rest."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.kinematics.iso import DOF, direction_of, iso_names
from errormotion.methods.linear_positioning.moving import cycles, ends, moving_of
from errormotion.methods.linear_positioning.schema import SCHEMA
from errormotion.methods.linear_positioning.virtual import MACHINE, instruments_of
from errormotion.twin import VirtualMachine, truth

if TYPE_CHECKING:
    from errormotion.methods.linear_positioning.settings import Settings

GROWTH, SHIFT = 30e-6, 8e-6
"""Final relative expansion of the screw, 1, and displacement of its bearing, m (rad for rotations)."""
TIME_CONSTANT = 2400.0
"""Of the warm-up of the screw, s."""
NOISE = 0.3e-6
"""Standard deviation of a reading; m, rad."""
COLD_INTERVAL = 30.0
"""Interval of the cold readings, s."""


def simulate_moving(settings: Settings, seed: int) -> tuple[xr.Dataset, xr.Dataset]:
    """Return readings at both ends of the stroke, and the true changes since the cold state."""
    generator = np.random.default_rng(seed)
    plan = list(cycles(settings))
    cold = sum(cycle.cold for cycle in plan)
    interval = moving_of(settings).interval
    time = np.array(
        [COLD_INTERVAL * (i + 1 - cold) if i < cold else interval * (i + 1 - cold) for i in range(len(plan))]
    )
    moving = np.array([cycle.moving for cycle in plan])
    warmth = _warmth(time, moving)
    P, along = np.array(ends(settings)), direction_of(settings.axis)
    columns = [DOF.index(name) for name in settings.freedoms]
    size = 1.0 + 0.3 * generator.normal(size=len(columns))
    shape = np.array([GROWTH * (P - P[0]) * (k == along) + SHIFT for k in columns])
    change = size[:, None, None] * warmth[None, :, None] * shape[:, None, :]  # (freedom, cycle, end)
    scale = (
        settings.uncertainty.length_or_assumed * generator.normal()
    )  # change of the instrument's scale since the cold state
    read = change + NOISE * generator.normal(size=change.shape)
    if along in columns:
        read[columns.index(along), cold:] += scale * (P - P[0])
    names = iso_names(settings.axis)
    variables: dict[str, Any] = {
        "end_deviation": (("freedom", "cycle", "end"), read),
        "end_position": ("end", P, {"units": "m"}),
        "reading_time": ("cycle", time, {"units": "s"}),
        "moving": ("cycle", moving.astype(float), {"units": "1"}),
        "functional_point": ("direction", np.zeros(3), {"units": "m"}),
        "length_uncertainty": ((), settings.uncertainty.length_or_assumed, {"units": "1"}),
    }
    coords = {"freedom": [names[name] for name in settings.freedoms], "direction": list("xyz")}
    machine = VirtualMachine(MACHINE, seed=seed)
    attrs = {"schema": SCHEMA, "axis": settings.axis, "machine": machine.name, "instruments": instruments_of(machine)}
    twist = np.full((time.size - cold + 1, 2, 6), np.nan)
    for values, k in zip(change, columns, strict=True):
        twist[..., k] = np.concatenate([np.zeros((1, 2)), values[cold:]])
    origin = truth.Origin(machine.name, machine.kind, machine.seed, machine.state.schedule.events)
    at = {"time": np.append(0.0, time[cold:]), "xyz"[along]: ("position", P, {"units": "m"})}
    true = truth.dataset(twist, ("time", "position"), at, settings.axis, np.zeros(3), "cold state", origin)
    return xr.Dataset(variables, coords, attrs), true


def _warmth(time: Array, moving: Array) -> Array:
    """Return the state of the screw at each reading, from 0 (cold) to 1."""
    state, states = 0.0, np.zeros_like(time)
    for i in range(1, time.size):
        step = 1.0 - np.exp(-(max(time[i], 0.0) - max(time[i - 1], 0.0)) / TIME_CONSTANT)
        state += step * (float(moving[i]) - state)
        states[i] = state
    return states
