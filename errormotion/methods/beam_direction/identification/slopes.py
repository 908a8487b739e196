"""Gradient of the reading with the stage position on each plane.

On a plane the reading is d = offset + g . s, with the stage position s. Readings contain white noise and, along a
stroke, speckle: errors whose correlation decreases with the distance of the positions,
speckle^2 exp(-|s_i - s_j| / length). Gradient and offset are estimated by generalised least squares, which is maximum
likelihood for this model. Outliers are detected by a fit of least absolute deviations; they are ignored and reported.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.estimation.robust import scale_about_median

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Mask = NDArray[np.bool_]

UNKNOWNS = 4
"""Gradient (3) and offset."""
OUTLIER = 6.0
"""Robust standard deviations from which on a reading is an outlier."""
MIN_USED = 0.7
"""Smallest share of readings that fit the plane."""
MAX_GRADIENT_U = 0.03
"""Largest standard uncertainty of the gradient along a measured direction."""
_MIN_FOR_OUTLIERS = 2 * UNKNOWNS
MAX_CORRELATED = 4000
"""Largest number of readings of a plane with speckle."""


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
        Too few readings, a stage that does not move along three independent directions, or readings off a plane.
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
    total, measured = float(np.hypot(noise, speckle)), used
    detect = robust and valid >= _MIN_FOR_OUTLIERS
    if detect:
        used = measured & ~_outliers(distance - design @ _least_deviations(design[used], distance[used]), used, total)
    for _ in range(10):
        solution, covariance, whitened = _generalised(
            design[used], distance[used], stage[used], noise, speckle, speckle_length, name
        )
        residual = distance - design @ solution
        kept = measured & ~_outliers(residual, used, total) if detect else used
        if (kept == used).all():
            break
        used = kept
    else:  # readings at the limit are left out and back by turns: the last choice counts
        solution, covariance, whitened = _generalised(
            design[used], distance[used], stage[used], noise, speckle, speckle_length, name
        )
        residual = distance - design @ solution
    if used.sum() < max(MIN_USED * valid, UNKNOWNS):
        raise MethodError(
            f"{name}: {valid - used.sum()} of {valid} readings do not fit a plane. Check that positions and readings "
            "correspond, and that all readings are on one plane."
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
        left_out=measured & ~used,
    )


def expected_covariance(stage: Array, noise: float, speckle: float = 0.0, speckle_length: float = 0.0) -> Array:
    """Return the expected covariance (4, 4) of gradient and offset of readings at positions (n, 3), m."""
    centre = stage.mean(axis=0)
    design = np.column_stack([stage - centre, np.ones(len(stage))])
    covariance = _generalised(design, np.zeros(len(stage)), stage, noise, speckle, speckle_length, "The plane")[1]
    return _about_zero(covariance, centre)


def gradient_covariance(stage: Array, noise: float, speckle: float = 0.0, speckle_length: float = 0.0) -> Array:
    """Return the expected covariance (3, 3) of the gradient of readings at positions (n, 3), m."""
    return expected_covariance(stage, noise, speckle, speckle_length)[:3, :3]


def _about_zero(covariance: Array, centre: Array) -> Array:
    """Return the covariance (4, 4) of (gradient, reading at position 0) from that with the reading at ``centre``."""
    to_zero = np.eye(UNKNOWNS)
    to_zero[3, :3] = -centre
    return np.asarray(to_zero @ covariance @ to_zero.T)


def correlation_factor(stage: Array, noise: float, speckle: float, speckle_length: float) -> Array:
    """Return the lower triangular factor (n, n) of the covariance of readings at positions (n, 3); m."""
    separation = np.linalg.norm(stage[:, None] - stage[None], axis=2)
    C = speckle**2 * (np.exp(-separation / speckle_length) if speckle_length > 0 else np.eye(len(stage)))
    C[np.diag_indices_from(C)] += noise**2
    return np.asarray(cholesky(C, lower=True))


def _generalised(
    design: Array, distance: Array, stage: Array, noise: float, speckle: float, speckle_length: float, name: str
) -> tuple[Array, Array, Array]:
    """Return solution (4,), covariance (4, 4) and whitened residuals (n,)."""
    if speckle > 0 and speckle_length > 0:
        if len(stage) > MAX_CORRELATED:
            raise MethodError(
                f"{name}: {len(stage)} readings with speckle; expected at most {MAX_CORRELATED}. Use fewer readings: "
                f"those closer than the correlation length ({speckle_length * 1e6:g} um) add little information."
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
    """Return the solution (4,) of approximately least absolute deviations, by iteratively reweighted least squares."""
    weight, middle = np.ones(distance.size), [(distance.size - 1) // 2, distance.size // 2]
    for _ in range(30):
        solution = np.linalg.lstsq(design * weight[:, None], distance * weight)[0]
        residual = np.abs(distance - design @ solution)
        median = np.partition(residual, middle)[middle].mean()  # much faster than np.median
        weight = 1 / np.sqrt(np.maximum(residual, 1e-3 * median + 1e-15))
    return np.asarray(solution)


def _outliers(residual: Array, used: Mask, total: float) -> Mask:
    """Return the outliers with respect to the stated noise and to the observed scatter."""
    return np.asarray(np.abs(residual) > OUTLIER * max(scale_about_median(residual[used]), total))


def _check_strokes(design: Array, total: float, name: str) -> None:
    """Raise MethodError for positions that do not spread along three directions, which the gradient requires."""
    values, vectors = np.linalg.eigh(design[:, :3].T @ design[:, :3])
    least = max((total / MAX_GRADIENT_U) ** 2, 1e-14 * float(values[2]))
    missing = vectors.T[values <= least]
    if not len(missing):
        return
    missing = missing * np.sign(missing[np.arange(len(missing)), np.argmax(np.abs(missing), axis=1)])[:, None]
    spread = float(np.sqrt(max(values[0], 0.0) / len(design)))
    along = ", ".join("({:.2f}, {:.2f}, {:.2f})".format(*(np.round(v, 2) + 0.0)) for v in missing)
    raise MethodError(
        f"{name}: the stage moves along {3 - len(missing)} of three independent directions; along {along} the spread "
        f"(rms) of its positions is {spread * 1e6:.3g} um. Expected strokes along three directions, such as X, Y and "
        f"Z, with a spread of more than {np.sqrt(least / len(design)) * 1e6:.2g} um, to determine the gradient."
    )
