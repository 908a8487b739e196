"""Shapes as the solver uses them, and those with an algebraic fit as a start: line, plane, circle, sphere.

Coordinates are centred and scaled: the origin is the centroid of the points, and their root mean square distance from
it is 1. The parameter vector contains each direction as three numbers; the solver varies the smaller number of free
steps spanned by ``tangent``. Cylinder and cone are in `errormotion.kinematics.fits._axial`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np

from errormotion.arrays import Array

Kind = Literal["position", "direction", "length", "angle"]

__all__ = ["Array", "Circle", "Circle3D", "Group", "Line", "Plane", "Shape", "Sphere", "complement", "norms"]


@dataclass(frozen=True)
class Group:
    """Parameters that belong together: a position and a direction have several, a length and an angle one."""

    name: str
    kind: Kind
    size: int = 1

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the single parameters, such as ``centre_x``."""
        return tuple(f"{self.name}_{axis}" for axis in "xyz"[: self.size]) if self.size > 1 else (self.name,)


class Shape(ABC):
    """A shape that points may lie on.

    Attributes
    ----------
    name : str
    groups : tuple of Group
        The parameter vector theta.
    minimum : int
        Smallest number of points that determine the shape.
    components : int
        Number of components of the vector from a point to the shape; its length is the orthogonal distance.
    spans : int
        Number of dimensions that the points must span: 1 a line, 2 a plane, 3 space.
    robust_tries : int
        Number of candidates from which a robust fit iterates to a minimum.
    """

    name: str
    groups: tuple[Group, ...]
    minimum: int
    components: int = 1
    spans: int
    robust_tries: int = 8

    @abstractmethod
    def starts(self, q: Array) -> list[Array]:
        """Return parameter vectors to start from, best first; none if the points determine none."""

    @abstractmethod
    def residuals(self, theta: Array, q: Array) -> Array:
        """Return the orthogonal distances, (n, components)."""

    @abstractmethod
    def gradient(self, theta: Array, q: Array) -> Array:
        """Return the derivative of the residuals with respect to theta, (n, components, k)."""

    @abstractmethod
    def tangent(self, theta: Array) -> Array:
        """Return the free steps as columns, (k, p), of ``settle(theta + tangent @ step)``."""

    @abstractmethod
    def settle(self, theta: Array) -> Array:
        """Return normalised parameters of the shape: unit directions of fixed sign, the point nearest to the origin."""

    def preference(self, theta: Array) -> float:  # noqa: ARG002 - only shapes with a hint have one
        """Return a number that is smallest for the preferred one of several shapes without residuals."""
        return 0.0

    def scaled(self, scale: float) -> Self:  # noqa: ARG002 - only shapes with a known length depend on it
        """Return the shape with lengths divided by ``scale``."""
        return self

    def robust_starts(self, q: Array, rng: np.random.Generator) -> Iterator[Array]:
        """Yield candidates through few points each, some of them without outliers."""
        few = [rng.choice(len(q), self.minimum, replace=False) for _ in range(50 * self.minimum)]
        yield from self.through(q[np.array(few)])

    def through(self, sets: Array) -> list[Array]:
        """Return the parameter vectors to start from of all sets of points (m, n, dimensions)."""
        return [theta for q in sets for theta in self.starts(q)]


class Line(Shape):
    """A line in 2D or 3D: point nearest to the origin, direction."""

    name, minimum, spans = "line", 2, 1

    def __init__(self, dimensions: int) -> None:
        self.dimensions = dimensions
        self.groups = (Group("point", "position", dimensions), Group("direction", "direction", dimensions))
        self.components = dimensions - 1

    def starts(self, q: Array) -> list[Array]:
        return self.through(q[None])

    def through(self, sets: Array) -> list[Array]:
        middle, s, axes = principal_axes(sets)
        known = s[:, 0] - s[:, 1] > 1e-9 * s[:, 0]  # the direction is determined
        return [self.settle(theta) for theta in np.concatenate([middle, axes[:, 0]], axis=1)[known]]

    def residuals(self, theta: Array, q: Array) -> Array:
        c, u = halves(theta)
        return (q - c) @ complement(u)

    def gradient(self, theta: Array, q: Array) -> Array:
        c, u = halves(theta)
        across = np.broadcast_to(complement(u).T, (len(q), self.components, self.dimensions))
        h = ((q - c) @ u)[:, None, None]
        return np.concatenate([-across, -h * across], axis=2)

    def tangent(self, theta: Array) -> Array:
        c, u = halves(theta)
        B = complement(u)
        return np.block([[B, -np.outer(u, c @ B)], [np.zeros_like(B), B]])

    def settle(self, theta: Array) -> Array:
        c, u = halves(theta)
        u = signed(u)
        return np.concatenate([c - u * (u @ c), u])


class Plane(Shape):
    """A plane: point nearest to the origin, normal."""

    name, minimum, spans = "plane", 3, 2
    groups = (Group("point", "position", 3), Group("normal", "direction", 3))

    def starts(self, q: Array) -> list[Array]:
        return self.through(q[None])

    def through(self, sets: Array) -> list[Array]:
        middle, s, axes = principal_axes(sets)
        known = s[:, 1] - s[:, 2] > 1e-9 * s[:, 0]
        return [self.settle(theta) for theta in np.concatenate([middle, axes[:, 2]], axis=1)[known]]

    def residuals(self, theta: Array, q: Array) -> Array:
        c, u = halves(theta)
        return ((q - c) @ u)[:, None]

    def gradient(self, theta: Array, q: Array) -> Array:
        c, u = halves(theta)
        return np.concatenate([np.broadcast_to(-u, q.shape), q - c], axis=1)[:, None, :]

    def tangent(self, theta: Array) -> Array:
        c, u = halves(theta)
        B = complement(u)
        return np.block([[u[:, None], (c @ u) * B], [np.zeros((3, 1)), B]])

    def settle(self, theta: Array) -> Array:
        c, u = halves(theta)
        u = signed(u)
        return np.concatenate([(u @ c) * u, u])


class Sphere(Shape):
    """A sphere, or a circle in 2D: centre, radius."""

    name, minimum, spans, dimensions = "sphere", 4, 3, 3

    def __init__(self) -> None:
        self.groups = (Group("centre", "position", self.dimensions), Group("radius", "length"))

    def starts(self, q: Array) -> list[Array]:
        """Return Taubin's algebraic fit (IEEE Trans. PAMI 13 (1991) 1115), by singular values."""
        return self.through(q[None])

    def through(self, sets: Array) -> list[Array]:
        middle = sets.mean(axis=1)
        d = sets - middle[:, None]
        z = np.einsum("mni,mni->mn", d, d)
        mean = z.mean(axis=1)
        d, z, mean, middle = (each[mean > 0] for each in (d, z, mean, middle))
        size = 2 * np.sqrt(mean)[:, None]
        a = np.linalg.svd(np.concatenate([((z - mean[:, None]) / size)[..., None], d], axis=2), full_matrices=False)[2]
        a0 = a[:, -1, :1] / size
        round_ = np.abs(a0[:, 0]) >= 1e-14
        c = -a[round_, -1, 1:] / (2 * a0[round_])
        radius = np.sqrt(np.einsum("mi,mi->m", c, c) + mean[round_])
        return list(np.column_stack([c + middle[round_], radius]))

    def residuals(self, theta: Array, q: Array) -> Array:
        miss: Array = norms(q - theta[:-1])[0] - theta[-1]
        return miss[:, None]

    def gradient(self, theta: Array, q: Array) -> Array:
        n = norms(q - theta[:-1])[1]
        return np.concatenate([-n, np.full((len(q), 1), -1.0)], axis=1).reshape(len(q), 1, -1)

    def tangent(self, theta: Array) -> Array:
        return np.eye(len(theta))

    def settle(self, theta: Array) -> Array:
        return np.array([*theta[:-1], abs(theta[-1])])


class Circle(Sphere):
    """A circle in 2D."""

    name, minimum, spans, dimensions = "circle", 3, 2, 2


class Circle3D(Shape):
    """A circle in 3D: centre, normal, radius. The distance has components in its plane and perpendicular to it."""

    name, minimum, spans, components = "circle", 3, 2, 2
    groups = (Group("centre", "position", 3), Group("normal", "direction", 3), Group("radius", "length"))

    def starts(self, q: Array) -> list[Array]:
        starts = []
        for plane in Plane().starts(q):
            c, u = halves(plane)
            B = complement(u)
            starts = [
                self.settle(np.array([*(c + B @ flat[:2]), *u, flat[2]])) for flat in Circle().starts((q - c) @ B)
            ]
        return starts

    def residuals(self, theta: Array, q: Array) -> Array:
        h, rho, _ = about_axis(theta, q)
        return np.column_stack([rho - theta[6], h])

    def gradient(self, theta: Array, q: Array) -> Array:
        h, _, n = about_axis(theta, q)
        one = np.ones((len(q), 1))
        in_plane = np.concatenate([-n, -h[:, None] * n, -one], axis=1)
        across = np.concatenate([-one * theta[3:6], q - theta[:3], 0 * one], axis=1)
        return np.stack([in_plane, across], axis=1)

    def tangent(self, theta: Array) -> Array:
        T = np.zeros((7, 6))
        T[:3, :3] = np.eye(3)
        T[3:6, 3:5] = complement(theta[3:6])
        T[6, 5] = 1.0
        return T

    def settle(self, theta: Array) -> Array:
        return np.array([*theta[:3], *signed(theta[3:6]), abs(theta[6])])


def principal_axes(sets: Array) -> tuple[Array, Array, Array]:
    """Return the means, singular values and principal axes (rows) of sets of points (m, n, dimensions)."""
    middle = sets.mean(axis=1)
    return middle, *np.linalg.svd(sets - middle[:, None], full_matrices=False)[1:]


def halves(theta: Array) -> tuple[Array, Array]:
    """Return the two vectors of equal length in a parameter vector."""
    middle = len(theta) // 2
    return theta[:middle], theta[middle:]


def norms(d: Array) -> tuple[Array, Array]:
    """Return lengths, (n,), and unit vectors, (n, dimensions), of vectors; that of a zero vector is 0."""
    length = np.sqrt(np.einsum("ni,ni->n", d, d))
    return length, d / np.where(length > 0, length, 1.0)[:, None]


def about_axis(theta: Array, q: Array) -> tuple[Array, Array, Array]:
    """Return height along, distance from and unit vector away from the axis (point theta[:3], direction theta[3:6])."""
    d, u = q - theta[:3], theta[3:6]
    h = d @ u
    return h, *norms(d - h[:, None] * u)


def complement(u: Array) -> Array:
    """Return the orthonormal complement of a unit vector as columns, (d, d - 1), by a Householder reflection."""
    v = u.copy()
    v[0] += np.copysign(1.0, u[0])
    return (np.eye(len(u)) - v[:, None] * v * (2 / (v @ v)))[:, 1:]


def signed(u: Array) -> Array:
    """Return the unit vector along ``u`` whose largest component is positive."""
    u = u / np.linalg.norm(u)
    return u if u[np.argmax(np.abs(u))] > 0 else -u
