"""The numbers of the unknowns of a problem: what is eliminated, and where derivatives belong in the sums."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from errormotion.estimation.blocks import Block, Index
from errormotion.estimation.linear.groups import Groups, Layout, labels
from errormotion.estimation.problem import Problem

__all__ = ["Numbering"]


@dataclass(frozen=True, eq=False)
class Numbering:
    """The numbers of the unknowns: rows of the eliminated block ``local``, and columns of the border.

    Attributes
    ----------
    local : int or None
        The block that is eliminated.
    border : list of ndarray, (size, width)
        The number of every unknown in the border, by block; q = not estimated. Empty for the local block.
    adjusted : list of ndarray, (k,)
        Numbers of the sources of the adjusted constants.
    size : int
        q, the size of the border.
    band : int
        How many rows further the coupling of the local block reaches; 0 = none.
    rows : ndarray of int, (n, w)
        Rows of the local block that each reading sees; w = 0 without one.
    shape : tuple of int
        (R, p) of the local block.
    columns : ndarray of int, (n, b)
        Numbers of the unknowns of the border that each reading sees.
    """

    local: int | None
    border: list[Index]
    adjusted: list[Index]
    size: int
    band: int
    rows: Index
    shape: tuple[int, int]
    columns: Index

    @classmethod
    def of(cls, problem: Problem) -> Numbering:
        """Return the numbering: the largest block without a group, and without random effects, is eliminated."""
        counts = [int(block.freed.sum()) for block in problem.unknowns]
        own = [k for k, block in enumerate(problem.unknowns) if not block.group and not any(block.component)]
        local = max(own, key=counts.__getitem__, default=None)
        position, border = 0, []
        for k, block in enumerate(problem.unknowns):
            number = np.zeros((0, 0), dtype=np.intp)
            if k != local:
                number = np.full(block.start.shape, -1, dtype=np.intp)
                number[block.freed] = position + np.arange(counts[k])
                position += counts[k]
            border.append(number)
        adjusted = []
        for constant in problem.adjusted.values():
            adjusted.append(position + np.arange(constant.sources))
            position += constant.sources
        for number in border:
            number[number < 0] = position
        n = len(problem.readings)
        seen = [border[k][block.index2].reshape(n, -1) for k, block in enumerate(problem.unknowns) if k != local] + [
            np.broadcast_to(its, (n, its.size)) for its in adjusted
        ]
        columns = np.concatenate([np.zeros((n, 0), dtype=np.intp), *seen], axis=1)
        if local is None:
            return cls(local, border, adjusted, position, 0, np.zeros((n, 0), dtype=np.intp), (0, 1), columns)
        block = problem.unknowns[local]
        R, p = block.start.shape
        return cls(local, border, adjusted, position, _band(block), block.index2, (R, p), columns)

    @cached_property
    def in_order(self) -> bool:
        """Whether each reading sees its own row of the local block, in their order."""
        return self.rows.shape == (self.shape[0], 1) and bool((self.rows[:, 0] == np.arange(self.shape[0])).all())

    @cached_property
    def same_columns(self) -> bool:
        """Whether all readings see the same unknowns of the border."""
        return self.columns.size > 0 and bool((self.columns == self.columns[0]).all())

    @cached_property
    def of_local(self) -> Groups:
        """Readings that see the same rows of the local block."""
        return Groups.of(labels(self.rows))

    @cached_property
    def of_border(self) -> Groups:
        """Readings that see the same unknowns of the border."""
        return Groups.of(labels(self.columns))

    @cached_property
    def of_both(self) -> Groups:
        """Readings that see the same rows and unknowns of the border."""
        return Groups.of(labels(np.stack([self.of_local.label, labels(self.columns)], axis=1)))

    def local_numbers(self, readings: Index) -> Index:
        """Return the numbers of the local unknowns that readings see, (k, w p)."""
        p = self.shape[1]
        return np.asarray((self.rows[readings][:, :, None] * p + np.arange(p)).reshape(len(readings), -1))

    @cached_property
    def into_border(self) -> Layout:
        """Where products (g, b, b) of derivatives by the border belong in D, (q + 1, q + 1)."""

        def at(first: Index) -> Index:
            columns = self.columns[first]
            return np.asarray(columns[:, :, None] * (self.size + 1) + columns[:, None, :])

        return Layout(self.of_border, at, self.columns.shape[1] ** 2)

    @cached_property
    def into_coupling(self) -> Layout:
        """Where products (g, w p, b) belong in G, (R, p, q + 1)."""

        def at(first: Index) -> Index:
            return np.asarray(self.local_numbers(first)[:, :, None] * (self.size + 1) + self.columns[first][:, None, :])

        return Layout(self.of_both, at, self.rows.shape[1] * self.shape[1] * self.columns.shape[1])

    @cached_property
    def into_band(self) -> Layout:
        """Where products (g, w p, w p) belong in the band of T, (d, R, p, p), and one place for those that do not."""
        (R, p), d = self.shape, self.band + 1

        def at(first: Index) -> Index:
            rows = self.rows[first]
            # Where a row lies behind, it is the transpose; further ahead than the band, nothing is coupled.
            ahead = rows[:, None, :] - rows[:, :, None]
            inside = (ahead >= 0) & (ahead < d)
            start = (ahead * R + rows[:, :, None])[:, :, None, :, None] * (p * p)
            found = np.where(inside[:, :, None, :, None], start + np.arange(p * p).reshape(p, 1, p), d * R * p * p)
            return found.reshape(len(rows), rows.shape[1] * p, -1)

        return Layout(self.of_local, at, (self.rows.shape[1] * p) ** 2)


def _band(block: Block) -> int:
    """Return the largest distance of rows that one reading sees."""
    index = block.index2
    if index.shape[1] == 1:
        return 0
    if block.weight is None:
        return int((index.max(axis=1) - index.min(axis=1)).max(initial=0))
    used = block.weight != 0
    high = np.where(used, index, -1).max(axis=1)
    low = np.where(used, index, len(block.start)).min(axis=1)
    return int(np.maximum(high - low, 0).max(initial=0))
