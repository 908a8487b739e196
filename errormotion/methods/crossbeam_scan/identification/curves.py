"""Smooth curves of the axis errors over position and over time.

The curves are fitted in the profiler's frame, where displacements do not contain the rotations times the lever. They
are then transformed to the carriage like the points, with the contributions of pose and lever.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.methods.crossbeam_scan.identification.carriage import Carriage, Rig
from errormotion.methods.crossbeam_scan.identification.chain import CarriageErrors, carriage_errors
from errormotion.methods.crossbeam_scan.identification.registrations import Registrations
from errormotion.methods.crossbeam_scan.identification.smoothing import smooth_twists, warm_up_scale

PLACES, MOMENTS = 41, 41
"""Number of points of a curve over position and over time."""


def curves(
    axis: Carriage,
    found: Registrations,
    rig: Rig,
    positions: Array,
    time: Array,
    warm: list[int],
    wrong: NDArray[np.bool_],
) -> dict[str, Any]:
    """Return the curves as extra results of the error dataset.

    Parameters
    ----------
    axis : Carriage
    found : Registrations
    rig : Rig
    positions : (artefact,)
        m.
    time : (warm cycle,)
        s, above 0.
    warm : list of int
        The cycles.
    wrong : (cycle, artefact)
        Points to exclude, because an artefact has moved.

    Returns
    -------
    dict
        ``smooth_position`` and ``_u`` (time, place, dof), the cold cycle first and zero; ``smooth_time`` and ``_u``
        (moment, position, dof); ``place`` m, ``moment`` s.
    """
    e = np.where(wrong[warm][..., None], np.nan, axis.profiler[warm])
    C = axis.profiler_covariance[warm]
    place = np.linspace(positions[0], positions[-1], PLACES) if positions.size > 1 else positions.copy()
    over = smooth_twists(positions, e, C, place)
    position, position_u = _chained(over.values, over.covariance, rig)
    cold = np.zeros((1, *position.shape[1:]))

    moment = np.linspace(0.0, time[-1], MOMENTS)
    share = found.cold_share[warm]
    e, C, share = (np.swapaxes(value, 0, 1) for value in (e, C, share))  # artefact, cycle
    own = C * (1 - share)[..., None, None]
    along = smooth_twists(warm_up_scale(time), e, own, warm_up_scale(moment), exact_zero=True)
    common = np.linalg.cholesky(_regularised(C * share[..., None, None]))  # one draw for all cycles of an artefact
    effect = along.carry(np.moveaxis(common, -1, 0))  # (6, artefact, moment, 6)
    total = along.covariance + np.einsum("s...i,s...j->...ij", effect, effect)
    over_time, over_time_u = _chained(along.values, total, rig)
    return {
        "place": ("place", place, {"units": "m"}),
        "smooth_position": (("time", "place", "dof"), np.concatenate([cold, position])),
        "smooth_position_u": (("time", "place", "dof"), np.concatenate([cold, position_u])),
        "moment": ("moment", moment, {"units": "s"}),
        "smooth_time": (("moment", "position", "dof"), np.swapaxes(over_time, 0, 1)),
        "smooth_time_u": (("moment", "position", "dof"), np.swapaxes(over_time_u, 0, 1)),
    }


def _chained(twist: Array, covariance: Array, rig: Rig) -> tuple[Array, Array]:
    """Return errors of the carriage and their standard uncertainty, pose and lever included."""
    found: CarriageErrors = carriage_errors(
        twist,
        covariance,
        rig.pose,
        rig.lever,
        pose_covariance=rig.pose_covariance,
        lever_uncertainty=rig.lever_uncertainty,
    )
    return found.values, np.sqrt(np.diagonal(found.covariance, axis1=-2, axis2=-1))


def _regularised(C: Array) -> Array:
    """Return matrices that have a Cholesky factor: with a tiny diagonal added, unknown ones as 0."""
    known = np.asarray(np.isfinite(C).all(axis=(-2, -1)))
    unit = np.full(6, 1e-12)
    return np.where(known[..., None, None], C, 0.0) + np.diag(unit**2)
