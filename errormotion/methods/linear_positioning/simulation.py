"""Raw data of the method on the virtual machine: those that a test is expected to give, and simulated ones.

`expected` is what plan and simulated data of the method are derived from. `raw_and_truth` does not use the measurement
model, so that validation and tests compare the model with it: the axis has scatter, and drift from run to run; the
instrument an error of scale, a beam that is not parallel to the axis, and thermometers with an offset.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.kinematics.iso import DOF, direction_of, iso_names
from errormotion.methods.linear_positioning.diagonals.simulation import expected_diagonals
from errormotion.methods.linear_positioning.identification.expansion import SIDES
from errormotion.methods.linear_positioning.planning.targets import positions
from errormotion.methods.linear_positioning.schema import APPROACHES, READINGS, SCHEMA, SENSORS
from errormotion.methods.linear_positioning.warming import expected_moving
from errormotion.twin import VirtualMachine, truth

if TYPE_CHECKING:
    from errormotion.methods.linear_positioning.settings import LinearPositioningSettings

SCATTER, DRIFT = 0.5e-6, 1.0e-6
"""Defaults of the standard deviation of a reading and of the range by drift during a run, m or rad."""
EXPANSION, EXCESS_TEMPERATURE = 11.5e-6, 2.0
"""Coefficient of expansion of the axis, 1/K, and its temperature above 20 degC, K."""
MACHINE = "gantry"
"""Kind of the virtual machine."""
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


def planned_scatter(settings: LinearPositioningSettings) -> tuple[float, float]:
    """Return standard deviation of a reading and range by drift during a run that a plan assumes, m or rad."""
    stated = settings.uncertainty
    return (
        SCATTER if stated.scatter is None else stated.scatter,
        DRIFT if stated.drift is None else stated.drift,
    )


def expected(settings: LinearPositioningSettings) -> xr.Dataset:
    """Return readings without noise at targets, at the ends of a moving axis, or along diagonals.

    They state the scatter and the drift that the settings state or a plan assumes, and the expansion and temperatures
    that the settings state.
    """
    scatter, drift = planned_scatter(settings)
    if settings.moving is not None:
        return expected_moving(settings, scatter)
    machine, reversal = VirtualMachine(MACHINE, seed=0), Behaviour().reversal
    if settings.diagonals is not None:
        return expected_diagonals(settings, machine, reversal, scatter, drift)
    P = positions(settings)
    temperature: dict[str, Array | float] = {}
    x = (
        _true(machine, settings, P, reversal)[:, None, None]
        + reversal / 2.0 * np.array([1.0, -1.0])[:, None]
        + np.zeros((1, settings.runs, 1, 1))
    )
    along = np.array([DOF.index(name) == direction_of(settings.axis) for name in settings.freedoms])
    stated: dict[str, Any] = {}
    for name, sign in SIDES.items():
        side = getattr(settings, name)
        if not side.expansion:
            continue
        excess = EXCESS_TEMPERATURE
        if side.temperature is not None and not side.sensors:
            excess = side.temperature - settings.reference_temperature
        else:
            temperature |= dict.fromkeys(side.sensors or (name,), settings.reference_temperature + excess)
        x = x + sign * side.expansion * excess * along[:, None, None, None] * (P - P[0])
        stated[f"{name}_expansion"] = ((), side.expansion, {"units": "1/K"})
        stated[f"{name}_expansion_uncertainty"] = ((), side.expansion_uncertainty, {"units": "1/K"})
    count = len(settings.freedoms)
    stated |= {"reading_scatter": ("freedom", np.full(count, scatter)), "run_drift": ("freedom", np.full(count, drift))}
    return _raw(settings, P, x, temperature).assign(stated)


def raw_and_truth(
    settings: LinearPositioningSettings, seed: int, behaviour: Behaviour
) -> tuple[xr.Dataset, xr.Dataset]:
    """Return deviations and true errors for an axis with a given behaviour.

    The seed selects the machine, its scatter, and the errors of the instrument.
    """
    machine = VirtualMachine(MACHINE, seed=seed)
    generator = np.random.default_rng(seed)
    P = positions(settings)
    true = _true(machine, settings, P, behaviour.reversal)
    departures = np.stack([_departures(behaviour, settings.runs, P, generator) for _ in true])
    x = true[:, None, None, :] + departures  # (freedom, run, approach, target)
    budget, along = settings.uncertainty, DOF[direction_of(settings.axis)]
    T = 20.0 + EXCESS_TEMPERATURE + 0.2 * generator.normal(size=(settings.runs, 1, 1))
    alpha = EXPANSION + 0.6e-6 * generator.normal()
    scale = budget.length_or_assumed * generator.normal()
    angle = budget.alignment_or_assumed * generator.normal(size=2)
    if along in settings.freedoms:
        change = alpha * (T - 20.0) + scale - (angle @ angle) / 2.0
        x[settings.freedoms.index(along)] += change * (P - P[0])
    raw = _raw(settings, P, x, {"machine": T + budget.temperature * generator.normal()}).assign(
        machine_expansion=((), EXPANSION, {"units": "1/K"}),
        machine_expansion_uncertainty=((), 0.6e-6, {"units": "1/K"}),
    )
    address = f"twin://{machine.kind}?seed={machine.seed}"
    instrument = {"id": "virtual interferometer", "address": address, "simulated": True}
    attrs = {"machine": machine.name, "instruments": json.dumps([instrument])}
    return raw.assign_attrs(attrs), _truth(machine, settings, P, true)


def _true(machine: VirtualMachine, settings: LinearPositioningSettings, P: Array, reversal: float) -> Array:
    """Return the mean deviations, (freedom, target), relative to the first target approached forward."""
    columns = [DOF.index(name) for name in settings.freedoms]
    geometric = machine.geometry.motions[settings.axis](np.append(P, P[0]))
    return np.asarray((geometric[:-1] - geometric[-1]).T[columns] - reversal / 2.0)


def _raw(
    settings: LinearPositioningSettings, P: Array, x: Array, temperature: Mapping[str, Array | float]
) -> xr.Dataset:
    """Return readings x (freedom, run, approach, target) with temperatures by sensor, degC, as a raw dataset."""
    budget, names = settings.uncertainty, iso_names(settings.axis)
    variables: dict[str, Any] = {
        "deviation": (READINGS, x),
        "target_position": ("target", P, _M),
        "zero_position": ((), float(P[0]), _M),
        "functional_point": ("direction", np.zeros(3), _M),
        "length_uncertainty": ((), budget.length_or_assumed, {"units": "1"}),
        "alignment_uncertainty": ((), budget.alignment_or_assumed, {"units": "rad"}),
    }
    coords = {
        "freedom": [names[name] for name in settings.freedoms],
        "approach": list(APPROACHES),
        "direction": list("xyz"),
    }
    if temperature:
        values = np.stack([np.broadcast_to(T, x.shape[1:]) for T in temperature.values()], axis=-1)
        variables["temperature"] = (SENSORS, values, {"units": "degC"})
        variables["temperature_uncertainty"] = ((), budget.temperature, {"units": "K"})
        coords["sensor"] = list(temperature)
    return xr.Dataset(variables, coords, {"schema": SCHEMA, "axis": settings.axis})


def _departures(behaviour: Behaviour, runs: int, P: Array, generator: np.random.Generator) -> Array:
    """Return reversal, scatter and drift at each reading, (run, approach, target)."""
    draw = generator.standard_normal
    sign = np.array([1.0, -1.0])[:, None]
    z = (P - P.mean()) / (np.ptp(P) / 2.0)
    common = behaviour.offset * draw((runs, 1, 1)) + behaviour.slope * draw((runs, 1, 1)) * z
    opposite = behaviour.opposite * sign * draw((runs, 1, 1))
    noise = behaviour.noise * draw((runs, 2, P.size))
    return np.asarray(sign * behaviour.reversal / 2.0 + common + opposite + noise)


def _truth(machine: VirtualMachine, settings: LinearPositioningSettings, P: Array, true: Array) -> xr.Dataset:
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
