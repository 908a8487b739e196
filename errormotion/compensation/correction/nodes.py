"""Interpolation between the measured positions: weights of the nodes at a point, and the added variance.

Outside the measured range a point is moved to its limit: to the nearest value of a line or a grid, or, for scattered
positions, to the intersection of their convex hull with the line to their mean. The value is continuous there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, Delaunay, KDTree

from errormotion.arrays import Array
from errormotion.datasets.results.interpolation import intensity, steps, variance_beside_a_step

_EDGE = 1e-6
"""Maximum distance from the hull of a point on it, relative to the distance from the mean of the nodes."""

NEIGHBOURS = 8
"""Neighbours from which a scattered node is predicted, to estimate the curvature of the errors."""

SAME = 1e-7
"""Distance within which two coordinates are equal, m or s."""

_JITTER = 1e-7
"""Displacement of the nodes for triangulation, relative to their range: that of a grid is not unique."""


@dataclass(frozen=True)
class Weights:
    """Weights of the nodes for the values at points.

    Attributes
    ----------
    node : (k, n) of int
        Index of each of the k nodes of a point.
    weight : (k, n)
        Their weights; the sum is 1.
    inside : (n,) of bool
        Whether the point lies within the measured range.
    """

    node: NDArray[np.intp]
    weight: Array
    inside: NDArray[np.bool_]

    def of(self, values: Array) -> Array:
        """Return the interpolated values, (n, ...), of values at the nodes, (node, ...)."""
        rest = (1,) * (values.ndim - 1)
        found: Array = self.weight[0].reshape(-1, *rest) * values[self.node[0]]
        for node, weight in zip(self.node[1:], self.weight[1:], strict=True):
            found += weight.reshape(-1, *rest) * values[node]
        return found

    def squared(self, values: Array) -> Array:
        """Return the sums of values at the nodes with squared weights: variances of independent ones."""
        return Weights(self.node, self.weight**2, self.inside).of(values)

    def times(self, other: Weights, size: int) -> Weights:
        """Return the weights on the product of these nodes and ``size`` others, which vary fastest."""
        node = (self.node[:, None] * size + other.node[None]).reshape(-1, other.node.shape[1])
        weight = (self.weight[:, None] * other.weight[None]).reshape(-1, other.node.shape[1])
        return Weights(node, weight, self.inside & other.inside)


class Nodes(Protocol):
    """Positions or times at which errors were measured.

    Attributes
    ----------
    size : int
        Number of nodes.
    """

    @property
    def size(self) -> int:
        """Number of nodes."""

    def weights(self, points: Array) -> Weights:
        """Return the weights of points, (n, coordinate)."""

    def added(self, points: Array, values: Array, own: Array) -> Array:
        """Return the variance of the interpolation at points, (n, 6); NaN where it cannot be estimated.

        ``values`` (node, 6) and ``own`` (node, 6, 6) are the errors at the nodes, and the covariance that is
        independent between them.
        """


@dataclass(frozen=True)
class Line:
    """Increasing positions or times."""

    nodes: Array

    @property
    def size(self) -> int:
        """Number of nodes."""
        return self.nodes.size

    def weights(self, points: Array) -> Weights:
        """Return the weights of points, (n, 1)."""
        before, share, inside = self._share(points[:, 0])
        if self.size == 1:
            return Weights(before[None], 1 - share[None], inside)
        return Weights(np.array([before, before + 1]), np.array([1 - share, share]), inside)

    def added(self, points: Array, values: Array, own: Array) -> Array:
        """Return the variance of an integrated Wiener process between two nodes; see `datasets.results.interpolation`.

        Errors (node, ..., 6) on several lines have one common intensity.
        """
        if self.size == 1:
            return np.zeros((len(points), 6))
        q = intensity(self.nodes, values, own, together=True).reshape(self.size - 1, 6)
        before, w, _ = self._share(points[:, 0])
        between = (np.diff(self.nodes)[before] ** 3 * w**2 * (1 - w) ** 2 / 3)[:, None]
        return np.where(between > 0, between * q[before], 0.0)

    def added_in_time(self, points: Array, values: Array, own: Array) -> Array:
        """Return `added` with the variance of a step between two instants; see `datasets.results.interpolation`."""
        added = self.added(points, values, own)
        if self.size == 1:
            return added
        before, w, _ = self._share(points[:, 0])
        square = steps(self.nodes, values, own, together=True).reshape(self.size - 1, 6)[before]
        between = ((w > 0) & (w < 1))[:, None]
        return np.asarray(added + np.where(between, variance_beside_a_step(w[:, None], square), 0.0))

    def _share(self, x: Array) -> tuple[NDArray[np.intp], Array, NDArray[np.bool_]]:
        t = self.nodes
        inside = (x >= t[0] - SAME) & (x <= t[-1] + SAME)
        if t.size == 1:
            return np.zeros(x.size, dtype=np.intp), np.zeros(x.size), inside
        before = np.clip(np.searchsorted(t, x, side="right") - 1, 0, t.size - 2)
        share = (x - t[before]) / (t[before + 1] - t[before])
        return before, np.clip(share, 0.0, 1.0), inside


@dataclass(frozen=True)
class Grid:
    """All combinations of some coordinates along each direction; the last direction counts fastest."""

    lines: tuple[Line, ...]

    @property
    def size(self) -> int:
        """Number of nodes."""
        return int(np.prod(self._shape))

    @property
    def _shape(self) -> tuple[int, ...]:
        return tuple(line.size for line in self.lines)

    def weights(self, points: Array) -> Weights:
        """Return the multilinear weights of points, (n, direction)."""
        found = self.lines[0].weights(points[:, :1])
        for k, line in enumerate(self.lines[1:], start=1):
            found = found.times(line.weights(points[:, k : k + 1]), line.size)
        return found

    def added(self, points: Array, values: Array, own: Array) -> Array:
        """Return the sum over the directions."""
        total = np.zeros((len(points), 6))
        for k, line in enumerate(self.lines):
            E, C = (np.moveaxis(each.reshape(*self._shape, *each.shape[1:]), k, 0) for each in (values, own))
            total += line.added(points[:, k : k + 1], E, C)
        return total


@dataclass(frozen=True)
class Scattered:
    """Positions in a volume, a plane or on a line, (node, 3), that are no grid: linear within a triangulation."""

    nodes: Array

    @property
    def size(self) -> int:
        """Number of nodes."""
        return len(self.nodes)

    @cached_property
    def _span(self) -> tuple[Array, Array, Array]:
        """Mean of the nodes, the directions in which they spread (direction, 3), and the nodes along them."""
        centre = self.nodes.mean(axis=0)
        _, size, rows = np.linalg.svd(self.nodes - centre, full_matrices=False)
        basis = rows[size > max(1e-6 * size.max(initial=0.0), SAME)]
        return centre, basis, (self.nodes - centre) @ basis.T

    @cached_property
    def _line(self) -> tuple[Line, NDArray[np.intp]]:
        along = self._span[2][:, 0] if len(self._span[1]) else np.zeros(1)
        order = np.argsort(along, kind="stable")
        return Line(along[order]), order

    @cached_property
    def _mesh(self) -> tuple[Delaunay, Array]:
        """Triangulation, and the facets of the hull: of a point x, the largest ``facets @ x`` is 1 on it."""
        own = self._span[2]
        jitter = np.random.default_rng(0).uniform(-_JITTER, _JITTER, own.shape) * np.ptp(own, axis=0)
        equations = ConvexHull(own).equations  # normal x + offset = 0; the mean of the nodes is the origin
        return Delaunay(own + jitter), -equations[:, :-1] / equations[:, -1:]

    def weights(self, points: Array) -> Weights:
        """Return the barycentric weights of points, (n, 3)."""
        centre, basis, own = self._span
        along = (points - centre) @ basis.T
        inside = np.linalg.norm(points - centre - along @ basis, axis=1) <= 10 * SAME
        if len(basis) < 2:
            line, order = self._line
            found = line.weights(along if len(basis) else np.zeros((len(points), 1)))
            return Weights(order[found.node], found.weight, found.inside & inside)
        mesh, facets = self._mesh
        simplex = mesh.find_simplex(along)
        beyond = np.flatnonzero(simplex < 0)
        if beyond.size:  # to the hull, along the line to the mean
            reach = np.concatenate([(part @ facets.T).max(axis=1) for part in _parts(along[beyond])])
            inside[beyond] &= reach <= 1 + _EDGE
            along[beyond] *= ((1 - _EDGE) / np.maximum(reach, 1 - _EDGE))[:, None]
            simplex[beyond] = mesh.find_simplex(along[beyond])
            lost = beyond[simplex[beyond] < 0]  # between the rounded facets: the simplex of the nearest node
            simplex[lost] = mesh.vertex_to_simplex[np.asarray(KDTree(own).query(along[lost])[1])]
        T = mesh.transform[simplex]
        first = np.einsum("nij,nj->in", T[:, :-1], along - T[:, -1])
        weight = np.clip(np.concatenate([first, 1 - first.sum(axis=0, keepdims=True)]), 0.0, 1.0)
        return Weights(mesh.simplices[simplex].T.astype(np.intp), weight / weight.sum(axis=0), inside)

    def added(self, points: Array, values: Array, own: Array) -> Array:
        """Return the variance for a mean square curvature, estimated at each node from its neighbours."""
        if len(self._span[1]) < 2:
            if len(self._span[1]) == 0:
                return np.zeros((len(points), 6))
            line, order = self._line
            along = (points - self._span[0]) @ self._span[1].T
            return line.added(along, values[order], own[order])
        found = self.weights(points)
        coordinates = self._span[2]
        at = found.of(coordinates)
        spread = np.einsum("kn,knd->n", found.weight, (coordinates[found.node] - at) ** 2)
        return np.asarray((0.5 * spread[:, None]) ** 2 * self._curvature(values, own))

    def _curvature(self, values: Array, own: Array) -> Array:
        """Return the mean square of the second derivative of each freedom, (6,); NaN where there are too few nodes."""
        x = self._span[2]
        count = min(NEIGHBOURS, self.size - 1)
        if count <= x.shape[1]:
            return np.full(6, np.nan)
        near = np.asarray(KDTree(x).query(x, k=count + 1)[1])[:, 1:]
        step = x[near] - x[:, None]
        plane = np.concatenate([np.ones((*near.shape, 1)), step], axis=2)
        weight = np.linalg.pinv(plane)[:, 0]  # of the neighbours, in the plane's value at the node
        lever = 0.5 * np.einsum("nk,nkd->n", weight, step**2)[:, None]
        misfit = values - np.einsum("nk,nkd->nd", weight, values[near])
        variance = np.diagonal(own, axis1=1, axis2=2)
        noise = variance + np.einsum("nk,nkd->nd", weight**2, variance[near])
        excess = np.maximum((misfit**2 - noise).sum(axis=0), 0.0)
        return np.asarray(excess / (lever**2).sum())


def of_targets(nodes: Array) -> tuple[Nodes, NDArray[np.intp]]:
    """Return the nodes of targets, (node, 3), and the order of the targets in them.

    A grid if the targets are all combinations of some coordinates, each once; else scattered nodes.
    """
    counts = np.round(nodes / SAME).astype(np.int64)
    steps, first, number = zip(
        *(np.unique(column, return_index=True, return_inverse=True) for column in counts.T), strict=True
    )
    shape = tuple(each.size for each in steps)
    if np.prod(shape) == len(nodes):
        flat = np.asarray(np.ravel_multi_index(number, shape))
        order = np.argsort(flat)
        if (flat[order] == np.arange(len(nodes))).all():
            return Grid(tuple(Line(nodes[row, k]) for k, row in enumerate(first))), order
    return Scattered(nodes), np.arange(len(nodes))


def _parts(points: Array) -> Iterator[Array]:
    """Yield 4096 points at a time, so that their intermediate results fit into the processor cache."""
    for k in range(0, len(points), 4096):
        yield points[k : k + 4096]


class Constant:
    """One measurement for all positions."""

    size = 1

    def weights(self, points: Array) -> Weights:
        """Return the weight 1 of the only node."""
        n = len(points)
        return Weights(np.zeros((1, n), dtype=np.intp), np.ones((1, n)), np.ones(n, dtype=bool))

    def added(self, points: Array, values: Array, own: Array) -> Array:  # noqa: ARG002 - nothing is interpolated
        """Return zeros."""
        return np.zeros((len(points), 6))
