"""Splitting of a text file with header lines and tables into cells, without interpretation of the cells."""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from pathlib import Path

from errormotion.datasets.files.reading import read_bytes
from errormotion.datasets.tables.encoding import decode
from errormotion.datasets.tables.format import Format
from errormotion.datasets.tables.numbers import signs
from errormotion.datasets.tables.recognition import split
from errormotion.errors import DatasetError

MAX_FILE = 64 << 20
"""Largest size of a file, bytes; its cells need more memory."""

_KEY = re.compile(r"#\s*([^\W\d]\w*)\s*=\s*(.*)")


@dataclass(frozen=True)
class Table:
    """Lines between empty ones: the header line and those below it, each with its number; and the signs of numbers."""

    head: tuple[int, list[str]]
    rows: list[tuple[int, list[str]]]
    form: Format


def blocks(path: Path) -> tuple[dict[str, tuple[int, str]], list[Table]]:
    """Return the header and the tables of a text file.

    Parameters
    ----------
    path : Path
        Text; fields are separated by tabulator, semicolon or comma, according to the first line of a table.

    Returns
    -------
    dict of str to (int, str)
        Line and text of each ``# key = text``.
    list of Table
        Tables have empty lines between them.

    Raises
    ------
    DatasetError
        The file cannot be read or split, a key is duplicated, or there is no table.
    """
    header: dict[str, tuple[int, str]] = {}
    parts: list[list[tuple[int, str]]] = [[]]
    for number, line in enumerate(_lines(path), 1):
        # Spreadsheets pad lines with separators, and may quote a line that contains commas.
        bare = line.strip().strip('",;\t ')
        if bare.startswith("#"):
            match = _KEY.fullmatch(bare)
            if match and match[1] in header:
                before = header[match[1]][0]
                raise DatasetError(
                    f"{path}, line {number}: duplicate key '{match[1]}'; first given in line {before}",
                    code="csv.key.duplicate",
                )
            if match:
                header[match[1]] = (number, match[2].strip())
        elif bare:
            parts[-1].append((number, line))
        elif parts[-1]:
            parts.append([])
    tables = [_split(path, block) for block in parts if block]
    if not tables:
        raise DatasetError(
            f"{path}: expected a line of column names and lines of readings; found none", code="csv.no_readings"
        )
    return header, tables


def _lines(path: Path) -> list[str]:
    try:
        data = read_bytes(path, MAX_FILE)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror}", code="file.unreadable") from error
    return decode(data, "auto", path)[0].splitlines()


def _split(path: Path, block: list[tuple[int, str]]) -> Table:
    first = block[0][1]
    delimiter = next((sign for sign in "\t;" if sign in first), ",")
    rows = []
    for number, line in block:
        try:
            rows.append((number, split(line, delimiter)))
        except csv.Error as error:
            raise DatasetError(
                f"{path}, line {number}: cannot be split into fields: {error}", code="csv.fields"
            ) from error
    return Table(rows[0], rows[1:], _form(path, delimiter, rows[1:]))


def _form(path: Path, delimiter: str, rows: list[tuple[int, list[str]]]) -> Format:
    """Return the signs of the numbers; DatasetError where a comma may be the decimal sign or separate thousands."""
    decimal, thousands, unclear = (".", "", "") if delimiter == "," else signs(text for _, row in rows for text in row)
    if unclear:
        raise DatasetError(
            f"{path}, line {rows[0][0]}: the comma in '{unclear}' may be the decimal sign or separate thousands; write "
            "decimal points, and no sign between thousands",
            code="file.numbers.ambiguous",
        )
    return Format.model_validate({"delimiter": delimiter, "decimal": decimal, "thousands": thousands or None})
