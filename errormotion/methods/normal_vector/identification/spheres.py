"""Spheres through the touches of balls, and the centre of every ball in every cycle."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import FitError, MethodError
from errormotion.kinematics.fits import fit_sphere

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAX_ITERATIONS = 12
SINGULAR = 1e-6
"""Smallest eigenvalue relative to the largest one below which a matrix counts as singular."""


@dataclass(frozen=True)
class Observations:
    """Data of k cycles, b balls and m numbers each: touches, or the coordinates of a centre.

    Attributes
    ----------
    position : ndarray (k, b, m, 3)
        Commanded positions, m; 0 where not measured.
    weight : ndarray (k, b, m, m)
        Inverse covariance of the numbers of a ball, 1/m^2; 0 where not measured.
    time : ndarray (k, b, m)
        Of each, s.
    cycle_time : ndarray (k,)
        s.
    touched : bool
        Whether the data are touches.
    """

    position: Array
    weight: Array
    time: Array
    cycle_time: Array
    touched: bool

    @cached_property
    def valid(self) -> NDArray[np.bool_]:
        """Which numbers were measured, (k, b, m)."""
        return np.asarray(np.diagonal(self.weight, axis1=2, axis2=3) > 0)

    @cached_property
    def spheres(self) -> tuple[Array, Array]:
        """Centres (b, 3) and radii (b,) of spheres through the touches of each ball without drift, m."""
        return spheres(self.position, self.valid)

    @property
    def mean_time(self) -> Array:
        """Mean time of the data of each cycle, (k,), s; 0 without data."""
        count = np.maximum(self.valid.sum(axis=(1, 2)), 1)
        return np.asarray(np.sum(np.where(self.valid, self.time, 0.0), axis=(1, 2)) / count)

    def without(self, wrong: NDArray[np.bool_]) -> Observations:
        """Return the observations without the outliers ``wrong`` (k, b, m)."""
        keep = (~wrong).astype(float)
        return replace(self, weight=self.weight * keep[..., :, None] * keep[..., None, :])


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


def spheres(position: Array, valid: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return centres (b, 3) and radii (b,), m, of spheres through each ball's mean position of touches in a direction.

    Raises
    ------
    MethodError
        A ball has too few directions.
    """
    count = valid.sum(axis=0)
    mean = np.where(valid[..., None], position, 0.0).sum(axis=0) / np.maximum(count, 1)[..., None]
    fitted = []
    for i, points in enumerate(mean):
        try:
            fitted.append(fit_sphere(points[count[i] > 0]))
        except FitError as error:
            raise MethodError(
                f"Ball {i + 1} has no sphere through its touches in {int((count[i] > 0).sum())} directions: {error}. "
                "Touch every ball five times or more, around it and on top.",
                code="probing.ball.no_sphere",
            ) from error
    return np.array([sphere.centre for sphere in fitted]), np.array([sphere.radius for sphere in fitted])


def improved(centre: Array, position: Array, valid: NDArray[np.bool_]) -> Array:
    """Return centres (b, 3), m, after a Gauss-Newton step to the spheres through all directions.

    Directions and distances are averaged separately, since the mean of positions on a sphere lies inside it. A ball
    whose remaining directions determine no sphere keeps its centre: it defines directions only.
    """
    count = valid.sum(axis=0)
    away = np.where(valid[..., None], position - centre[:, None], 0.0)
    length = np.linalg.norm(away, axis=-1)
    n = (away / np.where(length > 0, length, 1.0)[..., None]).sum(axis=0)
    n /= np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 0.5)
    J = np.concatenate([n, np.ones((*n.shape[:2], 1))], axis=-1) * (count > 0)[..., None]
    inverse = _inverse(np.swapaxes(J, 1, 2) @ J)
    distance = (length.sum(axis=0) / np.maximum(count, 1))[..., None]
    return np.asarray(centre + np.nan_to_num(inverse @ np.swapaxes(J, 1, 2) @ distance)[:, :3, 0])


def centres(seen: Observations, anchor: Array, reach: Array) -> Centres:
    """Return the centres at a distance of the reach from every touch of a ball, by least squares.

    The reaches (b, m), m, contain everything common to all cycles, so that the radius is not a free parameter of each
    cycle: the centre is the intersection of spheres around the tip, by Gauss-Newton from ``anchor`` (b, 3), m.
    """
    valid = seen.valid & np.isfinite(reach)
    if not seen.touched:
        known = np.all(valid, axis=-1)
        centre = np.where(known[..., None], seen.position[:, :, 0], np.nan)
        return Centres(centre, _inverse(seen.weight * valid[..., None] * valid[..., None, :]))
    centre = np.broadcast_to(anchor, (len(seen.position), *anchor.shape)).copy()
    N, sound = np.zeros((*centre.shape, 3)), None
    weight = np.diagonal(seen.weight, axis1=2, axis2=3) * valid  # touches are independent
    for _ in range(MAX_ITERATIONS):
        away = seen.position - centre[:, :, None]
        length = np.linalg.norm(away, axis=-1)
        normal = away / np.where(length > 0, length, 1.0)[..., None]
        WN = weight[..., None] * normal
        N = np.swapaxes(WN, 2, 3) @ normal
        misfit = np.where(valid, length - reach, 0.0)
        sound = _sound(N) if sound is None else sound  # the normals hardly change
        right = np.where(sound[..., None, None], np.swapaxes(WN, 2, 3) @ misfit[..., None], 0.0)
        step = np.linalg.solve(np.where(sound[..., None, None], N, np.eye(3)), right)[..., 0]
        centre += step
        if np.abs(step).max(initial=0.0) < 1e-13:
            break
    cofactor = _inverse(N)
    return Centres(np.where(np.isfinite(cofactor[..., 0]), centre, np.nan), cofactor)


def _sound(N: Array) -> NDArray[np.bool_]:
    """Return which of symmetric matrices (..., p, p) are not singular, (...)."""
    size = np.linalg.eigvalsh(N)
    return np.asarray(size[..., 0] > SINGULAR * size[..., -1])


def _inverse(N: Array) -> Array:
    """Return the inverses of symmetric matrices (..., p, p); NaN for singular ones."""
    known = _sound(N)[..., None, None]
    return np.asarray(np.where(known, np.linalg.inv(np.where(known, N, np.eye(N.shape[-1]))), np.nan))
