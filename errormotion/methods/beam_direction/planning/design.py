"""Orientation of the planes and strokes for the smallest uncertainty of the direction of a beam.

A plane of gradient g is one condition for the beam u: g.u = -1. Small angles between the beam and its nominal direction
change g.u in proportion to t, the plane's tilt across the beam (|t| = tan of the inclination). The uncertainty of the
condition is that of the slope of the reading along the beam. From strokes of lengths L along X, Y and Z with n readings
in total, optimally distributed, that slope has the variance 12 (sigma^2 / n) c^2 with c = sum |u_i| / L_i. The range R
of the sensor limits a stroke to L_i = R / |g_i|; hence c >= sum |u_i g_i| / R >= 1 / R, with equality if no u_i g_i is
positive. With an inclination of at most alpha, the larger uncertainty of the two angles, for n readings in total, is at
least

    sqrt(24 / n) sigma / (R tan alpha),

the value of two planes tilted in perpendicular directions, if gauge and travel allow them. A longer stroke never
increases the uncertainty, so the search is only over the orientations of the planes and their shares of the readings.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.kinematics.beams import across

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from errormotion.methods.beam_direction.settings import BeamDirectionSettings


MIN_READINGS = 3
"""Of a stroke, so that its straightness can be checked."""
_MIN_SHARE = 0.02
_PENALTY = 1e3
_MAX_EVALUATIONS = 1000
"""Largest number of evaluations of each search, per plane."""
_TOLERANCE = 1e-7
_ROUNDING = 1e-9
_TINY = np.finfo(float).tiny
_AXES = np.eye(3)
_REGULAR = 1e-12 * np.eye(2)
"""Relative information that is added, so that planes that do not determine the direction have a large uncertainty."""
_RESTARTS = 2
_STARTS = 3
"""Sets of planes, distributed evenly about the beam, from which the search starts in addition to the given one."""


@dataclass(frozen=True)
class Limits:
    """Limits of a set-up, and prior knowledge.

    Attributes
    ----------
    beam : ndarray (3,)
        Nominal direction of the beam.
    beam_uncertainty : float
        Standard uncertainty of each of its two angles, rad.
    reach : float
        Largest change of the reading over a stroke, m.
    travel : ndarray (3,)
        Longest strokes along X, Y, Z, m.
    plate : float
        Longest path of the light spot over the plane in one stroke, m.
    inclination, rotation : tuple of float
        Least and largest inclination and rotation of the gauge, rad.
    max_inclination : float
        Largest angle between the beam and the plane's normal, rad.
    readings : int
        Total number for all planes.
    noise : float
        Standard deviation of one reading, m.
    scale_uncertainty : float
        Relative standard uncertainty of the sensor's scale, common to all planes.
    slope_uncertainty : callable, optional
        Relative standard uncertainty of the slope from the remaining inclination error, as a function of the tilts: (k,
        2) -> (k,).
    """

    beam: Array
    beam_uncertainty: float
    reach: float
    travel: Array
    plate: float
    inclination: tuple[float, float]
    rotation: tuple[float, float]
    max_inclination: float
    readings: int
    noise: float
    scale_uncertainty: float = 0.0
    slope_uncertainty: Callable[[Array], Array] | None = None


def limits_of(
    settings: BeamDirectionSettings,
    sensor_range: float | None = None,
    slope_uncertainty: Callable[[Array], Array] | None = None,
) -> Limits:
    """Return the limits of the settings; ``sensor_range`` (m) of the sensor replaces that of the settings."""
    p = settings.layout
    if sensor_range is None:
        sensor_range = p.reading_range[1] - p.reading_range[0]
    u = np.array(p.nominal_direction, np.float64)
    return Limits(
        beam=u / np.linalg.norm(u),
        beam_uncertainty=p.direction_uncertainty,
        reach=p.used_range * sensor_range,
        travel=np.array(p.travel),
        plate=p.plate,
        inclination=p.inclinations,
        rotation=p.rotations,
        max_inclination=p.max_inclination,
        readings=len(settings.planes) * p.readings,
        noise=float(np.hypot(p.noise / np.sqrt(p.average), p.speckle)),
        scale_uncertainty=p.scale_uncertainty,
        slope_uncertainty=slope_uncertainty,
    )


@dataclass(frozen=True)
class Design:
    """A set-up: planes, strokes, and the number of readings of each stroke.

    Attributes
    ----------
    planes : ndarray (k, 2)
        Inclination and rotation of the gauge, rad.
    strokes : ndarray (k, 3)
        Lengths of the strokes along X, Y, Z, m.
    readings : ndarray of int64 (k, 3)
        Readings of each stroke, equally spaced.
    path : ndarray (n, 3), optional
        Stage positions on every plane instead of strokes, m.
    """

    planes: Array
    strokes: Array
    readings: NDArray[np.int64]
    path: Array | None = None

    def stages(self) -> list[Array]:
        """Return for each plane the positions (n, 3) of the stage, m, relative to that with the reading mid-range."""
        if self.path is not None:
            return [self.path] * len(self.planes)
        return [stroke_points(lengths, counts) for lengths, counts in zip(self.strokes, self.readings, strict=True)]

    @property
    def normals(self) -> Array:
        """Return the normals (k, 3) of the planes."""
        return plane_normals(self.planes)


def plane_normals(planes: Array) -> Array:
    """Return the normals (k, 3) of a gauge on a turntable about Z, from inclinations and rotations (k, 2), rad."""
    a, b = np.asarray(planes, np.float64).T
    sine, normals = np.sin(a), np.empty((len(a), 3))
    normals[:, 0], normals[:, 1], normals[:, 2] = sine * np.cos(b), sine * np.sin(b), np.cos(a)
    return normals


def stroke_points(lengths: Array, counts: NDArray[np.int64]) -> Array:
    """Return positions (n, 3) on strokes along X, Y and Z with a common midpoint, m."""
    parts = [
        np.linspace(-0.5, 0.5, count)[:, None] * length * axis
        for axis, length, count in zip(np.eye(3), lengths, counts, strict=True)
        if count
    ]
    return np.concatenate(parts)


def tilts(normals: Array, beam: Array) -> Array:
    """Return the tilts (k, 2) of planes along ``across(beam)``: the derivative of g.u with respect to its angles."""
    return np.asarray(normals @ _basis(tuple(beam)).T / -(normals @ beam)[:, None])


@lru_cache(maxsize=4)
def _basis(beam: tuple[float, ...]) -> Array:
    """Return ``across(beam)``; cached for the search."""
    return across(np.array(beam))


def inclinations(normals: Array, beam: Array) -> Array:
    """Return the angles (k,) between the reversed beam and the normals, rad; above pi/2 at the back of a plane."""
    return np.asarray(np.arccos(np.clip(-(normals @ beam), -1.0, 1.0)))


def longest_strokes(normals: Array, limits: Limits) -> Array:
    """Return the longest strokes (k, 3), m, within the range, the travel and the plate."""
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):  # a plane along the beam has no strokes
        gradient = -normals / (normals @ limits.beam)[:, None]
        spot = np.sqrt(((_AXES + gradient[:, :, None] * limits.beam) ** 2).sum(axis=-1))
        longest = np.minimum(limits.reach / np.abs(gradient), limits.plate / spot)
    return np.asarray(np.minimum(longest, limits.travel))


def shares_of_strokes(strokes: Array, limits: Limits) -> tuple[Array, Array]:
    """Return the best shares (k, 3) of the strokes in a plane's readings, and c (k,), 1/m (see the module)."""
    # with the uncertainty, because a beam that deviates from nominal has a component along every axis
    per_stroke = np.hypot(limits.beam, limits.beam_uncertainty) / strokes
    c = per_stroke.sum(axis=1)
    return per_stroke / c[:, None], c


def angle_covariance(planes: Array, shares: Array, limits: Limits) -> Array:
    """Return the covariance (2, 2) of the beam's two angles, rad^2, for planes with shares (k,) of the readings."""
    return _covariance_of(plane_normals(planes), shares, limits)


def _covariance_of(normals: Array, shares: Array, limits: Limits) -> Array:
    """Return the covariance (2, 2) of the beam's two angles, rad^2, for planes of these normals (k, 3)."""
    t = tilts(normals, limits.beam)
    _, c = shares_of_strokes(longest_strokes(normals, limits), limits)
    own = 12 * limits.noise**2 * c**2 / (limits.readings * shares)
    if limits.slope_uncertainty is not None:
        own = own + limits.slope_uncertainty(t) ** 2
    weighted = t / own[:, None]
    information = t.T @ weighted
    # The scale error s, common to all planes, is estimated with them: V^-1 of the conditions, V = diag(own) + s^2 1 1'.
    common = weighted.sum(axis=0) * limits.scale_uncertainty
    information -= np.outer(common, common) / (1 + limits.scale_uncertainty**2 * np.sum(1 / own))
    information += (information[0, 0] + information[1, 1]) * _REGULAR + _TINY
    return np.asarray(np.linalg.inv(information), np.float64)


def worst_angle(covariance: Array) -> float:
    """Return the largest standard uncertainty of the beam's angle, over all directions across the beam, rad."""
    return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))


def optimise(limits: Limits, start: Array, *, seed: int = 1) -> Design:
    """Return the planes, strokes and readings that minimise the larger uncertainty of the beam's two angles.

    Parameters
    ----------
    limits : Limits
    start : array_like (k, 2)
        Initial inclination and rotation of the planes, rad; the number of planes is kept.
    seed : int
        Of the search over all orientations, whose result is reproducible.

    Raises
    ------
    MethodError
        Fewer than two planes, too few readings, or no orientation within the limits.
    """
    import nlopt

    start = np.asarray(start, np.float64).reshape(-1, 2)
    number = len(start)
    check_numbers(number, limits)
    lower = np.array([0.0, -np.pi] * number + [_MIN_SHARE] * number)
    upper = np.array([limits.max_inclination, 3 * np.pi] * number + [1.0] * number)

    def cost(x: Array, gradient: Array) -> float:  # noqa: ARG001 - the signature of nlopt
        normals = plane_normals(_planes(x[: 2 * number], limits))
        beyond = np.maximum(inclinations(normals, limits.beam) - limits.max_inclination, 0.0).sum()
        if beyond > _ROUNDING:
            return _PENALTY * (1.0 + float(beyond))
        shares = x[2 * number :]
        return float(np.log(worst_angle(_covariance_of(normals, shares / shares.sum(), limits))))

    nlopt.srand(seed)

    def search(algorithm: int, x: Array, evaluations: int) -> Array:
        problem = nlopt.opt(algorithm, x.size)
        problem.set_lower_bounds(lower)
        problem.set_upper_bounds(upper)
        problem.set_min_objective(cost)
        problem.set_ftol_abs(_TOLERANCE)
        problem.set_maxeval(evaluations)
        try:
            result = np.clip(problem.optimize(x), lower, upper)
        except nlopt.RoundoffLimited:  # no further progress because of rounding
            return x
        return result if cost(result, result) <= cost(x, x) else x

    equal = np.full(number, 0.5)
    azimuths = [(np.arange(number) + turn / _STARTS) * 2 * np.pi / number for turn in range(_STARTS)]
    steep = [np.stack([np.full(number, limits.max_inclination), azimuth], axis=-1) for azimuth in azimuths]
    starts = [np.clip(np.concatenate([p.ravel(), equal]), lower, upper) for p in (_about_beam(start, limits), *steep)]
    starts[0] = search(nlopt.GN_CRS2_LM, starts[0], _MAX_EVALUATIONS * number)
    starts = [search(nlopt.LN_SBPLX, x, _MAX_EVALUATIONS * number) for x in starts]
    x = min(starts, key=lambda x: cost(x, x))
    # The larger of two variances is not smooth, which slows down the search; it is restarted.
    for algorithm in (nlopt.LN_COBYLA, nlopt.LN_SBPLX) * _RESTARTS:
        x = search(algorithm, x, _MAX_EVALUATIONS * number)
    if cost(x, x) >= _PENALTY:
        raise MethodError(
            f"No face of the gauge has an inclination of {np.degrees(limits.max_inclination):.3g} deg or less to the "
            "beam. Expected a nominal direction that points down to the gauge, and a gauge that can be inclined "
            "towards the beam.",
            code="beam.plan.no_face",
        )
    planes, shares = _planes(x[: 2 * number], limits), x[2 * number :]
    order = np.lexsort((planes[:, 0], planes[:, 1]))
    return with_readings(planes[order], shares[order] / shares.sum(), limits)


def _planes(about_beam: Array, limits: Limits) -> Array:
    """Return planes (k, 2) of the gauge from their inclinations to the beam and azimuths about it, flat (2 k,).

    A plane outside the limits of the gauge is replaced by the nearest one within them, whose inclination is not larger
    for a beam within these limits.
    """
    inclination, azimuth = about_beam.reshape(-1, 2).T
    turned = np.empty((len(azimuth), 2))
    turned[:, 0], turned[:, 1] = np.cos(azimuth), np.sin(azimuth)
    sideways = turned @ _basis(tuple(limits.beam))
    normals = np.sin(inclination)[:, None] * sideways - np.cos(inclination)[:, None] * limits.beam
    planes = np.empty((len(normals), 2))
    planes[:, 0] = np.arccos(np.clip(normals[:, 2], -1.0, 1.0))
    planes[:, 1] = np.mod(np.arctan2(normals[:, 1], normals[:, 0]), 2 * np.pi)
    lower, upper = zip(limits.inclination, limits.rotation, strict=True)
    return np.asarray(np.clip(planes, lower, upper))


def _about_beam(planes: Array, limits: Limits) -> Array:
    """Return the inclinations to the beam and the azimuths about it (k, 2) of planes of the gauge."""
    q = tilts(plane_normals(planes), limits.beam)
    return np.stack([np.arctan(np.hypot(*q.T)), np.arctan2(q[:, 1], q[:, 0])], axis=-1)


def check_numbers(planes: int, limits: Limits) -> None:
    """Check the number of planes and readings.

    Raises
    ------
    MethodError
        Fewer than two planes, or fewer readings than `MIN_READINGS` for each stroke.
    """
    if planes < 2:
        raise MethodError(
            f"Expected two planes or more, to determine both angles of the beam; found {planes}",
            code="beam.plan.planes_too_few",
        )
    if limits.readings < (needed := 3 * MIN_READINGS * planes):
        raise MethodError(
            f"Expected {needed} readings or more for {planes} planes with three strokes each; found {limits.readings}",
            code="beam.plan.readings_too_few",
        )


def with_readings(planes: Array, shares: Array, limits: Limits) -> Design:
    """Return the design with the longest strokes, and the readings rounded to whole numbers."""
    strokes = longest_strokes(plane_normals(planes), limits)
    fractions = (shares[:, None] * shares_of_strokes(strokes, limits)[0]).ravel()
    spare = limits.readings - MIN_READINGS * fractions.size
    wanted = np.maximum(fractions * limits.readings - MIN_READINGS, 0.0)
    wanted *= spare / max(wanted.sum(), _TINY)
    counts = np.floor(wanted).astype(np.int64)
    counts[np.argsort(counts - wanted, kind="stable")[: spare - counts.sum()]] += 1
    return Design(planes, strokes, (counts + MIN_READINGS).reshape(-1, 3))


def equal_strokes(planes: Array, limits: Limits) -> Design:
    """Return planes with strokes of the same length and number of readings, without optimisation."""
    planes = np.asarray(planes, np.float64).reshape(-1, 2)
    check_numbers(len(planes), limits)
    length = longest_strokes(plane_normals(planes), limits).min()
    strokes = np.full((len(planes), 3), length)
    counts = np.full(strokes.size, limits.readings // strokes.size)
    counts[: limits.readings - counts.sum()] += 1
    return Design(planes, strokes, counts.reshape(-1, 3))
