"""Direction of a beam from the gradients of its readings on planes.

With the zero point of the sensor at p0 + s, where s is the stage position, the reading d along the unit vector u of the
beam ends at the plane N . (x - P) = 0: N . (p0 + s + u d - P) = 0. The gradient of the reading is therefore
g = -N / (N . u), and each plane, with any normal, is one condition g . u = -1. With N towards the sensor N . u < 0, so
that N = g / |g|.

Measured gradients g_k have covariances S_k. Over all true gradients gamma_k that meet their condition, the maximum of
the likelihood is at gamma_k = g_k - S_k u c_k / (u . S_k u), with c_k = g_k . u + 1; it remains to minimise

    chi2(u) = sum_k c_k^2 / (u . S_k u)    under |u| = 1,

the exact profile likelihood, without linearisation and without prior knowledge of the planes. The information about u
is sum_k gamma_k gamma_k^T / (u . S_k u), across u; its inverse is both the covariance and the Cramer-Rao bound.

A step by the angle w across u changes each c_k by gamma_k . w + w^2 / 2 to second order, since gamma_k . u = -1. The
ratio of the second part to one standard deviation is the ``curvature``: with two planes it is the standard uncertainty
divided by twice the distance to the mirror plane of the two roots.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.kinematics.beams import across
from errormotion.methods.beam_direction.identification.slopes import gradient_covariance

if TYPE_CHECKING:
    from collections.abc import Sequence


MAX_GRADIENT = 10.0
"""At larger gradients the beam grazes the plane, at less than 6 degrees: 1 um across it is 10 um along the beam."""
MIN_GRADIENT = 0.8
"""-N / (N . u) is 1 or more for any plane; a sensor's inclination error is a few per cent."""
SAME_ANGLE = 0.8
"""Ratio of the angles of two roots to the nominal direction, from which on it does not distinguish them."""
EXCLUDED = 25.0
"""Difference of chi2 from which on a root is excluded by the data (5 standard deviations)."""
_MAX_CURVATURE = 1 / 6
_PARALLEL = 5.0
"""Standard deviations below which an angle between normals is not significant."""


@dataclass(frozen=True)
class Direction:
    """The direction of a beam.

    Attributes
    ----------
    direction : ndarray (3,)
        Unit vector towards the target.
    covariance : ndarray (3, 3)
        Of the direction; rank 2, since its length is 1.
    by_gradient : ndarray (3, k, 3)
        Derivative of the direction by each gradient.
    discrepancy : ndarray (k,)
        g . u + 1 of the measured gradients.
    closure, closure_u : ndarray (k,)
        The same, and its standard deviation by the noise; both 0 for two planes, which meet the condition exactly.
    other_root : ndarray (3,) or None
        Another direction that fits equally well.
    gradients_fitted : ndarray (k, 3)
        Most likely gradients that meet their condition.
    chi2 : float
        Chi-square of the closure of the planes.
    freedom : int
        Of ``chi2``: planes minus 2.
    curvature : float
        Nonlinearity over one standard uncertainty; above 0.05 intervals are approximate.
    """

    direction: Array
    covariance: Array
    by_gradient: Array
    discrepancy: Array
    closure: Array
    closure_u: Array
    other_root: Array | None
    gradients_fitted: Array
    chi2: float
    freedom: int
    curvature: float


def solve(gradients: Array, covariances: Array, nominal: Array, names: Sequence[str] | None = None) -> Direction:
    """Return the most likely direction of a beam from gradients on planes of unknown orientation.

    Parameters
    ----------
    gradients : ndarray (k, 3)
        Of the reading with the stage position, 1; two planes or more.
    covariances : ndarray (k, 3, 3)
        Of each gradient; planes are independent.
    nominal : ndarray (3,)
        Approximate direction, from sensor to target, which selects one of two roots.
    names : sequence of str, optional
        Names of the planes in messages.

    Raises
    ------
    MethodError
        One plane, parallel planes, a plane at grazing incidence, readings and positions in different units, a direction
        opposite to the nominal one, or two roots that cannot be distinguished.
    """
    names = names or [f"Plane {i + 1}" for i in range(len(gradients))]
    nominal = nominal / np.linalg.norm(nominal)
    _check_gradients(gradients, covariances, names)
    roots = sorted(_minima(gradients, covariances, nominal), key=lambda root: -float(root[1] @ nominal))
    chi2, u = roots[0]
    others = [root for root in roots[1:] if root[0] < chi2 + EXCLUDED]
    if u @ nominal < 0:
        raise MethodError(
            f"The direction of the beam {_vector(u)} differs by {_degrees(_angle(u, nominal))} from the nominal "
            f"direction {_vector(nominal)} and has the opposite sign. Check that the nominal direction points from the "
            "sensor to the target, that readings increase with the distance, and whether the stage carries the sensor "
            "or the target (setting moves)."
        )
    other = others[0][1] if others else None
    if other is not None and _angle(u, nominal) > SAME_ANGLE * _angle(other, nominal):
        better = others[0][0] < chi2 - EXCLUDED
        if not better and _angle(u, other) > 1e-6:
            raise MethodError(
                f"Two directions fit the planes: {_vector(u)} and {_vector(other)}, {_degrees(_angle(u, nominal))} and "
                f"{_degrees(_angle(other, nominal))} from the nominal direction, which does not distinguish them. "
                "State a more accurate nominal direction, or measure a third plane that is tilted about another axis."
            )
        if better:
            (chi2, u), other = others[0], None
    fitted, information, sigma2 = _information(gradients, covariances, u)
    basis = across(u)
    reduced = basis @ information @ basis.T
    curvature = np.inf
    if np.linalg.cond(reduced) < 1e14:
        small = np.linalg.inv(reduced)
        curvature = 0.5 * float(np.linalg.eigvalsh(small)[-1]) * float(np.sqrt(np.sum(1 / sigma2)))
    if not curvature < _MAX_CURVATURE:
        raise MethodError(
            f"Within its uncertainty, the beam lies in the plane of the normals of the planes, near {_vector(u)}, "
            "where the two possible directions coincide and are not distinguished. Measure a plane that is tilted "
            "about another axis."
        )
    covariance = basis.T @ small @ basis
    closure = gradients @ u + 1
    left = sigma2 - np.einsum("ki,ij,kj->k", fitted, covariance, fitted)
    exact = left < 1e-6 * sigma2
    return Direction(
        direction=u,
        covariance=covariance,
        by_gradient=-np.einsum("ij,kj,k,l->ikl", covariance, fitted, 1 / sigma2, u),
        discrepancy=closure,
        closure=np.where(exact, 0.0, closure),
        closure_u=np.sqrt(np.where(exact, 0.0, left)),
        other_root=other,
        gradients_fitted=fitted,
        chi2=chi2,
        freedom=len(gradients) - 2,
        curvature=curvature,
    )


def bound(
    stages: Sequence[Array],
    normals: Array,
    u: Array,
    noise: float,
    speckle: float = 0.0,
    speckle_length: float = 0.0,
) -> Array:
    """Return the Cramer-Rao bound (3, 3) of a beam's direction u (3,) with unknown planes.

    Parameters
    ----------
    stages : sequence of ndarray (n, 3)
        Stage positions on each plane, m.
    normals : ndarray (k, 3)
        Unit normals of the planes.
    u : ndarray (3,)
        Direction of the beam.
    noise, speckle, speckle_length : float
        Of the readings, m; see `slopes`.

    Raises
    ------
    MethodError
        Planes that do not determine the direction.
    """
    gradients = -normals / (normals @ u)[:, None]
    S = np.stack([gradient_covariance(stage, noise, speckle, speckle_length) for stage in stages])
    information = np.einsum("ki,kj,k->ij", gradients, gradients, 1 / np.einsum("i,kij,j->k", u, S, u))
    basis = across(u)
    reduced = basis @ information @ basis.T
    if not np.linalg.cond(reduced) < 1e14:
        raise MethodError(
            "The planes do not determine the direction of the beam: all normals and the beam are in one plane."
        )
    return np.asarray(basis.T @ np.linalg.inv(reduced) @ basis)


def _information(gradients: Array, covariances: Array, u: Array) -> tuple[Array, Array, Array]:
    """Return fitted gradients (k, 3), information (3, 3) and variances (k,) of the conditions."""
    Su = covariances @ u
    sigma2 = Su @ u
    fitted = gradients - Su * ((gradients @ u + 1) / sigma2)[:, None]
    return fitted, np.einsum("ki,kj,k->ij", fitted, fitted, 1 / sigma2), sigma2


def _minima(gradients: Array, covariances: Array, nominal: Array) -> list[tuple[float, Array]]:
    """Return the directions of minimum chi2, one or two, each with its chi2."""
    weight = 1 / np.sqrt(np.einsum("i,kij,j->k", nominal, covariances, nominal))
    U, s, V = np.linalg.svd(gradients * weight[:, None], full_matrices=True)
    foot = V[:2].T @ (U.T[:2] @ -weight / s[:2])
    height = np.sqrt(max(1 - float(foot @ foot), 0.0))
    roots: list[tuple[float, Array]] = []
    for sign in (1.0, -1.0):
        start = foot + sign * height * V[2]
        root = _descend(gradients, covariances, start / np.linalg.norm(start))
        if all(_angle(root[1], other) > 1e-7 for _, other in roots):
            roots.append(root)
    return roots


def _descend(gradients: Array, covariances: Array, u: Array) -> tuple[float, Array]:
    """Minimise chi2 by Gauss-Newton on the sphere; steps are halved until chi2 decreases."""

    def misfit(u: Array) -> tuple[Array, Array]:
        Su = covariances @ u
        sigma = np.sqrt(Su @ u)
        r = (gradients @ u + 1) / sigma
        return r, (gradients - Su * (r / sigma)[:, None]) / sigma[:, None]

    r, J = misfit(u)
    for _ in range(100):
        basis = across(u)
        step = np.asarray(np.linalg.lstsq(J @ basis.T, -r, rcond=1e-12)[0], np.float64)
        size = float(np.linalg.norm(step))
        step *= min(1.0, 0.3 / size) if size > 0 else 1.0
        for _ in range(30):
            new_u = u + step @ basis
            new_u /= np.linalg.norm(new_u)
            new_r, new_J = misfit(new_u)
            if new_r @ new_r <= r @ r or size < 1e-12:
                break
            step = step / 2
        else:
            break
        decrease = float(r @ r - new_r @ new_r)
        u, r, J = new_u, new_r, new_J
        if size < 1e-13 or (size < 1e-5 and decrease < 1e-14 * float(r @ r)):
            break
    return float(r @ r), u


def _check_gradients(gradients: Array, covariances: Array, names: Sequence[str]) -> None:
    if len(gradients) < 2:
        raise MethodError(
            f"Expected two or more planes that are not parallel; found {len(gradients)}. One plane determines only the "
            "angle between the beam and its normal."
        )
    size = np.linalg.norm(gradients, axis=1)
    for name, g in zip(names, size, strict=True):
        if g > 50 * MAX_GRADIENT or g < MIN_GRADIENT:
            raise MethodError(
                f"{name}: the gradient of the reading with the stage position is {g:.3g} m/m; expected 1 to 10. Check "
                "that readings and stage positions have the same unit, and that the plane is at rest."
            )
        if g > MAX_GRADIENT:
            raise MethodError(
                f"{name}: grazing incidence at {_degrees(np.arcsin(1 / g))} to the surface; expected at least "
                f"{_degrees(np.arcsin(1 / MAX_GRADIENT))}. Tilt the plane towards the sensor."
            )
    normals = gradients / size[:, None]
    noise = float(np.sqrt(np.max(np.linalg.eigvalsh(covariances)[:, -1] / size**2)))
    spread = np.linalg.svd(normals, compute_uv=False)[1] / np.sqrt(len(normals))
    if spread < max(_PARALLEL * noise, 1e-7):
        axis = normals.mean(axis=0)
        axis /= np.linalg.norm(axis)
        raise MethodError(
            f"The planes are parallel to within {_degrees(spread)}, with a noise of {_degrees(noise)}: they "
            f"determine the angle between the beam and their common normal {_vector(axis)}, but not the rotation of "
            "the beam about it. Expected planes with different normals, such as a sine gauge turned by 90 deg."
        )


def _angle(one: Array, other: Array) -> float:
    return float(np.arctan2(np.linalg.norm(np.cross(one, other)), one @ other))


def _degrees(angle: float) -> str:
    return f"{np.degrees(angle):.3g} deg"


def _vector(v: Array) -> str:
    return "({:.4f}, {:.4f}, {:.4f})".format(*(v + 0.0))
