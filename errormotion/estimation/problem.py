"""A least-squares problem stated by its equation."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.estimation.blocks import Constant, Noise, Table
from errormotion.estimation.derivatives import column

__all__ = ["READINGS", "Problem", "Unknown"]

READINGS = "readings"
"""Name of the derivatives by the readings among analytic ones."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Problem:
    """Readings, and the equation that they fulfil but for their noise.

    Attributes
    ----------
    equation : callable
        ``equation(y, x, c)`` returns the residuals, (n,) or (n, m), which are 0 without noise: reading minus predicted,
        or any other condition. y are the readings as given; x and c are named tuples of the same types as
        ``unknowns`` and ``constants``, with the rows that each reading sees in place of the tables.
    readings : ndarray, (n,) or (n, r)
        NaN = missing. A missing number of a vector reading makes the residuals that depend on it missing.
    unknowns : named tuple of Block
    constants : named tuple of Constant
        May be empty.
    noise : Noise
    reading_scale : float or ndarray, (r,)
        The change of a reading over which the equation bends noticeably; see `Table.scale`.
    gauge : mapping of str to ndarray, (g, size, width), optional
        Changes of unknowns by name that no reading sees, such as a motion of a whole network.
    derivatives : callable, optional
        ``derivatives(y, x, c)`` returns analytic derivatives of the residuals, (n, m, width) or (n, m, w, width), by
        name, for any of the unknowns and of the adjusted constants, and as `READINGS` those by the numbers of the
        readings, (n, m, r); those of the others are differences.
    constant_derivatives : callable, optional
        The same for any of the constants that are not adjusted.
    linear : bool
        Whether the derivatives, and the effect of the noise on the residuals, do not depend on the unknowns: they are
        computed once, and one step solves the problem.
    settled : callable, optional
        ``settled(problem, x)`` returns the tables of unknowns that are preferred among those which differ along the
        gauge only, such as a network moved to its nominal positions. It is applied after each step of a fit, since the
        gauge is linear and a motion is not.
    """

    equation: Callable[[Array, Any, Any], Array]
    readings: Array
    unknowns: Any
    constants: Any = ()
    noise: Noise
    reading_scale: float | Array = 1.0
    gauge: Mapping[str, Array] | None = None
    derivatives: Callable[[Array, Any, Any], Mapping[str, Array]] | None = None
    constant_derivatives: Callable[[Array, Any, Any], Mapping[str, Array]] | None = None
    linear: bool = False
    settled: Callable[[Problem, Any], Any] | None = None

    @cached_property
    def y(self) -> Array:
        """Readings with 0 for missing ones, in their own shape."""
        return np.where(np.isfinite(self.readings), self.readings, 0.0)

    @cached_property
    def start(self) -> Unknown:
        """Start of all unknowns, and 0 for the adjusted constants."""
        return Unknown(
            [block.start.copy() for block in self.unknowns], [np.zeros(c.sources) for c in self.adjusted.values()]
        )

    @cached_property
    def adjusted(self) -> dict[int, Constant]:
        """Constants that the readings may improve, by their position."""
        return {k: constant for k, constant in enumerate(self.constants) if constant.adjust and constant.sources}

    def constant_tables(self, at: Unknown) -> list[Array]:
        """Return the tables of the constants, with the adjusted ones at their present values."""
        tables = [constant.value for constant in self.constants]
        for (k, constant), z in zip(self.adjusted.items(), at.adjusted, strict=True):
            tables[k] = constant.value + constant.factor @ z
        return tables

    def named(self, x: list[Array], c: list[Array]) -> tuple[Any, Any]:
        """Return values as the named tuples that the equation receives."""
        return _like(self.unknowns, x), _like(self.constants, c)

    def evaluate(self, y: Array, rows: list[Array]) -> Array:
        """Return the residuals for the rows of all unknowns and constants."""
        count = len(self.unknowns)
        return self.equation(y, *self.named(rows[:count], rows[count:]))

    @property
    def tables(self) -> list[Table]:
        """All tables: unknowns, then constants."""
        return [*self.unknowns, *self.constants]

    def residuals(self, at: Unknown) -> Array:
        """Return the residuals (n, m); NaN where a reading is missing."""
        values = [*at.tables, *self.constant_tables(at)]
        return self.known([table.rows(value) for table, value in zip(self.tables, values, strict=True)])

    def known(self, rows: list[Array]) -> Array:
        """Return the residuals for rows, (n, m); NaN where a reading is missing."""
        residual = column(self.evaluate(self.y, rows))
        missing = ~np.isfinite(column(self.readings))
        if not missing.any():
            return residual
        if residual.shape[1] == missing.shape[1]:
            return np.where(missing, np.nan, residual)
        return np.where(missing.any(axis=1, keepdims=True), np.nan, residual)

    def without(self, wrong: NDArray[np.bool_]) -> Problem:
        """Return the problem without the readings ``wrong``, in the shape of the readings or (n,)."""
        mask = wrong if wrong.shape == self.readings.shape else np.broadcast_to(wrong[:, None], self.readings.shape)
        return replace(self, readings=np.where(mask, np.nan, self.readings))


@dataclass(frozen=True, eq=False)
class Unknown:
    """Values of all unknowns: the table of each block, and the sources of each adjusted constant."""

    tables: list[Array]
    adjusted: list[Array]


def _like(named: Any, values: list[Array]) -> Any:
    """Return values as the named tuple of the same type."""
    return type(named)(*values) if hasattr(named, "_fields") else tuple(values)
