"""Division of moves, so that straight lines and arcs between corrected points follow the corrected path.

A line between corrected ends follows the corrected path if the correction changes linearly along it; an arc through
three corrected points follows it if the correction transforms the arc into another arc. The deviation is examined at
points that are at most one sampling interval apart.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.compensation.program.reading.items import LINE
from errormotion.compensation.program.writing.path import Indices, Path
from errormotion.errors import ProgramError

MAX_PIECES = 10_000
"""Maximum number of pieces of one move."""

_POINTS = 200_000  # evaluated at a time


class Values(Protocol):
    """Corrections at points."""

    @property
    def offset(self) -> Array:
        """Translations added to the commands (n, 3), m."""

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Whether the correction is known at the points (n,)."""


Correcting = Callable[[Array, Array], Values]
"""Corrections of positions of the machine axes (n, 3), m, of tools with offsets (n, 3), m."""


@dataclass
class Division:
    """Pieces of moves; move k has the pieces ``first[k]`` to ``first[k + 1] - 1``.

    Attributes
    ----------
    first : array (move + 1,)
    u : array (piece,)
        Fraction of the move at the end of each piece; the last is 1.
    offset : array (piece, 3)
        Correction at the end of each piece, in units of the program.
    start : array (move, 3)
        Correction at the start of each divided move and of each arc; NaN for others.
    middle : array (piece, 3)
        Correction in the middle of each piece of an arc; NaN for lines.
    shifted : array (move,)
        Whether the correction of an arc is constant.
    valid : array (move,)
        Whether the correction is known at all points of the move.
    """

    first: Indices
    u: Array
    offset: Array
    start: Array
    middle: Array
    shifted: NDArray[np.bool_]
    valid: NDArray[np.bool_]


class _Field:
    """The correction along the moves of a path."""

    def __init__(self, path: Path, correcting: Correcting) -> None:
        self.path, self._correcting = path, correcting
        self.valid: NDArray[np.bool_] = np.ones(len(path), bool)

    def at(self, index: Indices, u: Array) -> Array:
        """Return the corrections (n, 3) at fractions of moves, in units of the program."""
        found: Array = np.empty((len(u), 3))
        for first in range(0, len(u), _POINTS):
            part = slice(first, first + _POINTS)
            k = index[part]
            places = self.path.machine(k, self.path.points(k, u[part]))
            values = self._correcting(places, self.path.tool[k])
            found[part] = self.path.own(k, values.offset)
            if not values.valid.all():
                self.valid[k[~values.valid]] = False
        if not np.isfinite(found).all():
            raise ProgramError(
                "the correction is unknown at some positions of the program", code="program.correction.unknown"
            )
        return found


def divide(path: Path, correcting: Correcting, tolerance: float, step: float, digits: Array) -> Division:
    """Divide moves.

    Parameters
    ----------
    path : Path
    correcting : callable
    tolerance : float
        Largest distance of the result from the corrected path, m.
    step : float
        Largest distance between two points at which it is examined, m.
    digits : array (move,)
        Last printed digit of each move, in units of the program.

    Raises
    ------
    ProgramError
        More than `MAX_PIECES` for one move, or an unknown correction.
    """
    field = _Field(path, correcting)
    counts = np.ones(len(path), np.intp)
    lines = np.flatnonzero(path.kind <= LINE)
    cuts = lines[path.kind[lines] == LINE]
    counts[cuts] = np.maximum(1, np.ceil(path.length[cuts] / step)).astype(np.intp)
    _bounded(counts, 100 * MAX_PIECES)
    start: Array = np.full((len(path), 3), np.nan)
    nodes: list[tuple[Indices, Array, Array, Array]] = []
    simple = lines[counts[lines] == 1]
    if simple.size:
        one = np.ones(simple.size)
        nodes.append((simple, one, field.at(simple, one), np.full((simple.size, 3), np.nan)))
    long = lines[counts[lines] > 1]
    for part in _parts(long, counts):
        nodes.append(_lines(field, part, counts[part], start, tolerance))
    shifted = np.zeros(len(path), bool)
    if path.arcs.size:
        nodes += _arcs(field, start, shifted, tolerance, step, digits)
    k, u, offset, middle = (np.concatenate(each) for each in zip(*nodes, strict=True))
    order = np.lexsort((u, k))
    first = np.concatenate([[0], np.cumsum(np.bincount(k, minlength=len(path)))])
    return Division(first, u[order], offset[order], start, middle[order], shifted, field.valid)


def _bounded(counts: Indices, most: int) -> None:
    if counts.size and counts.max() > most:
        raise ProgramError(
            f"a move requires {counts.max()} points, of which at most {most} are allowed: "
            "increase the tolerance or the sampling interval",
            code="program.points.too_many",
        )


def _parts(moves: Indices, counts: Indices) -> list[Indices]:
    """Return moves in parts of a bounded number of points."""
    if not moves.size:
        return []
    number = np.cumsum(counts[moves] + 1) // _POINTS
    return np.split(moves, np.flatnonzero(np.diff(number)) + 1)


def _lines(field: _Field, moves: Indices, counts: Indices, start: Array, tolerance: float) -> Any:
    path = field.path
    first = np.concatenate([[0], np.cumsum(counts + 1)])
    index = np.repeat(moves, counts + 1)
    u = (np.arange(first[-1]) - np.repeat(first[:-1], counts + 1)) / np.repeat(counts, counts + 1)
    offset = field.at(index, u)
    start[moves] = offset[first[:-1]]
    span = path.end[moves] - path.start[moves]
    scaled = offset * path.scale[index, None]
    direction = span / np.linalg.norm(span, axis=1)[:, None]
    kept = _greedy(scaled, first, direction, tolerance)
    return index[kept], u[kept], offset[kept], np.full((int(kept.sum()), 3), np.nan)


def _greedy(offset: Array, first: Indices, direction: Array, tolerance: float) -> NDArray[np.bool_]:
    """Return which samples are ends of pieces; each piece has the maximum length within the tolerance."""
    begin, last = first[:-1], first[1:] - 1
    kept: NDArray[np.bool_] = np.zeros(len(offset), np.bool_)
    kept[last] = True
    own = np.repeat(np.arange(begin.size), np.diff(first))
    share = (np.arange(len(offset)) - begin[own]) / (last - begin)[own]
    chord = offset[begin[own]] + share[:, None] * (offset[last] - offset[begin])[own]
    far = _distance(offset - chord, direction[own]) > tolerance
    for k in np.unique(own[far]):  # the moves that need several pieces
        anchor = begin[k]
        while anchor < last[k]:
            good = anchor + 1
            step = last[k] - anchor  # try the rest first, then halves: smooth corrections need few steps
            while step > 0 and good < last[k]:
                end = min(good + step, last[k])
                if end > good and _straight(offset[anchor : end + 1], direction[k], tolerance):
                    good = end
                else:
                    step //= 2
            kept[good] = True
            anchor = good
    return kept


def _straight(offset: Array, direction: Array, tolerance: float) -> bool:
    """Return whether the corrections (n, 3) along a line follow their chord within the tolerance."""
    share = np.linspace(0.0, 1.0, len(offset))[:, None]
    chord = offset[0] + share * (offset[-1] - offset[0])
    return bool((_distance(offset - chord, direction) <= tolerance).all())


def _distance(d: Array, direction: Array) -> Array:
    """Return the lengths of vectors (n, 3) across the direction of a move (3,) or (n, 3)."""
    along = np.einsum("ni,ni->n", d, np.broadcast_to(direction, d.shape))
    found: Array = np.sqrt(np.maximum(np.einsum("ni,ni->n", d, d) - along * along, 0.0))
    return found


def _arcs(
    field: _Field, start: Array, shifted: NDArray[np.bool_], tolerance: float, step: float, digits: Array
) -> list[tuple[Indices, Array, Array, Array]]:
    path, moves = field.path, field.path.arcs
    found = []
    turns = np.abs(path.sweep[moves])
    pieces = np.ceil(turns / np.pi - 1e-9).astype(np.intp)
    first = True
    while moves.size:
        _bounded(pieces, MAX_PIECES)
        points = np.ceil(path.length[moves] / pieces / step).astype(np.intp)
        points = 2 * np.maximum(2, np.minimum((points + 1) // 2, MAX_PIECES))
        fits = np.zeros(moves.size, bool)
        rest = np.arange(moves.size)
        total = np.cumsum(pieces * points + 1) // _POINTS
        for part in np.split(rest, np.flatnonzero(np.diff(total)) + 1):
            good, nodes = _pieces(
                field, moves[part], pieces[part], points[part], start, shifted, tolerance, digits, first
            )
            fits[part] = good
            found.append(nodes)
        first = False
        moves, pieces = moves[~fits], pieces[~fits]
        pieces = np.maximum(pieces + 1, np.ceil(1.3 * pieces).astype(np.intp))
    return found


def _pieces(
    field: _Field,
    moves: Indices,
    pieces: Indices,
    points: Indices,
    start: Array,
    shifted: NDArray[np.bool_],
    tolerance: float,
    digits: Array,
    first_time: bool,
) -> tuple[NDArray[np.bool_], tuple[Indices, Array, Array, Array]]:
    """Return which arcs follow the corrected path with ``pieces`` pieces, and their pieces.

    Each piece is examined at ``points`` intervals, an even number.
    """
    path = field.path
    count = pieces * points + 1
    begin = np.concatenate([[0], np.cumsum(count)])
    index = np.repeat(moves, count)
    own = np.repeat(np.arange(moves.size), count)
    j = np.arange(begin[-1]) - begin[own]
    u = j / (count - 1)[own]
    offset = field.at(index, u)
    start[moves] = offset[begin[:-1]]
    if first_time:
        rounded = np.round(offset / digits[index, None])
        low = np.minimum.reduceat(rounded, begin[:-1])
        high = np.maximum.reduceat(rounded, begin[:-1])
        shifted[moves] = (low == high).all(axis=1)
    target = path.flat(index, path.points(index, u) + offset)
    piece = np.minimum(j // points[own], pieces[own] - 1)
    s = begin[own] + piece * points[own]
    e, m = s + points[own], s + points[own] // 2
    deviation = path.scale[index] * from_arc(target, target[s], target[m], target[e])
    worst = np.maximum.reduceat(deviation, begin[:-1])
    good = (worst <= tolerance) | shifted[moves]
    ends = (j > 0) & (j % points[own] == 0) & good[own]
    ends &= ~shifted[index] | (u == 1.0)
    where = np.flatnonzero(ends)
    return good, (index[where], u[where], offset[where], offset[m[where - 1]])


def from_arc(point: Array, s: Array, m: Array, e: Array) -> Array:
    """Return the distance of points from arcs through s, m and e (n, 3), the axes of the plane first.

    The third coordinate of an arc changes linearly with its angle.
    """
    chord = e[:, :2] - s[:, :2]
    length = np.maximum(np.linalg.norm(chord, axis=1), 1e-300)
    along = chord / length[:, None]
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    mean = (s[:, :2] + e[:, :2]) / 2
    h = np.einsum("ni,ni->n", m[:, :2] - mean, across)
    q = point[:, :2] - mean
    x, y = np.einsum("ni,ni->n", q, along), np.einsum("ni,ni->n", q, across)
    half = length / 2
    h = np.where(np.abs(h) < 1e-12 * length, 1e-12 * length, h)
    # Centre at (0, yc): half^2 + yc^2 = (h - yc)^2. The distance is written without differences of large radii.
    yc = (h * h - half * half) / (2 * h)
    radius = np.abs(h - yc)
    outside = (x * x + y * y - 2 * y * yc - half * half) / (np.hypot(x, y - yc) + radius)
    turn = np.arctan2(x, np.sign(h) * (y - yc))
    whole = np.arctan2(half, -np.sign(h) * yc)
    part = (turn / whole + 1) / 2
    axial = point[:, 2] - (s[:, 2] + part * (e[:, 2] - s[:, 2]))
    found: Array = np.hypot(outside, axial)
    return found
