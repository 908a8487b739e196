"""``errormotion history``: one figure of merit of one machine over time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from errormotion import datasets
from errormotion.cli.commands.runs.listing import note_lines, plain_note
from errormotion.cli.output import show, show_json, table
from errormotion.cli.page import Page, new_files
from errormotion.datasets.files.tomlfile import nearest
from errormotion.errors import RunError
from errormotion.record.history import history as followed
from errormotion.record.history import version_changes
from errormotion.record.runs.listing import list_runs
from errormotion.record.text import date, field_of, sentences
from errormotion.report.text import rounded


def history(
    paths: list[Path],
    machine: str,
    figure: str,
    at: tuple[float, float, float] | None,
    method: str | None,
    test: str | None,
    out: Path | None,
    page: Page | None,
    as_json: bool,
) -> None:
    """Print a figure of merit of a machine over time with trend, steps and control limits, and write files.

    Raises
    ------
    RunError
        No run of the machine states the figure.
    DatasetError
        A file already exists, or cannot be written.
    """
    files = new_files(page, out)
    runs = list_runs(paths or [Path("runs")], machine=machine, method=method, test=test)
    if not runs.runs and machine.casefold() not in map(str.casefold, runs.machines):
        message = f"--machine {machine}: no runs found; {nearest(machine, runs.machines)}"
        raise RunError(
            "\n  - ".join([message, *(f"could not be read: {reason}" for reason in runs.skipped)]),
            code="runs.machine.unknown",
        )
    found = followed(runs, machine, figure, at)
    if out is not None:
        datasets.save(found, out)
    if page is not None:
        from errormotion.record.page import write

        write(found, page.file, page.form)
    if as_json:
        left_out = {"figures_not_read": runs.waiting, "skipped": list(runs.skipped)}
        notes = [plain_note(note) for note in runs.notes]
        show_json({"ok": True, **as_plain(found), "notes_on_machine": notes, **left_out})
        return
    show(_values(found))
    for line in [*note_lines(runs.notes), *sentences(found)]:
        show(line)
    for name in ("notes", "left_out"):
        for text in filter(None, found.attrs[name]):
            show(f"omitted: {text}" if name == "left_out" else text)
    if runs.waiting:
        show(f"{runs.waiting} runs: figures of merit not read yet from the error datasets; repeat the command")
    for reason in runs.skipped:
        show(f"could not be read: {reason}")
    for path in files:
        show(f"written: {path}")


def _values(ds: xr.Dataset) -> str:
    factor, unit = field_of(ds)
    rows = []
    for k, run in enumerate(ds["run"].values):
        value, U = rounded(
            factor * float(ds["value"][k]), factor * float(ds["expanded_uncertainty"][k]), signed=False, digits=2
        )
        remarks = [word for name, word in (("outside", "outside"), ("departing", "outlier")) if ds[name][k]]
        remarks += [version for changed, _, version in version_changes(ds) if changed == k]
        shown = [value.replace("−", "-"), U, unit, ", ".join(remarks), str(run)]
        rows.append([date(ds, float(ds["time"][k])), *shown])
    head = ["started (UTC)", "value", "U (k=2)", "unit", "limits", "run"]
    return f"{ds.attrs['figure']} of {ds.attrs['machine']}\n" + table(head, rows)


def as_plain(ds: xr.Dataset) -> dict[str, Any]:
    """Return a history for JSON output, SI."""
    runs = ("time", "value", "expanded_uncertainty", "centre", "lower_limit", "upper_limit", "outside", "departing")
    steps = ("time", "low", "high", "size", "half_width", "p", "event")
    scalars = ("trend", "trend_low", "trend_high", "reproducibility", "reproducibility_of_ranges", "chi2", "chi2_p")
    return {
        "machine": ds.attrs["machine"],
        "figure": ds.attrs["figure"],
        "unit": ds.attrs["unit"],
        "start": ds.attrs["start"],
        "values": [
            {
                "run": str(run),
                "version": str(ds["version"].values[k]),
                **{name: float(ds[name].values[k]) for name in runs},
            }
            for k, run in enumerate(ds["run"].values)
        ],
        **{name: float(ds[name]) for name in (*scalars, "degrees")},
        "steps": [{name: _plain(ds[f"step_{name}"].values[k]) for name in steps} for k in range(ds.sizes["step"])],
        "shared_sources": [str(each) for each in ds["source_id"].values],
        "summary": sentences(ds),
        "notes": [str(note) for note in ds.attrs["notes"] if note],
        "left_out": [str(each) for each in ds.attrs["left_out"] if each],
    }


def _plain(value: Any) -> Any:
    return float(value) if np.issubdtype(np.asarray(value).dtype, np.number) else str(value)
