"""Directions of beams: their deviation from nominal, and the inclination of a surface to them.

A beam starts at its zero point, where the reading is 0; its direction is the unit vector u to the target. A surface
with unit normal N (towards the sensor, N.u < 0) is inclined to it by alpha, the angle between -u and N. The azimuth of
this tilt about the beam, measured from the plane of triangulation (emitted and received beam), is the rotation beta.
Both together form the tilt vector

    q = tan(alpha) (cos beta, sin beta) = (N.e1, N.e2) / (-N.u),    e1 = t x u / |t x u|,   e2 = u x e1,

with t the normal of the plane of triangulation, on the side from which, looking along the beam with t upwards, the
receiver is to the right of the laser: t = r x u, with r the direction from the laser to the receiver, and e1 = -r. At
rotation 0 the normal of the surface leans away from the receiver, at 180 deg towards it, and at 90 deg along t. The
opposite normal makes q its negative, and k another one.

q has no pole where the beam is perpendicular to the surface. The published deflection of a sensor is not a third
freedom: u, t and N determine alpha and beta in any orientation.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.kinematics.twists import cross_matrix

__all__ = [
    "across",
    "beam_errors",
    "error_jacobian",
    "inclination_rotation",
    "rotation_between",
    "tilt",
    "tilt_vector",
    "turned",
]


_AXES = np.eye(3).tolist()
_PARALLEL_COSINE = np.cos(np.radians(1e-4))
"""Cosine of the angle above which a direction is parallel to an axis."""
_PARALLEL_SINE = 1e-6
"""Sine of the angle below which a triangulation normal is parallel to the beam."""


def across(direction: Array) -> Array:
    """Return two unit vectors (2, 3) that span the plane perpendicular to a direction (3,)."""
    u = direction.tolist()
    size = [abs(each) for each in u]
    first = np.array(_product(u, _AXES[size.index(min(size))]))
    first /= np.linalg.norm(first)
    return np.array([first, _product(u, first.tolist())])


def _product(a: list[float], b: list[float]) -> tuple[float, float, float]:
    """Return the vector product of two lists; faster than with arrays."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def turned(direction: Array, angles: Array) -> Array:
    """Return the unit vector (3,) at two small angles (2,), rad, to ``direction`` along the vectors of ``across``."""
    vector = direction + angles @ across(direction)
    return np.asarray(vector / np.linalg.norm(vector))


def rotation_between(nominal: ArrayLike, actual: ArrayLike) -> Array:
    """Return the smallest rotation (..., 3), rad, as a vector, that rotates one unit vector (..., 3) into the other.

    For opposite vectors the axis is not unique, and the result is NaN.
    """
    u0, u = np.asarray(nominal, float), np.asarray(actual, float)
    sine = np.cross(u0, u)
    size, cosine = np.linalg.norm(sine, axis=-1), np.sum(u0 * u, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        stretch = np.where(size > 0, np.arctan2(size, cosine) / size, np.where(cosine > 0, 1.0, np.nan))
    return np.asarray(sine * stretch[..., None])


def beam_errors(
    nominal_origin: ArrayLike,
    nominal_direction: ArrayLike,
    origin: ArrayLike,
    direction: ArrayLike,
    covariance: ArrayLike,
) -> tuple[Array, Array]:
    """Return the errors of beams relative to their nominal ones, and the covariance of these errors.

    EX EY EZ is the shift of the zero point, EA EB EC the smallest rotation from the nominal direction to the actual
    one, about the zero point of the beam. The rotation of a beam about itself is unknown: NaN where the nominal beam is
    parallel to an axis; elsewhere the smallest rotation is stated.

    Parameters
    ----------
    nominal_origin, nominal_direction, origin, direction : array_like (beam, 3)
        m and unit vectors; NaN in an origin that is not known.
    covariance : array_like (beam, 6, 6)
        Of (origin, direction), SI.

    Returns
    -------
    errors : ndarray (beam, 6)
        m and rad.
    covariance : ndarray (beam, 6, 6)

    Raises
    ------
    MethodError
        A beam that points away from its nominal direction.
    """
    p0, u0, p, u = (np.asarray(part, float) for part in (nominal_origin, nominal_direction, origin, direction))
    cosine = np.sum(u0 * u, axis=-1)
    if (cosine <= 0).any():
        raise MethodError(
            "A detected beam points away from its nominal direction: check the nominal directions.",
            code="beam.direction.opposite",
        )
    errors = np.concatenate([p - p0, rotation_between(u0, u)], axis=-1)
    chart = error_jacobian(u0, u)
    moved = chart @ np.nan_to_num(np.asarray(covariance, float)) @ np.swapaxes(chart, -1, -2)
    along = np.abs(u0) >= _PARALLEL_COSINE
    errors[:, 3:][along] = np.nan
    unseen = np.isnan(errors)
    return errors, np.where(unseen[:, :, None] | unseen[:, None, :], np.nan, moved)


def error_jacobian(nominal_direction: ArrayLike, direction: ArrayLike) -> Array:
    """Return the derivative (beam, 6, 6) of `beam_errors` with respect to (origin, direction)."""
    u0, u = np.asarray(nominal_direction, float), np.asarray(direction, float)
    chart = np.zeros((len(u), 6, 6))
    chart[:, :3, :3] = np.eye(3)
    chart[:, 3:, 3:] = _turning_by_direction(u0, u)
    return chart


def _turning_by_direction(u0: Array, u: Array) -> Array:
    """Return the derivative (..., 3, 3) of `rotation_between` with respect to the actual direction."""
    sine = np.cross(u0, u)
    size, cosine = np.linalg.norm(sine, axis=-1), np.sum(u0 * u, axis=-1)
    angle = np.arctan2(size, cosine)
    small = angle < 1e-3
    s = np.where(small, 1.0, size)
    stretch = np.where(small, 1 + angle**2 / 6, angle / s)
    # d(angle / sin angle) / d(cos angle)
    change = np.where(small, -1 / 3, -(s - angle * cosine) / s**3)
    return np.asarray(
        stretch[..., None, None] * cross_matrix(u0) + change[..., None, None] * sine[..., :, None] * u0[..., None, :]
    )


def tilt(beam: ArrayLike, triangulation_normal: ArrayLike, normal: ArrayLike) -> Array:
    """Return the inclination of surfaces to a beam, as tilt vectors.

    Parameters
    ----------
    beam : array_like (3,)
        Unit vector from the sensor to the target.
    triangulation_normal : array_like (3,)
        Unit normal of the plane of emitted and received beam, with the receiver to the right of the laser for an
        observer who looks along the beam and has this normal upwards; its component along the beam has no effect.
    normal : array_like (..., 3)
        Unit normals of the surfaces, towards the sensor.

    Returns
    -------
    ndarray (..., 2)
        q = tan(alpha) (cos beta, sin beta); NaN where the beam does not hit the outside of the surface.

    Raises
    ------
    MethodError
        The triangulation normal lies along the beam.
    """
    u, t, N = (np.asarray(part, float) for part in (beam, triangulation_normal, normal))
    first = np.cross(t, u)
    size = np.linalg.norm(first)
    if not size > _PARALLEL_SINE:
        raise MethodError(
            "The triangulation normal lies along the beam; expected the normal of the plane of the emitted and the "
            "received beam, which is perpendicular to the beam.",
            code="beam.normal.along_beam",
        )
    e1 = first / size
    e2 = np.cross(u, e1)
    facing = -(N @ u)
    with np.errstate(invalid="ignore", divide="ignore"):
        q = np.stack([N @ e1, N @ e2], axis=-1) / facing[..., None]
    return np.where((facing > 0)[..., None], q, np.nan)


def inclination_rotation(q: ArrayLike) -> tuple[Array, Array]:
    """Return inclination in [0, pi/2) and rotation in [0, 2 pi), rad, of tilt vectors (..., 2).

    The rotation is 0 where the beam is perpendicular to the surface.
    """
    q = np.asarray(q, float)
    alpha = np.arctan(np.hypot(q[..., 0], q[..., 1]))
    beta = np.mod(np.arctan2(q[..., 1], q[..., 0]), 2 * np.pi)
    return alpha, np.where(beta >= 2 * np.pi, 0.0, beta)


def tilt_vector(inclination: ArrayLike, rotation: ArrayLike) -> Array:
    """Return tilt vectors (..., 2) of inclinations and rotations, rad.

    A negative inclination is the same tilt at a rotation that is 180 deg larger.
    """
    alpha, beta = np.asarray(inclination, float), np.asarray(rotation, float)
    return np.asarray(np.tan(alpha)[..., None] * np.stack(np.broadcast_arrays(np.cos(beta), np.sin(beta)), axis=-1))
