"""Variation of the readings of one freedom: scatter from reading to reading, and drift from run to run.

Model of a reading of approach a, run j, target i, with the position scaled to z = -1 ... 1::

    x_aji = mu_ai + (o_j + q_j z_i) +- (p_j + w_j z_i) + e_aji

``o`` and ``q`` are an offset and a slope that both approaches of a run share (drift of the machine, expansion of its
scale); ``p`` and ``w`` have opposite signs forward and backward. All are independent from run to run. The coefficients
are those of a least-squares line of each run and approach, about the means of the targets; half their sum and half
their difference over the approaches determine the four variances, with n - 1 degrees of freedom each.

If a variance is estimated with v degrees of freedom, the standardised mean has a Student distribution. Its standard
deviation is larger by sqrt(v / (v - 2)) (JCGM 101:2008, 6.4.9.4); the stated uncertainty includes this factor.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from scipy import special

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.kinematics.iso import DOF, direction_of

if TYPE_CHECKING:
    from errormotion.methods.linear_positioning.settings import Settings

DRIFTS = ("offset", "slope")
MIN_RUNS = 4
"""For which the variance of the drift has a Student factor, v / (v - 2) with v = n - 1 above 2."""
SIGNIFICANT = 1e-3
"""Probability in Bartlett's test of equal variances below which each target has its own variance."""


@dataclass(frozen=True)
class Scatter:
    """Variances of one freedom, m^2 or rad^2.

    Attributes
    ----------
    z : ndarray, (target,)
        Scaled position.
    own : ndarray, (approach, target)
        Of one reading, independent from reading to reading; estimate.
    own_factor : float
        Student factor of ``own`` in a variance of a mean.
    common, opposite : ndarray, (2,)
        Of offset and slope of a run that the approaches share, and of those with opposite signs; estimates.
    common_mean, opposite_mean : ndarray, (2,)
        The same for the mean of one run: with Student factor and stated drift, minus the part that is already contained
        in ``own``.
    pooled : bool
        Whether all targets have one variance.
    freedom : int
        Degrees of freedom of ``common`` and ``opposite``; 0 where they are stated.
    noise : ndarray, (2,)
        Variance of the coefficients of a run by ``own``, which has been subtracted.
    unequal : bool
        Whether the variances of the targets differ significantly, with too few runs for one of each: it is then at
        least the common one.
    """

    z: Array
    own: Array
    own_factor: float
    common: Array
    opposite: Array
    common_mean: Array
    opposite_mean: Array
    pooled: bool
    freedom: int
    noise: Array
    unequal: bool = False


def scaled(position: Array) -> Array:
    """Return positions scaled to -1 ... 1 about their mean, in units of half their range."""
    return np.asarray((position - position.mean()) / (np.ptp(position) / 2.0))


def scatter(
    x: Array,
    position: Array,
    *,
    kind: Literal["auto", "pooled", "target", "stated"],
    drift: float | None,
    stated: float | None,
) -> Scatter:
    """Return the variances of readings (approach, run, target).

    Parameters
    ----------
    x : ndarray
        NaN for missing readings.
    position : ndarray, (target,)
        m.
    kind : {"auto", "pooled", "target", "stated"}
        Whether each target has its own variance; with ``stated``, ``drift`` and ``stated`` replace all estimates.
    drift : float, optional
        Stated standard deviation of a run of one approach by drift; a smaller estimate is replaced by it.
    stated : float, optional
        Standard deviation of a reading, for a single run.

    Raises
    ------
    MethodError
        Too few runs to estimate what is not stated.
    """
    z = scaled(position)
    Z = np.stack([np.ones_like(z), z], axis=1)
    approaches = [a for a in range(2) if np.isfinite(x[a]).any()]
    runs = x.shape[1]
    stated_drift = np.array([0.0 if drift is None else drift**2 / len(approaches), 0.0])
    if runs == 1 or kind == "stated":
        return _stated(x, z, stated, drift, stated_drift)
    if drift is None and runs < MIN_RUNS:
        raise MethodError(
            f"Expected {MIN_RUNS} runs or more, or the drift during one run (setting uncertainty.drift); found "
            f"{runs} runs: the drift from run to run cannot be estimated."
        )
    residual, coefficient, g = _lines(x, Z)
    own, factor, pooled, unequal = _own(residual, kind)
    mean_own = float(np.nanmean(own))
    own = np.where(np.isnan(own) & np.isfinite(x).any(axis=1), mean_own, own)  # readings of runs without a line
    both = len(approaches) == 2
    half_sum = coefficient.mean(axis=0) if both else coefficient[approaches[0]]
    half_difference = (coefficient[0] - coefficient[1]) / 2.0 if both else np.zeros_like(half_sum)
    noise = mean_own * g / len(approaches)
    common, opposite = (_mean_square(part) for part in (half_sum, half_difference))
    if runs >= MIN_RUNS:
        student = (runs - 1) / (runs - 3)
        common_mean, opposite_mean = (np.maximum(student * part - noise, 0.0) for part in (common, opposite))
    else:
        common_mean, opposite_mean = np.zeros(2), np.zeros(2)
    return Scatter(
        z=z,
        own=own,
        own_factor=factor,
        common=np.maximum(common - noise, stated_drift),
        opposite=np.maximum(opposite - noise, stated_drift) if both else np.zeros(2),
        common_mean=np.maximum(common_mean, stated_drift),
        opposite_mean=np.maximum(opposite_mean, stated_drift) if both else np.zeros(2),
        pooled=pooled,
        freedom=runs - 1 if runs >= MIN_RUNS else 0,
        noise=noise,
        unequal=unequal,
    )


def lacking(settings: Settings) -> dict[str, str]:
    """Return by setting what `scatter` will lack whatever is measured; only that of the positioning can be stated."""
    stated, only = settings.uncertainty, settings.freedoms == (DOF[direction_of(settings.axis)],)
    if settings.runs == 1:
        if only and stated.scatter is not None and stated.drift is not None:
            return {}
        needed = "uncertainty.scatter and uncertainty.drift"
    elif settings.runs >= MIN_RUNS or (only and stated.drift is not None):
        return {}
    else:
        needed = "uncertainty.drift"
    other = f", or the setting {needed}" if only else " for freedoms other than the positioning"
    return {"runs": f"expected {MIN_RUNS} runs or more{other}, to estimate scatter and drift; found {settings.runs}"}


def _stated(x: Array, z: Array, stated: float | None, drift: float | None, stated_drift: Array) -> Scatter:
    if stated is None or drift is None:
        raise MethodError(
            "The scatter of the readings cannot be estimated from one run. Measure more runs, or state the settings "
            "uncertainty.scatter and uncertainty.drift."
        )
    own = np.where(np.isfinite(x).any(axis=1), stated**2, np.nan)
    return Scatter(z, own, 1.0, stated_drift, stated_drift, stated_drift, stated_drift, True, 0, np.zeros(2))


def _lines(x: Array, Z: Array) -> tuple[Array, Array, Array]:
    """Return residuals of a line in each run about the means of the targets, its coefficients, and their cofactors.

    Shapes (approach, run, target), (approach, run, 2) and (2,).
    """
    known = np.isfinite(x)
    n = known.sum(axis=1, keepdims=True)
    mean = np.where(known, x, 0.0).sum(axis=1, keepdims=True) / np.maximum(n, 1)
    centred = np.where(known & (n > 1), x - mean, np.nan)
    residual, (coefficient, cofactors) = np.full_like(x, np.nan), np.full((2, *x.shape[:2], 2), np.nan)
    there = np.isfinite(centred)
    for here in np.unique(there.reshape(-1, len(Z)), axis=0):  # runs with readings at the same targets
        if here.sum() < 3 or np.ptp(Z[here, 1]) == 0:
            continue
        runs = (there == here).all(axis=-1)
        normal = np.linalg.inv(Z[here].T @ Z[here])
        readings = centred[runs][:, here, None]
        fitted = normal @ Z[here].T @ readings
        coefficient[runs] = fitted[..., 0]
        residual[runs[..., None] & here] = (readings - Z[here] @ fitted).ravel()
        cofactors[runs] = np.diagonal(normal)
    usable = np.isfinite(cofactors[..., 0])
    if not usable.any():
        raise MethodError("deviation: expected runs with readings at three targets or more; found none")
    return residual, coefficient, cofactors[usable].mean(axis=0)


def _own(residual: Array, kind: str) -> tuple[Array, float, bool, bool]:
    """Return the variance of one reading (approach, target), its Student factor, whether it is pooled, and unequal."""
    known = np.isfinite(residual)
    n = known.sum(axis=1)
    square = np.where(known, residual**2, 0.0).sum(axis=1)
    runs = known.any(axis=2).sum(axis=1)
    lost = 2 * np.maximum(runs - 1, 0).sum()  # lines of all runs but one, which the means of the targets contain
    total = int(np.maximum(n - 1, 0).sum())
    freedom = total - int(lost)
    if freedom < 3:
        raise MethodError(
            f"Too few readings to estimate their scatter: expected 3 degrees of freedom or more; found {freedom}. "
            "Measure more targets or runs."
        )
    pooled = float(square.sum() / freedom)
    if kind == "pooled" or (kind == "auto" and not _differ(square, n)):
        return np.where(n > 0, pooled, np.nan), freedom / (freedom - 2), True, False
    share = freedom / total
    each = np.where(n > 1, square / np.maximum(n - 1, 1) / share, pooled)
    own_freedom = share * (float(np.median(n[n > 0])) - 1.0)
    if own_freedom > 2:
        return np.where(n > 0, each, np.nan), own_freedom / (own_freedom - 2), False, False
    if kind == "auto":
        return np.where(n > 0, np.maximum(each, pooled), np.nan), freedom / (freedom - 2), True, True
    raise MethodError(
        f"Variances by target: expected {int(2 / share) + 2} runs or more at these targets; found {int(n.max())}. Use "
        "scatter 'pooled'."
    )


def _differ(square: Array, n: Array) -> bool:
    """Return whether the variances of the targets differ significantly (Bartlett's test)."""
    usable = (n > 2) & (square > 0)
    if usable.sum() < 2:
        return False
    k, v = usable.sum(), (n[usable] - 1).astype(float)
    variance = square[usable] / v
    pooled = (v @ variance) / v.sum()
    if not pooled > 0:
        return False
    statistic = v.sum() * np.log(pooled) - v @ np.log(variance)
    correction = 1.0 + ((1.0 / v).sum() - 1.0 / v.sum()) / (3.0 * (k - 1))
    return bool(special.chdtrc(k - 1, statistic / correction) < SIGNIFICANT)


def _mean_square(part: Array) -> Array:
    """Return the variance of coefficients (run, 2) over the runs, (2,)."""
    known = part[np.isfinite(part).all(axis=1)]
    if len(known) < 2:
        return np.zeros(2)
    return np.asarray(((known - known.mean(axis=0)) ** 2).sum(axis=0) / (len(known) - 1))
