"""Tables in text: of loggers, spreadsheets' exports and programs of instruments."""

from __future__ import annotations

import csv
import io
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.datasets.tables import recognition
from errormotion.datasets.tables.encoding import decode
from errormotion.datasets.tables.format import Format
from errormotion.datasets.tables.numbers import NO_VALUE, NUMERIC, signs
from errormotion.datasets.tables.recognition import Body, Line, body_of, delimiter_of, split
from errormotion.datasets.tables.table import Cells, Table, named, same
from errormotion.errors import DatasetError

MAX_LINE = 1 << 20
"""Largest number of characters of a line."""
_MANY = 2000
"""Number of rows from which columns are read by pandas."""
_CUT_OFF = re.compile(r"[.,]([0-9]+)$")
_SEPARATOR = re.compile(r"sep=(.)", re.IGNORECASE)


def text_table(data: bytes, path: Path, form: Format) -> Table:
    """Return the table of a text.

    Raises
    ------
    DatasetError
        The bytes are no text, or there is no table of numbers in it; a line is damaged.
    """
    text, encoding = decode(data, form.encoding, path)
    lines = re.sub("\r\n?", "\n", text).split("\n")
    _bound(lines, path)
    form = form.model_copy(update={"encoding": encoding})
    start = form.skip
    if match := _SEPARATOR.fullmatch(lines[0].strip()):
        start = max(start, 1)
        form = form.model_copy(update={"delimiter": match[1] if form.delimiter == "auto" else form.delimiter})
    if lines[0].startswith("LabVIEW Measurement"):
        start = max(start, _after_lvm_header(lines, path))
    kept = [k for k in range(start, len(lines)) if lines[k] and not lines[k].isspace()]
    if form.comment in text:
        kept = [k for k in kept if not _is_comment(lines[k], form)]
    if form.delimiter == "auto":
        head = [lines[k] for k in kept[: recognition.SAMPLE]]
        form = form.model_copy(update={"delimiter": delimiter_of(recognition.spread(head), form.missing)})
    sample = [*kept[: recognition.SAMPLE], *kept[recognition.SAMPLE :][-recognition.SAMPLE :]]
    rows = [(k, _split(lines[k], k + 1, form, path)) for k in sample]
    # Blanks also separate the words of a text above the table.
    body = body_of(rows, form.missing, form.header, slack=0 if form.delimiter == " " else 1)
    if body is None:
        raise DatasetError(
            f"{path}: expected lines of numbers; found none", _shown(lines, kept), code="file.no_numbers"
        )
    form = _marks(rows, body, form, path)
    first, last = rows[body.first][0], rows[body.last][0]
    notes: list[str] = []
    below = [k for k in kept if k > last]
    _below(below, lines, notes)
    titles, units, head_line, above = _head(lines, rows, body, form, first, start)
    rest = len(titles) - body.width
    if rest == 1 and titles:
        notes.append(f"the column '{titles[-1]}' has no values")
    elif rest < 0 and titles:
        titles += [""] * -rest
        units += [""] * -rest
    if not text.endswith(("\n", "\r")) and last == len(lines) - 1:
        _complete(lines, rows, body, path)
    cells = _TextCells(path, lines, first, last, body, form, head_line, notes)
    if not titles:
        titles, units = [str(k + 1) for k in range(body.width)], [""] * body.width
        form = form.model_copy(update={"header": False})
    return Table(path, form, titles, units, head_line + 1, above, cells, notes)


def _after_lvm_header(lines: Sequence[str], path: Path) -> int:
    """Return the index of the line of names of a LabVIEW measurement file.

    The end of the header of the file and of that of each segment has a line of its own (Specification for the LabVIEW
    Measurement File, ni.com tutorial 4139).
    """
    ends = [k for k, line in enumerate(lines) if line.startswith("***End_of_Header***")]
    if len(ends) > 2:
        raise DatasetError(
            f"{path}: has {len(ends) - 1} segments, from line {ends[1] + 1} on; expected one",
            code="file.sheet.several",
        )
    return ends[-1] + 1 if ends else 1


def _bound(lines: Sequence[str], path: Path) -> None:
    for k, line in enumerate(lines, 1):
        if len(line) > MAX_LINE:
            raise DatasetError(
                f"{path}, line {k}: expected at most {MAX_LINE} characters; it is longer", code="file.too_large"
            )


def _is_comment(line: str, form: Format) -> bool:
    return bool(form.comment) and line.lstrip().startswith(form.comment)


def _split(line: str, number: int, form: Format, path: Path) -> list[str]:
    try:
        return split(line, form.delimiter)
    except csv.Error as error:
        raise DatasetError(f"{path}, line {number}: cannot be split into fields: {error}", code="csv.fields") from error


def _shown(lines: Sequence[str], kept: Sequence[int]) -> list[str]:
    """Return the first lines, to show what was found in place of a table."""
    return [f"line {k + 1}: {lines[k].strip()[:80]}" for k in kept[:3]]


def _marks(rows: Sequence[Line], body: Body, form: Format, path: Path) -> Format:
    """Return the format with the signs of its numbers; DatasetError where they leave them open."""
    if form.decimal != "auto":
        return form
    if form.delimiter == "," and not any("," in text for _, row in rows for text in row):
        return form.model_copy(update={"decimal": "."})
    texts = [row[k] for _, row in rows[body.first : body.last + 1] if len(row) == body.width for k in body.numeric]
    decimal, thousands, unclear = signs(texts)
    if not decimal:
        raise DatasetError(
            f"{path}: some numbers have a comma and others a point, such as '{unclear}'; set format.decimal and "
            "format.thousands in the map",
            code="file.numbers.ambiguous",
        )
    if unclear and form.thousands is None:
        raise DatasetError(
            f"{path}: the comma in '{unclear}' may be the decimal sign or separate thousands; set format.decimal = ',' "
            "or format.thousands = ',' in the map",
            code="file.numbers.ambiguous",
        )
    if form.thousands == decimal:
        decimal = "." if decimal == "," else ","
    update = {"decimal": decimal}
    if form.thousands is None and thousands:
        update["thousands"] = thousands
    return form.model_copy(update=update)


def _below(below: Sequence[int], lines: Sequence[str], notes: list[str]) -> None:
    """Note the text below the table."""
    if below:
        number = "1 line" if len(below) == 1 else f"{len(below)} lines"
        first = lines[below[0]].strip()[:60]
        notes.append(f"{number} below the table not read, from line {below[0] + 1} on: '{first}'")


def _head(
    lines: Sequence[str], rows: Sequence[Line], body: Body, form: Format, first: int, start: int
) -> tuple[list[str], list[str], int, list[str]]:
    """Return names, units, line of the names and the lines above it."""
    if body.header is None:
        comment = next(
            (k for k in range(first - 1, start - 1, -1) if _is_comment(lines[k], form) and lines[k].strip("# \t")), None
        )
        if form.header is None and comment is not None and comment >= first - 2:  # names in a comment, as of numpy
            fields = split(lines[comment].strip().removeprefix(form.comment), form.delimiter)
            if len(fields) == body.width:
                names, units = named(fields, None)
                return names, units, comment, [line.strip() for line in lines[:comment]]
        return [], [], first, [line.strip() for line in lines[:first]]
    titles = rows[body.header][1]
    second = rows[body.units][1] if body.units is not None else None
    while len(titles) > body.width + 1 or (len(titles) == body.width + 1 and not titles[-1]):
        titles = titles[:-1]
    names, units = named(titles, second)
    line = rows[body.header][0]
    return names, units, line, [each.strip() for each in lines[:line]]


def _complete(lines: Sequence[str], rows: Sequence[Line], body: Body, path: Path) -> None:
    """Raise DatasetError if the last number, without an end of its line, has fewer decimals than all others."""
    column = [row[-1] for _, row in rows[body.first : body.last + 1] if len(row) == body.width]
    numbers = [text for text in column[:-1] if NUMERIC.fullmatch(text)] + column[-1:]
    decimals = [len(match[1]) if (match := _CUT_OFF.search(text)) else 0 for text in numbers]
    if len(decimals) > 3 and min(decimals[:-1]) > decimals[-1]:
        raise DatasetError(
            f"{path}, line {len(lines)}: the file ends in '{column[-1]}', which has fewer decimals than all numbers "
            "above it, and no end of the line. Is the file complete?",
            code="file.incomplete",
        )


@dataclass
class _TextCells(Cells):
    """Rows of a text, which pandas reads where all of them have their fields, else one by one."""

    path: Path
    source: Sequence[str]
    first: int
    last: int
    body: Body
    form: Format
    head_line: int
    notes: list[str]
    _known: dict[int, list[str]] = field(default_factory=dict, repr=False)

    @cached_property
    def lines(self) -> NDArray[np.int64]:  # type: ignore[override]
        if self._regular:
            return np.arange(self.first, self.last + 1, dtype=np.int64) + 1
        return np.array([line for line, _ in self._split[0]], dtype=np.int64)

    def texts(self, column: int) -> Sequence[str]:
        """Return the cells of a column as text, (n,)."""
        if column >= self.body.width:
            return [""] * len(self.lines)
        if column not in self._known:
            if self._regular:
                frame = self._frame([column], str)
                self._known[column] = [text.strip() for text in frame[column].tolist()]
            else:
                self._known[column] = [fields[column] for _, fields in self._split[0]]
        return self._known[column]

    def top(self, count: int) -> _TextCells:
        """Return the first rows, at most ``count``, of as many lines."""
        return replace(self, last=min(self.last, self.first + count - 1), notes=[], _known={})

    def numbers(self, columns: Sequence[int]) -> dict[int, Array]:
        """Return the columns that contain numbers only, (n,) each."""
        wanted = [k for k in columns if k in self.body.numeric]
        if not wanted or not self._regular or "'" in (self.form.thousands or "") or self.form.thousands == " ":
            return {}
        try:
            frame = self._frame(wanted, float)
        except ValueError:  # some cell is no number; `Table.numbers` names it
            return {}
        found = {k: frame[k].to_numpy(dtype=float) for k in wanted}
        return {} if any(np.isinf(values).any() for values in found.values()) else found

    @cached_property
    def _regular(self) -> bool:
        """Whether pandas finds a row with every field in each line."""
        rows = self.source[self.first : self.last + 1]
        if (
            len(rows) <= _MANY
            or self.source[self.head_line] in rows
            or (self.form.comment in self._text and any(_is_comment(row, self.form) for row in rows))
        ):
            return False
        if self.form.delimiter != " " and '"' not in self._text:
            fields = self.body.width - 1
            return fields > 0 and set(map(str.count, rows, repeat(self.form.delimiter))) == {fields}
        try:
            last = self.body.width - 1
            frame = self._frame([last], str)
        except ValueError:
            return False
        return len(frame) == len(rows) and not frame[last].isna().any()

    @cached_property
    def _text(self) -> str:
        return "\n".join(self.source[self.first : self.last + 1])

    def _frame(self, columns: list[int], kind: type) -> Any:
        import pandas as pd

        missing = ["", *NO_VALUE, *(text.upper() for text in NO_VALUE), "NaN", *self.form.missing]
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)
            return pd.read_csv(
                io.StringIO(self._text),
                sep=r"\s+" if self.form.delimiter == " " else self.form.delimiter,
                decimal=self.form.decimal,
                thousands=(self.form.thousands or None) if kind is float else None,
                header=None,
                usecols=columns,
                dtype=kind,
                skipinitialspace=True,
                skip_blank_lines=False,
                keep_default_na=False,
                na_values=missing if kind is float else [],
            )

    def damaged(self) -> Sequence[tuple[int, str]]:
        """Return line and text of the rows that cannot be read."""
        return () if self._regular else self._split[1]

    @cached_property
    def _split(self) -> tuple[list[Line], list[tuple[int, str]]]:
        """The rows, and line and text of those that are damaged."""
        width, repeated = self.body.width, 0
        head = same(self.source[self.head_line]) if self.head_line < self.first else None
        rows: list[Line] = []
        damaged: list[tuple[int, str]] = []
        for k in range(self.first, self.last + 1):
            line = self.source[k]
            if not line.strip() or _is_comment(line, self.form):
                continue
            if head is not None and same(line) == head:
                repeated += 1
                continue
            try:
                fields = split(line, self.form.delimiter)
            except csv.Error as error:
                damaged.append((k + 1, f"cannot be split into fields: {error}"))
                continue
            if len(fields) == width + 1 and not fields[-1]:
                del fields[-1]
            if len(fields) == width:
                rows.append((k + 1, fields))
            else:
                damaged.append((k + 1, f"expected {width} fields; found {len(fields)}"))
        if repeated:
            times = "once" if repeated == 1 else f"{repeated} times"
            self.notes.append(f"the header is repeated {times} between the rows")
        return rows, damaged
