"""Outliers, found without trust in any single point.

1. Shapes through few points are tried; the one that half of the points are nearest to wins (least median of squares,
   Rousseeuw 1984), improved by fitting to the nearest half (concentration steps of least trimmed squares).
2. Points within four robust standard deviations of it make a first clean set.
3. The set is refitted and every point judged by a fit that does not contain it, until the set no longer changes. A
   point is left out where Student's t says that among n clean Gaussian points the worst is so far off once in two
   hundred fits.
4. Few points may look wrong only because the others agree too well by chance. Unless all left-out points together gain
   more than such luck, the judging starts again from the set of all points.
"""

from __future__ import annotations

from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.errors import FitError
from errormotion.kinematics.fits._shapes import Shape
from errormotion.kinematics.fits._solver import EPS, Frame, design, levenberg

__all__ = ["FALSE_ALARMS", "outliers"]

Flags = NDArray[np.bool_]

FALSE_ALARMS = 0.01  # fits of clean Gaussian data in which any point is named; steps 3 and 4 share it
SEED = 230


def outliers(shape: Shape, points: Array, weights: Array, sigma: float | None) -> tuple[int, ...]:
    """Return the indices of the points that are not on the shape.

    Raises
    ------
    FitError
        Too few points, or no shape that half of the points agree on.
    """
    spare = 3
    if len(points) < shape.minimum + spare:
        raise FitError(
            f"a robust fit of a {shape.name} needs at least {shape.minimum + spare} points to distinguish outliers "
            f"from the others; found {len(points)}"
        )
    centre = np.median(points, axis=0)
    scale = float(np.median(np.linalg.norm(points - centre, axis=1)))
    if scale <= 10 * EPS * np.abs(points).max():
        raise FitError(f"half of the points are one point; a {shape.name} needs distinct points")
    frame = Frame(centre, scale)
    local, q, root = shape.scaled(scale), frame.inside(points), np.sqrt(weights)
    # Nothing below the rounding of the coordinates is a deviation; nor, where the noise is known, what it explains.
    floor = 50 * EPS * (1 + np.abs(points).max() / scale) * root.max()
    floor = floor if sigma is None else max(floor, sigma / scale)

    theta, spread = _least_trimmed(local, q, root)
    clean = _grown(local, theta, q, root, _misses(local, theta, q, root) <= 4 * max(spread, floor), floor)
    if not _stand_out(local, theta, q, root, clean, floor):
        clean = _grown(local, theta, q, root, np.ones(len(q), dtype=bool), floor)
    return tuple(int(i) for i in np.flatnonzero(~clean))


def _grown(shape: Shape, theta: Array, q: Array, root: Array, clean: Flags, floor: float) -> Flags:
    """Refit and judge until the clean set no longer changes."""
    seen: set[bytes] = set()
    while clean.tobytes() not in seen:
        seen.add(clean.tobytes())
        _majority(shape, clean)
        theta = levenberg(shape, theta, q[clean], root[clean]).theta
        clean = _belongs(shape, theta, q, root, clean, floor)
    _majority(shape, clean)
    return clean


def _stand_out(shape: Shape, theta: Array, q: Array, root: Array, clean: Flags, floor: float) -> bool:
    """Whether leaving these points out gains more than the luckiest choice of clean ones would.

    An F test of what the sum of squares loses; among n points there are n! / k! (n - k)! choices of k.
    """
    from scipy.special import betainc, gammaln

    n, left = len(q), int((~clean).sum())
    if not left:
        return True
    costs = [levenberg(shape, theta, q[part], root[part]).cost for part in (clean, np.ones(n, dtype=bool))]
    freedoms = left * shape.components
    dof = int(clean.sum()) * shape.components - shape.tangent(theta).shape[1]
    gain = (costs[1] - costs[0]) / max(costs[0] / dof, floor**2)
    choices = gammaln(n + 1) - gammaln(left + 1) - gammaln(n - left + 1)
    return bool(betainc(dof / 2, freedoms / 2, dof / (dof + max(gain, 0.0))) <= FALSE_ALARMS / 2 * np.exp(-choices))


def _least_trimmed(shape: Shape, q: Array, root: Array) -> tuple[Array, float]:
    """Return the shape that the nearest half of the points agree on best, and their robust standard deviation."""
    n, rng = len(q), np.random.default_rng(SEED)
    half = min(n - 1, (n + shape.minimum + 1) // 2)

    def rank(theta: Array) -> float:
        return float(np.partition(_misses(shape, theta, q, root), half - 1)[half - 1])

    starts = sorted(shape.robust_starts(q, rng), key=rank)[: shape.robust_tries]
    if not starts:
        raise FitError(f"no small set of the points determines a {shape.name}; plot them")
    trimmed = [_concentrate(shape, theta, q, root, half) for theta in starts]
    best = min(trimmed, key=rank)
    quantile = _normal_length(half / n, shape.components)
    small_sample = 1 + 5 / max(n * shape.components - shape.tangent(best).shape[1], 1)
    return best, rank(best) / quantile * small_sample


def _concentrate(shape: Shape, theta: Array, q: Array, root: Array, half: int) -> Array:
    before: NDArray[np.intp] | None = None
    for _ in range(15):
        nearest = np.sort(np.argpartition(_misses(shape, theta, q, root), half - 1)[:half])
        if before is not None and np.array_equal(nearest, before):
            break
        before = nearest
        theta = levenberg(shape, theta, q[nearest], root[nearest], limit=20, last_digits=False).theta
    return theta


def _belongs(shape: Shape, theta: Array, q: Array, root: Array, clean: Flags, floor: float) -> Flags:
    """Judge every point by the fit to the clean set without it."""
    J, f = design(shape, theta, q, root)
    m, p = shape.components, J.shape[1]
    inside = np.repeat(clean, m)
    dof = int(inside.sum()) - p
    if dof < 2 * m:
        return clean
    R = np.linalg.qr(J[inside])[1]
    # Leverage: the share of the fit's own uncertainty in the point's distance, mean over its components.
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
    """Return the F quantile with (m, dof) freedoms that the worst of n clean points seldom exceeds."""
    tail = FALSE_ALARMS / 2 / n
    if m == 2:
        return float(dof / 2 * (tail ** (-2 / dof) - 1))
    from scipy.special import stdtrit  # loaded here: half a second that only robust fits need

    quantile = float(stdtrit(dof, 1 - tail / 2))
    return quantile * quantile


def _normal_length(share: float, m: int) -> float:
    """Return the length below which this share of standard normal vectors of m = 1 or 2 components stay."""
    return NormalDist().inv_cdf((1 + share) / 2) if m == 1 else float(np.sqrt(-2 * np.log(1 - share)))


def _misses(shape: Shape, theta: Array, q: Array, root: Array) -> Array:
    length: Array = np.linalg.norm(shape.residuals(theta, q), axis=1) * root
    return length


def _majority(shape: Shape, clean: Flags) -> None:
    if clean.sum() < max(shape.minimum + 1, (len(clean) + 1) // 2):
        raise FitError(
            f"no {shape.name} that at least half of the {len(clean)} points agree on; they have another shape"
        )
