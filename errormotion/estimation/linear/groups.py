"""Readings that see the same rows of tables, side by side: sums over them are products of matrices.

The touches of a cycle see the same unknowns. Their derivatives J as a matrix of its own have the normal matrix J' J and
the gradient J' r, in a time that is that of the products alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from errormotion.arrays import Array
from errormotion.estimation.blocks import Index

__all__ = ["Groups", "Layout", "labels", "products", "rows_summed"]

_LARGEST = 2**62
_SIZE = 1e7
"""Largest number of products that are held at a time."""


@dataclass(frozen=True, eq=False)
class Groups:
    """Readings in groups of at most c that have a label in common; several groups may have the same one.

    Attributes
    ----------
    label : ndarray of int, (n,)
    member : ndarray of int, (g, c)
        The readings of each group; n = none.
    """

    label: Index
    member: Index

    @classmethod
    def of(cls, label: Index) -> Groups:
        """Return readings in groups of the mean size, so that hardly more numbers are stored than there are."""
        n = label.size
        order = np.argsort(label, kind="stable")
        ordered = label[order]
        start = np.flatnonzero(np.append(True, ordered[1:] != ordered[:-1])[:n])
        count = np.diff(np.append(start, n))
        c = -(-n // max(start.size, 1))
        parts = -(-count // max(c, 1))
        within = np.arange(n) - np.repeat(start, count)
        group = np.repeat(np.cumsum(parts) - parts, count) + within // max(c, 1)
        member = np.full((int(parts.sum()), c), n, dtype=np.intp)
        member[group, within % max(c, 1)] = order
        return cls(label, member)

    @cached_property
    def first(self) -> Index:
        """A reading of each group, (g,)."""
        return self.member[:, 0]

    @cached_property
    def _plain(self) -> bool:
        """Whether the groups are the readings in their order."""
        return self.member.size == self.label.size and bool((np.diff(self.member.ravel()) == 1).all())

    def among(self, rows: Index | None) -> Groups:
        """Return the groups of some of the readings, numbered among these."""
        return self if rows is None else Groups.of(self.label[rows])

    def each(self, values: Array) -> Array:
        """Return numbers of readings (n, m, ...) as those of groups (g, c m, ...); 0 where there is no reading."""
        g, c = self.member.shape
        shape = (g, c * values.shape[1], *values.shape[2:])
        if self._plain:
            return values.reshape(shape)
        members = values.take(np.minimum(self.member, max(len(values) - 1, 0)), axis=0)
        members[self.member == len(values)] = 0.0
        return members.reshape(shape)

    def spread(self, values: Array, m: int) -> Array:
        """Return numbers of groups (g, c m, ...) as those of readings (n, m, ...)."""
        g, c = self.member.shape
        each = values.reshape(g, c, m, *values.shape[2:])
        if self._plain:
            return each.reshape(g * c, *each.shape[2:])
        known = self.member < self.label.size
        rows = np.empty((self.label.size, *each.shape[2:]))
        rows[self.member[known]] = each[known]
        return rows


class Layout:
    """Where the products of two derivatives, ``a' b`` summed over the readings of a group, belong in an array.

    Parameters
    ----------
    groups : Groups
    at : callable
        From a reading of each group to the numbers (g, i, j) of the places.
    size : int
        Number of products of a group, i j. Unless there are very many, the places are computed once.
    """

    def __init__(self, groups: Groups, at: Callable[[Index], Index], size: int) -> None:
        self.groups, self.at, self.size = groups, at, size
        self._known: list[Index] = []

    def summed(self, a: Array, b: Array, total: int) -> Array:
        """Return the sums of the products of derivatives (n, m, i) and (n, m, j) at their places, (total,)."""
        step = max(int(_SIZE // max(self.size, 1)), 1)
        if len(self.groups.member) <= step:
            self._known = self._known or [self.at(self.groups.first)]
            return _summed(self._known[0], products(self.groups.each(a), self.groups.each(b)), total)
        sums = np.zeros(total)
        for start in range(0, len(self.groups.member), step):
            part = replace(self.groups, member=self.groups.member[start : start + step])
            sums += _summed(self.at(part.first), products(part.each(a), part.each(b)), total)
        return sums


def products(a: Array, b: Array) -> Array:
    """Return ``a' b`` for the matrices of groups, (g, l, i) and (g, l, j)."""
    if a.shape[1] == 1:
        return np.asarray(a[:, 0, :, None] * b[:, 0, None, :])
    return np.asarray(np.swapaxes(a, 1, 2) @ b)


def rows_summed(index: Index, values: Array, size: int) -> Array:
    """Return the sums of rows (g, l, k) by index (g, l), (size, k)."""
    k = values.shape[2]
    return _summed(index[:, :, None] * k + np.arange(k), values, size * k).reshape(size, k)


def _summed(index: Index, values: Array, size: int) -> Array:
    """Return the sums of values by index, (size,)."""
    return np.asarray(np.bincount(index.ravel(), weights=values.ravel(), minlength=size), dtype=float)


def labels(index: Index) -> Index:
    """Return numbers (n,) that are equal where the rows of an index (n, w) are."""
    label, highest = np.zeros(len(index), dtype=np.intp), 1
    if not index.size or (index == index[0]).all():
        return label
    for column in index.T:
        size = int(column.max(initial=0)) + 1
        if highest * size > _LARGEST:
            label = np.asarray(np.unique(label, return_inverse=True)[1], dtype=np.intp).reshape(-1)
            highest = int(label.max(initial=0)) + 1
        label = label * size + column
        highest *= size
    return label
