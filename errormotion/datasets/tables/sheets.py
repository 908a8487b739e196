"""Tables in spreadsheets: .xlsx, .xlsm, .xlsb, .xls and .ods."""

from __future__ import annotations

import io
import zlib
from collections.abc import Sequence
from datetime import date, datetime, time, timedelta
from pathlib import Path
from zipfile import BadZipFile, ZipFile

import numpy as np

from errormotion.arrays import Array
from errormotion.datasets.files.tomlfile import nearest
from errormotion.datasets.tables import recognition
from errormotion.datasets.tables.format import Format
from errormotion.datasets.tables.numbers import signs
from errormotion.datasets.tables.sheet_cells import MAX_CELLS, count_cells
from errormotion.datasets.tables.table import Cells, Table, named, same
from errormotion.errors import DatasetError

MAX_UNPACKED = 1 << 29
"""Largest sum of the sizes of the parts of a packed file, bytes."""


def sheet_table(data: bytes, path: Path, form: Format) -> Table:
    """Return the table of a sheet: the stated one, or the only one with rows of numbers.

    Raises
    ------
    DatasetError
        The file cannot be read, has no such sheet, no sheet with numbers, or several.
    """
    tables = sheet_tables(data, path, form)
    if len(tables) > 1:
        found = ", ".join(f"'{table.form.sheet}'" for table in tables)
        raise DatasetError(
            f"{path}: expected one sheet with a table; found {found}. Set format.sheet in the map",
            code="file.sheet.several",
        )
    return tables[0]


def sheet_tables(data: bytes, path: Path, form: Format) -> list[Table]:
    """Return the tables of all sheets with rows of numbers, or of the stated one.

    Raises
    ------
    DatasetError
        The file cannot be read, has no such sheet, or no sheet with numbers.
    """
    from python_calamine import CalamineError, CalamineWorkbook

    try:
        if data.startswith(b"PK"):
            _require_small(data, path)
        _require_few(data, path, form.sheet)
        book = CalamineWorkbook.from_filelike(io.BytesIO(data))
        names = book.sheet_names
        wanted = [form.sheet] if form.sheet else names
        if form.sheet and form.sheet not in names:
            raise DatasetError(
                f"{path}: no sheet '{form.sheet}'; {nearest(form.sheet, names)}", code="file.sheet.unknown"
            )
        tables = [table for name in wanted if (table := _table(book, name, path, form)) is not None]
    except (
        CalamineError,
        BadZipFile,
        EOFError,
        NotImplementedError,
        OSError,
        RuntimeError,
        ValueError,
        zlib.error,
    ) as error:
        raise DatasetError(
            f"{path}: cannot be read as a spreadsheet: {error}. Is it complete?", code="file.unreadable"
        ) from error
    if not tables:
        raise DatasetError(
            f"{path}: expected rows of numbers in sheet {', '.join(wanted)}; found none", code="file.no_numbers"
        )
    return tables


def _require_small(data: bytes, path: Path) -> None:
    """Raise DatasetError if the parts of a packed file are larger than `MAX_UNPACKED`, whatever it states."""
    rest = MAX_UNPACKED
    with ZipFile(io.BytesIO(data)) as parts:
        for part in parts.infolist():
            with parts.open(part) as file:
                while piece := file.read(1 << 20):
                    rest -= len(piece)
                    if rest < 0:
                        raise DatasetError(
                            f"{path}: expected at most {MAX_UNPACKED} bytes when unpacked; found more",
                            code="file.too_large",
                        )


def _require_few(data: bytes, path: Path, sheet: str) -> None:
    """Raise DatasetError if sheets have more than `MAX_CELLS` cells, or cannot be read."""
    count = count_cells(data, sheet)
    if isinstance(count, str):
        raise ValueError(count)
    if count is None or count > MAX_CELLS:
        raise DatasetError(
            f"{path}: expected at most {MAX_CELLS} cells, empty ones between others included; found more. Is there a "
            "cell far from the table? Delete it",
            code="file.too_large",
        )


def _table(book: object, name: str, path: Path, form: Format) -> Table | None:
    sheet = book.get_sheet_by_name(name)  # type: ignore[attr-defined]
    grid = sheet.to_python(skip_empty_area=False)
    filled = [k for k, row in enumerate(grid) if k >= form.skip and any(cell not in ("", None) for cell in row)]
    kept = [k for k in filled if not (form.comment and str(grid[k][0]).startswith(form.comment))]
    # Formatted empty cells make a sheet wider than its table.
    width = max((j + 1 for k in kept for j, cell in enumerate(grid[k]) if cell not in ("", None)), default=0)
    rows = [(k, [text_of(cell) for cell in grid[k][:width]]) for k in kept]
    body = recognition.body_of(rows, form.missing, form.header)
    if body is None:
        return None
    notes = []
    inside = rows[body.first : body.last + 1]
    if rest := len(rows) - 1 - body.last:
        notes.append(f"{rest} rows below the table not read, from row {rows[body.last + 1][0] + 1} on")
    texts = [row[j] for _, row in inside for j in body.numeric if j < len(row) and isinstance(row[j], str)]
    decimal = (signs(texts[:4000])[0] or ".") if form.decimal == "auto" else form.decimal
    head = rows[body.header][1] if body.header is not None else []
    second = rows[body.units][1] if body.units is not None else None
    titles, units = named(head[: body.width], second)
    titles += [str(j + 1) for j in range(len(titles), body.width)]
    units += [""] * (body.width - len(units))
    line = rows[body.header][0] if body.header is not None else inside[0][0]
    known = form.model_copy(update={"sheet": name, "decimal": decimal, "header": body.header is not None})
    above = [" ".join(text for text in fields if text) for k, fields in rows if k < line]
    cells = SheetCells([grid[k] for k, _ in inside], [k + 1 for k, _ in inside], body.width)
    return Table(path, known, [same(title) for title in titles], units, line + 1, above, cells, notes)


def text_of(cell: object) -> str:
    """Return a cell as text: numbers with a point, dates in the form of ISO 8601."""
    match cell:
        case None:
            return ""
        case bool():
            return str(cell)
        case float() if cell.is_integer() and abs(cell) < 1e15:
            return str(int(cell))
        case float() | int():
            return repr(cell)
        case datetime():
            return cell.isoformat(" ")
        case date() | time():
            return cell.isoformat()
        case timedelta():
            seconds = cell.total_seconds()
            return f"{int(seconds // 3600)}:{int(seconds // 60 % 60):02d}:{seconds % 60:09.6f}"
    return str(cell).strip()


class SheetCells(Cells):
    """Rows of a sheet, whose numbers need no conversion."""

    def __init__(self, rows: Sequence[Sequence[object]], lines: Sequence[int], width: int) -> None:
        self._rows = rows
        self.lines = np.array(lines, dtype=np.int64)
        self._width = width

    def _column(self, column: int) -> list[object]:
        return [row[column] if column < len(row) else "" for row in self._rows]

    def texts(self, column: int) -> Sequence[str]:
        """Return the cells of a column as text, (n,)."""
        return [text_of(cell) for cell in self._column(column)]

    def top(self, count: int) -> SheetCells:
        """Return the first rows, at most ``count``."""
        return SheetCells(self._rows[:count], self.lines[:count].tolist(), self._width)

    def numbers(self, columns: Sequence[int]) -> dict[int, Array]:
        """Return the columns that contain numbers only, (n,) each."""
        found = {}
        for k in columns:
            cells = self._column(k)
            if all(type(cell) in (float, int) or cell in ("", None) for cell in cells):
                found[k] = np.array([np.nan if cell in ("", None) else cell for cell in cells], dtype=float)
        return found
