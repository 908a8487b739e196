"""What a test is expected to give, and what it will be worth."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets.units import format_quantity
from errormotion.errors import MethodError
from errormotion.kinematics.iso import DOF
from errormotion.measurement import ModelMethod
from errormotion.measurement.planning import plan as planned
from errormotion.methods.normal_vector.acquisition import touching
from errormotion.methods.normal_vector.acquisition.cycle import TIP_RADIUS, cycles
from errormotion.methods.normal_vector.identification import normals
from errormotion.methods.normal_vector.identification.freedoms import Motion, check_layout
from errormotion.methods.normal_vector.schema import RESULT, SCHEMA

if TYPE_CHECKING:
    from errormotion.methods.normal_vector.settings import NormalVectorSettings

NOISE = 0.25e-6
"""Noise of a touch where the settings have none, m."""

PLANNED = ("normals_loss", "redundancy", "smallest_error", "smallest_error_effect")
"""Further variables of a plan."""
MEASURED = [*(name for name in RESULT if name not in PLANNED), "cycle_time", "direction", "direction_"]
"""Variables of a result that a plan has not."""

_M, _S = {"units": "m"}, {"units": "s"}


def expected(settings: NormalVectorSettings) -> xr.Dataset:
    """Return the touches of a machine without errors; those of a cycle are simultaneous.

    No source of the model multiplies an error, so that errors of typical size would have the same uncertainty.

    Raises
    ------
    MethodError
        Fewer than three balls, a layout that leaves errors undetermined, or no cycle after the cold one.
    """
    names, count = touching.names(settings), cycles(settings)
    centre = np.array([ball.centre for ball in settings.balls], dtype=float).reshape(-1, 3)
    check_layout(centre, names, settings.tool_axes)
    if count < 2:
        raise MethodError(
            f"Expected the cold cycle and at least one more; a warm-up of {settings.duration:g} s has none at an "
            f"interval of {settings.interval:g} s.",
            code="probing.cycles.too_few",
        )
    radius = np.array([ball.radius for ball in settings.balls])
    tip = settings.tip_radius or TIP_RADIUS
    normal = touching.normals(settings)
    touch = centre[:, None] + (radius + tip)[:, None, None] * normal
    time = settings.interval * np.arange(count)
    dims = ("time", "ball", "touch")
    return xr.Dataset(
        {
            "touch": ((*dims, "direction"), np.tile(touch, (count, 1, 1, 1)), _M),
            "touch_time": (dims, np.tile(time[:, None, None], (1, *touch.shape[:2])), _S),
            "approach": ((*dims[1:], "direction"), -normal, {"units": "1"}),
            "tip_radius": ((), tip, _M),
            "ball_radius": ("ball", radius, _M),
            "ball_nominal": (("ball", "direction"), centre, _M),
            "touch_noise": ((), settings.touch_noise or NOISE, _M),
        },
        {"time": ("time", time, _S), "ball": names, "direction": list("xyz")},
        {"schema": SCHEMA, "tool_axes": settings.tool_axes},
    )


def plan(method: ModelMethod, settings: NormalVectorSettings) -> xr.Dataset:
    """Return an error dataset of zeros over the cycles, with the covariance expected from balls, touches and noise.

    ``normals_loss(dof)`` is the uncertainty of the published construction relative to that of the fit; ``notes`` state
    the expected uncertainties and the errors that are not determined.

    Raises
    ------
    MethodError
        See `expected`.
    """
    errors = planned(method, settings, method.info)
    loss = errors["normals_loss"].values[-1]
    if settings.tool_axes == "XYZ" and len(settings.balls) >= 4:
        four = normals.chosen(touching.names(settings), settings.normals_balls)
        if not normals.planes_apart(np.array([settings.balls[i].centre for i in four])):
            loss = np.full(6, np.inf)
    ds = errors.drop_vars(MEASURED).assign(normals_loss=("dof", loss, {"units": "1"}))
    return ds.assign_attrs(notes=_notes(settings, errors["covariance"].values[-1], loss), tool_axes=settings.tool_axes)


def _notes(settings: NormalVectorSettings, covariance: Array, loss: Array) -> list[str]:
    motion = Motion(settings.tool_axes, np.zeros(3))
    u = np.sqrt(np.diagonal(covariance))
    stated = ", ".join(f"{DOF[k]} {format_quantity(float(u[k]), 'um' if k < 3 else 'arcsec', 3)}" for k in motion.seen)
    noise = format_quantity(settings.touch_noise or NOISE, "um", 2)
    touches = settings.touches * len(settings.balls)
    notes = [
        f"With {touches} touches in each cycle and a noise of {noise}, the standard "
        f"uncertainties relative to the cold cycle are {stated}. Half of the variance is due to the cold "
        "cycle, which is probed once."
    ]
    if unseen := [DOF[k] for k in range(6) if k not in motion.seen]:
        notes.append(
            f"Not determined: {', '.join(unseen)}. Only {' and '.join(motion.tool_axes) or 'no axis'} carries the "
            "tool, and a rotation is observed through the travel of these axes alone."
        )
    notes.append("Not determined: a tilt of the spindle relative to the last axis; it displaces all balls equally.")
    if np.isinf(loss).any():
        notes.append(normals.ONE_PLANE)
    elif np.isfinite(loss).all():
        worse = ", ".join(f"{name} {factor:.2f}" for name, factor in zip(DOF, loss, strict=True))
        notes.append(f"The uncertainties by the normals of two planes would be larger by the factors {worse}.")
    return notes
