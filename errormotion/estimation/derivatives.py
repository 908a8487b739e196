"""Derivatives of an equation by the rows of tables that it receives, by central differences.

The rows of all readings change together, so that the number of evaluations is twice the number of columns of a table,
whatever the number of unknowns. The error of a difference over the step h is of the order ``h^2 + eps / h`` relative to
the scale on which the equation bends; it is smallest, about 4e-11, for ``h = eps^(1/3)``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from errormotion.arrays import Array
from errormotion.estimation.blocks import Table

__all__ = ["along", "by_rows", "column"]

STEP = float(np.finfo(float).eps) ** (1 / 3)
"""Step of the differences, relative to the scale."""


def column(values: Array) -> Array:
    """Return values of readings as (n, m): one column if there is one number each."""
    return values[:, None] if values.ndim == 1 else values


def by_rows(
    equation: Callable[[list[Array]], Array],
    tables: Sequence[Table],
    values: Sequence[Array],
    which: Sequence[int],
    *,
    weighed: bool = True,
) -> list[Array]:
    """Return the derivatives by the rows of some tables.

    Parameters
    ----------
    equation : callable
        From the rows of all tables to (n,) or (n, m).
    tables : sequence of Table
    values : sequence of ndarray, (size, width)
        Their values.
    which : sequence of int
        The tables to differentiate by.
    weighed : bool
        Whether the derivatives by a sum of rows are those by each row; otherwise by the sum, w = 1.

    Returns
    -------
    list of ndarray, (n, m, w, width)
        Of the tables ``which``; w = 1 for one row a reading.
    """
    rows = [table.rows(value) for table, value in zip(tables, values, strict=True)]
    derivatives = []
    for k in which:
        table, seen = tables[k], rows[k]
        width = values[k].shape[1]
        steps = STEP * np.broadcast_to(np.asarray(table.scale, dtype=float), (width,))
        summed = seen.ndim == 2
        slots = 1 if summed else seen.shape[1]
        parts: list[Array] = []
        if not width:
            derivatives.append(np.zeros((*column(equation(rows)).shape, slots, 0)))
            continue
        for slot in range(slots):
            for col in range(width):
                at: Any = (slice(None), col) if summed else (slice(None), slot, col)
                parts.append(_difference(equation, rows, k, at, float(steps[col])))
        J = np.stack(parts, axis=-1)
        J = J.reshape(*J.shape[:2], slots, width)
        if weighed and summed and table.weight is not None:
            J = J * table.weight[:, None, :, None]
        derivatives.append(J)
    return derivatives


def along(equation: Callable[[Array], Array], y: Array, scale: Array) -> Array:
    """Return the derivatives of an equation by the r numbers of each reading, (n, m, r); ``scale`` (r,)."""
    parts = []
    for k in range(y.shape[1]):
        step = STEP * float(scale[k])
        up, down = y.copy(), y.copy()
        up[:, k] += step
        down[:, k] -= step
        parts.append((column(equation(up)) - column(equation(down))) / (up[:, k] - down[:, k])[:, None])
    return np.stack(parts, axis=-1)


def _difference(equation: Callable[[list[Array]], Array], rows: list[Array], k: int, at: Any, step: float) -> Array:
    """Return the derivative by one column of the rows of table k, (n, m)."""
    changed = []
    for sign in (1.0, -1.0):
        moved = rows[k].copy()
        moved[at] += sign * step
        changed.append((moved[at], column(equation([*rows[:k], moved, *rows[k + 1 :]]))))
    (high, above), (low, below) = changed
    return np.asarray((above - below) / (high - low)[:, None])  # the step as rounded
