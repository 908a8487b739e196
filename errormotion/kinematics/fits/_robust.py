"""Detection of outliers.

1. Of many shapes through few points, the one nearest to half of the points is selected (least median of squares,
   Rousseeuw 1984) and fitted to the nearest half (concentration steps of least trimmed squares).
2. The points within four robust standard deviations of it are the first clean set.
3. The shape is fitted to the clean set, and every point is tested against a fit without it, until the set no longer
   changes. A point is excluded if, by Student's t, the worst of n clean Gaussian points would be so far off in fewer
   than one of two hundred fits.
4. If few points agree well by chance, others appear as outliers. Unless the excluded points together are significant
   as well, step 3 is repeated from the set of all points.
"""

from __future__ import annotations

from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.errors import FitError
from errormotion.kinematics.fits._shapes import Shape, norms
from errormotion.kinematics.fits._solver import EPS, Frame, design, levenberg

__all__ = ["FALSE_ALARMS", "outliers"]

Flags = NDArray[np.bool_]

FALSE_ALARMS = 0.01  # share of fits of clean Gaussian data with any excluded point; one half each for steps 3 and 4
SEED = 230


def outliers(shape: Shape, points: Array, weights: Array, sigma: float | None) -> tuple[int, ...]:
    """Return the indices of the outliers.

    Raises
    ------
    FitError
        Too few points, or no shape through at least half of the points.
    """
    spare = 3
    if len(points) < shape.minimum + spare:
        raise FitError(
            f"a robust fit of a {shape.name} needs at least {shape.minimum + spare} points to distinguish outliers "
            f"from the others; found {len(points)}",
            code="shape.points.too_few",
        )
    centre = np.median(points, axis=0)
    scale = float(np.median(np.linalg.norm(points - centre, axis=1)))
    if scale <= 10 * EPS * np.abs(points).max():
        raise FitError(
            f"half of the points are one point; a {shape.name} needs distinct points", code="shape.points.not_distinct"
        )
    frame = Frame(centre, scale)
    local, q, root = shape.scaled(scale), frame.inside(points), np.sqrt(weights)
    # Deviations below the rounding of the coordinates, or below the stated noise, are not significant.
    floor = 50 * EPS * (1 + np.abs(points).max() / scale) * root.max()
    floor = floor if sigma is None else max(floor, sigma / scale)

    theta, spread = _least_trimmed(local, q, root)
    clean = _clean_set(local, theta, q, root, _misses(local, theta, q, root) <= 4 * max(spread, floor), floor)
    if not _significant(local, theta, q, root, clean, floor):
        clean = _clean_set(local, theta, q, root, np.ones(len(q), dtype=bool), floor)
    return tuple(int(i) for i in np.flatnonzero(~clean))


def _clean_set(shape: Shape, theta: Array, q: Array, root: Array, clean: Flags, floor: float) -> Flags:
    """Fit the shape and test the points until the clean set no longer changes."""
    seen: set[bytes] = set()
    while clean.tobytes() not in seen:
        seen.add(clean.tobytes())
        _check_majority(shape, clean)
        theta = levenberg(shape, theta, q[clean], root[clean]).theta
        clean = _accepted(shape, theta, q, root, clean, floor)
    _check_majority(shape, clean)
    return clean


def _significant(shape: Shape, theta: Array, q: Array, root: Array, clean: Flags, floor: float) -> bool:
    """Return whether excluding these points improves the fit more than excluding as many clean points could.

    F test of the decrease of the sum of squares, for n! / k! (n - k)! choices of k among n points.
    """
    from scipy.special import betainc, gammaln

    n, excluded = len(q), int((~clean).sum())
    if not excluded:
        return True
    costs = [levenberg(shape, theta, q[part], root[part]).cost for part in (clean, np.ones(n, dtype=bool))]
    freedoms = excluded * shape.components
    dof = int(clean.sum()) * shape.components - shape.tangent(theta).shape[1]
    gain = (costs[1] - costs[0]) / max(costs[0] / dof, floor**2)
    choices = gammaln(n + 1) - gammaln(excluded + 1) - gammaln(n - excluded + 1)
    return bool(betainc(dof / 2, freedoms / 2, dof / (dof + max(gain, 0.0))) <= FALSE_ALARMS / 2 * np.exp(-choices))


def _least_trimmed(shape: Shape, q: Array, root: Array) -> tuple[Array, float]:
    """Return the shape nearest to half of the points, and the robust standard deviation of the points."""
    n, rng = len(q), np.random.default_rng(SEED)
    half = min(n - 1, (n + shape.minimum + 1) // 2)

    def rank(theta: Array) -> float:
        return float(np.partition(_misses(shape, theta, q, root), half - 1)[half - 1])

    starts = sorted(shape.robust_starts(q, rng), key=rank)[: shape.robust_tries]
    if not starts:
        raise FitError(
            f"no small set of the points determines a {shape.name}; plot the points", code="shape.undetermined"
        )
    seen: set[bytes] = set()
    trimmed = [_concentrate(shape, theta, q, root, half, seen) for theta in starts]
    best = min((theta for theta in trimmed if theta is not None), key=rank)
    quantile = _normal_length(half / n, shape.components)
    small_sample = 1 + 5 / max(n * shape.components - shape.tangent(best).shape[1], 1)
    return best, rank(best) / quantile * small_sample


def _concentrate(shape: Shape, theta: Array, q: Array, root: Array, half: int, seen: set[bytes]) -> Array | None:
    """Fit the shape to the nearest half until this no longer changes; None if it was that of an earlier start."""
    own: set[bytes] = set()
    for _ in range(15):
        nearest = np.sort(np.argpartition(_misses(shape, theta, q, root), half - 1)[:half])
        key = nearest.tobytes()
        if key in own:
            break
        if key in seen:
            return None
        own.add(key)
        seen.add(key)
        theta = levenberg(shape, theta, q[nearest], root[nearest], limit=20, refine=False).theta
    return theta


def _accepted(shape: Shape, theta: Array, q: Array, root: Array, clean: Flags, floor: float) -> Flags:
    """Return which points are consistent with the fit to the clean set without them."""
    J, f = design(shape, theta, q, root)
    m, p = shape.components, J.shape[1]
    inside = np.repeat(clean, m)
    dof = int(inside.sum()) - p
    if dof < 2 * m:
        return clean
    R = np.linalg.qr(J[inside])[1]
    # Leverage: contribution of the uncertainty of the fit to the distance of a point, mean over its components.
    leverage = np.sum(np.linalg.lstsq(R.T, J.T, rcond=None)[0] ** 2, axis=0).reshape(-1, m).mean(axis=1)
    square = np.sum(f.reshape(-1, m) ** 2, axis=1)
    total = float(f[inside] @ f[inside])
    own = np.maximum(1 - leverage, 1e-6)
    variance_without = np.where(clean, (total - square / own) / (dof - m), total / dof)
    variance_without = np.maximum(variance_without, floor**2)
    deviation = square / np.where(clean, own, 1 + leverage) / m / variance_without
    limit = np.where(clean, _limit(m, dof - m, len(q)), _limit(m, dof, len(q)))
    return np.asarray(deviation <= limit)


def _limit(m: int, dof: int, n: int) -> float:
    """Return the F quantile with (m, dof) degrees of freedom that the worst of n clean points rarely exceeds."""
    tail = FALSE_ALARMS / 2 / n
    if m == 2:
        return float(dof / 2 * (tail ** (-2 / dof) - 1))
    from scipy.special import stdtrit  # slow to import, needed for robust fits only

    quantile = float(stdtrit(dof, 1 - tail / 2))
    return quantile * quantile


def _normal_length(share: float, m: int) -> float:
    """Return the quantile of the length of standard normal vectors with m = 1 or 2 components."""
    return NormalDist().inv_cdf((1 + share) / 2) if m == 1 else float(np.sqrt(-2 * np.log(1 - share)))


def _misses(shape: Shape, theta: Array, q: Array, root: Array) -> Array:
    misses = shape.residuals(theta, q)
    length = np.abs(misses[:, 0]) if shape.components == 1 else norms(misses)[0]
    return np.asarray(length * root)


def _check_majority(shape: Shape, clean: Flags) -> None:
    if clean.sum() < max(shape.minimum + 1, (len(clean) + 1) // 2):
        raise FitError(
            f"no {shape.name} fits at least half of the {len(clean)} points; the points have another shape",
            code="shape.other",
        )
