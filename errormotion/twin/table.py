"""Pieces on the table of the gantry, and their scans by the line profiler during a pass of the carriage."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import BenchError
from errormotion.twin.artefacts.pieces import Artefact, circular_pocket, swept
from errormotion.twin.crossbeam import Crossbeam
from errormotion.twin.sensors.profiler import Profiler

#: Default distance of two artefacts, m.
SPACING = 0.2
#: Margin of a scan beyond the artefact, m: an artefact deviates from its position by 0.2 mm (one sigma), and the
#: profiler, tilted by some mrad, measures 20 mm up and down.
SCAN_MARGIN = 3e-3
#: Lines per block; their noise does not depend on the start of a stream.
CHUNK = 64


@dataclass(frozen=True)
class Target:
    """A piece on the table.

    Attributes
    ----------
    artefact : Artefact
        Its shape.
    pose : ndarray, (4, 4)
        In the machine, m.
    position : float
        Of the axis over its middle, m.
    """

    artefact: Artefact
    pose: Array
    position: float

    @property
    def span(self) -> tuple[float, float]:
        """Lowest and highest position of the axis at which the profiler may measure it, m."""
        half = self.artefact.half_size[1] + SCAN_MARGIN
        return self.position - half, self.position + half


@dataclass(frozen=True)
class Table:
    """Pieces on the table under the line profiler of a crossbeam.

    Attributes
    ----------
    crossbeam : Crossbeam
        Carries the profiler.
    targets : sequence of Target
        By their position; no two overlap.
    """

    crossbeam: Crossbeam
    targets: Sequence[Target]

    def __post_init__(self) -> None:
        ordered = sorted(self.targets, key=lambda target: target.position)
        for one, other in pairwise(ordered):
            if one.span[1] > other.span[0]:
                apart = one.span[1] - one.position + other.position - other.span[0]
                raise BenchError(
                    f"expected pieces {apart * 1e3:.0f} mm or more apart along Y; found {one.artefact.name} at "
                    f"{one.position:g} m and {other.artefact.name} at {other.position:g} m",
                    code="virtual.pieces.too_close",
                )
        object.__setattr__(self, "targets", tuple(ordered))

    def runs(self, y: Array) -> Iterator[tuple[slice, Target | None]]:
        """Yield slices of increasing positions (n,) of the axis in order, each with its piece, None without one."""
        first = 0
        for target in self.targets:
            start, end = (int(index) for index in np.searchsorted(y, target.span))
            if first < start:
                yield slice(first, start), None
            if start < end:
                yield slice(start, end), target
            first = max(first, end)
        if first < y.size:
            yield slice(first, y.size), None

    def scan(self, target: Target, profiler: Profiler, t: Array, positions: Array, key: tuple[int, ...]) -> Array:
        """Return the lines that the profiler measures on a piece, each with the error at its time.

        Parameters
        ----------
        target : Target
            The piece.
        profiler : Profiler
            The sensor.
        t : ndarray, (n,)
            Time of each line since the start of the warm-up, s; cold before 0.
        positions : ndarray, (n, 3)
            Commanded X, Y and Z, m.
        key : tuple of int
            Key of the noise.

        Returns
        -------
        ndarray, (n, point)
            Heights, m; NaN = none.
        """
        single = len(t) == 1
        if single:  # two lines are needed for the direction of the feed
            t, positions = np.repeat(t, 2), positions + np.array([[0.0, 0.0, 0.0], [0.0, 1e-6, 0.0]])
        lines = self.crossbeam.lines(self.crossbeam.carriage_at(t, positions), target.pose, lift=positions[:, 2])
        heights = profiler.scan(target.artefact, lines, key=key)
        return heights[:1] if single else heights


def set_table(crossbeam: Crossbeam, seed: int, positions: Sequence[float], pocket: float | None = None) -> Table:
    """Return a table with a swept free form at each position of the axis, m, and optionally a circular pocket.

    The free forms are misaligned below the profiler by `Crossbeam.artefact_pose`; the pocket was cut by the cold
    machine itself at the position ``pocket`` and Z = 0.

    Raises
    ------
    BenchError
        Two of them overlap.
    """
    shape = swept()
    targets = [Target(shape, crossbeam.artefact_pose(seed, position), position) for position in positions]
    if pocket is not None:
        over = pocket - float(crossbeam.pose[1, 3])  # position at which the profiler is over the middle of the pocket
        targets.append(Target(circular_pocket(), crossbeam.pocket_pose(pocket), over))
    return Table(crossbeam, targets)


def default_positions(travel: tuple[float, float]) -> list[float]:
    """Return the positions of artefacts in a travel, 200 mm apart and 200 mm from both ends, m."""
    n = int(round((travel[1] - travel[0]) / SPACING, 6))
    return [round(travel[0] + SPACING * k, 9) for k in range(1, n)]
