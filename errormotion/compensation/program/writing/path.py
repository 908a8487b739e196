"""Moves as arrays: their points in coordinates of the program and of the machine."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.compensation.program.reading.frames import Frame
from errormotion.compensation.program.reading.items import LINE, PLANES, Move

Indices = NDArray[np.intp]


class Path:
    """Moves of a program.

    Attributes
    ----------
    kind : array (move,)
    start, end : array (move, 3)
        Units of the program.
    scale : array (move,)
        Unit of the program, m.
    length : array (move,)
        m.
    """

    def __init__(self, moves: Sequence[Move]) -> None:
        self.kind: NDArray[Any] = np.array([m.kind for m in moves])
        self.start: Array = np.array([m.start for m in moves], float).reshape(-1, 3)
        self.end: Array = np.array([m.end for m in moves], float).reshape(-1, 3)
        frames: dict[int, int] = {}
        known: list[Frame] = []
        self.frame: Indices = np.empty(len(moves), np.intp)
        for number, move in enumerate(moves):
            index = frames.get(id(move.frame))
            if index is None:
                index = frames[id(move.frame)] = len(known)
                known.append(move.frame)
            self.frame[number] = index
        self.frames = known
        self.scale: Array = np.array([f.scale for f in known])[self.frame]
        self._turn: Array = np.array([f.turn for f in known])[self.frame]
        self._shift: Array = np.array([f.machine((0.0, 0.0, 0.0)) for f in known])[self.frame]
        self.tool: Array = np.array([f.tool for f in known])[self.frame]
        self.arcs: Indices = np.flatnonzero(self.kind > LINE)
        self._sweep: Array = np.zeros(len(moves))
        self._centre: Array = np.zeros((len(moves), 2))
        self._axes: Indices = np.zeros((len(moves), 3), np.intp)
        for number in self.arcs.tolist():
            move = moves[number]
            self._sweep[number], self._centre[number], self._axes[number] = move.sweep, move.centre, PLANES[move.plane]
        self.length: Array = self.scale * np.linalg.norm(self.end - self.start, axis=1)
        if self.arcs.size:
            k = self.arcs
            axial = (self.end - self.start)[k, self._axes[k, 2]]
            self.length[k] = self.scale[k] * np.hypot(self.radius(k) * self._sweep[k], axial)

    def __len__(self) -> int:
        return len(self.kind)

    @property
    def sweep(self) -> Array:
        """Angles of the arcs with their signs, rad; 0 for lines."""
        return self._sweep

    def radius(self, index: Indices) -> Array:
        """Return the radii of arcs at their starts, in units of the program."""
        found: Array = np.linalg.norm(self.flat(index, self.start[index])[:, :2] - self._centre[index], axis=1)
        return found

    def flat(self, index: Indices, points: Array) -> Array:
        """Return points (n, 3) of arcs with the axes of their planes first."""
        found: Array = np.take_along_axis(points, self._axes[index], axis=1)
        return found

    def points(self, index: Indices, u: Array) -> Array:
        """Return the points (n, 3) of moves at a fraction of each, in units of the program."""
        start, end = self.start[index], self.end[index]
        found: Array = start + u[:, None] * (end - start)
        found[u == 1.0] = end[u == 1.0]
        turned = np.flatnonzero((self.kind[index] > LINE) & (u != 0.0) & (u != 1.0))
        if turned.size:
            k, part = index[turned], u[turned]
            axes, centre = self._axes[k], self._centre[k]
            s = self.flat(k, start[turned])[:, :2] - centre
            e = self.flat(k, end[turned])[:, :2] - centre
            r = np.linalg.norm(s, axis=1)
            r = r + part * (np.linalg.norm(e, axis=1) - r)
            angle = np.arctan2(s[:, 1], s[:, 0]) + part * self._sweep[k]
            found[turned, axes[:, 0]] = centre[:, 0] + r * np.cos(angle)
            found[turned, axes[:, 1]] = centre[:, 1] + r * np.sin(angle)
        return found

    def machine(self, index: Indices, points: Array) -> Array:
        """Return the positions of the machine axes (n, 3) at points of the program, m."""
        return self._rotated(index, points * self.scale[index, None], 1.0) + self._shift[index]

    def vector(self, index: Indices, vectors: Array) -> Array:
        """Return vectors (n, 3) of the program in machine axes, m."""
        return self._rotated(index, vectors * self.scale[index, None], 1.0)

    def own(self, index: Indices, vectors: Array) -> Array:
        """Return vectors (n, 3) of machine axes, m, in coordinates of the program."""
        return self._rotated(index, vectors, -1.0) / self.scale[index, None]

    def _rotated(self, index: Indices, v: Array, sense: float) -> Array:
        c, s = self._turn[index, 0], sense * self._turn[index, 1]
        if not s.any():
            return v
        return np.stack([c * v[:, 0] - s * v[:, 1], s * v[:, 0] + c * v[:, 1], v[:, 2]], axis=1)
