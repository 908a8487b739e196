"""The centre of every ball in every cycle, from its touches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array

if TYPE_CHECKING:
    from errormotion.methods.normal_vector.identification.rigid import Observations

MAX_ITERATIONS = 12
SINGULAR = 1e-6
"""Smallest eigenvalue relative to the largest one below which a matrix counts as singular."""


@dataclass(frozen=True)
class Centres:
    """Apparent centres of the balls.

    Attributes
    ----------
    centre : ndarray (k, b, 3)
        m; NaN where the touches do not determine it.
    cofactor : ndarray (k, b, 3, 3)
        Covariance for unit weights of the touches, from their scatter in this cycle alone.
    """

    centre: Array
    cofactor: Array


def centres(seen: Observations, anchor: Array, reach: Array) -> Centres:
    """Return the centres at a distance of the reach from every touch of a ball, by least squares.

    The reaches (b, m), m, contain everything common to all cycles, so that the radius is not a free parameter of each
    cycle: the centre is the intersection of spheres around the tip, by Gauss-Newton from ``anchor`` (b, 3), m.
    """
    valid = seen.valid & np.isfinite(reach)
    weight = seen.weight * valid[..., None] * valid[..., None, :]
    if not seen.touched:
        known = np.all(valid, axis=-1)
        centre = np.where(known[..., None], seen.position[:, :, 0], np.nan)
        return Centres(centre, _inverse(weight))
    centre = np.broadcast_to(anchor, (len(seen.position), *anchor.shape)).copy()
    cofactor = np.full((*centre.shape, 3), np.nan)
    for _ in range(MAX_ITERATIONS):
        away = seen.position - centre[:, :, None]
        length = np.linalg.norm(away, axis=-1)
        normal = away / np.where(length > 0, length, 1.0)[..., None]
        misfit = np.where(valid, length - reach, 0.0)
        WN = weight @ normal
        cofactor = _inverse(np.swapaxes(normal, 2, 3) @ WN)
        step = (cofactor @ (np.swapaxes(WN, 2, 3) @ misfit[..., None]))[..., 0]
        step = np.nan_to_num(step)
        centre += step
        if np.abs(step).max(initial=0.0) < 1e-13:
            break
    return Centres(np.where(np.isfinite(cofactor[..., 0]), centre, np.nan), cofactor)


def _inverse(N: Array) -> Array:
    """Return the inverse of matrices (..., 3, 3); NaN for singular ones."""
    size = np.linalg.eigvalsh(N)
    sound = size[..., 0] > SINGULAR * size[..., -1]
    safe = np.where(sound[..., None, None], N, np.eye(3))
    return np.asarray(np.where(sound[..., None, None], np.linalg.inv(safe), np.nan))
