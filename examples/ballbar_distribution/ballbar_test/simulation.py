"""A circular test on a virtual machine: raw data, and the true radial deviation, parameters and figures.

The machine has squareness, scales, servo lags, backlash, spikes at reversals and bows; the bar has a
calibration error, an expansion, a drift of its transducer and noise. Lengths are computed by exact geometry, not by
the linear model of the evaluation.
"""

import json
from dataclasses import dataclass

import numpy as np
import xarray as xr

from ballbar_test import circles, extremes, result
from ballbar_test.path import SENSES, middles, sector_angles, since_reversal
from ballbar_test.schema import READINGS, SCHEMA
from errormotion.datasets import provenance

PATH = 7200
"""Angles of the true path."""
MISSING = 0.002
"""Share of missing readings."""
EXPANSION, EXPANSION_U, TEMPERATURE_U = 11.5e-6, 1e-6, 0.05  # 1/K, 1/K, K


@dataclass(frozen=True)
class Machine:
    """Errors of the two axes of a circle; see ``path`` for the parameters. SI."""

    squareness: float = 0.0
    scale: tuple[float, float] = (0.0, 0.0)
    lag: tuple[float, float] = (0.0, 0.0)
    backlash: tuple[float, float] = (0.0, 0.0)
    bow: tuple[float, float] = (0.0, 0.0)
    spike: tuple[float, float] = (0.0, 0.0)
    lobes: float = 0.0
    spike_decay: float = 0.0

    @property
    def parameters(self):
        """In the order of ``path.PARAMETERS``."""
        mismatch = self.scale[0] - self.scale[1], self.lag[0] - self.lag[1]
        return np.array([self.squareness, *mismatch, *self.backlash, *self.bow, *self.spike])

    def position(self, angle, sense, radius, feed):
        """Return the position of the tool in the plane at a commanded angle of the circle, (..., 2), m."""
        x, y = radius * np.cos(angle), radius * np.sin(angle)
        velocity = feed * np.stack([-sense * np.sin(angle), sense * np.cos(angle)], axis=-1)
        since = np.stack(since_reversal(angle, sense), axis=-1)
        command = np.stack([x, y], axis=-1)
        error = np.array(self.scale) * command - np.array(self.lag) * velocity
        error -= np.array(self.backlash) / 2 * np.sign(velocity)
        if self.spike_decay:
            error += np.array(self.spike) * np.sign(command) * np.exp(-since / self.spike_decay)
        error += np.array(self.bow)[::-1] * (command[..., ::-1] / radius) ** 2
        error[..., 0] -= self.squareness * y
        return command * (1 + self.lobes / radius * np.cos(5 * angle))[..., None] + error

    def path(self, settings):
        """Return the true radial deviation of the path, without the offset of its circle, (2, `PATH`), m."""
        angle = np.array([middles(PATH)] * 2)
        sense = np.broadcast_to(np.array(list(SENSES.values()))[:, None], angle.shape)
        position = self.position(angle, sense, settings.nominal_radius, settings.feed)
        return extremes.centred(np.linalg.norm(position, axis=-1) - settings.nominal_radius)

    def deviation(self, settings):
        """Return the true mean radial deviation over each sector, without the offset of its circle, (2, place), m."""
        angle = np.array([sector_angles(settings.places)] * 2)
        sense = np.broadcast_to(np.array(list(SENSES.values()))[:, None, None], angle.shape)
        position = self.position(angle, sense, settings.nominal_radius, settings.feed)
        return extremes.centred(np.linalg.norm(position, axis=-1).mean(axis=2) - settings.nominal_radius)


def draw_machine(settings, rng):
    """Return a machine with typical errors of a machining centre."""
    return Machine(
        squareness=30e-6 * rng.standard_normal(),
        scale=tuple(15e-6 * rng.standard_normal(2)),
        lag=tuple(0.2e-3 * rng.standard_normal(2)),
        backlash=tuple(3e-6 * rng.random(2)),
        bow=tuple(1e-6 * rng.standard_normal(2)),
        spike=tuple(4e-6 * rng.random(2)),
        spike_decay=settings.spike_decay,
    )


def simulate(settings, seed, machine=None):
    """Return ``(raw, truth)`` of one seed: a raw dataset, and the true deviations as an error dataset."""
    rng = np.random.default_rng(seed)
    machine = machine or draw_machine(settings, rng)
    raw = measure(settings, machine, rng, missing=MISSING)
    return raw, truth(settings, machine, seed)


def truth(settings, machine, seed):
    """Return the true deviations, parameters and figures as an error dataset without uncertainty."""
    deviation = machine.deviation(settings)
    parameters = machine.parameters
    return result.build(
        deviation,
        np.zeros_like(deviation),
        circles.read(raw_dataset(settings, *np.ones((3, 2, 1, 1)), np.full((2, 1), 20.0)), []),
        shared={},
        parameters=parameters,
        covariance=np.zeros((len(parameters),) * 2),
        figures=result.exact(extremes.evaluate(machine.path(settings))),
        machine="virtual machine",
        frame="machine",
        reference=result.REFERENCE,
        method="simulation",
        method_version="1",
        provenance=provenance.make(settings, None, None, seed=seed),
    )


def measure(settings, machine, rng, missing=0.0):
    """Return the raw dataset of a test: circles alternately counterclockwise and clockwise."""
    R, V, n = settings.nominal_radius, settings.feed, settings.samples
    step = 2 * np.pi / n
    sense = np.array(list(SENSES.values()))[:, None, None]
    travelled = step * (np.arange(n) + rng.random((2, settings.runs, 1)))
    angle = np.where(sense > 0, travelled, 2 * np.pi - travelled)
    lap = 2 * np.arange(settings.runs)[None, :, None] + np.array([0, 1])[:, None, None]
    time = 60.0 + lap * (2 * np.pi * R / V + 10.0) + travelled * R / V
    position = machine.position(angle, np.broadcast_to(sense, angle.shape), R, V)
    ball = 30e-6 * rng.standard_normal(2)  # of the ball on the table from the programmed centre
    length = np.linalg.norm(position - ball, axis=-1)
    temperature = 20.6 + 0.2 * rng.standard_normal() + 2e-4 * time.mean(axis=2)
    warm = temperature + TEMPERATURE_U * rng.standard_normal()
    true_expansion = EXPANSION + EXPANSION_U * rng.standard_normal()
    length += settings.length_uncertainty * rng.standard_normal()
    length -= true_expansion * R * (warm - 20.0)[:, :, None]
    length += 1e-9 * rng.standard_normal() * time  # drift of the transducer, m/s
    length += settings.length_noise * rng.standard_normal(length.shape)
    length[rng.random(length.shape) < missing] = np.nan
    return raw_dataset(settings, length, angle, time, temperature)


def raw_dataset(settings, length, angle, time, temperature):
    """Return readings and the constants of a test as a raw dataset."""
    over = READINGS
    unit = np.eye(3)[["xyz".index(name.lower()) for name in settings.plane]]

    def number(value, units):
        return ((), float(value), {"units": units})

    return xr.Dataset(
        {
            "length": (over, length, {"units": "m"}),
            "angle": (over, angle, {"units": "rad"}),
            "reading_time": (over, time, {"units": "s"}),
            "temperature": (over[:2], temperature, {"units": "degC"}),
            "nominal_radius": number(settings.nominal_radius, "m"),
            "feed": number(settings.feed, "m/s"),
            "length_noise": number(settings.length_noise, "m"),
            "length_uncertainty": number(settings.length_uncertainty, "m"),
            "calibration_temperature": number(20.0, "degC"),
            "expansion": number(EXPANSION, "1/K"),
            "expansion_uncertainty": number(EXPANSION_U, "1/K"),
            "temperature_uncertainty": number(TEMPERATURE_U, "K"),
            "centre": ("direction", np.array(settings.centre), {"units": "m"}),
            "axis_direction": (("axis", "direction"), unit, {"units": "1"}),
        },
        coords={
            "direction_of_travel": list(SENSES),
            "direction": list("xyz"),
            "axis": list(settings.plane),
        },
        attrs={
            "schema": SCHEMA,
            "machine": "virtual machine",
            "frame": "machine",
            "instruments": json.dumps([{"name": "ballbar", "kind": "ballbar", "identity": {"simulated": True}}]),
        },
    )
