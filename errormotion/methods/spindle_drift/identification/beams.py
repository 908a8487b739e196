"""Origin and direction of a beam, from readings on a sphere that the machine steps through it.

Two estimators use the same readings. The likelihood fit adjusts five unknowns (origin P, direction u of unit length) to
every reading through the intersection of ray and sphere,

    |P + u d - C| = r  on the near side,   so   dd = -(n . (dP + d du - dC) - dr) / (n . u),

n the outward normal at the point where the beam meets the sphere; it is efficient, and its covariance follows from the
scatter of the readings. The construction of the paper uses only the smallest reading of each profile: the point is then
on a circle of radius r about the centre of the sphere, perpendicular to the scan; the beam is the line nearest to all
circles.
Source: Geiselhart et al. (euspen 2024), section 2.3.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.estimation.robust import scale_about_median
from errormotion.kinematics.beams import across, turned

if TYPE_CHECKING:
    from numpy.typing import NDArray


UNKNOWNS = 5
"""Origin (3) and the two components of the direction across the beam."""
_OUTLIER = 6.0
"""Robust standard deviations from which on a reading is an outlier; outliers are ignored and reported."""
_MIN_USED = 0.7
"""Smallest share of the readings that must not be outliers."""


@dataclass(frozen=True)
class Beam:
    """A detected beam.

    Attributes
    ----------
    origin, direction : ndarray (3,)
        Zero point of the reading, m, and unit vector towards the target.
    covariance : ndarray (6, 6)
        Of (origin, direction), SI; rank 5, since the direction keeps its length.
    noise : float
        Standard deviation of one reading, from the residuals, m.
    residual : ndarray (profile, step)
        Reading minus model, m; NaN where there was no reading.
    left_out : ndarray of int64 (k, 2)
        (profile, step) of outliers.
    """

    origin: Array
    direction: Array
    covariance: Array
    noise: float
    residual: Array
    left_out: NDArray[np.int64]


def sphere_reading(origin: Array, direction: Array, centre: Array, radius: float) -> tuple[Array, Array]:
    """Return the readings (...,), m, of a beam on spheres at ``centre`` (..., 3), NaN for a miss, and their Jacobian.

    The Jacobian (..., 5) is with respect to the origin and to the two rotations of the direction along ``across``.
    """
    w = origin - centre
    b = w @ direction
    below = b * b - np.einsum("...i,...i->...", w, w) + radius * radius
    with np.errstate(invalid="ignore"):
        reading = -b - np.sqrt(below)
    n = (w + reading[..., None] * direction) / radius
    gain = -1.0 / (n @ direction)
    jacobian = np.concatenate([n, (n @ across(direction).T) * reading[..., None]], axis=-1) * gain[..., None]
    return reading, jacobian


def likelihood_fit(
    distance: Array, centre: Array, radius: float, origin: Array, direction: Array, name: str = "beam"
) -> Beam:
    """Fit origin and direction to all readings by least squares on ray and sphere.

    Parameters
    ----------
    distance : ndarray (profile, step)
        Readings, m; NaN where the beam missed.
    centre : ndarray (profile, step, 3)
        Sphere centres, m.
    radius : float
        Sphere radius, m.
    origin, direction : ndarray (3,)
        Start of the fit: the nominal beam.
    name : str
        Name of the beam in messages.

    Raises
    ------
    MethodError
        Too few readings, readings that do not determine the beam, or no convergence.
    """
    used = np.isfinite(distance) & np.isfinite(centre).all(axis=-1)
    if used.sum() <= UNKNOWNS:
        raise MethodError(
            f"Beam {name}: {used.sum()} of {used.size} readings are valid; expected more than {UNKNOWNS}, the number "
            "of "
            "unknowns."
        )
    direction = direction / np.linalg.norm(direction)
    origin, direction = _first_shift(distance, centre, radius, origin, direction, used)
    valid = used.copy()
    while True:
        origin, direction, jacobian = _gauss_newton(distance, centre, radius, origin, direction, used, name)
        residual = distance - sphere_reading(origin, direction, centre, radius)[0]
        spread = scale_about_median(residual[used])
        outlier = used & ~(np.abs(residual) <= max(_OUTLIER * spread, 1e-12))
        if not outlier.any():
            break
        used = used & ~outlier
        if used.sum() < _MIN_USED * valid.sum():
            raise MethodError(
                f"Beam {name}: more than {1 - _MIN_USED:.0%} of the readings do not fit any beam. Check that the "
                "sphere "
                "centres belong to the readings."
            )
    freedom = int(used.sum()) - UNKNOWNS
    noise = float(np.sqrt(np.sum(residual[used] ** 2) / freedom))
    size = np.linalg.norm(jacobian, axis=0)
    if not size.all() or np.linalg.cond(jacobian / size) > 1e6:
        raise MethodError(
            f"Beam {name}: the scans do not determine the beam. Expected profiles at two or more distances, "
            "each along both directions across the beam."
        )
    small = noise**2 * np.linalg.inv(jacobian.T @ jacobian)
    chart = np.zeros((6, UNKNOWNS))
    chart[:3, :3] = np.eye(3)
    chart[3:, 3:] = across(direction).T
    return Beam(origin, direction, chart @ small @ chart.T, noise, residual, np.argwhere(valid & ~used))


def _first_shift(
    distance: Array, centre: Array, radius: float, origin: Array, direction: Array, used: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Shift the nominal beam to the spheres: across by the smallest readings of the profiles, then along."""
    lowest = np.where(used, distance, np.inf).argmin(axis=1)
    seen = used.any(axis=1)
    nearest = centre[seen, lowest[seen]].mean(axis=0)
    offset = nearest - origin
    sideways = offset - direction * (offset @ direction)
    lowest_reading = np.mean(distance[seen, lowest[seen]])
    along = (offset @ direction) - radius - lowest_reading
    return origin + sideways + direction * along, direction


def _gauss_newton(
    distance: Array,
    centre: Array,
    radius: float,
    origin: Array,
    direction: Array,
    used: NDArray[np.bool_],
    name: str,
) -> tuple[Array, Array, Array]:
    for _ in range(50):
        model, jacobian = sphere_reading(origin, direction, centre, radius)
        meets = used & np.isfinite(model)
        if meets.sum() <= UNKNOWNS:
            break
        step, *_ = np.linalg.lstsq(jacobian[meets], (distance - model)[meets])
        origin = origin + step[:3]
        direction = turned(direction, np.asarray(step[3:], np.float64))
        if np.abs(step[:3]).max() < 1e-13 and np.abs(step[3:]).max() < 1e-11:
            model, jacobian = sphere_reading(origin, direction, centre, radius)
            if np.isfinite(model[used]).all():
                return origin, direction, jacobian[used]
            break
    raise MethodError(
        f"Beam {name}: the fit does not converge. Check the nominal origin and direction (m, machine coordinates), the "
        f"sphere radius ({radius * 1e3:g} mm) and that the sphere centres belong to the readings."
    )


def circles_and_line(
    distance: Array, centre: Array, scan: Array, radius: float, direction: Array
) -> tuple[Array, Array]:
    """Return origin and direction (3,) by the construction of the paper.

    Parameters
    ----------
    distance : ndarray (profile, step)
        Readings, m.
    centre : ndarray (profile, step, 3)
        Sphere centres, m.
    scan : ndarray (profile, 3)
        Unit vector of each profile's steps.
    radius : float
        Sphere radius, m.
    direction : ndarray (3,)
        Nominal direction of the beam.
    """
    middles, lowest = [], []
    for readings, centres, v in zip(distance, centre, scan, strict=True):
        good = np.isfinite(readings)
        if good.sum() < 4:
            continue
        s = (centres - centres[0]) @ v
        arc = _arc(s[good], readings[good], radius)
        middles.append((centres[0] + arc[0] * v, v))
        lowest.append(arc[1])
    if len(middles) < 4:
        return np.full(3, np.nan), np.full(3, np.nan)
    C = np.array([middle for middle, _ in middles])
    V = np.array([v for _, v in middles])
    basis = across(direction)
    anchor = C.mean(axis=0)

    def line(p: Array) -> tuple[Array, Array]:
        u = direction + p[2:] @ basis
        return anchor + (p[:2] * radius) @ basis, u / np.linalg.norm(u)

    def crossing(point: Array, u: Array) -> Array:
        """Return the parameter along the line at which its projection to the plane of each circle enters the circle."""
        w = point - C
        w = w - V * np.sum(w * V, axis=1, keepdims=True)
        flat = u - V * (V @ u)[:, None]
        a, b = np.sum(flat**2, axis=1), np.sum(w * flat, axis=1)
        return np.asarray((-b - np.sqrt(np.maximum(b * b - a * (np.sum(w**2, axis=1) - radius**2), 0.0))) / a)

    def gaps(p: Array) -> Array:
        point, u = line(p)
        touched = point + crossing(point, u)[:, None] * u
        return np.asarray(np.sum((touched - C) * V, axis=1) / radius)

    from scipy.optimize import least_squares

    solution = least_squares(gaps, np.zeros(4), method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    point, u = line(solution.x)
    along = crossing(point, u) - np.array(lowest)
    return point + along.mean() * u, u


def _arc(s: Array, readings: Array, radius: float) -> tuple[float, float]:
    """Fit y = y0 + (R - sqrt(R^2 - (s - s0)^2)) with R free; return s0 and y0 of the lowest point."""
    c, b, a = (float(x) for x in np.linalg.lstsq(np.vander(s, 3, increasing=True), readings)[0])
    start = np.array([-b / (2 * a), c - b * b / (4 * a), 1 / (2 * a)])
    unit = np.array([1e-3, 1e-3, radius])

    def misfit(p: Array) -> Array:
        s0, y0, R = p * unit
        return np.asarray((y0 + R - np.sqrt(np.maximum(R * R - (s - s0) ** 2, 0.0)) - readings) * 1e6)

    def slopes(p: Array) -> Array:
        s0, _, R = p * unit
        root = np.sqrt(np.maximum(R * R - (s - s0) ** 2, 1e-12 * R * R))
        return np.stack([(s0 - s) / root, np.ones(len(s)), 1.0 - R / root], axis=1) * (1e6 * unit)

    from scipy.optimize import leastsq

    # The full output has no warning of tolerances that rounding does not allow.
    found = leastsq(misfit, start / unit, Dfun=slopes, full_output=True, ftol=1e-14, xtol=1e-14, gtol=1e-14, maxfev=300)
    s0, y0, _ = found[0] * unit
    return float(s0), float(y0)


def fisher_bound(origin: Array, direction: Array, centre: Array, radius: float, noise: float) -> Array:
    """Return the Cramer-Rao bound (6, 6) of (origin, direction) for readings with white noise (m)."""
    reading, jacobian = sphere_reading(origin, direction, centre, radius)
    rows = jacobian[np.isfinite(reading)]
    chart = np.zeros((6, UNKNOWNS))
    chart[:3, :3] = np.eye(3)
    chart[3:, 3:] = across(direction).T
    return np.asarray(noise**2 * chart @ np.linalg.inv(rows.T @ rows) @ chart.T)
