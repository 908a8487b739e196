"""Optimal positions of the tracker: the layout with the smallest uncertainty of the targets.

The uncertainty depends only on positions (see `bound`). Positions are searched within boxes from many start values,
first with a smooth approximation of the largest uncertainty of all targets, then with the largest itself.
"""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.errors import MethodError

if TYPE_CHECKING:
    from collections.abc import Callable

    from errormotion.methods.multilateration.planning.sight import Sight
    from errormotion.methods.multilateration.settings import Layout


MIN_STATIONS = 4
"""Minimum number of stations, and of readings of each."""
_PENALTY = 1e3
_NOT_VISIBLE = 10.0
"""Cost of positions that are not visible: one in a hundred is equivalent to uncertainties larger by a tenth."""
_TRIED, _GLOBAL, _LOCAL = 30, 80, 60
"""Evaluations per coordinate: random positions, global search, and local search from each start value."""
_STARTS = 3
_ROUNDS = 2
_POWER = 16.0
"""Exponent of the power mean of the uncertainties: a smooth approximation of the largest."""
_TOLERANCE = 1e-6


def grid(layout: Layout) -> tuple[Array, Array]:
    """Return axis positions of the targets and positions of the reflector, both (m, 3), m."""
    if layout.targets:
        listed = np.array(layout.targets, np.float64)
        return listed, listed + np.array(layout.reflector)
    axes = [np.linspace(a, b, k) if k > 1 else np.array([(a + b) / 2])
            for a, b, k in zip(layout.low, layout.high, layout.count, strict=True)]  # fmt: skip
    position = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return position, position + np.array(layout.reflector)


def serpentine(count: tuple[int, int, int]) -> list[int]:
    """Return the targets of a grid in an order in which each is a neighbour of the previous one."""
    nx, ny, nz = count
    order: list[int] = []
    for i in range(nx):
        rows = range(ny) if i % 2 == 0 else range(ny - 1, -1, -1)
        for j in rows:
            line = [(i * ny + j) * nz + k for k in range(nz)]
            order += line if len(order) // nz % 2 == 0 else line[::-1]
    return order


def route(layout: Layout) -> list[int]:
    """Return the targets in the order of measurement: a grid by rows, others by the nearest remaining target."""
    if not layout.targets:
        return serpentine(layout.count)
    position = grid(layout)[0]
    remaining = list(range(len(position)))
    order = [remaining.pop(int(np.argmin(position.sum(axis=1))))]
    while remaining:
        away = np.abs(position[remaining] - position[order[-1]]).max(axis=1)  # axes move simultaneously
        order.append(remaining.pop(int(np.argmin(away))))
    return order


def uncertainty(covariance: Array) -> Array:
    """Return standard uncertainties (m,) of the three coordinates together, m, from covariances (m, 3, 3)."""
    return np.asarray(np.sqrt(np.trace(covariance, axis1=1, axis2=2)))


def optimise(
    target: ArrayLike,
    boxes: ArrayLike,
    sight: Sight,
    *,
    noise: float,
    start: ArrayLike | None = None,
    minimise: Literal["largest", "mean"] = "largest",
    seed: int = 1,
    worth: Callable[[Array], Array] | None = None,
    thorough: bool = True,
) -> Array:
    """Return the positions of the tracker with the smallest uncertainty of the targets.

    Parameters
    ----------
    target : array_like (m, 3)
        Positions of the reflector, m.
    boxes : array_like (n, 2, 3)
        Lower and upper corner of the box of each station, m.
    sight : Sight
        Lines of sight. Every target must be visible from at least three stations, and enough of them from four.
    noise : float
        Standard deviation of a reading, m.
    start : array_like (n, 3), optional
        Start positions, m. The result is never worse than these, moved into their boxes.
    minimise : {"largest", "mean"}
        Which uncertainty.
    seed : int
        Of the search, which is reproducible.
    worth : callable, optional
        Uncertainties to minimise, m, from positions (n, 3); default: those of the targets.
    thorough : bool
        Whether to search the whole boxes, or only near the start.

    Returns
    -------
    ndarray (n, 3)
        m.

    Raises
    ------
    MethodError
        No positions within the boxes determine all targets.
    """
    import nlopt

    from errormotion.methods.multilateration.planning.bound import predicted_uncertainty

    u, corners = np.asarray(target, np.float64), np.asarray(boxes, np.float64)
    if len(corners) < MIN_STATIONS:
        raise MethodError(
            f"Expected boxes for at least {MIN_STATIONS} stations; found {len(corners)}. Add some.",
            code="network.plan.boxes_too_few",
        )
    low, high = corners[:, 0].ravel(), corners[:, 1].ravel()
    free = np.flatnonzero(high > low)
    fixed = low.copy()

    def at(x: Array) -> Array:
        full = fixed.copy()
        full[free] = x
        return full.reshape(-1, 3)

    def cost(x: Array, power: float | None = None) -> float:
        U = at(x)
        seen = sight.sees(U, u)
        if lacking := _lacking(seen):
            return _PENALTY * (1.0 + lacking)
        try:
            sigma = predicted_uncertainty(seen / noise, U, u) if worth is None else worth(U)
        except np.linalg.LinAlgError:
            return _PENALTY
        if sigma is None or (worth is None and not np.isfinite(sigma).all()):  # a freedom is undetermined
            return _PENALTY
        return cost_of(sigma, power)

    def cost_of(sigma: Array, power: float | None) -> float:
        known = np.isfinite(sigma)
        unseen, sigma = _NOT_VISIBLE * float(np.mean(~known)), sigma[known]
        if not len(sigma):
            return _PENALTY
        if minimise == "mean":
            return float(np.log(sigma.mean())) + unseen
        largest = sigma.max()
        smooth = 0.0 if power is None else float(np.log(np.mean((sigma / largest) ** power)) / power)
        return float(np.log(largest)) + smooth + unseen

    nlopt.srand(seed)
    rng = np.random.default_rng(seed)

    def search(algorithm: int, x: Array, evaluations: int, power: float | None = None) -> Array:
        x = np.clip(x, low[free], high[free])
        lowest, best = cost(x, power), x

        def follow(y: Array, gradient: Array) -> float:  # noqa: ARG001 - the signature of nlopt
            nonlocal lowest, best
            if (value := cost(y, power)) < lowest:
                lowest, best = value, y.copy()
            return value

        problem = nlopt.opt(algorithm, x.size)
        problem.set_lower_bounds(low[free])
        problem.set_upper_bounds(high[free])
        problem.set_min_objective(follow)
        problem.set_ftol_abs(_TOLERANCE)
        problem.set_maxeval(evaluations * x.size)
        with suppress(nlopt.RoundoffLimited):  # converged
            problem.optimize(x)
        return np.asarray(np.clip(best, low[free], high[free]), np.float64)

    given = fixed if start is None else np.clip(np.asarray(start, np.float64).ravel(), low, high)
    best = given[free]
    if free.size:
        # Good positions are often on the faces and at the corners of the boxes.
        share = rng.uniform(size=(_TRIED * free.size if thorough else 0, free.size))
        share = np.where(rng.uniform(size=share.shape) < 0.5, np.round(share), share)
        tried = sorted((low[free] + share * (high - low)[free]).tolist(), key=lambda x: cost(np.array(x)))
        everywhere = [search(nlopt.GN_CRS2_LM, best, _GLOBAL, _POWER)] if thorough else []
        starts = [best, *everywhere, *(np.array(x) for x in tried[:_STARTS])]
        starts = [search(nlopt.LN_SBPLX, x, _LOCAL, _POWER) for x in starts]
        best = min([best, *starts], key=cost)
        # The largest uncertainty is not smooth, so that a search is slow: the search is restarted.
        for algorithm in (nlopt.LN_BOBYQA, nlopt.LN_SBPLX, nlopt.LN_COBYLA) * (_ROUNDS if thorough else 1):
            best = search(algorithm, best, _LOCAL)
    if cost(best) >= _PENALTY:
        raise MethodError(
            f"Expected positions within the boxes with the targets visible from {MIN_STATIONS} stations; found none: "
            f"the best ones lack {_lacking(sight.sees(at(best), u))} readings. Enlarge the boxes, use a reflector with "
            "a larger acceptance angle, move the obstacles, or add stations.",
            code="network.plan.no_sight",
        )
    return at(best)


def _lacking(sees: NDArray[np.bool_]) -> int:
    """Return the number of missing readings, for each target, each station, and all unknowns."""
    n, _ = sees.shape
    by_target, by_station = sees.sum(axis=0), sees.sum(axis=1)
    lacking = np.maximum(3 - by_target, 0).sum() + np.maximum(MIN_STATIONS - by_station, 0).sum()
    return int(lacking + max(4 * n - 6 - np.maximum(by_target - 3, 0).sum(), 0))
