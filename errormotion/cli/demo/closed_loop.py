"""The closed loop on the virtual machine, in simulated time: probe a warm-up, fit a model, compensate further ones.

Each warm-up starts cold. Balls are probed in cycles, the thermometers are read in each period of the compensation, and
the offsets move the tool, so that the probe measures the remaining errors. Offsets are constant during probing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import xarray as xr

from errormotion import plugins
from errormotion.arrays import Array
from errormotion.compensation.effect import Effect, effect
from errormotion.compensation.online.prediction import predictor
from errormotion.compensation.online.rehearsal import Rehearsal, rehearse
from errormotion.compensation.online.settings import Limits
from errormotion.compensation.thermal_model import ThermalModel, ThermalModelSettings, fit
from errormotion.twin import Event, VirtualMachine

METHOD = "normal_vector"
OFF = {"X": False, "Y": False, "Z": False}
"""The compensation of the control is switched off."""
DISPLACEMENTS = ("EX", "EY", "EZ")
TRUTH_STEP = 60.0
"""Interval of the true errors, s."""

MIN_RISE = 1.0
"""Smallest change of a temperature in the training for the use of its sensor, K; it excludes noise and air."""

SMALL = ThermalModelSettings(variant="dynamics", most_sensors=2, time_constants=(600.0, 3600.0))
"""At most 10 features: the 19 cycles of one warm-up do not determine more, and the prediction of a larger model at
other speeds would be too uncertain to be used."""

Speeds = Sequence[tuple[float, float]]
"""Times after the start of the warm-up, s, and spindle speeds, 1/min."""


@dataclass(frozen=True)
class Duty:
    """Schedule and settings of the measurements.

    Attributes
    ----------
    duration, interval : float
        Duration of a warm-up, and interval between the starts of two probing cycles, s.
    cycle : float
        Duration of a cycle, s. The spindle starts after the first one.
    limits : Limits
        Limits of the compensation.
    model : ThermalModelSettings
        Settings of the fit; default: `SMALL`.
    """

    duration: float = 10800.0
    interval: float = 600.0
    cycle: float = 120.0
    limits: Limits = field(default_factory=Limits)
    model: ThermalModelSettings = SMALL

    @property
    def cycles(self) -> Array:
        """Start of each cycle, s."""
        return np.arange(0.0, self.duration + 1e-6, self.interval)


@dataclass(frozen=True)
class WarmUp:
    """One warm-up without and with the compensation.

    Attributes
    ----------
    before, after : Dataset
        Measured errors.
    true_before, true_after : (n, 3)
        True displacement at the functional point since the cold cycle, m, at ``time``, s.
    offsets : Rehearsal
    """

    before: xr.Dataset
    after: xr.Dataset
    time: Array
    true_before: Array
    true_after: Array
    offsets: Rehearsal

    @property
    def effect(self) -> Effect:
        """Measured effect of the compensation."""
        return effect(self.before, self.after, freedoms=DISPLACEMENTS)

    @property
    def remaining(self) -> float:
        """True root mean square displacement with the compensation, relative to that without."""
        return float(np.sqrt((self.true_after**2).sum() / (self.true_before**2).sum()))


@dataclass(frozen=True)
class Loop:
    """A model, and the warm-ups that it compensated."""

    model: ThermalModel
    warm_ups: tuple[WarmUp, ...]


def close(machine: VirtualMachine, training: Speeds, further: Sequence[Speeds], duty: Duty | None = None) -> Loop:
    """Measure one warm-up, fit a model to it, and compensate further ones.

    Parameters
    ----------
    machine : VirtualMachine
    training : Speeds
        Speeds of the warm-up to which the model is fitted.
    further : sequence of Speeds
        Speeds of the compensated warm-ups.
    duty : Duty, optional
    """
    duty = duty or Duty()
    measured = _measured(machine, training, duty, 0, None)
    point = tuple(float(x) for x in measured.attrs["functional_point"])
    model = fit([with_warm_sensors(measured)], duty.model)
    warm_ups = []
    for number, speeds in enumerate(further, start=1):
        before = _measured(machine, speeds, duty, 2 * number - 1, point)
        time, without = _truth(machine, duty, point)
        offsets = _offsets(machine, model, duty, seed=2 * number)
        after = _measured(machine, speeds, duty, 2 * number, point, offsets)
        _, with_it = _truth(machine, duty, point)
        warm_ups.append(WarmUp(before, after, time, without, with_it, offsets))
    return Loop(model, tuple(warm_ups))


def _measured(
    machine: VirtualMachine,
    speeds: Speeds,
    duty: Duty,
    seed: int,
    point: tuple[float, ...] | None,
    offsets: Rehearsal | None = None,
) -> xr.Dataset:
    """Start a warm-up, probe it, and identify its errors."""
    from errormotion.methods.normal_vector import simulation

    machine.start([Event(duty.cycle + at, speed, OFF if k == 0 else None) for k, (at, speed) in enumerate(speeds)])
    if offsets is not None:
        machine.compensate(offsets.time, offsets.offset)
    raw = simulation.raw(machine, duty.cycles, seed=seed, cycle=duty.cycle)
    method = plugins.get("methods", METHOD)
    settings = {"tool_axes": machine.tool_axes} | ({} if point is None else {"functional_point": point})
    found: xr.Dataset = method().identify(raw, method.Settings(**settings))
    return found


def with_warm_sensors(errors: xr.Dataset) -> xr.Dataset:
    """Return errors without the temperatures that changed by less than `MIN_RISE`."""
    temperature = errors["temperature"]
    change = (temperature.max("time") - temperature.min("time")).values
    return errors.isel(sensor=np.flatnonzero(change >= MIN_RISE))


def _truth(machine: VirtualMachine, duty: Duty, point: Sequence[float]) -> tuple[Array, Array]:
    """Return times, and the true displacement since the middle of the cold cycle."""
    t = np.arange(duty.cycle, duty.duration + duty.cycle, TRUTH_STEP)
    times = np.concatenate([[duty.cycle / 2], t])
    truth = machine.truth_probing(times, point)
    values = np.stack([truth[name].values for name in DISPLACEMENTS], axis=-1)
    return t, values[1:] - values[0]


def _offsets(machine: VirtualMachine, model: ThermalModel, duty: Duty, seed: int) -> Rehearsal:
    """Return the offsets for the present schedule of the machine."""
    time = np.arange(0.0, duty.duration + duty.cycle, duty.limits.period)
    readings = machine.sensor_temperatures(time, seed=seed)
    temperature = dict(zip(machine.temperature_sensors, readings.T, strict=True))
    parameter = {"spindle_speed": machine.spindle_speed(time), "feed": np.zeros(time.size)}
    probing = (time % duty.interval) < duty.cycle
    return rehearse(predictor(model.dataset), duty.limits, time, temperature, parameter, probing)
