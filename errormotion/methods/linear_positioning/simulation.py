"""Raw data of the method, simulated on the virtual machine with known errors.

The axis has the geometric errors of the virtual machine, a reversal error, scatter, and drift from run to run. The
instrument has an error of scale, a beam that is not parallel to the axis, and thermometers with an offset.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.kinematics.iso import DOF, direction_of, iso_names
from errormotion.methods.linear_positioning.diagonals.simulation import simulate_diagonals
from errormotion.methods.linear_positioning.planning.targets import positions
from errormotion.methods.linear_positioning.schema import APPROACHES, READINGS, SCHEMA, SENSORS
from errormotion.methods.linear_positioning.virtual import MACHINE, instruments_of
from errormotion.methods.linear_positioning.warming import simulate_moving
from errormotion.twin import VirtualMachine, truth

if TYPE_CHECKING:
    from errormotion.methods.linear_positioning.settings import Settings

EXPANSION, EXCESS_TEMPERATURE = 11.5e-6, 2.0
"""Coefficient of expansion of the axis, 1/K, and its temperature above 20 degC, K."""
_M = {"units": "m"}


@dataclass(frozen=True)
class Behaviour:
    """Variation of the errors of an axis; m, and rad for rotations.

    ``noise`` is the standard deviation of a reading, ``offset`` and ``slope`` those of a run, ``opposite`` that of an
    offset with opposite signs forward and backward; ``reversal`` is the mean difference of forward and backward.
    """

    noise: float = 0.3e-6
    offset: float = 0.4e-6
    slope: float = 0.2e-6
    opposite: float = 0.1e-6
    reversal: float = 1.5e-6


def simulate(settings: Settings, seed: int) -> tuple[xr.Dataset, xr.Dataset]:
    """Return deviations at targets, at the ends of a moving axis, or along diagonals, and the true errors.

    The seed selects the machine, its scatter, and the errors of the instrument.
    """
    if settings.moving is not None:
        return simulate_moving(settings, seed)
    if settings.diagonals is not None:
        return simulate_diagonals(settings, seed)
    return raw_and_truth(settings, seed, Behaviour())


def raw_and_truth(settings: Settings, seed: int, behaviour: Behaviour) -> tuple[xr.Dataset, xr.Dataset]:
    """Return deviations and true errors for an axis with a given behaviour."""
    machine = VirtualMachine(MACHINE, seed=seed)
    generator = np.random.default_rng(seed)
    P = positions(settings)
    axis, along = settings.axis, direction_of(settings.axis)
    columns = [DOF.index(name) for name in settings.freedoms]
    geometric = machine.geometry.motions[axis](np.append(P, P[0]))
    error = (geometric[:-1] - geometric[-1]).T[columns]  # (freedom, target), relative to the first target
    true = error - behaviour.reversal / 2.0  # the instrument is set to zero after an approach forward
    departures = np.stack([_departures(behaviour, settings.runs, P, generator) for _ in columns])
    x = true[:, None, None, :] + departures  # (freedom, run, approach, target)
    lever = P - P[0]
    budget = settings.uncertainty
    T = 20.0 + EXCESS_TEMPERATURE + 0.2 * generator.normal(size=(settings.runs, 1, 1))
    alpha = EXPANSION + 0.6e-6 * generator.normal()
    scale = budget.length_or_assumed * generator.normal()
    angle = budget.alignment_or_assumed * generator.normal(size=2)
    if along in columns:
        x[columns.index(along)] += (alpha * (T - 20.0) + scale - (angle @ angle) / 2.0) * lever
    measured_T = np.broadcast_to(T + budget.temperature * generator.normal(), departures.shape[1:])
    names = iso_names(axis)
    variables: dict[str, Any] = {
        "deviation": (READINGS, x),
        "target_position": ("target", P, _M),
        "zero_position": ((), float(P[0]), _M),
        "functional_point": ("direction", np.zeros(3), _M),
        "length_uncertainty": ((), budget.length_or_assumed, {"units": "1"}),
        "alignment_uncertainty": ((), budget.alignment_or_assumed, {"units": "rad"}),
        "temperature": (SENSORS, measured_T[..., None], {"units": "degC"}),
        "temperature_uncertainty": ((), budget.temperature, {"units": "K"}),
        "machine_expansion": ((), EXPANSION, {"units": "1/K"}),
        "machine_expansion_uncertainty": ((), 0.6e-6, {"units": "1/K"}),
    }
    coords = {
        "freedom": [names[name] for name in settings.freedoms],
        "approach": list(APPROACHES),
        "sensor": ["machine"],
        "direction": list("xyz"),
    }
    attrs = {"schema": SCHEMA, "axis": axis, "machine": machine.name, "instruments": instruments_of(machine)}
    return xr.Dataset(variables, coords, attrs), _truth(machine, settings, P, true)


def _departures(behaviour: Behaviour, runs: int, P: Array, generator: np.random.Generator) -> Array:
    """Return reversal, scatter and drift at each reading, (run, approach, target)."""
    draw = generator.standard_normal
    sign = np.array([1.0, -1.0])[:, None]
    z = (P - P.mean()) / (np.ptp(P) / 2.0)
    common = behaviour.offset * draw((runs, 1, 1)) + behaviour.slope * draw((runs, 1, 1)) * z
    opposite = behaviour.opposite * sign * draw((runs, 1, 1))
    noise = behaviour.noise * draw((runs, 2, P.size))
    return np.asarray(sign * behaviour.reversal / 2.0 + common + opposite + noise)


def _truth(machine: VirtualMachine, settings: Settings, P: Array, true: Array) -> xr.Dataset:
    """Return the true errors; of a straightness relative to the line through the first and the last target."""
    twist = np.full((P.size, 6), np.nan)
    along = direction_of(settings.axis)
    t = (P - P[0]) / (P[-1] - P[0])
    for values, name in zip(true, settings.freedoms, strict=True):
        k = DOF.index(name)
        line = (1.0 - t) * values[0] + t * values[-1] if k < 3 and k != along else 0.0
        twist[:, k] = values - line
    origin = truth.Origin(machine.name, machine.kind, machine.seed, machine.state.schedule.events)
    coords = {"xyz"[along]: ("position", P, _M)}
    return truth.dataset(twist, "position", coords, settings.axis, np.zeros(3), "zero of the instrument", origin)
