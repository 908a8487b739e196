"""Least squares of orthogonal distances to any shape, with covariance, and errors if the points do not determine it.

The points are centred and scaled, so that all numbers are near 1 for any origin of the machine. Levenberg-Marquardt (by
QR) iterates from the start of the shape to the minimum, and Gauss-Newton refines it to the rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import FitError
from errormotion.kinematics.fits._shapes import Shape, norms

__all__ = ["Estimate", "Frame", "Solution", "design", "estimate", "levenberg"]

EPS = float(np.finfo(float).eps)
SEARCHED_POINTS = 1000  # number of points by which the best of several starts is selected
# Step below which the minimum is refined. On a shape of size 1, such a step changes the sum of squares by a relative
# 1e-14: convergence is then shown by the steps, no longer by the sum.
REFINED_STEP = 1e-7
# Sum of squares below which a fit is exact: `Shape.preference` selects one of several exact fits.
EXACT = 1e-20
# Ratio of the smallest to the largest singular value below which a freedom is numerically undetermined. An arc of one
# part in 1e5 of its radius has 1e-10.
UNDETERMINED = 1e-11
# Largest relative uncertainty of a radius, and largest uncertainty of a direction, rad, for a linear covariance.
TOO_UNCERTAIN = 0.5


@dataclass(frozen=True)
class Solution:
    """Result of the solver."""

    theta: Array
    cost: float
    converged: bool


@dataclass(frozen=True)
class Frame:
    """Centre and scale of the points: ``q = (p - centre) / scale``."""

    centre: Array
    scale: float

    def inside(self, points: Array) -> Array:
        """Return points in the frame."""
        return (points - self.centre) / self.scale

    def outside(self, shape: Shape, theta: Array) -> tuple[Array, Array]:
        """Return parameters in the unit of the points, and the scale of each."""
        shift: list[float] = []
        scale: list[float] = []
        for group in shape.groups:
            shift.extend(self.centre if group.kind == "position" else np.zeros(group.size))
            scale.extend(np.full(group.size, self.scale if group.kind in ("position", "length") else 1.0))
        return np.array(shift) + np.array(scale) * theta, np.array(scale)


@dataclass(frozen=True)
class Estimate:
    """A fitted shape in the unit of the points; ``residuals`` of all points, including the excluded ones."""

    shape: Shape
    theta: Array
    covariance: Array
    residuals: Array
    left_out: tuple[int, ...]
    sigma: float
    dof: int


def estimate(
    shape: Shape, points: Array, weights: Array, sigma: float | None, left_out: tuple[int, ...] = ()
) -> Estimate:
    """Fit a shape to all points except the excluded ones.

    Raises
    ------
    FitError
        The points do not determine the shape; the message states the undetermined parameters.
    """
    used = np.ones(len(points), dtype=bool)
    used[list(left_out)] = False
    frame = _frame(shape, points[used], weights[used])
    local, q, root = shape.scaled(frame.scale), frame.inside(points), np.sqrt(weights)
    _refuse_flat(shape, points[used], frame)
    solution = _best(local, q[used], root[used])
    theta = solution.theta

    J, f = design(local, theta, q[used], root[used])
    _, s, Vt = np.linalg.svd(J, full_matrices=False)
    if not np.isfinite(theta).all() or s[-1] <= UNDETERMINED * s[0]:
        raise _undetermined(shape, points[used], local.tangent(theta) @ Vt[-1])
    if not solution.converged:
        raise FitError(
            f"the fit of the {shape.name} did not converge: the points may have another shape. "
            f"Plot them, or use a robust fit",
            code="shape.not_converged",
        )
    dof = int(used.sum()) * shape.components - J.shape[1]
    estimated = float(np.sqrt(f @ f / dof)) if dof > 0 else np.nan
    unit = estimated if sigma is None else sigma / frame.scale
    half = local.tangent(theta) @ (Vt.T / s) * unit
    _refuse_uncertain(shape, theta, half)

    outside, scale = frame.outside(shape, theta)
    covariance = (half @ half.T) * np.outer(scale, scale)
    parts = local.residuals(theta, q) * frame.scale
    residuals = parts[:, 0] if shape.components == 1 else norms(parts)[0]
    return Estimate(shape, outside, covariance, residuals, left_out, float(unit * frame.scale), dof)


def design(shape: Shape, theta: Array, q: Array, root_weights: Array) -> tuple[Array, Array]:
    """Return the weighted Jacobian of the free steps, (n components, p), and the weighted residuals."""
    J = (shape.gradient(theta, q) @ shape.tangent(theta)) * root_weights[:, None, None]
    f = shape.residuals(theta, q) * root_weights[:, None]
    return J.reshape(f.size, -1), f.ravel()


def levenberg(
    shape: Shape, theta: Array, q: Array, root_weights: Array, *, limit: int = 200, refine: bool = True
) -> Solution:
    """Iterate from ``theta`` to the nearest minimum of the weighted sum of squared distances."""
    damping, cost = 1e-3, np.inf
    for _ in range(limit):
        J, f = design(shape, theta, q, root_weights)
        R, g = _triangle(J, f)
        cost = float(f @ f)
        if np.linalg.norm(_solve(R, g)) < REFINED_STEP:
            return _refined(shape, theta, q, root_weights) if refine else Solution(theta, cost, converged=True)
        marquardt, right = np.maximum(np.sqrt((R * R).sum(axis=0)), 1e-6), np.concatenate([g, np.zeros_like(g)])
        while damping < 1e10:
            step = _solve(np.concatenate([R, np.diag(np.sqrt(damping) * marquardt)]), right)
            trial = shape.settle(theta + shape.tangent(theta) @ step)
            misses = shape.residuals(trial, q) * root_weights[:, None]
            if np.sum(misses**2) < cost:
                theta, damping = trial, 0.1 * damping
                break
            damping = max(10 * damping, 1e-6)
        else:  # no step decreases the sum: a minimum within rounding, if the gradient is small as well
            flat = np.linalg.norm(R.T @ g) <= 1e-6 * np.linalg.norm(R) * np.sqrt(cost)
            return Solution(theta, cost, bool(flat or cost < (100 * EPS) ** 2 * len(q)))
    return Solution(theta, cost, converged=False)


def _refined(shape: Shape, theta: Array, q: Array, root_weights: Array) -> Solution:
    """Iterate by Gauss-Newton as long as the steps decrease."""
    before = np.inf
    for _ in range(100):
        J, f = design(shape, theta, q, root_weights)
        step = _solve(*_triangle(J, f))
        length = float(np.linalg.norm(step))
        if length >= before or length < EPS:
            break
        theta, before = shape.settle(theta + shape.tangent(theta) @ step), length
    return Solution(theta, float(f @ f), converged=True)


def _best(shape: Shape, q: Array, root_weights: Array) -> Solution:
    starts = shape.starts(q)
    if not starts:
        raise FitError(
            f"the points do not determine one {shape.name}: several fit equally well. Add points elsewhere",
            code="shape.ambiguous",
        )
    if len(starts) > 1:
        part = np.unique(np.linspace(0, len(q) - 1, min(len(q), SEARCHED_POINTS)).astype(int))
        tried = [levenberg(shape, theta, q[part], root_weights[part], limit=60, refine=False) for theta in starts]
        starts = [min(tried, key=lambda end: (max(end.cost, EXACT), shape.preference(end.theta))).theta]
    return levenberg(shape, starts[0], q, root_weights)


def _triangle(J: Array, f: Array) -> tuple[Array, Array]:
    Q, R = np.linalg.qr(J)
    return R, np.asarray(Q.T @ f)


def _solve(R: Array, g: Array) -> Array:
    return np.asarray(np.linalg.lstsq(R, -g, rcond=1e-14)[0], dtype=float)


def _frame(shape: Shape, points: Array, weights: Array) -> Frame:
    _enough(shape, points)
    centre = np.average(points, axis=0, weights=weights)
    scale = float(np.sqrt(np.mean((points - centre) ** 2) * points.shape[1]))
    if scale <= 10 * EPS * np.abs(points).max():
        raise FitError(
            f"a {shape.name} needs {shape.minimum} distinct points; all {len(points)} are one point",
            code="shape.points.not_distinct",
        )
    return Frame(centre, scale)


def _enough(shape: Shape, points: Array) -> None:
    if len(points) < shape.minimum:
        raise FitError(
            f"a {shape.name} needs at least {shape.minimum} points; found {len(points)}. Measure more",
            code="shape.points.too_few",
        )


def _refuse_flat(shape: Shape, points: Array, frame: Frame) -> None:
    s = np.linalg.svd(frame.inside(points), compute_uv=False)
    rounding = 1e-12 + 100 * EPS * np.abs(points).max() / frame.scale
    spread = int(np.sum(s > rounding * s[0]))
    if spread < shape.spans:
        where = {1: "on one line", 2: "in one plane"}[spread]
        undetermined = ", ".join(group.name for group in shape.groups)
        raise FitError(
            f"the points lie {where}, which leaves the {shape.name} undetermined ({undetermined}); it needs points "
            f"that spread {'over a plane' if shape.spans == 2 else 'in space'}{_repeated(shape, points)}",
            code="shape.undetermined",
        )


def _undetermined(shape: Shape, points: Array, direction: Array) -> FitError:
    """Return the error that states the parameters which can change without a change of the residuals."""
    names, start = [], 0
    for group in shape.groups:
        if np.linalg.norm(direction[start : start + group.size]) > 0.1 * np.linalg.norm(direction):
            names.append(group.name)
        start += group.size
    return FitError(
        f"the points leave the {shape.name} undetermined: {' and '.join(names) or 'all parameters'} can change "
        f"together without a change of the residuals. Add points elsewhere on it{_repeated(shape, points)}",
        code="shape.undetermined",
    )


def _repeated(shape: Shape, points: Array) -> str:
    distinct = len(np.unique(points, axis=0))
    return f". Only {distinct} of the {len(points)} points are distinct" if distinct < shape.minimum else ""


def _refuse_uncertain(shape: Shape, theta: Array, half: Array) -> None:
    start = 0
    for group in shape.groups:
        part = slice(start, start + group.size)
        uncertainty = np.linalg.norm(half[part], axis=None if group.size > 1 else 1).item()
        size = abs(theta[part][0]) if group.kind == "length" else 1.0
        if group.kind != "position" and uncertainty > TOO_UNCERTAIN * size:
            raise FitError(
                f"the noise hides the {group.name} of the {shape.name}: its standard uncertainty is "
                f"{uncertainty / size:.2g} {'times its value' if group.kind == 'length' else 'rad'}. "
                f"The points cover too little of the {shape.name}; distribute them, or fit a simpler shape",
                code="shape.hidden_by_noise",
            )
        start += group.size
