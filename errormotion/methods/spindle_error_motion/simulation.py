"""Simulated tests of a virtual spindle: expected readings, and those with every source drawn once, with the truth."""

from __future__ import annotations

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.kinematics.iso import DOF, direction_of
from errormotion.methods.spindle_error_motion.circles import CIRCLES, range_about
from errormotion.methods.spindle_error_motion.figures import centred, curves_of, fundamental, range_of
from errormotion.methods.spindle_error_motion.layout import Layout
from errormotion.methods.spindle_error_motion.model import FORM, PEAKS
from errormotion.methods.spindle_error_motion.schema import SCHEMA
from errormotion.methods.spindle_error_motion.settings import SpindleErrorMotionSettings
from errormotion.twin.spindle import TAU, Spindle, displacements

_FINE = 3600
"""Angles at which true values are evaluated."""
_MADE = '[{"id": "virtual spindle", "simulated": true}]'
_SEED = 7
"""Of the asynchronous motion of expected readings."""


def spindle_of(settings: SpindleErrorMotionSettings) -> Spindle:
    """Return the virtual spindle of a test."""
    return Spindle(
        speed=settings.spindle_speed,
        asynchronous=settings.asynchronous,
        eccentricity=settings.eccentricity * np.exp(0.4j),
    )


def sensors_of(settings: SpindleErrorMotionSettings) -> tuple[Array, Array]:
    """Return directions and positions of the sensors of a spindle along Z, (sensor, 3), m.

    The first direction is outward, the second inward, so that both signs occur.
    """
    R, h = settings.artefact_radius, settings.height
    place = {"X": ([1, 0, 0], [R, 0, 0]), "Y": ([0, -1, 0], [0, R, 0]), "Z": ([0, 0, 1], [0, 0, -R])}
    direction, position = [], []
    for k, name in enumerate(settings.sensors):
        n, p = place[name]
        direction.append(n)
        position.append([p[0], p[1], p[2] + (h if k in (2, 3) and name != "Z" else 0.0)])
    return np.array(direction, float), np.array(position, float)


def _turned(vectors: Array, axis: str) -> Array:
    """Return vectors (..., 3) of a spindle along Z in the frame of one along another axis."""
    return np.roll(vectors, direction_of(axis) - 2, axis=-1)


def expected(settings: SpindleErrorMotionSettings) -> xr.Dataset:
    """Return the readings without noise of a spindle with error motions of typical size.

    They contain an asynchronous motion, the same one each time, whose scatter states the uncertainty of the plan.
    """
    direction, position = sensors_of(settings)
    return _recorded(settings, spindle_of(settings), direction, position, np.random.default_rng(_SEED))[0]


def simulate(
    settings: SpindleErrorMotionSettings, seed: int, spindle: Spindle | None = None
) -> tuple[xr.Dataset, Array]:
    """Return raw data with every source drawn once, and the motions that do not repeat at the samples, (n, 6)."""
    generator = np.random.default_rng(seed)
    spindle = spindle or spindle_of(settings)
    direction, position = sensors_of(settings)
    count = len(direction)
    across = np.linalg.svd(direction[:, None, :])[2][:, 1:]
    turned = settings.direction_uncertainty * generator.standard_normal((count, 2))
    true = direction + np.einsum("st,sti->si", turned, across)
    heights = {round(z, 6): k for k, z in enumerate(sorted({round(p[2], 6) for p in position}))}
    orders = np.arange(2.0, FORM + 1)
    u = 1.0 / orders * (settings.roundness / PEAKS) / np.sqrt(np.square(1.0 / orders).sum())
    form = u * generator.standard_normal((2, len(heights), orders.size))
    section = [heights[round(p[2], 6)] for p in position]
    placed = position.copy()
    placed[:, 2] += settings.position_uncertainty * generator.standard_normal(count)
    raw, other = _recorded(
        settings, spindle, true, placed, generator, (orders, form[0][section], form[1][section]), stated=position
    )
    gain = 1 + settings.gain_uncertainty * generator.standard_normal(count)
    noisy = gain * raw["displacement"].values + settings.noise * generator.standard_normal(raw["displacement"].shape)
    shift = 10e-6 * generator.standard_normal(count)
    raw["displacement"] = raw["displacement"].copy(data=noisy + shift)
    raw["sensor_direction"] = raw["sensor_direction"].copy(data=_turned(direction, settings.axis))
    return raw.assign_attrs(machine="simulated", instruments=_MADE), other


def _recorded(
    settings: SpindleErrorMotionSettings,
    spindle: Spindle,
    direction: Array,
    position: Array,
    generator: np.random.Generator,
    form: tuple[Array, Array, Array] | None = None,
    stated: Array | None = None,
) -> tuple[xr.Dataset, Array]:
    """Return readings without noise, and the motion that does not repeat, (n, 6)."""
    turn = 60 / abs(settings.spindle_speed)
    n = int(np.ceil((settings.turns + 0.3) * turn * settings.sample_rate))
    time: Array = np.asarray((np.arange(n) + 0.37) / settings.sample_rate, dtype=float)
    angle = spindle.angle(time)
    other = spindle.other(angle, generator)
    motion = spindle.synchronous(angle) + other + spindle.set_up(angle)
    readings = displacements(motion, angle, direction, position, settings.artefact_radius, form)
    place = position if stated is None else stated
    m = {"units": "m"}
    variables = {
        "displacement": (("time", "sensor"), readings.T, m),
        "sensor_direction": (("sensor", "direction"), _turned(direction, settings.axis), {"units": "1"}),
        "sensor_position": (("sensor", "direction"), _turned(place, settings.axis), m),
        "axis_point": (("direction",), np.zeros(3), m),
        "artefact_radius": ((), settings.artefact_radius, m),
        "spindle_speed": ((), settings.spindle_speed, {"units": "1/min"}),
        "displacement_noise": ((), settings.noise, m),
        "gain_uncertainty": ((), settings.gain_uncertainty, {"units": "1"}),
        "sensor_direction_uncertainty": ((), settings.direction_uncertainty, {"units": "rad"}),
        "position_uncertainty": ((), settings.position_uncertainty, m),
        "roundness": ((), settings.roundness, m),
    }
    if settings.angle_from == "index":
        variables["index_time"] = (("index",), spindle.pulses(float(time[-1])), {"units": "s"})
    elif settings.angle_from == "encoder":
        variables["angle"] = (("time",), angle, {"units": "rad"})
    coords = {"time": ("time", time, {"units": "s"}), "direction": list("xyz")}
    attrs = {"schema": SCHEMA, "axis": settings.axis, "machine": "expected"}
    return xr.Dataset(variables, coords, attrs), _in_frame(other, settings.axis)


def _in_frame(motion: Array, axis: str) -> Array:
    return np.concatenate([_turned(motion[:, :3], axis), _turned(motion[:, 3:], axis)], axis=1)


def true_motion(
    settings: SpindleErrorMotionSettings, layout: Layout, angle: Array, spindle: Spindle | None = None
) -> Array:
    """Return the synchronous error motion relative to the axis average line, (place, 6); NaN where none is measured."""
    spindle = spindle or spindle_of(settings)
    shift = 0.0 if settings.angle_from != "eccentricity" else -float(np.angle(spindle.eccentricity))
    motion = spindle.synchronous(angle + shift)
    grid = (np.arange(_FINE) + 0.5) * TAU / _FINE
    full = _in_frame(spindle.synchronous(grid + shift), settings.axis)
    motion = _in_frame(motion, settings.axis)
    E, full = motion * layout.determined, full * layout.determined
    columns = layout.eccentric(grid).reshape(-1, _FINE * 6).T
    own = layout.eccentric(angle).reshape(-1, angle.size * 6).T
    h = np.linalg.lstsq(columns, (full - full.mean(axis=0)).ravel(), rcond=None)[0] if columns.size else np.zeros(0)
    E = E - full.mean(axis=0) - (own @ h).reshape(E.shape)
    return np.asarray(np.where(layout.determined, E, np.nan))


def truth_of(
    errors: xr.Dataset, settings: SpindleErrorMotionSettings, spindle: Spindle, raw: xr.Dataset, other: Array
) -> xr.Dataset:
    """Return the true error motions and figures in the form of a result."""
    layout = Layout.of(raw)
    true = true_motion(settings, layout, errors["angle"].values, spindle)
    grid = (np.arange(_FINE) + 0.5) * TAU / _FINE
    fine = np.nan_to_num(true_motion(settings, layout, grid, spindle))
    time = raw["time"].values
    angle = spindle.angle(time)
    pulses = spindle.pulses(float(time[-1]))
    used = (time >= pulses[0]) & (time < pulses[errors.attrs["turns"]])
    sectors = errors.sizes["angle"]
    sector = np.minimum((np.mod(angle[used], TAU) / TAU * sectors).astype(int), sectors - 1)
    values = dict(zip(errors["figure"].values.tolist(), errors["figure_value"].values.tolist(), strict=True))
    middle = errors["angle"].values
    for curve, its in zip(
        curves_of(layout, middle, settings.sensitive_angle),
        curves_of(layout, grid, settings.sensitive_angle),
        strict=True,
    ):
        smooth = np.sum(its.weight * fine, axis=1)
        values[f"synchronous {curve.name}"] = float(range_of(smooth, grid, axial=curve.axial))
        for circle in CIRCLES:
            values[f"synchronous {curve.name}, {circle}"] = float(range_about(smooth, grid, circle))
        if curve.axial:
            values["fundamental axial"] = float(fundamental(smooth, grid))
            values["residual synchronous axial"] = float(range_of(smooth, grid, axial=False))
        rest = np.sum(curve.weight[sector] * np.nan_to_num(other[used]), axis=1)
        low, high = np.full(sectors, np.inf), np.full(sectors, -np.inf)
        np.minimum.at(low, sector, rest)
        np.maximum.at(high, sector, rest)
        values[f"asynchronous {curve.name}"] = float((high - low).max())
        mean = centred(smooth, grid, axial=curve.axial)[(sector * _FINE + _FINE // 2) // sectors]
        values[f"total {curve.name}"] = float(np.ptp(mean + rest))
    zero = {
        name: 0.0 * errors[name] for name in ("covariance", "influence", "figure_influence", "figure_u", "figure_bias")
    }
    truth = errors.assign(zero)
    truth = truth.assign({dof: errors[dof].copy(data=true[:, k]) for k, dof in enumerate(DOF)})
    names = errors["figure"].values.tolist()
    figures = errors["figure_value"].copy(data=[values[name] for name in names])
    return truth.assign(figure_value=figures).assign_attrs(notes=[], machine="simulated")
