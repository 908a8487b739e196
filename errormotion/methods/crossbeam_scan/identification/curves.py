"""Smooth curves of the axis errors over position and over time.

The curves are fitted in the profiler's frame, where displacements do not contain the rotations times the lever: over
the lever of 2 m, the noise of the rotations would dominate that of the displacements. They are then transformed to the
carriage like the points, with the contributions of pose and lever. Errors that all points share (pose of the profiler,
lever, cold scan) are not reduced by smoothing.

Reasons for the choices (`errormotion.estimation.smoothing`), from the virtual gantry (eight positions, nine times, each
point predicted from the others):

* Order 3 predicts the omitted point far better than order 2, with half the uncertainty. A beam in a smooth temperature
  field has a continuous curvature, as order 3 has and order 2 does not.
* One amplitude for all cycles of a freedom is as good as one for each cycle, or one in proportion to the errors of the
  cycle, with a ninth of the parameters: the cycles share the shape of the guide.
* On a linear scale of time, the curves bend most at the beginning, where their uncertainty would be too small. On
  ``warm_up_scale``, exponentials with time constants from 15 min to 2 h are about equally smooth.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from errormotion.arrays import Array
from errormotion.estimation.smoothing import smooth_vectors
from errormotion.methods.crossbeam_scan.identification.chain import Rig, carriage_errors

PLACES, MOMENTS = 41, 41
"""Number of points of a curve over position and over time."""
LINEAR_TIME = 1500.0
"""Time at which the scale of time changes from linear to logarithmic, s."""


def warm_up_scale(time: ArrayLike) -> Array:
    """Return log(1 + t / 25 min) of times t (s): the scale on which the errors of a warm-up are equally smooth."""
    return np.log1p(np.asarray(time, dtype=float) / LINEAR_TIME)


def curves(twist: Array, covariance: Array, cold: Array, rig: Rig, positions: Array, time: Array) -> dict[str, Any]:
    """Return the curves as extra results of the error dataset.

    Parameters
    ----------
    twist, covariance, cold : (cycle, artefact, 6), (cycle, artefact, 6, 6), (cycle, artefact, 6, 6)
        Motion of the profiler, its covariance, and what of it the cold scans cause; NaN for points that are not used.
        The first cycle is the cold one.
    rig : Rig
    positions : (artefact,)
        m.
    time : (cycle,)
        s, 0 for the cold one.

    Returns
    -------
    dict
        ``smooth_position`` and ``_u`` (time, place, dof), the cold cycle first and zero; ``smooth_time`` and ``_u``
        (moment, position, dof); ``place`` m, ``moment`` s.
    """
    e, C, common = twist[1:], covariance[1:], cold[1:]
    place = np.linspace(positions[0], positions[-1], PLACES) if positions.size > 1 else positions.copy()
    over = smooth_vectors(positions, e, C, place)
    position, position_u = _chained(over.values, over.covariance, rig)
    zero = np.zeros((1, *position.shape[1:]))

    moment = np.linspace(0.0, time[-1], MOMENTS)
    e, own, common = (np.swapaxes(value, 0, 1) for value in (e, C - common, common))  # artefact, cycle
    along = smooth_vectors(warm_up_scale(time[1:]), e, own, warm_up_scale(moment), exact_zero=True)
    roots = np.linalg.cholesky(_regularised(common))  # one draw for all cycles of an artefact
    effect = along.carry(np.moveaxis(roots, -1, 0))  # (6, artefact, moment, 6)
    total = along.covariance + np.einsum("s...i,s...j->...ij", effect, effect)
    over_time, over_time_u = _chained(along.values, total, rig)
    return {
        "place": ("place", place, {"units": "m"}),
        "smooth_position": (("time", "place", "dof"), np.concatenate([zero, position])),
        "smooth_position_u": (("time", "place", "dof"), np.concatenate([zero, position_u])),
        "moment": ("moment", moment, {"units": "s"}),
        "smooth_time": (("moment", "position", "dof"), np.swapaxes(over_time, 0, 1)),
        "smooth_time_u": (("moment", "position", "dof"), np.swapaxes(over_time_u, 0, 1)),
    }


def _chained(twist: Array, covariance: Array, rig: Rig) -> tuple[Array, Array]:
    """Return errors of the carriage and their standard uncertainty, pose and lever included."""
    E, C = carriage_errors(twist, covariance, rig)
    return E, np.sqrt(np.diagonal(C, axis1=-2, axis2=-1))


def _regularised(C: Array) -> Array:
    """Return matrices that have a Cholesky factor: with a tiny diagonal added, unknown ones as 0."""
    known = np.asarray(np.isfinite(C).all(axis=(-2, -1)))
    unit = np.full(6, 1e-12)
    return np.where(known[..., None, None], C, 0.0) + np.diag(unit**2)
