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
from typing import TYPE_CHECKING, Generic, NamedTuple, TypeVar

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.estimation.blocks import Block, Constant, Noise
from errormotion.estimation.problem import Problem
from errormotion.estimation.sources import Places
from errormotion.kinematics.beams import across
from errormotion.measurement.identification import solve
from errormotion.measurement.observed import Observed

if TYPE_CHECKING:
    from numpy.typing import NDArray


T = TypeVar("T")
UNKNOWNS = 5
"""Origin (3) and the two components of the direction across the beam."""
RADIUS_OF_SPHERE, SCALES = "radius of the sphere", "scales of the positions"
UNIT = 1e-6
"""Noise of which that of the residuals is a multiple, m."""
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
    influence : dict of str to ndarray (6,)
        Effect of one standard uncertainty of each source that all beams have in common; contained in ``covariance``.
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
    influence: dict[str, Array]
    noise: float
    residual: Array
    left_out: NDArray[np.int64]
    notes: tuple[str, ...] = ()


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
    distance: Array,
    centre: Array,
    radius: float,
    origin: Array,
    direction: Array,
    name: str = "beam",
    *,
    radius_uncertainty: float = 0.0,
    scale_uncertainty: float = 0.0,
    middle: Array | None = None,
) -> Beam:
    """Fit origin and direction to all readings by least squares on ray and sphere.

    The noise is that of the residuals. Its correlation from step to step of a profile, such as that of the errors of
    neighbouring positions, is a part of the uncertainty.

    Parameters
    ----------
    distance : ndarray (profile, step)
        Readings, m; NaN where the beam missed.
    centre : ndarray (profile, step, 3)
        Sphere centres, m.
    radius, radius_uncertainty : float
        Sphere radius and its standard uncertainty, m.
    origin, direction : ndarray (3,)
        Start of the fit: the nominal beam.
    name : str
        Name of the beam in messages.
    scale_uncertainty : float
        Relative standard uncertainty of the machine's positions along each axis, about ``middle``.
    middle : ndarray (3,), optional
        m; by default the mean of the centres. A common shift of all beams is that of the frame.

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
            "unknowns.",
            code="readings.too_few",
        )
    direction = direction / np.linalg.norm(direction)
    origin, direction = _first_shift(distance, centre, radius, origin, direction, used)
    about = centre[used].mean(axis=0) if middle is None else middle
    observed = _observed(
        np.where(used, distance, np.nan),
        centre,
        radius,
        origin,
        direction,
        radius_uncertainty,
        scale_uncertainty,
        about,
    )
    try:
        solved = solve(observed)
    except MethodError as error:
        if "do not determine" in str(error):
            raise MethodError(_UNDETERMINED.format(name), code="beam.undetermined") from error
        if "converge" not in str(error):
            raise MethodError(f"Beam {name}: {error}", code=error.code) from error
        raise MethodError(
            f"Beam {name}: the fit does not converge. Check the nominal origin and direction (m, machine coordinates), "
            f"the sphere radius ({radius * 1e3:g} mm) and that the sphere centres belong to the readings.",
            code="beam.not_converged",
        ) from error
    kept = np.isfinite(solved.white.problem.readings).reshape(used.shape)
    if kept.sum() < _MIN_USED * used.sum():
        raise MethodError(
            f"Beam {name}: more than {1 - _MIN_USED:.0%} of the readings do not fit any beam. Check that the sphere "
            "centres belong to the readings.",
            code="beam.readings.differ",
        )
    errors = solved.relative.errors
    found, along = errors.value[0, :3], errors.value[0, 3:]
    reading, jacobian = sphere_reading(found, along, centre, radius)
    J = jacobian[kept & np.isfinite(reading)]
    size = np.linalg.norm(J, axis=0)
    if not size.all() or np.linalg.cond(J / size) > 1e6:
        raise MethodError(_UNDETERMINED.format(name), code="beam.undetermined")
    influence = {source.name: source.effect[0] for source in errors.sources}
    return Beam(
        origin=found,
        direction=along,
        covariance=errors.covariance[0],
        influence=influence,
        noise=UNIT * float(np.sqrt(solved.scatter.factor)),
        residual=distance - reading,
        left_out=np.argwhere(used & ~kept),
        notes=tuple(note for note in solved.observed.notes if "correlated" in note),
    )


_UNDETERMINED = (
    "Beam {}: the scans do not determine the beam. Expected profiles at two or more distances, each along both "
    "directions across the beam."
)


class Unknowns(NamedTuple, Generic[T]):
    """Shift of the origin and two angles of the direction, from their start."""

    beam: T


class Known(NamedTuple, Generic[T]):
    """Radius of the sphere, and the relative errors of the scales of the positions along X, Y and Z."""

    radius: T
    scale: T


def _observed(
    distance: Array,
    centre: Array,
    radius: float,
    origin: Array,
    direction: Array,
    radius_uncertainty: float,
    scale_uncertainty: float,
    middle: Array,
) -> Observed:
    """Return the readings of one beam as a model."""
    profiles, steps = distance.shape
    series, order = np.indices((profiles, steps)).reshape(2, -1)
    one, basis = np.zeros(distance.size, dtype=np.intp), across(direction)
    position = np.nan_to_num(centre.reshape(-1, 3))

    def beam(x: Array) -> tuple[Array, Array]:
        u = direction + x[:, 3:] @ basis
        return origin + x[:, :3], u / np.linalg.norm(u, axis=1, keepdims=True)

    def equation(y: Array, x: Unknowns[Array], c: Known[Array]) -> Array:
        start, u = beam(x.beam)
        w = start - middle - (position - middle) * (1 + c.scale)
        along = np.sum(w * u, axis=1)
        with np.errstate(invalid="ignore"):
            return np.asarray(y + along + np.sqrt(along**2 - np.sum(w * w, axis=1) + c.radius[:, 0] ** 2))

    def derivatives(_: Array, x: Unknowns[Array], c: Known[Array]) -> dict[str, Array]:
        """``dd = -(n . (dP + d du)) / (n . u)`` with ``du = (E - (E . u) u) / |v|``."""
        v = direction + x.beam[:, 3:] @ basis
        start, u = beam(x.beam)
        w = start - middle - (position - middle) * (1 + c.scale)
        reading = -equation(np.zeros(len(w)), x, c)
        n = w + reading[:, None] * u
        across_u = n @ basis.T - np.sum(n * u, axis=1, keepdims=True) * (u @ basis.T)
        angles = across_u * (reading / np.linalg.norm(v, axis=1))[:, None]
        return {"beam": (np.concatenate([n, angles], axis=1) / np.sum(n * u, axis=1, keepdims=True))[:, None]}

    return Observed(
        problem=Problem(
            equation=equation,
            derivatives=derivatives,
            readings=distance.ravel(),
            unknowns=Unknowns(
                beam=Block(start=np.zeros((1, UNKNOWNS)), index=one, scale=np.array([radius, radius, radius, 1.0, 1.0]))
            ),
            constants=Known(
                radius=Constant(
                    value=np.full((1, 1), radius),
                    factor=np.full((1, 1, int(radius_uncertainty > 0)), radius_uncertainty),
                    index=one,
                    scale=radius,
                    group=RADIUS_OF_SPHERE,
                ),
                scale=Constant(
                    value=np.zeros((1, 3)),
                    factor=scale_uncertainty * np.eye(3)[None, :, : 3 * int(scale_uncertainty > 0)],
                    index=one,
                    scale=1e-3,
                    group=SCALES,
                    names=[f"scale of the positions {axis}" for axis in "XYZ"] if scale_uncertainty > 0 else (),
                ),
            ),
            noise=Noise(sd=np.full(distance.size, UNIT), stated=False),
        ),
        places=Places(lambda x, _: np.concatenate(beam(x.beam), axis=1), 1),
        dims=("beam",),
        coords={"beam": ["beam"]},
        component="beam",
        functional_point=(0.0, 0.0, 0.0),
        reference="",
        order=order.astype(float),
        series=series,
    )


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
    solution = leastsq(
        misfit, start / unit, Dfun=slopes, full_output=True, ftol=1e-14, xtol=1e-14, gtol=1e-14, maxfev=300
    )
    s0, y0, _ = solution[0] * unit
    return float(s0), float(y0)


def fisher_bound(origin: Array, direction: Array, centre: Array, radius: float, noise: float) -> Array:
    """Return the Cramer-Rao bound (6, 6) of (origin, direction) for readings with white noise (m)."""
    reading, jacobian = sphere_reading(origin, direction, centre, radius)
    rows = jacobian[np.isfinite(reading)]
    chart = np.zeros((6, UNKNOWNS))
    chart[:3, :3] = np.eye(3)
    chart[3:, 3:] = across(direction).T
    return np.asarray(noise**2 * chart @ np.linalg.inv(rows.T @ rows) @ chart.T)
