"""A problem linearised about values of its unknowns: derivatives, whitening, and the sums of the normal equations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.errors import FitError
from errormotion.estimation.blocks import Block, Index, Table
from errormotion.estimation.derivatives import along, by_rows, column
from errormotion.estimation.linear.groups import products, rows_summed
from errormotion.estimation.linear.normal import Normal, factorised
from errormotion.estimation.linear.numbering import Numbering
from errormotion.estimation.problem import READINGS, Problem, Unknown

__all__ = ["Linear", "by_slot", "linearised", "white_of"]

_EPS = float(np.finfo(float).eps)
OPERATIONS = 8.0
"""Rounding errors of a residual, in units of those of the readings and unknowns in it."""


@dataclass(frozen=True, eq=False)
class Linear:
    """A problem linearised about values of its unknowns, in units of the noise.

    Attributes
    ----------
    residual : ndarray, (n, m)
        0 where missing.
    used : ndarray of bool, (n, m)
    whitener : ndarray, (n, m, m)
        The inverse of a square root of the covariance of the residuals of each reading.
    local : ndarray, (n, m, w, p)
        Derivatives by the rows of the eliminated block; w = 0 without one.
    border : ndarray, (n, m, b)
        Derivatives by the b unknowns of the border that a reading sees.
    """

    problem: Problem
    at: Unknown
    numbering: Numbering
    residual: Array
    used: NDArray[np.bool_]
    whitener: Array
    local: Array
    border: Array

    @property
    def chi2(self) -> float:
        """Sum of the squared whitened residuals."""
        return float(np.vdot(self.residual, self.residual))

    @cached_property
    def rounding(self) -> float:
        """Sum of squares of the errors in the whitened residuals by rounding of readings and unknowns."""
        noise, number = self.problem.noise, self.numbering
        y = np.abs(column(self.problem.y))
        if noise.sd is None:
            size = np.abs(self.whitener).sum(axis=2) * y.max(axis=1, initial=0.0, keepdims=True)
        else:
            # A number with the standard deviation s contributes at most y / s.
            sd = column(np.asarray(noise.sd, dtype=float))
            most = np.max(y / np.where(sd > 0, sd, np.inf), axis=1, initial=0.0, keepdims=True)
            size = np.where(self.used, most, 0.0)
        if number.local is not None:
            table = np.abs(self.at.tables[number.local]).reshape(-1, 1)
            groups = number.of_local
            its = groups.each(np.abs(self.local_matrix)) @ table[number.local_numbers(groups.first)]
            size = size + groups.spread(its, size.shape[1])[..., 0]
        return float(np.sum(np.square(OPERATIONS * _EPS * size)))

    def normal(self) -> tuple[Normal, Array, Array]:
        """Return the factorised normal equations, and their right sides (R, p) and (q,) for the next step."""
        return self.factorised(), *self.downhill()

    def factorised(self) -> Normal:
        """Return the factorised normal equations."""
        number, q = self.numbering, self.numbering.size
        band, G, D = self.sums()
        if number.local is not None:
            block = self.problem.unknowns[number.local]
            prior = np.where(block.freed, block.information, 1.0)
            band[0] += prior[:, :, None] * np.eye(prior.shape[1])
        D[np.arange(q), np.arange(q)] += self.border_prior()[0]
        return factorised(band, G, D, self.gauge())

    def downhill(self) -> tuple[Array, Array]:
        """Return the right sides (R, p) and (q,) of the normal equations for the next step."""
        number = self.numbering
        a, b = self.gradient(self.residual)
        if number.local is not None:
            block = self.problem.unknowns[number.local]
            a = np.where(block.freed, a + block.information * (self.at.tables[number.local] - block.start), 0.0)
        prior, offset = self.border_prior()
        return -a, -(b + prior * offset)

    def sums(self) -> tuple[list[Array], Array, Array]:
        """Return the sums of products of derivatives: the band of T, G, and D."""
        number, q = self.numbering, self.numbering.size
        (R, p), d = number.shape, number.band + 1
        A, B = self.local_matrix, self.border
        D = number.into_border.summed(B, B, (q + 1) ** 2).reshape(q + 1, q + 1)[:q, :q]
        if number.local is None:
            return [np.zeros((0, 1, 1))], np.zeros((0, 1, q)), D
        if number.in_order and (number.same_columns or not q):
            transposed = np.swapaxes(A, 1, 2)
            G = np.zeros((q + 1, R, p))
            np.add.at(G, number.columns[0], np.moveaxis(transposed @ B, 2, 0))
            return [transposed @ A], np.ascontiguousarray(np.moveaxis(G[:q], 0, 2)), D
        band = number.into_band.summed(A, A, d * R * p * p + 1)[:-1].reshape(d, R, p, p)
        G = number.into_coupling.summed(A, B, R * p * (q + 1)).reshape(R, p, q + 1)[..., :q]
        return list(band), G, D

    def gradient(self, residual: Array, rows: Index | None = None) -> tuple[Array, Array]:
        """Return ``J' r`` for whitened numbers (n, m) or (n, m, k): (R, p[, k]) and (q[, k]).

        With ``rows``, the numbers are those of these readings only.
        """
        only: Any = slice(None) if rows is None else rows
        single = residual.ndim == 2
        r = residual[..., None] if single else residual
        number, k, q = self.numbering, r.shape[2], self.numbering.size
        groups = number.of_border.among(rows)
        product = products(groups.each(self.border[only]), groups.each(r))
        b = rows_summed(number.columns[only][groups.first], product, q + 1)[:q]
        if number.local is None:
            a = np.zeros((0, 1, k))
        elif number.in_order and rows is None:
            a = np.swapaxes(self.local_matrix, 1, 2) @ r
        else:
            R, p = number.shape
            groups = number.of_local.among(rows)
            product = products(groups.each(self.local_matrix[only]), groups.each(r))
            first = groups.first if rows is None else rows[groups.first]
            a = rows_summed(number.local_numbers(first), product, R * p).reshape(R, p, k)
        return (a[..., 0], b[..., 0]) if single else (a, b)

    def effect(self, a: Array, b: Array, rows: Index | None = None) -> Array:
        """Return ``J x`` for changes of the unknowns (R, p, k) and (q, k): the change of the residuals, (n, m, k).

        With ``rows``, of these readings only.
        """
        only: Any = slice(None) if rows is None else rows
        number, m = self.numbering, self.used.shape[1]
        padded = np.concatenate([b, np.zeros((1, b.shape[1]))])
        groups = number.of_border.among(rows)
        columns = number.columns[only][groups.first]
        effect = groups.spread(groups.each(self.border[only]) @ padded[columns], m)
        if number.local is not None:
            groups = number.of_local.among(rows)
            its = a[number.rows[only][groups.first]].reshape(len(groups.first), self.local_matrix.shape[2], a.shape[2])
            effect = effect + groups.spread(groups.each(self.local_matrix[only]) @ its, m)
        return np.asarray(effect)

    @property
    def local_matrix(self) -> Array:
        """Derivatives by the local unknowns that a reading sees, (n, m, w p)."""
        return self.local.reshape(*self.used.shape, self.local.shape[2] * self.local.shape[3])

    def moved(self, a: Array, b: Array) -> Unknown:
        """Return the values of the unknowns after a step (R, p), (q,)."""
        padded = np.append(b, 0.0)
        tables = []
        for k, table in enumerate(self.at.tables):
            step = a if k == self.numbering.local else padded[self.numbering.border[k]]
            tables.append(table + step)
        return Unknown(tables, [z + b[n] for z, n in zip(self.at.adjusted, self.numbering.adjusted, strict=True)])

    def border_prior(self) -> tuple[Array, Array]:
        """Return the information of the priors of the border, and the distance from their centre, (q,)."""
        q = self.numbering.size
        information, offset = np.zeros(q + 1), np.zeros(q + 1)
        for block, table, n in zip(self.problem.unknowns, self.at.tables, self.numbering.border, strict=True):
            if n.size:
                information[n], offset[n] = block.information, table - block.start
        for z, n in zip(self.at.adjusted, self.numbering.adjusted, strict=True):
            information[n], offset[n] = 1.0, z
        return information[:q], offset[:q]

    def prior_square(self) -> float:
        """Return the sum of squares of the distances from the priors, in units of their standard deviations."""
        information, offset = self.border_prior()
        total = float(information @ np.square(offset))
        if self.numbering.local is not None:
            block = problem_block(self)
            total += float(np.sum(block.information * np.square(self.at.tables[self.numbering.local] - block.start)))
        return total

    def gauge(self) -> Array | None:
        """Return the changes of the border that no reading sees, (q, g); None without."""
        if not self.problem.gauge:
            return None
        q = self.numbering.size
        count = len(next(iter(self.problem.gauge.values())))
        gauge = np.zeros((q + 1, count))
        for name, n in zip(self.problem.unknowns._fields, self.numbering.border, strict=True):
            if n.size and name in self.problem.gauge:
                gauge[n] = np.moveaxis(self.problem.gauge[name], 0, -1)
        return gauge[:q]


def problem_block(linear: Linear) -> Block:
    """Return the eliminated block."""
    if linear.numbering.local is None:
        raise FitError("no block is eliminated", code="estimation.no_block")
    block: Block = linear.problem.unknowns[linear.numbering.local]
    return block


def linearised(problem: Problem, at: Unknown, numbering: Numbering | None = None) -> Linear:
    """Return a problem linearised about values of its unknowns."""
    number = Numbering.of(problem) if numbering is None else numbering
    values = [*at.tables, *problem.constant_tables(at)]
    count, tables = len(problem.unknowns), problem.tables
    rows = [table.rows(value) for table, value in zip(tables, values, strict=True)]
    raw = problem.known(rows)
    used = np.isfinite(raw)
    n, m = raw.shape
    given: Mapping[str, Array] = {}
    if problem.derivatives is not None:
        given = problem.derivatives(problem.y, *problem.named(rows[:count], rows[count:]))
    J = _derivatives(problem, tables, values, given)
    whitener = _whitener(problem, rows, used, given.get(READINGS))
    r = white_of(whitener, np.where(used, raw, 0.0))
    parts = []
    local = np.zeros((n, m, 0, 1))
    for k, block in enumerate(problem.unknowns):
        white = white_of(whitener, J[k])
        if k == number.local:
            local = white * _weight(block)
            continue
        parts.append((white if block.weight is None else white * block.weight[:, None, :, None]).reshape(n, m, -1))
    for k, constant in problem.adjusted.items():
        factor = constant.factor[constant.index2]  # (n, w, width, k)
        each = J[count + list(problem.adjusted).index(k)]
        its = (each if constant.weight is None else each * constant.weight[:, None, :, None]).reshape(n, m, -1)
        parts.append(white_of(whitener, its @ factor.reshape(n, its.shape[2], -1)))
    border = np.concatenate(parts, axis=2) if parts else np.zeros((n, m, 0))
    return Linear(problem, at, number, r, used, whitener, local, border)


def _weight(block: Block) -> Array:
    """Return the factors of the derivatives by the rows that a reading sees: weights, and 0 for what is not estimated.

    (n, 1, w, p), or (n, 1, w, 1) if they are the same for all columns.
    """
    free = block.freed if (block.freed != block.freed[:, :1]).any() else block.freed[:, :1]
    numbers = free[block.index2]
    return np.asarray(numbers if block.weight is None else numbers * block.weight[..., None], dtype=float)[:, None]


def white_of(whitener: Array, values: Array) -> Array:
    """Return numbers of readings (n, m, ...) in units of their noise, by their whitener (n, m, m)."""
    if whitener.shape[1] == 1:
        return np.asarray(whitener.reshape(-1, *[1] * (values.ndim - 1)) * values)
    flat = values.reshape(*values.shape[:2], -1)
    return np.asarray((whitener @ flat).reshape(values.shape))


def _derivatives(problem: Problem, tables: list[Table], values: list[Array], given: Mapping[str, Array]) -> list[Array]:
    """Return the derivatives by all unknowns, then by the adjusted constants, as the equation sees their rows.

    (n, m, w, width); w = 1 for a sum of rows.
    """
    count = len(problem.unknowns)
    names = [*problem.unknowns._fields, *getattr(problem.constants, "_fields", ())]
    needed = [*range(count), *(count + k for k in problem.adjusted)]
    known: dict[int, Array] = {}
    for k in needed:
        if names[k] in given:
            J = given[names[k]]
            known[k] = J[:, :, None, :] if J.ndim == 3 else J
    wanted = [k for k in needed if k not in known]
    derivatives = by_rows(lambda each: problem.evaluate(problem.y, each), tables, values, wanted, weighed=False)
    by_number = {**known, **dict(zip(wanted, derivatives, strict=True))}
    return [by_number[k] for k in needed]


def by_slot(J: Array, table: Table) -> Array:
    """Return analytic derivatives (n, m, width) or (n, m, w, width) by the rows w that each reading sees."""
    whole = J[:, :, None, :] if J.ndim == 3 else J
    return whole if table.weight is None else whole * table.weight[:, None, :, None]


def _whitener(problem: Problem, rows: list[Array], used: NDArray[np.bool_], by_readings: Array | None) -> Array:
    """Return the inverse square roots of the covariances of the residuals, (n, m, m); 0 for missing ones.

    With ``L = dr/dy``, which is 1 for a reading minus its prediction, the covariance is that of the reading times L
    from both sides.
    """
    y = column(problem.y)
    scale = np.broadcast_to(np.asarray(problem.reading_scale, dtype=float), (y.shape[1],))
    shape = problem.y.shape
    L = by_readings
    if L is None:
        L = along(lambda moved: problem.evaluate(moved.reshape(shape), rows), y, scale)
    root = problem.noise.effect(L)
    m = used.shape[1]
    if m == 1:
        V = np.sum(np.square(root), axis=2, keepdims=True)
        return np.asarray(np.where(used[..., None], 1.0 / np.sqrt(np.where(used[..., None], V, 1.0)), 0.0))
    V = root @ np.swapaxes(root, 1, 2)
    both = used[:, :, None] & used[:, None, :]
    root = np.linalg.cholesky(np.where(both, V, np.eye(m)))
    return np.asarray(np.where(used[:, None, :], np.linalg.inv(root), 0.0) * used[:, :, None])
