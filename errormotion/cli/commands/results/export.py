"""``errormotion export``: the tables of a result as CSV or XLSX, or the dataset as NetCDF or Zarr."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from errormotion import datasets
from errormotion.cli.output import show, show_json
from errormotion.cli.results import load
from errormotion.cli.summary import as_printed
from errormotion.datasets.files.writing import whole
from errormotion.datasets.results.merit import figures_of
from errormotion.datasets.results.tables import to_dataframe
from errormotion.datasets.storage.disk import reading
from errormotion.errors import DatasetError
from errormotion.report.exports import xlsx
from errormotion.report.exports.tables import Entry, Sheet, plain_text

MAX_ROWS = 2**20 - 2
"""Largest number of rows of a table in a workbook: the limit of the format, less caption and head."""

FORMS = (".csv", ".xlsx", ".nc", ".zarr")


def export(
    result: Path,
    out: Path,
    freedoms: Sequence[str] | None,
    at: tuple[float, float, float] | None,
    k: float,
    as_json: bool,
) -> None:
    """Write the errors of one result; the ending of the file states the format.

    Raises
    ------
    DatasetError
        The path is not exactly one result, the ending or a freedom is unknown, or the file already exists.
    """
    if out.suffix.lower() not in FORMS:
        raise DatasetError(f"{out}: expected a name that ends in {', '.join(FORMS)}", code="file.name.ending")
    if out.exists():
        raise DatasetError(f"{out}: already exists, and is not replaced; give another name", code="file.exists")
    found = load([result], {}).results
    if len(found) != 1:
        names = ", ".join(found) or "none"
        raise DatasetError(
            f"{result}: expected one result, a run folder or a NetCDF file; found {names}",
            code="export.result.ambiguous",
        )
    (errors,) = found.values()
    with reading(result):
        rows = int(np.prod([errors.sizes[dim] for dim in errors.em.dims]))
        if at is not None:
            errors = errors.em.at(at)
    if out.suffix.lower() in (".nc", ".zarr"):
        if freedoms is not None:
            raise DatasetError(
                f"{out}: a dataset contains all freedoms; --freedoms is allowed for .csv and .xlsx only",
                code="export.freedoms.not_allowed",
            )
        datasets.save(errors, out)
        sheets = []
    else:
        sheets = [_errors(errors, freedoms, k), _figures(errors), _about(errors, k)]
        rows = len(sheets[0].rows)
        if out.suffix.lower() == ".csv":
            with whole(out) as beside:
                beside.write_bytes(_csv(sheets[0]))
        elif rows > MAX_ROWS:
            raise DatasetError(
                f"{out}: a workbook has at most {MAX_ROWS} rows; found {rows}. Write .csv or .nc",
                code="export.rows.too_many",
            )
        else:
            xlsx.write(sheets, out)
    if as_json:
        show_json({"ok": True, "file": str(out), "rows": rows, "columns": list(sheets[0].head) if sheets else []})
        return
    tables = f"; tables {', '.join(sheet.section for sheet in sheets)}" if out.suffix.lower() == ".xlsx" else ""
    show(f"{out}: {rows} row{'' if rows == 1 else 's'}{tables}")


def _errors(errors: xr.Dataset, freedoms: Sequence[str] | None, k: float) -> Sheet:
    table = to_dataframe(errors, freedoms, k)
    caption = f"{errors.attrs['machine']}: errors of {errors.attrs['component']}, U with k = {k:g}"
    return _sheet(1, "errors", caption, list(table.columns), [list(row) for row in table.itertuples(index=False)])


def _figures(errors: xr.Dataset) -> Sheet:
    rows = [
        [each["name"], each["value"], each["expanded_uncertainty"], each["unit"]]
        for each in (as_printed(figure) for figure in figures_of(errors))
    ]
    return _sheet(2, "figures of merit", "Figures of merit", ["figure", "value", "U (k = 2)", "unit"], rows)


def _about(errors: xr.Dataset, k: float) -> Sheet:
    rows: list[list[Any]] = [["coverage factor of the errors", k]]
    for name, value in errors.attrs.items():
        if name == "functional_point":
            rows.append(["functional point / mm", ", ".join(f"{1e3 * each:.6g}" for each in np.asarray(value, float))])
        elif name == "provenance":
            software = json.loads(value).get("software")
            if isinstance(software, dict):  # of a file from anywhere
                rows += [[f"software {key}", str(version)] for key, version in software.items()]
        else:
            listed = value.tolist() if isinstance(value, np.ndarray) else value
            rows.append([str(name), ". ".join(map(str, listed)) if isinstance(listed, list) else str(listed)])
    return _sheet(3, "about", "What the result is", ["item", "value"], rows)


def _sheet(number: int, section: str, caption: str, head: list[str], rows: list[list[Any]]) -> Sheet:
    cells: list[list[Entry]] = [[_entry(value) for value in row] for row in rows]
    return Sheet(number, section, caption, head, cells, [[None] * len(row) for row in cells], [])


def _entry(value: Any) -> Entry:
    """Return a cell: a number, a text, or None for an unknown value."""
    if isinstance(value, (int, float, np.number)) and not isinstance(value, bool):
        return float(f"{value:.15g}") if np.isfinite(value) else None
    return None if value is None else str(value)


def _csv(sheet: Sheet) -> bytes:
    """Return a table as UTF-8 with commas and decimal points; unknown values are empty."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\r\n")
    writer.writerow([_text(name) for name in sheet.head])
    writer.writerows([_text(cell) for cell in row] for row in sheet.rows)
    return stream.getvalue().encode("utf-8")


def _text(entry: Entry) -> str:
    """Return a cell; a text that a spreadsheet would take as a formula is preceded by an apostrophe."""
    if isinstance(entry, str):
        return plain_text(entry)
    return "" if entry is None else f"{entry:.12g}"
