"""The motion of every probing cycle, from all touches of all balls together.

In a touch of ball i in direction j at time t the commanded position of the tip is p, and the true one p + e(p),

    |p + e(p, t) - b_i| = reach_ij + noise

``reach_ij`` is the sum of ball and tip radius, form of the ball, pre-travel in this direction and geometric error of
the axes: it is the same in every cycle, and none of its parts needs to be known. Unknowns are the twists of all cycles
except the cold one, whose twist is zero, and all reaches; b_i only defines the directions of the reaches and results
from a sphere fit. Between the cycles the twist follows a parabola through three of them, or is constant.

For a dataset of centres, p is the centre, and p + e(p, t) = b_i replaces the equation for each of the coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import FitError, MethodError
from errormotion.kinematics.fits import fit_sphere
from errormotion.methods.normal_vector.identification import chain
from errormotion.methods.normal_vector.identification.freedoms import FLAT, Motion, rotated, spread

if TYPE_CHECKING:
    from numpy.typing import NDArray

CONVERGED = 1e-12
"""Change of the twist, m and rad, at which the iteration ends: far below any noise, above the rounding at 4 m."""
MAX_ITERATIONS = 25


@dataclass(frozen=True)
class Observations:
    """Data of k cycles, b balls and m numbers each: touches, or the coordinates of a centre.

    Attributes
    ----------
    position : ndarray (k, b, m, 3)
        Commanded positions, m; 0 where not measured.
    weight : ndarray (k, b, m, m)
        Inverse covariance of the numbers of a ball, 1/m^2; 0 where not measured.
    time : ndarray (k, b, m)
        Of each, s.
    cycle_time : ndarray (k,)
        s.
    touched : bool
        Whether the data are touches.
    """

    position: Array
    weight: Array
    time: Array
    cycle_time: Array
    touched: bool

    @cached_property
    def valid(self) -> NDArray[np.bool_]:
        """Which numbers were measured, (k, b, m)."""
        return np.asarray(np.diagonal(self.weight, axis1=2, axis2=3) > 0)

    @cached_property
    def spheres(self) -> tuple[Array, Array]:
        """Centres (b, 3) and radii (b,) of spheres through the touches of each ball without drift, m."""
        return _spheres(self.position, self.valid)

    def without(self, wrong: NDArray[np.bool_]) -> Observations:
        """Return the observations without the outliers ``wrong`` (k, b, m)."""
        keep = (~wrong).astype(float)
        return replace(self, weight=self.weight * keep[..., :, None] * keep[..., None, :])

    def cycles(self, which: NDArray[np.intp]) -> Observations:
        """Return the selected cycles."""
        if np.array_equal(which, np.arange(len(self.cycle_time))):
            return self
        return replace(
            self,
            position=self.position[which],
            weight=self.weight[which],
            time=self.time[which],
            cycle_time=self.cycle_time[which],
        )


@dataclass(frozen=True)
class Rigid:
    """The fit; covariances refer to the weights of the observations.

    Attributes
    ----------
    twist : ndarray (k, 6)
        m, rad; 0 in the first cycle and for errors that are not determined.
    own : ndarray (k, 6, 6)
        Covariance without the contribution common to all cycles.
    shared : ndarray (k, 6, q)
        Effect of one standard uncertainty of each of q independent components of the reaches.
    time : ndarray (k,)
        Times of the twists, s.
    anchor : ndarray (b, 3)
        Centres of the balls in the first cycle, m.
    reach : ndarray (b, m)
        m; NaN if never measured. For centres: their coordinates.
    residual : ndarray (k, b, m)
        Measured minus fitted, m; NaN where not measured.
    normal : ndarray (k, b, m, 3)
        Unit vectors of the measuring directions.
    design : ndarray (k, b, m, p)
        Derivative of each number by the p determined errors at its time.
    chi2 : float
    freedom : int
        Degrees of freedom.
    """

    twist: Array
    own: Array
    shared: Array
    time: Array
    anchor: Array
    reach: Array
    residual: Array
    normal: Array
    design: Array
    chi2: float
    freedom: int

    @property
    def covariance(self) -> Array:
        """Of each twist, (k, 6, 6)."""
        return self.own + self.shared @ np.swapaxes(self.shared, 1, 2)


def fit(seen: Observations, motion: Motion, *, interpolate: bool = True) -> Rigid:
    """Return the twists of all cycles relative to the first one, and their covariance.

    Raises
    ------
    MethodError
        A ball with fewer than four touches, fewer than two cycles, or a singular problem.
    """
    k = len(seen.cycle_time)
    if k < 2:
        raise MethodError(
            f"Expected the cold cycle and at least one more; found {k} that determine the motion. Repeat the probing."
        )
    time = mean_time(seen) if interpolate else seen.cycle_time
    to_knots = knot_weights(time, seen.time, interpolate)
    twist, anchor = np.zeros((k, 6)), seen.spheres[0] if seen.touched else None
    for _ in range(MAX_ITERATIONS):
        previous = twist
        twist, solved, parts = _step(seen, motion, to_knots, twist, anchor)
        change = np.abs(twist - previous).max()
        if change < CONVERGED:
            break
        if anchor is not None:
            true = seen.position + motion.error(at_times(to_knots, twist), motion.lever(seen.position))
            anchor = _spheres(true, seen.valid, anchor)[0]
    else:
        raise MethodError(
            f"The fit has not converged after {MAX_ITERATIONS} iterations (last change {change:.2g} m or rad). Check "
            "that the balls have the same order in every cycle, and that positions are in m."
        )
    return _result(seen, motion, twist, solved, parts, anchor, time)


def determined(seen: Observations, motion: Motion) -> NDArray[np.bool_]:
    """Return which cycles determine the motion alone, (k,)."""
    normal = _directions(seen.position, seen.spheres[0]) if seen.touched else _axes(seen.position)
    H = motion.design(motion.lever(seen.position), normal)
    valid = seen.valid
    positions = seen.position[valid]
    H = H / np.where(np.array(motion.seen) < 3, 1.0, spread(positions) if len(positions) else 1.0)
    N = np.einsum("kbmp,kbm,kbmq->kpq", H, valid.astype(float), H)
    eigenvalues = np.linalg.eigvalsh(N)
    return np.asarray((eigenvalues[:, 0] > FLAT**2 * eigenvalues[:, -1]) & (eigenvalues[:, -1] > 0))


def mean_time(seen: Observations) -> Array:
    """Return the mean time of the data of each cycle, (k,), s."""
    valid = seen.valid
    return np.asarray(np.sum(np.where(valid, seen.time, 0.0), axis=(1, 2)) / np.maximum(valid.sum(axis=(1, 2)), 1))


def knot_weights(time: Array, at: Array, interpolate: bool) -> Array:
    """Return the weights of the twists of the previous, the same and the next cycle in that at times ``at`` (k, b, m).

    There is no drift within the first cycle, which is the reference state; in the last cycle the drift is linear.
    """
    weights = np.zeros((*at.shape, 3))
    weights[..., 1] = 1.0
    if interpolate:
        u = at - time[:, None, None]
        a, b = (step[:, None, None] for step in (time[1:-1] - time[:-2], time[2:] - time[1:-1]))
        w = u[1:-1]
        weights[1:-1, ..., 0] = w * (w - b) / (a * (a + b))
        weights[1:-1, ..., 2] = w * (w + a) / (b * (a + b))
        weights[-1, ..., 0] = -u[-1] / (time[-1] - time[-2])
        weights[1:, ..., 1] -= weights[1:, ..., 0] + weights[1:, ..., 2]
    weights[0] = 0.0
    return weights


def at_times(to_knots: Array, twist: Array) -> Array:
    """Return the twists at the times of the weights (k, b, m, 3), (k, b, m, 6)."""
    edge = np.zeros((1, 6))
    around = np.stack([np.concatenate([edge, twist[:-1]]), twist, np.concatenate([twist[1:], edge])], axis=1)
    return np.asarray(np.einsum("kbms,ksd->kbmd", to_knots, around))


def _spheres(position: Array, valid: NDArray[np.bool_], about: Array | None = None) -> tuple[Array, Array]:
    """Return the spheres through the mean position of each ball's touches in each direction.

    With approximate centres ``about`` (b, 3), m, directions and distances are averaged separately, since the mean of
    positions on a sphere lies inside it.
    """
    count = valid.sum(axis=0)
    each = np.maximum(count, 1)[..., None]
    if about is None:
        mean = np.where(valid[..., None], position, 0.0).sum(axis=0) / each
    else:
        away = np.where(valid[..., None], position - about[:, None], 0.0)
        length = np.linalg.norm(away, axis=-1, keepdims=True)
        direction = (away / np.where(length > 0, length, 1.0)).sum(axis=0)
        direction /= np.maximum(np.linalg.norm(direction, axis=-1, keepdims=True), 0.5)
        mean = about[:, None] + length.sum(axis=0) / each * direction
    found = []
    for i, points in enumerate(mean):
        try:
            found.append(fit_sphere(points[count[i] > 0]))
        except FitError as error:
            raise MethodError(
                f"Ball {i + 1} has no sphere through its touches in {int((count[i] > 0).sum())} directions: {error}. "
                "Touch every ball five times or more, around it and on top."
            ) from error
    return np.array([sphere.centre for sphere in found]), np.array([sphere.radius for sphere in found])


def _directions(position: Array, anchor: Array) -> Array:
    away = position - anchor[:, None]
    length = np.linalg.norm(away, axis=-1, keepdims=True)
    return np.asarray(away / np.where(length > 0, length, 1.0))


def _axes(position: Array) -> Array:
    return np.broadcast_to(np.eye(3), (*position.shape[:2], 3, 3))


def _step(
    seen: Observations, motion: Motion, to_knots: Array, twist: Array, anchor: Array | None
) -> tuple[Array, chain.Solved, tuple[Array, Array, Array]]:
    """Return the twists after one Gauss-Newton step, its solution, and the misfit, normals and design before it."""
    lever = motion.lever(seen.position)
    now = at_times(to_knots, twist)
    true = seen.position + motion.error(now, lever)
    if anchor is None:
        normal, misfit = _axes(seen.position), np.diagonal(true, axis1=2, axis2=3)
    else:
        normal = _directions(true, anchor)
        misfit = np.linalg.norm(true - anchor[:, None], axis=-1)
    H = motion.design(rotated(now[..., 3:], lever), normal)
    solved = _normal_equations(seen, H, to_knots, misfit, spread(seen.position[seen.valid]), motion)
    after = twist.copy()
    after[1:, list(motion.seen)] += solved.x
    return after, solved, (misfit, normal, H)


def _normal_equations(
    seen: Observations, H: Array, to_knots: Array, misfit: Array, length: float, motion: Motion
) -> chain.Solved:
    """Solve for the changes of the twists of all cycles except the first, and the reaches."""
    k, b, m, p = H.shape
    scale = np.where(np.array(motion.seen) < 3, 1.0, 1.0 / length)
    A = (to_knots[..., :, None] * (H * scale)[..., None, :]).reshape(k, b, m, 3 * p)
    WA = seen.weight @ A
    misfit = np.where(seen.valid, misfit, 0.0)
    Wy = (seen.weight @ misfit[..., None])[..., 0]
    local = np.einsum("kbmp,kbmq->kpq", A, WA, optimize=True).reshape(k, 3, p, 3, p)
    N = [np.zeros((k, p, p)) for _ in range(3)]  # coupling of a cycle with itself, the next and the second next
    g, r = np.zeros((k, p, b * m)), np.zeros((k, p))
    own_g = np.moveaxis(WA, 3, 1).reshape(k, 3, p, b * m)
    own_r = -np.einsum("kbmp,kbm->kp", A, Wy).reshape(k, 3, p)
    for i in range(3):
        inside, where = _shifted(k, i - 1)
        g[where] += own_g[inside, i]
        r[where] += own_r[inside, i]
        for j in range(i, 3):
            N[j - i][where] += local[inside, i, :, j]
    blocks = np.zeros((b, m, b, m))
    blocks[np.arange(b), :, np.arange(b)] = seen.weight.sum(axis=0)
    D = blocks.reshape(b * m, b * m)
    s = Wy.sum(axis=0).ravel()
    never = np.diagonal(D) == 0
    D[never, never] = 1.0
    # reach d: misfit + A x - d = noise, so that the coupling has the sign of -1.
    T, after, G, right = _paired(N, -g, r)
    unit = 1.0 / np.mean(np.diagonal(D)[~never])
    try:
        solved = chain.solve(T * unit, after * unit, G * unit, D * unit, right * unit, s * unit)
    except np.linalg.LinAlgError as error:
        raise MethodError(
            "The touches do not determine the motion of every cycle. Check that the cold cycle contains the balls of "
            "the other cycles."
        ) from error
    x = solved.x.reshape(-1, p)[: k - 1] * scale
    pairs = solved.own.reshape(-1, 2, p, 2, p)
    own = np.stack([pairs[:, 0, :, 0], pairs[:, 1, :, 1]], axis=1).reshape(-1, p, p)[: k - 1]
    own = own * scale * scale[:, None] * unit
    shared = solved.shared.reshape(-1, p, b * m)[: k - 1] * scale[:, None] * np.sqrt(unit)
    offset = np.where(never, np.nan, solved.offset)
    return chain.Solved(x, offset, own, shared)


def _shifted(k: int, by: int) -> tuple[slice, slice]:
    """Return the cycles that have a neighbour at the distance ``by``, and these neighbours; the first is fixed."""
    return slice(max(0, -by), k - max(0, by)), slice(max(0, by), k - max(0, -by))


def _paired(N: list[Array], g: Array, r: Array) -> tuple[Array, Array, Array, Array]:
    """Return the equations of all cycles except the first, in pairs."""
    n, p = len(r) - 1, r.shape[1]
    odd = n % 2
    pairs = (n + odd) // 2
    diagonal, one, two = (np.concatenate([block[1:], np.zeros((odd + 2, p, p))]) for block in N)
    if odd:
        diagonal[n] = np.eye(p) * np.mean(np.abs(diagonal[:n]))
    T = np.zeros((pairs, 2, p, 2, p))
    T[:, 0, :, 0], T[:, 1, :, 1] = diagonal[0 : 2 * pairs : 2], diagonal[1 : 2 * pairs : 2]
    T[:, 0, :, 1] = one[0 : 2 * pairs : 2]
    T[:, 1, :, 0] = np.swapaxes(one[0 : 2 * pairs : 2], 1, 2)
    after = np.zeros((pairs - 1, 2, p, 2, p))
    after[:, 0, :, 0], after[:, 1, :, 1] = two[0 : 2 * pairs - 2 : 2], two[1 : 2 * pairs - 2 : 2]
    after[:, 1, :, 0] = one[1 : 2 * pairs - 2 : 2]
    G = np.concatenate([g[1:], np.zeros((odd, *g.shape[1:]))]).reshape(pairs, 2 * p, -1)
    right = np.concatenate([r[1:], np.zeros((odd, p))]).reshape(pairs, 2 * p)
    return T.reshape(pairs, 2 * p, 2 * p), after.reshape(-1, 2 * p, 2 * p), G, right


def _result(
    seen: Observations,
    motion: Motion,
    twist: Array,
    solved: chain.Solved,
    parts: tuple[Array, Array, Array],
    anchor: Array | None,
    time: Array,
) -> Rigid:
    misfit, normal, H = parts
    k, b, m = misfit.shape
    reach = solved.offset.reshape(b, m)
    residual = np.where(seen.valid, misfit - reach, np.nan)
    zero = np.nan_to_num(residual)
    chi2 = float(np.einsum("kbi,kbij,kbj->", zero, seen.weight, zero, optimize=True))
    p = len(motion.seen)
    rows = np.array(motion.seen)
    own, shared = np.zeros((k, 6, 6)), np.zeros((k, 6, b * m))
    own[1:, rows[:, None], rows] = solved.own
    shared[1:, rows] = solved.shared
    return Rigid(
        twist,
        own,
        shared,
        time,
        reach if anchor is None else anchor,
        reach,
        residual,
        normal,
        H,
        chi2,
        int(seen.valid.sum()) - p * (k - 1) - int(np.isfinite(reach).sum()),
    )
