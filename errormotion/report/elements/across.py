"""Tables whose columns are the places along a dim, and whose rows are quantities there."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from errormotion.report import document
from errormotion.report.document import Block, Cell, Source
from errormotion.report.elements.tables import Column, filled
from errormotion.report.text import fixed


@dataclass(frozen=True)
class Across:
    """A table with a column for each place along a dim and a row for each quantity, such as the results by target.

    Attributes
    ----------
    caption : str
        `{name}` is replaced by an attribute of the dataset.
    rows : sequence of Column
        Quantities over the dim; those with one more dim have a row for each place along it, whose number replaces
        ``{}`` in their `head`. Uncertainties are left out, as are quantities that the dataset lacks.
    over : str
        Dim of the columns, which are numbered from 1.
    decimals : callable
        Returns the decimals of all rows without a `format`, from the dataset.
    most : int
        Columns of one table; more are in further tables.
    """

    caption: str
    rows: Sequence[Column]
    over: str
    decimals: Callable[[xr.Dataset], int]
    most: int = 8

    def blocks(self, source: Source, key: str) -> list[Block]:  # noqa: ARG002 - a table has no identifiers
        """Return the tables; nothing without known quantities over the dim."""
        ds = source.errors
        rows = [row for column in self.rows for row in self._rows(ds, column)]
        if not rows or not ds.sizes[self.over]:
            return []
        m = ds.sizes[self.over]
        parts = np.array_split(np.arange(m), math.ceil(m / self.most))
        caption = filled(self.caption, ds)
        return [
            document.Table(
                caption, ["", *(f"{k + 1}" for k in part)], [[name, *(cells[k] for k in part)] for name, cells in rows]
            )
            for part in parts
        ]

    def _rows(self, ds: xr.Dataset, column: Column) -> list[tuple[str, list[Cell | str]]]:
        """Return the rows of a quantity: name and cells."""
        quantity = column.read(ds)
        if quantity is None or self.over not in quantity.values.dims:
            return []
        values = np.atleast_2d(quantity.values.transpose(..., self.over).values.astype(float)) / quantity.size
        places, name = self.decimals(ds), column.title(quantity) if column.format else column.head or quantity.name
        return [
            (
                name.replace("{}", str(k + 1)),
                [column.cell(v, None, "") if column.format else fixed(v, places) for v in row],
            )
            for k, row in enumerate(values)
        ]
