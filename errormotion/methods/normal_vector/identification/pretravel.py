"""The pre-travel map of a probe, from touches all over a ball of known radius.

Where the probe trips, the tip p is by R + r - s(n) away from the middle c of the ball: R and r are the radii of ball
and tip, n the direction from c to p, s the pre-travel. c and the coefficients of s are found together. How many degrees
s has is decided by the error at touches that are left out one by one. The covariance has, beside the noise, what all
touches share: how well the radii are known, how round the ball is, and by how much the machine itself measures longer
in one direction than in another over the size of the ball.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from pydantic import Field

from errormotion.arrays import Array
from errormotion.datasets import provenance
from errormotion.datasets.calibrations import owner
from errormotion.datasets.calibrations.pretravel import HIGHEST, PretravelMap, assemble, harmonics, terms_up_to, unit
from errormotion.datasets.units import Length
from errormotion.errors import FitError
from errormotion.plugins import PluginSettings, Touch

SPARE = 4
"""Touches more than unknowns, at least."""
_ROUNDS = 20
_OUTSIDE = 5.0  # robust standard deviations: a touch so far from the others is left out
_MOST_LEFT_OUT = 0.1
_MAD = 1.4826  # standard deviations of a normal distribution for one median absolute deviation
_OVAL = 0.27  # rms of a surface over the sphere for one peak to valley, where it is an ellipsoid
_WEAK = 1e-6  # smallest singular value of the design, in largest ones


class PretravelSettings(PluginSettings):
    """What is known of the ball, the tip and the machine."""

    ball_radius: Length = Field(description="radius of the ball, from its calibration", gt=0)
    ball_radius_uncertainty: Length = Field(default=0.5e-6, description="its standard uncertainty", ge=0)
    ball_roundness: Length = Field(default=0.2e-6, description="of the ball, peak to valley", ge=0)
    tip_radius: Length = Field(description="radius of the tip", gt=0)
    tip_radius_uncertainty: Length = Field(default=1e-6, description="its standard uncertainty", ge=0)
    strain: float = Field(
        default=10e-6, description="by how much the machine's scales and right angles may be off, m/m, one sigma", ge=0
    )
    serial_number: str = Field(default="", description="serial number of the probe; unknown if not given")
    highest: int = Field(default=5, description="highest degree that is tried", ge=0, le=HIGHEST)


def calibrating_touches(
    centre: Sequence[float],
    ball_radius: float,
    tip_radius: float,
    *,
    count: int = 60,
    lowest: float = 0.0,
    standoff: float = 2e-3,
    overtravel: float = 1e-3,
) -> list[Touch]:
    """Return touches all over a ball, evenly spread, along its normals.

    Parameters
    ----------
    centre : (3,)
        Of the ball as far as it is known, m.
    ball_radius, tip_radius : float
        m.
    count : int
        How many.
    lowest : float
        Elevation of the lowest ones, rad; the ball's post is below.
    standoff, overtravel : float
        Where the touch begins before the expected place of contact, and where it ends behind, m.
    """
    k = np.arange(count)
    z = 1.0 - (1.0 - math.sin(lowest)) * (k + 0.5) / count
    turn = k * math.pi * (3.0 - math.sqrt(5.0))
    across = np.sqrt(1.0 - z**2)
    n = np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)
    contact = ball_radius + tip_radius
    starts = np.asarray(centre) + (contact + standoff) * n
    targets = np.asarray(centre) + (contact - overtravel) * n
    return [Touch(_place(start), _place(target)) for start, target in zip(starts, targets, strict=True)]


def _place(point: Array) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in point)
    return x, y, z


def fit_pretravel(touch: ArrayLike, settings: PretravelSettings) -> PretravelMap:
    """Fit the map to touches of one ball.

    Parameters
    ----------
    touch : (n, 3)
        Places of the tip where the probe tripped, m, in the machine's coordinates; rows with NaN gave none.
    settings : PretravelSettings

    Returns
    -------
    PretravelMap

    Raises
    ------
    FitError
        Too few touches, or touches that do not surround enough of the ball.
    """
    given = np.asarray(touch, dtype=float).reshape(-1, 3)
    points = given[np.isfinite(given).all(axis=1)]
    if len(points) < 4 + SPARE:
        raise FitError(
            f"Expected at least {4 + SPARE} touches of the ball; found {len(points)}. For lobes 40 or more make sense"
        )
    contact = settings.ball_radius + settings.tip_radius
    used = np.ones(len(points), dtype=bool)
    while True:
        tried = _tried(points[used], contact, settings.highest)
        best = min(tried, key=lambda each: each.cross_validated)
        worst = _worst(best.left_out_residual)
        if worst is None or used.sum() <= math.ceil((1 - _MOST_LEFT_OUT) * len(points)):
            break
        used[np.flatnonzero(used)[worst]] = False
    degrees, orders = terms_up_to(best.highest)
    normals = unit(points - best.centre)
    residual = contact - np.linalg.norm(points - best.centre, axis=1)
    residual -= harmonics(normals, degrees, orders) @ best.coefficients
    noise, C = _covariance(best, normals[used], contact, settings)
    raw = xr.Dataset({"touch": (("touch", "direction"), points, {"units": "m"})})
    dataset = assemble(
        {
            "coefficient": best.coefficients,
            "coefficient_covariance": C,
            "degree": degrees,
            "order": orders,
            "normal": normals,
            "residual": residual,
            "left_out": (~used).astype(int),
            "reach": _widest_gap(normals[used]),
            "noise": noise,
            "cross_validated": [each.cross_validated for each in tried],
            "highest": [each.highest for each in tried],
            "ball_radius": settings.ball_radius,
            "tip_radius": settings.tip_radius,
        },
        {
            "provenance": json.dumps(provenance.make(settings, raw, None)),
            **({owner.ATTRIBUTE: settings.serial_number} if settings.serial_number else {}),
        },
    )
    return PretravelMap(dataset)


@dataclass(frozen=True)
class _Fit:
    """Centre and coefficients with a highest degree; rows and residuals of the touches."""

    highest: int
    centre: Array
    coefficients: Array
    design: Array
    residual: Array
    left_out_residual: Array

    @property
    def cross_validated(self) -> float:
        """Rms error at touches left out, m."""
        return float(np.sqrt(np.mean(self.left_out_residual**2)))


def _tried(points: Array, contact: float, highest: int) -> list[_Fit]:
    tried = []
    for degree in (0, *range(2, highest + 1)):
        unknowns = len(terms_up_to(degree)[0]) + 3
        if len(points) >= unknowns + SPARE and (fit := _fit(points, contact, degree)) is not None:
            tried.append(fit)
    if not tried:
        raise FitError("The touches do not surround enough of the ball to find its middle; touch it from more sides")
    return tried


def _fit(points: Array, contact: float, highest: int) -> _Fit | None:
    """Find middle and coefficients together; None where the touches do not determine them."""
    degrees, orders = terms_up_to(highest)
    centre = _first_centre(points)
    for _ in range(_ROUNDS):
        offset = points - centre
        distance = np.linalg.norm(offset, axis=1)
        n = offset / distance[:, None]
        A = np.hstack([harmonics(n, degrees, orders), -n])  # R + r - |p - c| = H b - n dc
        values = np.linalg.svd(A, compute_uv=False)
        if values[-1] < _WEAK * values[0]:
            return None
        found = np.linalg.lstsq(A, contact - distance, rcond=None)[0]
        centre = centre + found[-3:]
        if np.abs(found[-3:]).max() < 1e-12:
            break
    residual = contact - distance - A @ found
    leverage = (np.linalg.qr(A)[0] ** 2).sum(axis=1)
    left_out = residual / np.maximum(1.0 - leverage, 1e-9)
    return _Fit(highest, centre, found[:-3], A, residual, left_out)


def _first_centre(points: Array) -> Array:
    """Return the middle of the sphere through all points, by linear algebra."""
    mean = points.mean(axis=0)
    p = points - mean
    A = np.hstack([2 * p, np.ones((len(p), 1))])
    return np.asarray(mean + np.linalg.lstsq(A, (p**2).sum(axis=1), rcond=None)[0][:3])


def _worst(residual: Array) -> int | None:
    """Return the number of the touch that does not belong to the others; None if all do."""
    off = np.abs(residual - np.median(residual))
    worst = int(np.argmax(off))
    return worst if off[worst] > _OUTSIDE * _MAD * float(np.median(off)) else None


def _covariance(fit: _Fit, normals: Array, contact: float, settings: PretravelSettings) -> tuple[float, Array]:
    """Return the noise of a touch and the covariance of the coefficients, all sources."""
    A, free = fit.design, len(fit.residual) - fit.design.shape[1]
    noise = float(np.sqrt((fit.residual**2).sum() / free))
    inverse = np.linalg.pinv(A)
    C = noise**2 * free / max(free - 2, 1) * inverse @ inverse.T  # the variance of Student's t
    for shared in _shared(normals, contact, settings):
        effect = inverse @ shared
        C += np.outer(effect, effect)
    count = len(fit.coefficients)
    C = C[:count, :count]
    return noise, np.asarray((C + C.T) / 2)


def _shared(n: Array, contact: float, settings: PretravelSettings) -> list[Array]:
    """Return what errors that all touches share do to each of them, one sigma, m."""
    radii = math.hypot(settings.ball_radius_uncertainty, settings.tip_radius_uncertainty)
    shared = [np.full(len(n), radii)]
    oval = _OVAL * settings.ball_roundness / math.sqrt(5.0)  # of each of the five terms of degree 2
    shared += list(oval * harmonics(n, np.full(5, 2), np.arange(-2, 3)).T)
    pairs = [(i, j) for i in range(3) for j in range(i, 3)]
    shared += [settings.strain * contact * n[:, i] * n[:, j] for i, j in pairs]
    return shared


def _widest_gap(normals: Array) -> float:
    """Return the largest angle between a touch and the one next to it, rad."""
    cosine = normals @ normals.T
    np.fill_diagonal(cosine, -1.0)
    return float(np.arccos(np.clip(cosine.max(axis=1), -1.0, 1.0)).max())
