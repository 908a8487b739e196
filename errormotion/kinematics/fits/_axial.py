"""Cylinder and cone: the solver starts from an approximate direction of the axis, which a search provides.

For each of many directions, the points are projected onto the plane perpendicular to it. There a cylinder is a circle,
``|p - c|^2 = r^2``, and a cone is a circle whose radius increases with the height h, ``|p - c|^2 = (r + t h)^2``: both
are linear in functions of their parameters. Few points determine a candidate; the solver starts from the candidates
nearest to all points.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from errormotion.arrays import Array
from errormotion.kinematics.fits._shapes import Group, Shape, about_axis, complement, signed

__all__ = ["Cone", "Cylinder"]

DIRECTIONS = 150  # over the half sphere: every axis is within 8 degrees of one of them
SEARCHED_POINTS = 150


class _Axial(Shape):
    """Base of both: point of the axis nearest to the origin, direction of the axis, radius at the point."""

    spans = 3
    elements: int  # number of points that determine a candidate for a known direction
    near: Array | None = None  # approximate direction of the axis
    robust_tries = 24

    def starts(self, q: Array) -> list[Array]:
        return self._search(q, np.random.default_rng(len(q)), robust=False)

    def preference(self, theta: Array) -> float:
        return 0.0 if self.near is None else -abs(float(self.near @ theta[3:6]))

    def robust_starts(self, q: Array, rng: np.random.Generator) -> Iterator[Array]:
        yield from self._search(q, rng, robust=True)

    def _search(self, q: Array, rng: np.random.Generator, *, robust: bool) -> list[Array]:
        q = q[rng.permutation(len(q))[:SEARCHED_POINTS]]
        u = self._directions(q)
        B = np.stack([complement(direction) for direction in u])
        xy, h = np.einsum("ni,kij->knj", q, B), u @ q.T
        # Candidates through few points: if 30 % are outliers, all candidates contain one with a probability of 1e-5.
        few = rng.permuted(np.tile(np.arange(len(q)), (30 if self.elements < 4 else 70, 1)), axis=1)[:, : self.elements]
        with np.errstate(all="ignore"):  # no circle through points on a line; such candidates are removed below
            through_few = self._candidates(xy[:, few], h[:, few])
            through_all = self._candidates(xy[:, None], h[:, None])
            c, r, t = (np.concatenate(parts, axis=1) for parts in zip(through_few, through_all, strict=True))
            rho = np.linalg.norm(xy[:, None] - c[:, :, None], axis=-1)
            miss = np.abs(rho - r[..., None] - t[..., None] * h[:, None]) / np.hypot(1.0, t)[..., None]
            half = len(q) // 2
            cost = np.partition(miss, half, axis=-1)[..., half] if robust else np.mean(miss**2, axis=-1)
        cost[~np.isfinite(cost)] = np.inf
        best = np.argmin(cost, axis=1)
        order = np.argsort(cost[np.arange(len(u)), best], kind="stable")[: self.robust_tries if robust else 8]
        return [
            self.settle(self._vector(B[k] @ c[k, i], u[k], r[k, i], t[k, i]))
            for k, i in zip(order, best[order], strict=True)
            if np.isfinite(cost[k, i])
        ]

    def _directions(self, q: Array) -> Array:
        """Return the principal directions of the points, and directions distributed over the half sphere."""
        z = (np.arange(DIRECTIONS) + 0.5) / DIRECTIONS
        turn = np.pi * (1 + np.sqrt(5)) * np.arange(DIRECTIONS)
        spread = np.column_stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z])
        if self.near is not None:
            return np.concatenate([self.near[None], spread[np.abs(spread @ self.near) > np.cos(np.radians(20))]])
        return np.concatenate([np.linalg.svd(q - q.mean(axis=0), full_matrices=False)[2], spread])

    def _candidates(self, xy: Array, h: Array) -> tuple[Array, Array, Array]:
        """Return centre (k, m, 2), radius at height 0 and growth per height, (k, m), for points (k, m, e, 2)."""
        raise NotImplementedError

    def _vector(self, point: Array, direction: Array, radius: float, growth: float) -> Array:
        raise NotImplementedError


class Cylinder(_Axial):
    """A cylinder: point, direction and, where it is not known, radius."""

    name = "cylinder"

    def __init__(self, radius: float | None = None, near: Array | None = None) -> None:
        self.radius, self.near = radius, near
        self.groups = (Group("point", "position", 3), Group("direction", "direction", 3))
        # Points on two parallel lines determine a cylinder of known radius; one of free radius needs points in space.
        self.minimum, self.elements, self.spans = 4, 2, 2
        if radius is None:
            self.groups = (*self.groups, Group("radius", "length"))
            self.minimum, self.elements, self.spans = 5, 3, 3

    def scaled(self, scale: float) -> Cylinder:
        return Cylinder(None if self.radius is None else self.radius / scale, self.near)

    def residuals(self, theta: Array, q: Array) -> Array:
        _, rho, _ = about_axis(theta, q)
        return (rho - (theta[6] if self.radius is None else self.radius))[:, None]

    def gradient(self, theta: Array, q: Array) -> Array:
        h, _, n = about_axis(theta, q)
        columns = [-n, -h[:, None] * n]
        if self.radius is None:
            columns.append(np.full((len(q), 1), -1.0))
        return np.concatenate(columns, axis=1).reshape(len(q), 1, -1)

    def tangent(self, theta: Array) -> Array:
        T = _axis_tangent(theta)
        return T if self.radius is None else T[:6, :4]

    def settle(self, theta: Array) -> Array:
        c, u = theta[:3], signed(theta[3:6])
        return np.array([*(c - u * (u @ c)), *u, *np.abs(theta[6:])])

    def _candidates(self, xy: Array, h: Array) -> tuple[Array, Array, Array]:
        del h
        if self.radius is not None and xy.shape[2] == 2:
            c = _circles_of_radius(self.radius, xy)
            return c, np.full(c.shape[:2], self.radius), np.zeros(c.shape[:2])
        x = _least_squares(np.concatenate([2 * xy, np.ones_like(xy[..., :1])], axis=-1), np.sum(xy**2, axis=-1))
        c = x[..., :2]
        r = np.sqrt(x[..., 2] + np.sum(c**2, axis=-1))
        return c, r if self.radius is None else np.full_like(r, self.radius), np.zeros_like(r)

    def _vector(self, point: Array, direction: Array, radius: float, growth: float) -> Array:
        del growth
        return np.array([*point, *direction, radius][: 7 if self.radius is None else 6])


class Cone(_Axial):
    """One nappe of a cone: point, direction towards the opening, radius at the point, half angle."""

    name, minimum, elements = "cone", 6, 5
    groups = (
        Group("point", "position", 3),
        Group("direction", "direction", 3),
        Group("radius", "length"),
        Group("half_angle", "angle"),
    )

    def __init__(self, near: Array | None = None) -> None:
        self.near = near

    def residuals(self, theta: Array, q: Array) -> Array:
        h, rho, _ = about_axis(theta, q)
        miss: Array = (rho - theta[6]) * np.cos(theta[7]) - h * np.sin(theta[7])
        return miss[:, None]

    def gradient(self, theta: Array, q: Array) -> Array:
        h, rho, n = about_axis(theta, q)
        sin, cos = np.sin(theta[7]), np.cos(theta[7])
        by_point = -cos * n + sin * theta[3:6]
        by_direction = -(h * cos)[:, None] * n - sin * (q - theta[:3])
        by_radius = np.full(len(q), -cos)
        by_angle = -(rho - theta[6]) * sin - h * cos
        columns = [by_point, by_direction, by_radius[:, None], by_angle[:, None]]
        return np.concatenate(columns, axis=1).reshape(len(q), 1, 8)

    def tangent(self, theta: Array) -> Array:
        T = np.zeros((8, 6))
        T[:7, :5] = _axis_tangent(theta)
        # The point moves along the axis to remain nearest to the origin; the radius changes accordingly.
        T[6, 2:4] = -(theta[:3] @ T[3:6, 2:4]) * np.tan(theta[7])
        T[7, 5] = 1.0
        return T

    def settle(self, theta: Array) -> Array:
        c, u, r, angle = theta[:3], theta[3:6] / np.linalg.norm(theta[3:6]), theta[6], theta[7]
        if angle < 0:
            u, angle = -u, -angle
        slide = -(u @ c)
        return np.array([*(c + slide * u), *u, r + slide * np.tan(angle), angle])

    def _candidates(self, xy: Array, h: Array) -> tuple[Array, Array, Array]:
        h = h[..., None]
        x = _least_squares(np.concatenate([2 * xy, np.ones_like(h), 2 * h, h**2], axis=-1), np.sum(xy**2, axis=-1))
        c = x[..., :2]
        r = np.sqrt(x[..., 2] + np.sum(c**2, axis=-1))
        return c, r, x[..., 3] / r

    def _vector(self, point: Array, direction: Array, radius: float, growth: float) -> Array:
        return np.array([*point, *direction, radius, np.arctan(growth)])


def _axis_tangent(theta: Array) -> Array:
    """Return the free steps of (point, direction, radius): two lateral shifts, two tilts, the radius."""
    c, u = theta[:3], theta[3:6]
    B = complement(u)
    T = np.zeros((7, 5))
    T[:3, :2] = B
    T[:3, 2:4] = -np.outer(u, c @ B)
    T[3:6, 2:4] = B
    T[6, 4] = 1.0
    return T


def _least_squares(A: Array, b: Array) -> Array:
    solution: Array = (np.linalg.pinv(A, rcond=1e-9) @ b[..., None])[..., 0]
    return solution


def _circles_of_radius(radius: float, xy: Array) -> Array:
    """Return the centres, (k, 2 m, 2), of the circles of one radius through pairs of points (k, m, 2, 2)."""
    middle, chord = xy.mean(axis=2), xy[:, :, 1] - xy[:, :, 0]
    length = np.linalg.norm(chord, axis=-1, keepdims=True)
    across = np.stack([-chord[..., 1], chord[..., 0]], axis=-1) / length
    height = np.sqrt(np.maximum(radius**2 - length**2 / 4, 0))
    return np.concatenate([middle + height * across, middle - height * across], axis=1)
