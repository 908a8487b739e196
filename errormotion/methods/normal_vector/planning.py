"""Expected uncertainty of a measurement, and the errors that it will not determine."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets import build_errors, provenance
from errormotion.datasets.units import format_quantity
from errormotion.errors import MethodError
from errormotion.estimation.low_rank import root_of
from errormotion.kinematics.iso import DOF
from errormotion.methods.normal_vector.acquisition import touching
from errormotion.methods.normal_vector.acquisition.cycle import TIP_RADIUS
from errormotion.methods.normal_vector.identification import normals as published
from errormotion.methods.normal_vector.identification.freedoms import Motion, check_layout
from errormotion.methods.normal_vector.identification.rigid import Observations, fit
from errormotion.methods.normal_vector.identification.spheres import centres

if TYPE_CHECKING:
    from errormotion.methods.normal_vector.settings import Settings
    from errormotion.plugins import Method

NOISE = 0.25e-6
"""Noise of a touch where the settings have none, m."""


def plan(method: Method, settings: Settings) -> xr.Dataset:
    """Return an error dataset of zeros over the cycles, with the covariance expected from balls, touches and noise.

    ``normals_loss(dof)`` is the uncertainty of the published construction relative to that of the fit; ``notes`` state
    the expected uncertainties and the errors that are not determined.

    Raises
    ------
    MethodError
        Fewer than three balls, or a layout of balls that leaves errors undetermined.
    """
    names = touching.names(settings)
    rough = np.array([ball.centre for ball in settings.balls], dtype=float).reshape(-1, 3)
    check_layout(rough, names, settings.tool_axes)
    point = settings.functional_point
    motion = Motion(settings.tool_axes, np.round(rough.mean(axis=0), 4) if point is None else np.array(point, float))
    noise, count = settings.touch_noise or NOISE, int(method.progress(settings))
    if count < 2:
        raise MethodError(
            f"Expected the cold cycle and at least one more; a warm-up of {settings.duration:g} s has none at an "
            f"interval of {settings.interval:g} s."
        )
    seen = planned_touches(settings, count, noise)
    found = fit(seen, motion, interpolate=False)
    covariance = found.covariance
    unseen = [k for k in range(6) if k not in motion.seen]
    values = np.zeros((count, 6))
    values[:, unseen] = np.nan
    loss = _loss(seen, settings, motion, found.anchor, found.reach, covariance)
    factors = root_of(covariance[-1] - found.own[-1], smallest=1e-9).T
    influence = np.repeat(factors[:, None], count, axis=1)
    influence[:, 0] = 0.0
    ds = build_errors(
        values,
        covariance,
        dims=("time",),
        coords={"time": ("time", settings.interval * np.arange(count), {"units": "s"}), "ball": names},
        component="tool",
        machine="plan",
        frame="machine",
        functional_point=motion.point,
        reference="planned, not measured",
        method=method.info.id,
        method_version=method.info.version,
        provenance=provenance.make(settings, None, None, steps=["plan"]),
        influence=influence,
        sources=[f"cold reference {i + 1}" for i in range(len(influence))],
        source_groups=["cold reference"] * len(influence),
        extras={"normals_loss": xr.DataArray(loss, dims="dof", attrs={"units": "1"})},
    )
    return ds.assign_attrs(notes=_notes(settings, motion, covariance[-1], loss, noise), tool_axes=settings.tool_axes)


def planned_touches(settings: Settings, cycles: int, noise: float) -> Observations:
    """Return the touches of cycles without errors, one cycle for each interval."""
    normal = touching.normals(settings)
    reach = np.array([ball.radius for ball in settings.balls]) + (settings.tip_radius or TIP_RADIUS)
    position = np.array([ball.centre for ball in settings.balls], float)[:, None] + reach[:, None, None] * normal
    b, m, _ = position.shape
    weight = np.zeros((cycles, b, m, m))
    weight[..., range(m), range(m)] = noise**-2
    time = np.asarray(settings.interval * np.arange(cycles))
    every = np.array(np.broadcast_to(time[:, None, None], (cycles, b, m)))
    return Observations(np.tile(position, (cycles, 1, 1, 1)), weight, every, time, touched=True)


def _loss(
    seen: Observations, settings: Settings, motion: Motion, anchor: Array, reach: Array, covariance: Array
) -> Array:
    if motion.tool_axes != "XYZ" or len(anchor) < 4:
        return np.full(6, np.nan)
    four = published.chosen(touching.names(settings), settings.normals_balls)
    measured = centres(seen, anchor, reach)
    if not published.planes_apart(measured.centre[0, four]):
        return np.full(6, np.inf)
    C = published.covariance(
        measured.cofactor[0, four], measured.cofactor[1:2, four], motion.point, measured.centre[0, four]
    )
    return np.asarray(np.sqrt(np.diagonal(C[0]) / np.diagonal(covariance[1])))


def _notes(settings: Settings, motion: Motion, covariance: Array, loss: Array, noise: float) -> list[str]:
    u = np.sqrt(np.diagonal(covariance))
    stated = ", ".join(f"{DOF[k]} {format_quantity(float(u[k]), 'um' if k < 3 else 'arcsec', 3)}" for k in motion.seen)
    touches = settings.touches * len(settings.balls)
    notes = [
        f"With {touches} touches in each cycle and a noise of {format_quantity(noise, 'um', 2)}, the standard "
        f"uncertainties relative to the cold cycle are {stated}. Half of the variance is due to the cold cycle, which "
        "is probed once."
    ]
    if unseen := [DOF[k] for k in range(6) if k not in motion.seen]:
        notes.append(
            f"Not determined: {', '.join(unseen)}. Only {' and '.join(motion.tool_axes) or 'no axis'} carries the "
            "tool, and a rotation is observed through the travel of these axes alone."
        )
    notes.append("Not determined: a tilt of the spindle relative to the last axis; it displaces all balls equally.")
    if np.isinf(loss).any():
        notes.append(published.ONE_PLANE)
    elif np.isfinite(loss).all():
        worse = ", ".join(f"{name} {factor:.2f}" for name, factor in zip(DOF, loss, strict=True))
        notes.append(f"The uncertainties by the normals of two planes would be larger by the factors {worse}.")
    return notes
