"""Propagation of noise, known points and shared sources to the beam, through the iteration of the compensation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import gammaincinv

from errormotion.arrays import Array
from errormotion.methods.beam_direction.identification.compensation import Planes, uncompensated
from errormotion.methods.beam_direction.identification.origin import locate
from errormotion.methods.beam_direction.identification.slopes import expected_covariance

if TYPE_CHECKING:
    from collections.abc import Sequence

    from errormotion.methods.beam_direction.identification.compensation import Converged
    from errormotion.methods.beam_direction.identification.origin import Origin


FALSE_ALARM = 1e-3
"""Probability that correct data are reported as noisier than stated, correlated, or not closing."""


@dataclass(frozen=True)
class Propagated:
    """Uncertainty of a beam.

    Attributes
    ----------
    covariance : ndarray (6, 6)
        Of (origin, direction) from the noise and the known point of each plane; SI. NaN without an origin.
    influence : ndarray (source, 6)
        Effect on (origin, direction) of one standard uncertainty of each shared source.
    closure : ndarray (k,)
        g . u + 1 by plane.
    closure_covariance : ndarray (k, k)
        Covariance of ``closure``, sources included; rank k - 2, so 0 for two planes.
    """

    covariance: Array
    influence: Array
    closure: Array
    closure_covariance: Array


def propagate(converged: Converged, origin: Origin | None, point_uncertainty: float) -> Propagated:
    """Propagate every uncertainty to the beam, to first order.

    Parameters
    ----------
    converged : Converged
        Direction and compensation.
    origin : Origin, optional
        Zero point, if it is known.
    point_uncertainty : float
        Standard uncertainty of the known points along the normals, m.
    """
    direction, planes = converged.direction, converged.planes
    k = len(planes.offsets)
    # Derivative of (gradient, offset) of a plane by its slope.
    by_slope = (
        -np.column_stack([planes.gradients, planes.offsets - converged.mid_range]) / (1 + converged.slope)[:, None]
    )
    by_reading = np.zeros((6, k, 4))
    by_reading[3:, :, :3] = direction.by_gradient
    by_reading[:3] = origin.by_reading if origin is not None else np.nan
    H = converged.slope_by_direction
    M = np.einsum("ikl,kl->ik", by_reading[3:], by_slope)
    direct = np.linalg.solve(np.eye(3) - M @ H, by_reading[3:].reshape(3, -1)).reshape(3, k, 4)
    # A rotation of the beam changes the slopes, and with them gradients and offsets.
    T = by_reading + np.einsum("ikl,kl,kj,jmn->imn", by_reading, by_slope, H, direct)
    covariance = np.einsum("ikl,klm,jkm->ij", T, planes.covariances, T)
    if origin is not None:
        covariance[:3, :3] += point_uncertainty**2 * origin.by_point @ origin.by_point.T
    influence = np.einsum("ikl,kl,sk->si", T, by_slope, converged.slope_by_source)

    u, fitted = direction.direction, direction.gradients_fitted
    sigma2 = np.einsum("i,kij,j->k", u, planes.covariances[:, :3, :3], u)
    slopes = converged.slope_by_source + influence[:, 3:] @ H.T
    closes = slopes * (by_slope[:, :3] @ u) + influence[:, 3:] @ fitted.T
    closing = np.diag(sigma2) - fitted @ direction.covariance @ fitted.T + closes.T @ closes
    if k == 2:  # conditions met exactly, except for rounding
        return Propagated(covariance, influence, np.zeros(2), np.zeros((2, 2)))
    return Propagated(covariance, influence, direction.discrepancy, closing)


def closure_chi2(propagated: Propagated) -> float:
    """Return chi-square of the closure, with as many degrees of freedom as planes less 2."""
    k = len(propagated.closure)
    size = np.sqrt(np.diag(propagated.closure_covariance))
    if k < 3:
        return 0.0
    C = propagated.closure_covariance / np.outer(size, size)
    values, vectors = np.linalg.eigh(C)
    z = vectors[:, 2:].T @ (propagated.closure / size)
    return float(np.sum(z**2 / values[2:]))


def chi2_quantile(p: float, degrees: int) -> float:
    """Return the quantile of a chi-square distribution."""
    return 2.0 * float(gammaincinv(degrees / 2, p))


def expected_beam(
    stages: Sequence[Array],
    normals: Array,
    direction: Array,
    noise: float,
    speckle: float = 0.0,
    speckle_length: float = 0.0,
    *,
    origin: Array | None = None,
    points: Array | None = None,
    point_uncertainty: float = 0.0,
    slope_by_source: Array | None = None,
) -> Propagated:
    """Return the expected uncertainty of a beam from readings on planes.

    Parameters
    ----------
    stages : sequence of ndarray (n, 3)
        Stage positions on each plane, m.
    normals : ndarray (k, 3)
        Unit normals of the planes.
    direction : ndarray (3,)
        Of the beam.
    noise, speckle, speckle_length : float
        Of the readings, m; see `slopes`.
    origin : ndarray (3,), optional
        Zero point of the beam, m.
    points : ndarray (k, 3), optional
        Known points of the planes, m.
    point_uncertainty : float
        Standard uncertainty of these points along the normals, m.
    slope_by_source : ndarray (source, k), optional
        Relative change of each plane's slope, about the reading 0, with one standard uncertainty of each shared source.

    Returns
    -------
    Propagated
        NaN for the origin if ``origin`` or ``points`` is not given, or the planes do not determine it.

    Raises
    ------
    MethodError
        Planes that do not determine the direction.
    """
    k = len(normals)
    gradients = -normals / (normals @ direction)[:, None]
    p0 = np.zeros(3) if origin is None else origin
    P = np.full((k, 3), np.nan) if points is None or origin is None else points
    offsets = np.nan_to_num(np.sum(gradients * (p0 - P), axis=1))
    C = np.stack([expected_covariance(stage, noise, speckle, speckle_length) for stage in stages])
    names = tuple(f"Plane {i + 1}" for i in range(k))
    converged = uncompensated(Planes(names, gradients, offsets, C), direction)
    located = locate(converged.direction, offsets, C, P, point_uncertainty)
    if slope_by_source is not None:
        converged = replace(converged, slope_by_source=slope_by_source)
    return propagate(converged, located, point_uncertainty)
