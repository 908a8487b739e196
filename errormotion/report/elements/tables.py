"""Tables of a chapter as data: variables over the dims of a dataset, one row for each place."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets.results.places import place_of
from errormotion.report import document
from errormotion.report.document import Block, Cell, Source, estimate, noted
from errormotion.report.elements.quantities import Of, Quantity
from errormotion.report.text import DASH, fixed, integer, percent, significant

MISSING = "not part of this result"
"""Reason of a dash where the dataset lacks a variable."""

_MOST = 240
"""Rows of a table; more are in the dataset."""

REDUCTIONS: dict[str, Callable[[Array], float]] = {
    "rms": lambda values: float(np.sqrt(np.mean(np.square(values)))),
    "largest": lambda values: float(np.abs(values).max()),
    "lowest": lambda values: float(values.min()),
    "highest": lambda values: float(values.max()),
    "mean": lambda values: float(values.mean()),
    "median": lambda values: float(np.median(values)),
    "sum": lambda values: float(values.sum()),
    "first": lambda values: float(values[0]),
    "last": lambda values: float(values[-1]),
}
"""Reductions of the known values of one row over all dims that are not those of the rows."""

FORMATS: dict[str, Callable[[float], str]] = {"integer": integer, "percent": percent}
"""Formats of a number by name."""


@dataclass(frozen=True)
class Column(Of):
    """One column of a table.

    Attributes
    ----------
    head : str
        Its name; by default that of the variable. The unit is added. `{name}` is an attribute of the dataset.
    format : str or callable
        ``.2``: two decimals, ``3``: three significant digits, ``integer``, ``percent``, or a function of the value in
        the unit of the column. By default a value follows its uncertainty, else it has four significant digits.
    signed : bool
        Whether a positive value has a plus sign.
    reason : str
        Why a value is unknown: the footnote of its dash, or the name of a variable of texts over the rows.
    reduce : str
        How the values at one row become one number: a key of `REDUCTIONS`. The uncertainty is left out.
    note : str
        Name of a variable of texts over the rows: the footnote of a known value.
    optional : bool
        Whether the column is left out if the dataset lacks its variable, in place of dashes.
    """

    head: str = ""
    format: str | Callable[[float], str] = ""
    signed: bool = True
    reason: str = "not determined"
    reduce: str = ""
    note: str = ""
    optional: bool = False

    def title(self, quantity: Quantity | None) -> str:
        """Return the head of the column."""
        name = self.head or (quantity.name if quantity is not None else str(self.variable))
        unit = quantity.unit if quantity is not None else ""
        if unit and self.format != "percent" and "/" not in name and unit not in name:
            return f"{name} / {unit}"
        return name

    def cell(self, value: float, u: float | None, reason: str) -> Cell:
        """Return a cell; value and standard uncertainty in the unit of the column, None if it has no uncertainty."""
        if not np.isfinite(value):
            return Cell(DASH, reason=reason)
        if u is not None and not self.format:
            return estimate(value, 2 * u, signed=self.signed)
        if callable(self.format):
            return Cell(self.format(value))
        if self.format.startswith("."):
            return Cell(fixed(value, int(self.format[1:]), signed=self.signed))
        if self.format in FORMATS:
            return Cell(FORMATS[self.format](value))
        text = significant(value, int(self.format or 4))
        return Cell(f"+{text}" if self.signed and value > 0 else text)


@dataclass(frozen=True)
class KeyValue:
    """A number at the head of the chapter that is no figure of merit; nothing if it is unknown.

    Attributes
    ----------
    label : str
    value : Column
        A quantity of one value, or reduced to one.
    note : str or callable
        Below it; a function of the dataset.
    """

    label: str
    value: Column
    note: str | Callable[[xr.Dataset], str] = ""

    def key_figures(self, source: Source) -> list[document.KeyFigure]:
        """Return the number for the head of the chapter."""
        ds = source.errors
        quantity = self.value.read(ds)
        if quantity is None:
            return []
        cell = _single(self.value, quantity)
        note = self.note(ds) if callable(self.note) else self.note
        return [] if cell.text == DASH else [document.KeyFigure(self.label, cell, quantity.unit, note)]


def _name_of(ds: xr.Dataset, dims: Sequence[str], index: Sequence[int]) -> str:
    """Return a place in field units; along a single coordinate of texts its text alone, as the head names the dim."""
    if len(dims) == 1 and dims[0] in ds.coords and ds[dims[0]].dtype.kind in "UO":
        return str(ds[dims[0]].values[index[0]])
    return place_of(ds, dims, index)


@dataclass(frozen=True)
class Table:
    """A table with one row for each place along dims of the dataset.

    A variable that the dataset lacks is a column of dashes; without any of its variables, the table is left out.

    Attributes
    ----------
    caption : str
        `{name}` is replaced by an attribute of the dataset.
    columns : sequence of Column
    over : str or sequence of str
        Dims of the rows; the first of several dims groups the rows, unless it has a single place.
    head : str
        Name of the first column; by default that of the last dim.
    of : callable
        Returns the dataset that the table reads, made from that of the result; None for no table.
    place : callable
        ``place(dataset, dims, index)``: a row's name; by default the places along the dims in field units, or the text
        of a coordinate.
    where : callable
        Returns which rows are shown, a `DataArray` of bool over the dims of the rows.
    groups : sequence of (str, int)
        Second head: names over several columns, from the first column; `{name}` is replaced as in the caption.
    notes : sequence of str or callable
        Below the table; a function of the dataset returns several.
    absent : str
        A note in place of the table if there is nothing to show.
    total : str
        Name of a last row, in which the columns reduce the values of all rows; none by default.
    """

    caption: str
    columns: Sequence[Column]
    over: str | Sequence[str]
    head: str = ""
    of: Callable[[xr.Dataset], xr.Dataset | None] | None = None
    place: Callable[[xr.Dataset, Sequence[str], Sequence[int]], str] | None = None
    where: Callable[[xr.Dataset], xr.DataArray] | None = None
    groups: Sequence[tuple[str, int]] = ()
    notes: Sequence[str | Callable[[xr.Dataset], Sequence[str]]] = ()
    absent: str = ""
    total: str = ""

    def __post_init__(self) -> None:
        if not self.over:
            raise ValueError(
                f"table '{self.caption}': expected the dims of its rows (over), at least one; found none. Without a "
                "dim, state the values as figures or notes."
            )

    def blocks(self, source: Source, key: str) -> list[Block]:  # noqa: ARG002 - a table has no identifiers
        """Return the table; a note or nothing without its variables."""
        ds = source.errors if self.of is None else self.of(source.errors)
        if ds is None:
            return noted(self.absent)
        over = [self.over] if isinstance(self.over, str) else list(self.over)
        read = [(column, column.read(ds)) for column in self.columns]
        read = [(column, each) for column, each in read if each is not None or not column.optional]
        columns, found = [column for column, _ in read], [each for _, each in read]
        if not any(found) or not set(over) <= set(map(str, ds.sizes)):
            return noted(self.absent)
        place = self.place or _name_of
        shape = [ds.sizes[dim] for dim in over]
        shown = np.ones(shape, bool)
        if self.where is not None:
            shown = np.asarray(self.where(ds).transpose(*over).values, dtype=bool)
        made = [_column(ds, column, each, over, shape) for column, each in zip(columns, found, strict=True)]
        rows: list[list[Cell | str]] = []
        indices = np.argwhere(shown)
        if not len(indices):
            return noted(self.absent)
        last = None
        for index in indices[:_MOST]:
            if len(over) > 1 and shape[0] > 1 and index[0] != last:
                last = index[0]
                rows.append([place(ds, over[:1], index[:1])])
            own = slice(1, None) if len(over) > 1 else slice(None)
            name = place(ds, over[own], index[own]) or f"{over[-1]} {index[-1] + 1}"
            rows.append([name, *_once([column[tuple(index)] for column in made])])
        if self.total:
            whole = zip(columns, found, strict=True)
            rows.append([self.total, *(_single(each, q) if q and each.reduce else Cell("") for each, q in whole)])
        heads = [filled(column.title(each), ds) for column, each in zip(columns, found, strict=True)]
        more = [f"{len(indices) - _MOST} more rows are in the dataset."] if len(indices) > _MOST else []
        notes = [note for each in self.notes for note in (each(ds) if callable(each) else [each])]
        head = [self.head or over[-1], *heads]
        groups = [(filled(name, ds), span) for name, span in self.groups]
        return [document.Table(filled(self.caption, ds), head, rows, groups, notes=[*notes, *more])]


def _single(column: Column, quantity: Quantity) -> Cell:
    """Return the cell of a quantity of one value, or reduced to one."""
    cell: Cell = _column(xr.Dataset(coords={"place": [0]}), column, quantity, ["place"], [1])[0]
    return cell


def _once(cells: Sequence[Cell]) -> list[Cell]:
    """Return the cells of a row; if all are dashes for one reason, the first one states it."""
    if len({cell.reason for cell in cells}) == 1 and all(cell.text == DASH for cell in cells):
        return [cells[0], *[Cell(DASH)] * (len(cells) - 1)]
    return list(cells)


def filled(template: str, ds: xr.Dataset) -> str:
    """Return a text with attributes of a dataset in the place of their names in braces."""
    for name, value in ds.attrs.items():
        if isinstance(value, str):
            template = template.replace(f"{{{name}}}", value)
    return template


def _column(
    ds: xr.Dataset, column: Column, quantity: Quantity | None, over: Sequence[str], shape: Sequence[int]
) -> np.ndarray:
    """Return the cells of a column over the dims of the rows."""
    cells = np.empty(shape, dtype=object)
    if quantity is None:
        for index in np.ndindex(*shape):
            cells[index] = Cell(DASH, reason=MISSING)
        return cells
    values, u = (_over(each, ds, over) for each in (quantity.values, quantity.u))
    reasons, remarks = (
        _over(column.picked(ds[name]), ds, over) if name in ds.variables else None
        for name in (column.reason, column.note)
    )
    assert values is not None
    spare = [str(dim) for dim in quantity.values.dims if dim not in over and quantity.values.sizes[dim] > 1]
    if spare and not column.reduce:
        raise ValueError(
            f"Column '{quantity.name}': it has several values over {', '.join(spare)} in each row; expected 'reduce' "
            f"({', '.join(REDUCTIONS)}), or 'select'"
        )
    for index in np.ndindex(*shape):
        each = values[index]
        if each.dtype.kind in "UO":
            cells[index] = Cell(text) if (text := str(each.ravel()[0])) else Cell(DASH, reason=column.reason)
            continue
        why = column.reason if reasons is None else str(reasons[index].ravel()[0]) or "not determined"
        numbers = np.asarray(each, dtype=float).ravel() / quantity.size
        if column.reduce:
            known = numbers[np.isfinite(numbers)]
            number = REDUCTIONS[column.reduce](known) if known.size else np.nan
            cell = column.cell(number, None, why)
        else:
            spread = None if u is None else float(u[index].ravel()[0]) / quantity.size
            cell = column.cell(float(numbers[0]), spread, why)
        remark = "" if remarks is None or cell.text == DASH else str(remarks[index].ravel()[0])
        cells[index] = replace(cell, reason=remark) if remark else cell
    return cells


def _over(values: xr.DataArray | None, ds: xr.Dataset, over: Sequence[str]) -> np.ndarray | None:
    """Return values with the dims of the rows first, repeated along those that they lack."""
    if values is None:
        return None
    spread = values.variable.set_dims(
        {**{dim: ds.sizes[dim] for dim in over if dim not in values.dims}, **values.sizes}
    )  # type: ignore[no-untyped-call]
    return np.asarray(spread.transpose(*over, ...).values)
