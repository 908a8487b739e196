"""Change of the reading with the stage position on each plane.

On a plane the reading is d = offset + g . s, s the stage position. Readings carry white noise and, along a stroke,
speckle: errors whose correlation falls off with the distance of the positions, speckle^2 exp(-|s_i - s_j| / length).
Gradient and offset are estimated by generalised least squares, which is maximum likelihood for this model. Readings
that do not fit a plane are found by a fit of least absolute deviations; they are ignored and reported.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from errormotion.arrays import NORMAL_MAD, Array
from errormotion.errors import MethodError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Mask = NDArray[np.bool_]

UNKNOWNS = 4
"""Gradient (3) and offset."""
OUTLIER = 6.0
"""Robust standard deviations from which on a reading is an outlier."""
LEAST_USED = 0.7
"""Smallest share of the readings that must be on a plane."""
WEAKEST = 0.03
"""Largest standard uncertainty of the gradient along a measured direction."""
_LEAST_FOR_SCATTER = 2 * UNKNOWNS
_MOST_CORRELATED = 4000


@dataclass(frozen=True)
class PlaneFit:
    """Fit of one plane.

    Attributes
    ----------
    gradient : ndarray (3,)
        Change of the reading with the stage position, 1.
    offset : float
        Reading at the stage position 0, m.
    covariance : ndarray (4, 4)
        Of (gradient, offset), SI, by the stated noise and speckle.
    residual : ndarray (n,)
        Reading minus plane, m; NaN where missing.
    whitened : ndarray (n,)
        Decorrelated residuals of the readings used, divided by their standard deviation, in the order of the readings;
        NaN elsewhere.
    left_out : ndarray of bool (n,)
        Outliers.
    """

    gradient: Array
    offset: float
    covariance: Array
    residual: Array
    whitened: Array
    left_out: Mask


def fit_plane_readings(
    distance: Array,
    stage: Array,
    noise: float,
    speckle: float = 0.0,
    speckle_length: float = 0.0,
    robust: bool = True,
    name: str = "The plane",
) -> PlaneFit:
    """Fit gradient and offset to the readings on one plane.

    Parameters
    ----------
    distance : ndarray (n,)
        Readings, m; NaN where missing.
    stage : ndarray (n, 3)
        Stage positions, m. Strokes along three independent directions, in any order.
    noise : float
        Standard deviation of the white noise of one reading, m; above 0.
    speckle, speckle_length : float
        Standard deviation and correlation length of the correlated error, m.
    robust : bool
        Ignore outliers.
    name : str
        Name of the plane in messages.

    Raises
    ------
    MethodError
        Too few readings, a stage that does not move along three independent directions, or readings on no plane.
    """
    used = np.isfinite(distance) & np.isfinite(stage).all(axis=1)
    valid = int(used.sum())
    if valid < UNKNOWNS:
        raise MethodError(
            f"{name}: {valid} of {distance.size} readings are valid; expected at least {UNKNOWNS}, on strokes along "
            "three independent directions."
        )
    centre = stage[used].mean(axis=0)
    design = np.column_stack([stage - centre, np.ones(distance.size)])
    _check_strokes(design[used], np.hypot(noise, speckle), name)
    total, everything = float(np.hypot(noise, speckle)), used
    look = robust and valid >= _LEAST_FOR_SCATTER
    if look:
        used = everything & ~_far_off(distance - design @ _least_deviations(design[used], distance[used]), used, total)
    for _ in range(10):
        solution, covariance, whitened = _generalised(design[used], distance[used], stage[used], noise, speckle,
                                                      speckle_length, name)  # fmt: skip
        residual = distance - design @ solution
        kept = everything & ~_far_off(residual, used, total) if look else used
        if (kept == used).all():
            break
        used = kept
    if used.sum() < max(LEAST_USED * valid, UNKNOWNS):
        raise MethodError(
            f"{name}: {valid - used.sum()} of {valid} readings do not fit any plane. Check that positions and readings "
            "belong together and that all of them are on one plane."
        )
    _check_strokes(design[used], total, name)
    padded = np.full(distance.size, np.nan)
    padded[used] = whitened
    return PlaneFit(
        gradient=solution[:3],
        offset=float(solution[3] - solution[:3] @ centre),
        covariance=_about_zero(covariance, centre),
        residual=residual,
        whitened=padded,
        left_out=everything & ~used,
    )


def expected_covariance(stage: Array, noise: float, speckle: float = 0.0, speckle_length: float = 0.0) -> Array:
    """Return the covariance (4, 4) that gradient and offset of readings at positions (n, 3), m, will have."""
    centre = stage.mean(axis=0)
    design = np.column_stack([stage - centre, np.ones(len(stage))])
    nothing = np.zeros(len(stage))
    covariance = _generalised(design, nothing, stage, noise, speckle, speckle_length, "The plane")[1]
    return _about_zero(covariance, centre)


def gradient_covariance(stage: Array, noise: float, speckle: float = 0.0, speckle_length: float = 0.0) -> Array:
    """Return the covariance (3, 3) that the gradient of readings at positions (n, 3), m, will have."""
    return expected_covariance(stage, noise, speckle, speckle_length)[:3, :3]


def _about_zero(covariance: Array, centre: Array) -> Array:
    """Return the covariance (4, 4) of (gradient, reading at position 0) from that with the reading at ``centre``."""
    to_zero = np.eye(UNKNOWNS)
    to_zero[3, :3] = -centre
    return np.asarray(to_zero @ covariance @ to_zero.T)


def correlation_factor(stage: Array, noise: float, speckle: float, speckle_length: float) -> Array:
    """Return the lower triangular factor (n, n) of the covariance of readings at positions (n, 3); m."""
    apart = np.linalg.norm(stage[:, None] - stage[None], axis=2)
    C = speckle**2 * (np.exp(-apart / speckle_length) if speckle_length > 0 else np.eye(len(stage)))
    C[np.diag_indices_from(C)] += noise**2
    return np.asarray(cholesky(C, lower=True))


def _generalised(
    design: Array, distance: Array, stage: Array, noise: float, speckle: float, speckle_length: float, name: str
) -> tuple[Array, Array, Array]:
    """Return solution (4,), covariance (4, 4) and whitened residuals (n,)."""
    if speckle > 0 and speckle_length > 0:
        if len(stage) > _MOST_CORRELATED:
            raise MethodError(
                f"{name}: {len(stage)} readings with speckle; expected at most {_MOST_CORRELATED}. Use fewer: "
                f"readings closer than the correlation length ({speckle_length * 1e6:g} um) add little information."
            )
        L = correlation_factor(stage, noise, speckle, speckle_length)
        A, b = (solve_triangular(L, part, lower=True) for part in (design, distance))
    else:
        scale = np.hypot(noise, speckle)
        A, b = design / scale, distance / scale
    size = np.linalg.norm(A, axis=0)
    Q, R = np.linalg.qr(A / size)
    inverse = np.linalg.inv(R) / size[:, None]
    solution = inverse @ (Q.T @ b)
    return solution, inverse @ inverse.T, b - A @ solution


def _least_deviations(design: Array, distance: Array) -> Array:
    """Return the solution (4,) of approximately least absolute deviations, by weights from the previous residuals."""
    weight = np.ones(distance.size)
    for _ in range(30):
        solution = np.linalg.lstsq(design * weight[:, None], distance * weight)[0]
        residual = np.abs(distance - design @ solution)
        weight = 1 / np.sqrt(np.maximum(residual, 1e-3 * np.median(residual) + 1e-15))
    return np.asarray(solution)


def _far_off(residual: Array, used: Mask, total: float) -> Mask:
    """Return the outliers with respect to the stated noise and to the observed scatter."""
    scatter = NORMAL_MAD * np.median(np.abs(residual[used] - np.median(residual[used])))
    return np.asarray(np.abs(residual) > OUTLIER * max(float(scatter), total))


def _check_strokes(design: Array, total: float, name: str) -> None:
    """Refuse positions that do not spread along three directions, which would not determine the gradient."""
    values, vectors = np.linalg.eigh(design[:, :3].T @ design[:, :3])
    least = max((total / WEAKEST) ** 2, 1e-14 * float(values[2]))
    open_ = vectors.T[values <= least]
    if not len(open_):
        return
    open_ = open_ * np.sign(open_[np.arange(len(open_)), np.argmax(np.abs(open_), axis=1)])[:, None]
    spread = float(np.sqrt(max(values[0], 0.0) / len(design)))
    along = ", ".join("({:.2f}, {:.2f}, {:.2f})".format(*(np.round(v, 2) + 0.0)) for v in open_)
    raise MethodError(
        f"{name}: the stage moves along {3 - len(open_)} of three independent directions; along {along} its positions "
        f"spread by {spread * 1e6:.3g} um. Expected strokes along three directions, such as X, Y and Z, that spread by "
        f"more than {np.sqrt(least / len(design)) * 1e6:.2g} um, which determine the gradient."
    )
