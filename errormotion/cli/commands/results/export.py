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
from errormotion.datasets.files.workbook import Cell, Sheet, workbook
from errormotion.datasets.results.merit import figures_of
from errormotion.datasets.results.tables import to_dataframe
from errormotion.errors import DatasetError

FORMS = (".csv", ".xlsx", ".nc", ".zarr")


def export(
    result: Path,
    out: Path,
    freedoms: Sequence[str] | None,
    at: tuple[float, float, float] | None,
    k: float,
    as_json: bool,
) -> None:
    """Write the errors of one result in the form that the ending of a file names.

    Raises
    ------
    DatasetError
        Not one result, another ending, an existing file, no such freedom.
    """
    if out.suffix.lower() not in FORMS:
        raise DatasetError(f"{out}: expected a name that ends in {', '.join(FORMS)}")
    if out.exists():
        raise DatasetError(f"{out}: exists already, and is not replaced; give another name to --out")
    found, _ = load([result], {})
    if len(found) != 1:
        names = ", ".join(found) or "none"
        raise DatasetError(f"{result}: expected one result, a run folder or a NetCDF file; found {names}")
    (errors,) = found.values()
    if at is not None:
        errors = errors.em.at(at)
    if out.suffix.lower() in (".nc", ".zarr"):
        if freedoms is not None:
            raise DatasetError(f"{out}: a dataset holds all freedoms; --freedoms is for .csv and .xlsx")
        datasets.save(errors, out)
        rows = int(np.prod([errors.sizes[dim] for dim in errors.em.dims]))
        sheets = []
    else:
        sheets = [_errors(errors, freedoms, k), _figures(errors), _about(errors, k)]
        rows = len(sheets[0].rows)
        content = _csv(sheets[0]) if out.suffix.lower() == ".csv" else workbook(sheets)
        with out.open("xb") as file:
            file.write(content)
    if as_json:
        show_json({"ok": True, "file": str(out), "rows": rows, "columns": list(sheets[0].head) if sheets else []})
        return
    tables = f"; tables {', '.join(sheet.name for sheet in sheets)}" if out.suffix.lower() == ".xlsx" else ""
    show(f"{out}: {rows} row{'' if rows == 1 else 's'}{tables}")


def _errors(errors: xr.Dataset, freedoms: Sequence[str] | None, k: float) -> Sheet:
    table = to_dataframe(errors, freedoms, k)
    return Sheet("errors", tuple(table.columns), [tuple(row) for row in table.itertuples(index=False)])


def _figures(errors: xr.Dataset) -> Sheet:
    rows: list[tuple[Cell, ...]] = [
        (each["name"], each["value"], each["expanded_uncertainty"], each["unit"])
        for each in (as_printed(figure) for figure in figures_of(errors))
    ]
    return Sheet("figures of merit", ("figure", "value", "U (k = 2)", "unit"), rows)


def _about(errors: xr.Dataset, k: float) -> Sheet:
    rows: list[tuple[Cell, ...]] = [("coverage factor of the errors", k)]
    for name, value in errors.attrs.items():
        if name == "functional_point":
            rows.append(("functional point / mm", ", ".join(f"{1e3 * each:.6g}" for each in np.asarray(value, float))))
        elif name == "provenance":
            software = json.loads(value).get("software", {})
            rows += [(f"software {key}", str(version)) for key, version in software.items()]
        else:
            listed = value.tolist() if isinstance(value, np.ndarray) else value
            rows.append((str(name), ". ".join(map(str, listed)) if isinstance(listed, list) else str(listed)))
    return Sheet("about", ("item", "value"), rows)


def _csv(sheet: Sheet) -> bytes:
    """Return a table as UTF-8 with commas and decimal points; unknown values are empty."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\r\n")
    writer.writerow([_text(name) for name in sheet.head])
    writer.writerows([_text(cell) for cell in row] for row in sheet.rows)
    return stream.getvalue().encode("utf-8")


def _text(cell: Any) -> Any:
    """Return a cell; a text that a spreadsheet would take as a formula begins with an apostrophe."""
    if isinstance(cell, str):
        return f"'{cell}" if cell[:1] in ("=", "+", "-", "@", "\t", "\r") else cell
    if isinstance(cell, (float, np.floating)):
        return f"{cell:.12g}" if np.isfinite(cell) else ""
    return cell
