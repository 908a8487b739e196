"""Pre-travel map of a probe, from touches distributed over a ball of known radius.

When the probe trips, the tip p is at the distance R + r - s(n) from the centre c of the ball: R and r are the radii of
ball and tip, n the direction from c to p, s the pre-travel. c and the coefficients of s are estimated together. The
highest degree of s is selected by leave-one-out cross-validation. In addition to the noise, the covariance contains the
errors common to all touches: the uncertainty of the radii, the roundness of the ball, and the scale and squareness
errors of the machine over the size of the ball.
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
from errormotion.estimation.robust import NORMAL_MAD
from errormotion.plugins import PluginSettings, Touch

REDUNDANCY = 4
"""Smallest number of touches beyond the number of unknowns."""
_ITERATIONS = 20
_OUTLIER = 5.0  # distance from the other touches, in robust standard deviations
_MAX_OUTLIERS = 0.1  # fraction of the touches
_OVAL = 0.27  # rms of the surface of an ellipsoid over the sphere for one peak to valley
_SINGULAR = 1e-6  # smallest singular value of the design relative to the largest one


class PretravelSettings(PluginSettings):
    """Properties of the ball, the tip and the machine."""

    ball_radius: Length = Field(description="radius of the ball, from its calibration", gt=0)
    ball_radius_uncertainty: Length = Field(default=0.5e-6, description="its standard uncertainty", ge=0)
    ball_roundness: Length = Field(default=0.2e-6, description="of the ball, peak to valley", ge=0)
    tip_radius: Length = Field(description="radius of the tip", gt=0)
    tip_radius_uncertainty: Length = Field(default=1e-6, description="its standard uncertainty", ge=0)
    strain: float = Field(
        default=10e-6, description="standard uncertainty of the machine's scales and squareness, m/m", ge=0
    )
    serial_number: str = Field(default="", description="serial number of the probe; unknown if not given")
    highest: int = Field(default=5, description="highest degree of the candidates", ge=0, le=HIGHEST)


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
    """Return touches evenly distributed over a ball, along its normals.

    Parameters
    ----------
    centre : (3,)
        Approximate centre of the ball, m.
    ball_radius, tip_radius : float
        m.
    count : int
        Number of touches.
    lowest : float
        Elevation of the lowest touches, rad; the post of the ball is below.
    standoff, overtravel : float
        Distances of start and end of a touch before and beyond the expected contact, m.
    """
    k = np.arange(count)
    z = 1.0 - (1.0 - math.sin(lowest)) * (k + 0.5) / count
    turn = k * math.pi * (3.0 - math.sqrt(5.0))
    across = np.sqrt(1.0 - z**2)
    n = np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)
    contact = ball_radius + tip_radius
    starts = np.asarray(centre) + (contact + standoff) * n
    targets = np.asarray(centre) + (contact - overtravel) * n
    return [Touch(_tuple(start), _tuple(target)) for start, target in zip(starts, targets, strict=True)]


def _tuple(point: Array) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in point)
    return x, y, z


def fit_pretravel(touch: ArrayLike, settings: PretravelSettings) -> PretravelMap:
    """Fit the map to touches of one ball.

    Parameters
    ----------
    touch : (n, 3)
        Positions of the tip when the probe tripped, m, machine coordinates; rows with NaN are ignored.
    settings : PretravelSettings

    Returns
    -------
    PretravelMap

    Raises
    ------
    FitError
        Too few touches, or touches that do not surround the ball sufficiently.
    """
    given = np.asarray(touch, dtype=float).reshape(-1, 3)
    points = given[np.isfinite(given).all(axis=1)]
    if len(points) < 4 + REDUNDANCY:
        raise FitError(
            f"Expected at least {4 + REDUNDANCY} touches of the ball; found {len(points)}. 40 or more are recommended",
            code="probing.touches.too_few",
        )
    contact = settings.ball_radius + settings.tip_radius
    used = np.ones(len(points), dtype=bool)
    while True:
        candidates = _candidates(points[used], contact, settings.highest)
        best = min(candidates, key=lambda candidate: candidate.cross_validated)
        worst = _worst(best.left_out_residual)
        if worst is None or used.sum() <= math.ceil((1 - _MAX_OUTLIERS) * len(points)):
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
            "cross_validated": [candidate.cross_validated for candidate in candidates],
            "highest": [candidate.highest for candidate in candidates],
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
    """Centre and coefficients for one highest degree; design and residuals of the touches."""

    highest: int
    centre: Array
    coefficients: Array
    design: Array
    residual: Array
    left_out_residual: Array

    @property
    def cross_validated(self) -> float:
        """Rms of the cross-validation residuals, m."""
        return float(np.sqrt(np.mean(self.left_out_residual**2)))


def _candidates(points: Array, contact: float, highest: int) -> list[_Fit]:
    candidates = []
    for degree in (0, *range(2, highest + 1)):
        unknowns = len(terms_up_to(degree)[0]) + 3
        if len(points) >= unknowns + REDUNDANCY and (fit := _fit(points, contact, degree)) is not None:
            candidates.append(fit)
    if not candidates:
        raise FitError(
            "The touches do not surround the ball sufficiently to determine its centre; touch it from more sides",
            code="probing.touches.one_side",
        )
    return candidates


def _fit(points: Array, contact: float, highest: int) -> _Fit | None:
    """Estimate centre and coefficients together; None if the touches do not determine them."""
    degrees, orders = terms_up_to(highest)
    centre = _first_centre(points)
    for _ in range(_ITERATIONS):
        offset = points - centre
        distance = np.linalg.norm(offset, axis=1)
        n = offset / distance[:, None]
        A = np.hstack([harmonics(n, degrees, orders), -n])  # R + r - |p - c| = H b - n dc
        coefficients, _, _, singular = np.linalg.lstsq(A, contact - distance, rcond=None)
        if singular[-1] < _SINGULAR * singular[0]:
            return None
        centre = centre + coefficients[-3:]
        if np.abs(coefficients[-3:]).max() < 1e-12:
            break
    residual = contact - distance - A @ coefficients
    leverage = (np.linalg.qr(A)[0] ** 2).sum(axis=1)
    left_out = residual / np.maximum(1.0 - leverage, 1e-9)
    return _Fit(highest, centre, coefficients[:-3], A, residual, left_out)


def _first_centre(points: Array) -> Array:
    """Return the centre of the sphere through all points, by linear least squares."""
    mean = points.mean(axis=0)
    p = points - mean
    A = np.hstack([2 * p, np.ones((len(p), 1))])
    return np.asarray(mean + np.linalg.lstsq(A, (p**2).sum(axis=1), rcond=None)[0][:3])


def _worst(residual: Array) -> int | None:
    """Return the index of the largest outlier; None if there is none."""
    off = np.abs(residual - np.median(residual))
    worst = int(np.argmax(off))
    return worst if off[worst] > _OUTLIER * NORMAL_MAD * float(np.median(off)) else None


def _covariance(fit: _Fit, normals: Array, contact: float, settings: PretravelSettings) -> tuple[float, Array]:
    """Return the noise of a touch and the covariance of the coefficients from all sources."""
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
    """Return the effects on each touch of the errors common to all touches, one standard uncertainty, m."""
    radii = math.hypot(settings.ball_radius_uncertainty, settings.tip_radius_uncertainty)
    shared = [np.full(len(n), radii)]
    oval = _OVAL * settings.ball_roundness / math.sqrt(5.0)  # of each of the five terms of degree 2
    shared += list(oval * harmonics(n, np.full(5, 2), np.arange(-2, 3)).T)
    pairs = [(i, j) for i in range(3) for j in range(i, 3)]
    shared += [settings.strain * contact * n[:, i] * n[:, j] for i, j in pairs]
    return shared


def _widest_gap(normals: Array) -> float:
    """Return the largest angle between a touch and its nearest neighbour, rad."""
    cosine = normals @ normals.T
    np.fill_diagonal(cosine, -1.0)
    return float(np.arccos(np.clip(cosine.max(axis=1), -1.0, 1.0)).max())
