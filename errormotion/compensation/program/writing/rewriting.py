"""Reading, correction and output of a program in parts, so that memory is limited."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from errormotion.arrays import Array
from errormotion.compensation.program.reading.items import LINE, RAPID, Item, Move, Setting, Text, Unchanged
from errormotion.compensation.program.reading.reader import Reader
from errormotion.compensation.program.writing.dividing import Correcting, Division, divide
from errormotion.compensation.program.writing.path import Indices, Path
from errormotion.compensation.program.writing.writer import DECIMALS, Writer
from errormotion.errors import ProgramError
from errormotion.instruments.nc_words import MAX_BLOCK

MAX_WRITTEN = 20_000_000
"""Maximum number of lines of the new program."""

SHOWN = 4000
"""Maximum number of points of the path for the page."""

_MOVES = 10_000  # in memory at a time
_ITEMS = 100_000
_ANGLE = 0.2  # between points of arcs for the page, rad


@dataclass
class Summary:
    """Summary of the correction of a program.

    Attributes
    ----------
    read, written : int
        Lines.
    cuts, rapids : int
        Corrected moves.
    divided : int
        Divided cuts.
    unchanged : dict of str to (int, int)
        Moves without correction: number of each kind, and line of the first.
    uncorrected : (int, int)
        Cuts that start at a position without correction: number, and line of the first.
    outside : (int, int)
        Moves outside the measured range, with the correction at its limit: number, and line of the first.
    after_end : (int, int)
        Lines after the end of the program (M2, M30, ``%``), which are not corrected: number, and line of the first.
    largest : float
        Largest correction, m.
    largest_line : int
    length : float
        Length of all cuts, m.
    seconds : float
        Duration of all cuts and dwells at the programmed feed, s.
    unfed : int
        Cuts with unknown feed, which ``seconds`` does not include.
    positions, offsets : array (n, 3)
        Positions of the machine axes on the path, and corrections there, m; at most `SHOWN`.
    tools : array (n, 3)
        Offset of the tool at each position, m.
    lines : array (n,)
        Line of the program at each position; 0 for the end of a rapid move.
    """

    read: int = 0
    written: int = 0
    cuts: int = 0
    rapids: int = 0
    divided: int = 0
    unchanged: dict[str, tuple[int, int]] = field(default_factory=dict)
    uncorrected: tuple[int, int] = (0, 0)
    outside: tuple[int, int] = (0, 0)
    after_end: tuple[int, int] = (0, 0)
    largest: float = 0.0
    largest_line: int = 0
    length: float = 0.0
    seconds: float = 0.0
    unfed: int = 0
    positions: Array = field(default_factory=lambda: np.empty((0, 3)))
    offsets: Array = field(default_factory=lambda: np.empty((0, 3)))
    tools: Array = field(default_factory=lambda: np.empty((0, 3)))
    lines: Array = field(default_factory=lambda: np.empty(0))


class Rewriting:
    """Correction of one program.

    Parameters
    ----------
    reader : Reader
    correcting : callable
    tolerance : float
         Largest distance of the new cuts from the corrected path, in addition to the last printed digit, m.
    step : float
        Largest distance between two points at which it is examined, m.
    """

    def __init__(self, reader: Reader, correcting: Correcting, *, tolerance: float = 1e-6, step: float = 2e-3) -> None:
        if not (math.isfinite(tolerance) and 1e-8 <= tolerance <= 1e-3):
            raise ProgramError(
                f"tolerance: expected 0.01 um to 1 mm; found {1e6 * tolerance:g} um", code="program.tolerance.outside"
            )
        if not (math.isfinite(step) and 1e-5 <= step <= 1.0):
            raise ProgramError(
                f"sampling interval: expected 0.01 mm to 1 m; found {1e3 * step:g} mm", code="program.step.outside"
            )
        self._reader, self._correcting = reader, correcting
        self._tolerance, self._step = tolerance, step
        self._writer = Writer()
        self._every, self._count = 1, 0
        self._shown: list[Array] = []
        self.summary = Summary()

    def lines(self, source: Iterable[str]) -> Iterator[str]:
        """Yield the lines of the new program, without their ends.

        Raises
        ------
        ProgramError
            A line is not supported, or its effect is not determined.
        """
        items: list[Item] = []
        moves: list[Move] = []
        for item in self._reader.items(source):
            items.append(item)
            if isinstance(item, Move):
                moves.append(item)
            if len(moves) >= _MOVES or len(items) >= _ITEMS:
                yield from self._written(items, moves)
                items, moves = [], []
        yield from self._written(items, moves)
        self._finish()

    def _written(self, items: list[Item], moves: list[Move]) -> Iterator[str]:
        summary, writer = self.summary, self._writer
        first: list[int] = []
        if moves:
            path = Path(moves)
            scale = {unit: 10.0**-decimals for unit, decimals in DECIMALS.items()}
            digits = np.array([scale[move.frame.scale] for move in moves])
            division = divide(path, self._correcting, self._tolerance, self._step, digits)
            self._note(moves, path, division)
            first, u = division.first.tolist(), division.u.tolist()
            offset, middle = division.offset.tolist(), division.middle.tolist()
            start, shifted = division.start.tolist(), division.shifted.tolist()
        number = 0
        for item in items:
            summary.read += 1
            if isinstance(item, Move):
                part = slice(first[number], first[number + 1])
                made = writer.move(
                    item, u[part], offset[part], middle[part], start[number], shifted[number], self._tolerance
                )
                number += 1
                summary.written += len(made)
                if summary.written > MAX_WRITTEN:
                    raise ProgramError(
                        f"the new program would exceed {MAX_WRITTEN} lines: increase the tolerance",
                        code="program.result.too_long",
                    )
                if max(map(len, made)) > MAX_BLOCK >= len(item.block.text):
                    raise ProgramError(
                        f"line {item.block.line} would exceed {MAX_BLOCK} characters, which controls do not read",
                        code="program.line.too_long",
                    )
                yield from made
                continue
            summary.written += 1
            if isinstance(item, Text):
                summary.seconds += item.dwell
                yield writer.text(item)
            elif isinstance(item, Unchanged):
                count, line = summary.unchanged.get(item.kind, (0, item.line))
                summary.unchanged[item.kind] = count + 1, line
                yield writer.unchanged(item)
            elif isinstance(item, Setting):
                yield writer.setting(item)

    def _note(self, moves: list[Move], path: Path, division: Division) -> None:
        """Add the moves to the summary."""
        summary = self.summary
        index = np.repeat(np.arange(len(path)), np.diff(division.first))
        size = np.linalg.norm(division.offset, axis=1) * path.scale[index]
        worst = int(size.argmax())
        if size[worst] > summary.largest:
            summary.largest, summary.largest_line = float(size[worst]), moves[index[worst]].block.line
        outside = np.flatnonzero(~division.valid)
        if outside.size:
            count, line = summary.outside
            summary.outside = count + outside.size, line or moves[outside[0]].block.line
        cut = path.kind != RAPID
        summary.cuts += int(cut.sum())
        summary.rapids += int((~cut).sum())
        summary.length += float(path.length[cut].sum())
        mode = np.array([move.feed_mode for move in moves])
        feed = np.array([move.feed for move in moves])
        speed = np.array([move.speed for move in moves])
        with np.errstate(divide="ignore", invalid="ignore"):
            seconds = 60 * np.where(mode == 93, 1.0, path.length / path.scale) / feed
            seconds = np.where(mode == 95, seconds / speed, seconds)[cut]
        known = np.isfinite(seconds)
        summary.seconds += float(seconds[known].sum())
        summary.unfed += int((~known).sum())
        self._show(moves, path, division)

    def _show(self, moves: list[Move], path: Path, division: Division) -> None:
        """Keep points of the path for the page, thinned out: ends of pieces of lines, and points on arcs."""
        pieces = np.diff(division.first)
        counts = np.where(path.kind > LINE, np.ceil(np.abs(path.sweep) / _ANGLE - 1e-9), pieces).astype(np.intp)
        ends = np.cumsum(counts)
        chosen = np.flatnonzero((self._count + np.arange(ends[-1])) % self._every == 0)
        self._count += int(ends[-1])
        k = np.searchsorted(ends, chosen, side="right")
        number = chosen - (ends - counts)[k]
        u = np.where(path.kind[k] > LINE, (number + 1) / counts[k], division.u[division.first[k] + number % pieces[k]])
        positions = path.machine(k, path.points(k, u))
        offset = path.vector(k, _between(division, k, u))
        lines = np.where(path.kind[k] == RAPID, 0, np.array([move.block.line for move in moves])[k])
        self._shown.append(np.hstack([positions, offset, path.tool[k], lines[:, None]]))
        while sum(map(len, self._shown)) > SHOWN:
            self._shown = [np.concatenate(self._shown)[::2]]
            self._every *= 2

    def _finish(self) -> None:
        summary, writer = self.summary, self._writer
        summary.divided = writer.divided
        summary.after_end = self._reader.after_end
        summary.uncorrected = writer.uncorrected, writer.first_uncorrected
        if self._shown:
            rows = np.concatenate(self._shown)
            summary.positions, summary.offsets, summary.tools = rows[:, :3], rows[:, 3:6], rows[:, 6:9]
            summary.lines = rows[:, 9]


def _between(division: Division, k: Indices, u: Array) -> Array:
    """Return corrections at fractions of moves, interpolated between ends and middles of their pieces."""
    size = np.diff(division.first)
    index = np.repeat(np.arange(len(size)), size)
    inside = np.isfinite(division.start[:, 0])  # for undivided moves only the end is known
    before = np.concatenate([[0.0], division.u[:-1]])
    before[division.first[:-1]] = 0.0
    arcs = np.isfinite(division.middle[:, 0])
    keys = np.concatenate(
        [3.0 * np.flatnonzero(inside), 3 * index + division.u, (3 * index + (before + division.u) / 2)[arcs]]
    )
    values = np.concatenate([division.start[inside], division.offset, division.middle[arcs]])
    order = np.argsort(keys, kind="stable")
    found: Array = np.stack([np.interp(3.0 * k + u, keys[order], values[order, axis]) for axis in range(3)], axis=1)
    return found
