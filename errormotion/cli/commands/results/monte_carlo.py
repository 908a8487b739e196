"""``errormotion identify --monte-carlo``: the uncertainty of one result by the Monte Carlo method."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import xarray as xr

from errormotion.cli.output import show, table
from errormotion.cli.page import new_files
from errormotion.cli.summary import notes_of
from errormotion.errors import DatasetError, MethodError
from errormotion.montecarlo.result import lines
from errormotion.montecarlo.saving import evaluation_file


def trials_of(text: str) -> int | None:
    """Return the number of trials, None for ``auto``."""
    if text == "auto":
        return None
    try:
        return int(text)
    except ValueError as error:
        raise MethodError(
            f"--monte-carlo: expected 'auto' or a number of trials; found '{text}'", code="option.form"
        ) from error


def beside(out: Path) -> Path:
    """Return the file of the evaluation of a result; DatasetError if it already exists or has no folder."""
    file = evaluation_file(out)
    if not out.parent.is_dir():
        raise DatasetError(f"{out.parent}: no such folder, which --out states for the result", code="folder.not_found")
    new_files(None, file)
    return file


def summary(found: xr.Dataset) -> list[dict[str, Any]]:
    """Return the verdicts for JSON output, SI."""
    return [
        {
            "freedom": line.name,
            "verdict": line.word,
            "linear_uncertainty": line.linear_uncertainty,
            "uncertainty": line.uncertainty,
            "difference": line.distance,
            "tolerance": line.tolerance,
            "place": line.place,
        }
        for line in lines(found)
    ]


def show_evaluation(found: xr.Dataset, file: Path) -> None:
    """Print the evaluation of each freedom."""
    from errormotion.montecarlo.report import texts

    percent = 100 * float(found.attrs["probability"])
    show(
        f"{file}: Monte Carlo (JCGM 101), {int(found.attrs['trials'])} trials, seed {int(found.attrs['seed'])}, "
        f"{percent:g} % intervals"
    )
    show(table(*texts(found)))
    for note in notes_of(found):
        show(f"  note: {note}")
