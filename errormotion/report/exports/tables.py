"""Tables of a report as rows of numbers and texts, and as CSV files."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup

from errormotion.datasets.files.writing import whole_folder, writing
from errormotion.report.document import Cell, Table

Entry = float | str | None
_NUMBER = re.compile(r"[+-]?\d+(?:[.,]\d+)?(?:e[+-]?\d+)?")
_FORMULA = re.compile(r"(^\s*|[,;\t\r\n])([=+\-@\uff1d\uff0b\uff0d\uff20])")
"""Begin of a formula: at the start of a text, or after what a spreadsheet in another language takes as a separator."""


@dataclass(frozen=True)
class Sheet:
    """One table: its number and section, caption, names of columns, rows, and the reasons of missing values.

    ``decimals`` are those of the numbers on the page, None for other entries; its shape is that of ``rows``.
    """

    number: int
    section: str
    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[Entry]]
    decimals: Sequence[Sequence[int | None]]
    notes: Sequence[str]


def sheet(table: Table, number: int, section: str) -> Sheet:
    """Return a table with a separate column for each expanded uncertainty; a dash is an empty entry."""
    names = _names(table)
    bodies = [row for row in table.rows if len(row) == len(names)]
    uncertain = [any(isinstance(row[j], Cell) and row[j].uncertainty for row in bodies) for j in range(len(names))]  # type: ignore[union-attr]
    head: list[str] = []
    for name, has in zip(names, uncertain, strict=True):
        head += [name, f"U of {name}"] if has else [name]
    rows, decimals, notes = [], [], list(table.notes)
    for row in table.rows:
        texts: list[str] = []
        for j, entry in enumerate(row):
            cell = entry if isinstance(entry, Cell) else Cell(entry)
            texts.append(_plain(cell.text))
            if len(row) == len(names) and uncertain[j]:
                texts.append(_plain(cell.uncertainty))
            if cell.reason and len(row) == len(names):
                notes.append(f"{texts[0]}, {names[j]}: {cell.reason}")
        parsed = [_parsed(text) for text in texts]
        rows.append([value for value, _ in parsed])
        decimals.append([places for _, places in parsed])
    return Sheet(number, section, _plain(table.caption), head, rows, decimals, notes)


def _names(table: Table) -> list[str]:
    """Return the names of the columns, with those of their groups."""
    over = [_plain(name) for name, span in table.groups for _ in range(span)]
    over += [""] * (len(table.head) - len(over))
    return [f"{group}: {_plain(name)}" if group else _plain(name) for name, group in zip(table.head, over, strict=True)]


def _plain(text: str | Markup) -> str:
    if isinstance(text, Markup):
        return str(text.striptags())
    return str(text)


def _parsed(text: str) -> tuple[Entry, int | None]:
    """Return the number in a text with its decimals, else the text; None for an empty text or a dash."""
    stripped = text.strip()
    if stripped in ("", "—"):
        return None, None
    written = stripped.replace("−", "-").replace("\u202f", "")
    if _NUMBER.fullmatch(written):
        written = written.replace(",", ".")
        return float(written), len(written.partition("e")[0].partition(".")[2])
    return stripped, None


def write_csv(sheets: Sequence[Sheet], folder: Path, *, comma: bool = False) -> Path:
    """Write a CSV file (UTF-8) for each table into a folder, which is replaced.

    With ``comma``, numbers have a decimal comma and columns are separated by semicolons.
    """
    with writing(folder), whole_folder(folder) as beside:
        for each in sheets:
            text = io.StringIO()
            writer = csv.writer(text, delimiter=";" if comma else ",", lineterminator="\r\n")
            writer.writerow([plain_text(name) for name in each.head])
            for row, decimals in zip(each.rows, each.decimals, strict=True):
                writer.writerow([_written(entry, places, comma) for entry, places in zip(row, decimals, strict=True)])
            for note in (each.caption, *each.notes):
                writer.writerow([plain_text(f"# {note}")])
            name = f"{each.number:02d}-{re.sub(r'[^a-z0-9]+', '-', each.section.lower()).strip('-')[:40]}.csv"
            (beside / name).write_bytes(text.getvalue().encode("utf-8-sig"))
    return folder


def _written(entry: Entry, places: int | None, comma: bool) -> str:
    if isinstance(entry, float):
        text = f"{entry:.{places or 0}f}" if abs(entry) >= 1e-6 or not entry else f"{entry:.9g}"
        return text.replace(".", ",") if comma else text
    return plain_text(entry or "")


def plain_text(text: str) -> str:
    """Return a text that no spreadsheet interprets as a formula: an apostrophe stands before each start of one.

    A file with commas is also opened with semicolons, and the other way round. A tab or a line at the start, which some
    programs discard, does not hide what follows.
    """
    found = _FORMULA.sub(r"\1'\2", text)
    return f"'{found}" if found.startswith(("\t", "\r", "\n")) else found
