"""``errormotion runs``: lists runs, newest first, each with its figure of merit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from errormotion.cli.options import date
from errormotion.cli.output import show, show_json, table
from errormotion.cli.summary import as_printed, digits_of
from errormotion.cli.tolerances import end_with, remarks
from errormotion.datasets.files.tomlfile import nearest
from errormotion.record.runs.entry import Entry
from errormotion.record.runs.judging import judge_runs
from errormotion.record.runs.listing import Listing, Note, list_runs
from errormotion.tolerances.table import load_tolerances


def runs(
    paths: list[Path],
    machine: str | None,
    method: str | None,
    since: str | None,
    tolerances: Path | None,
    as_json: bool,
) -> None:
    """Print the runs of folders; with a file of tolerances, decide on each run and end with the exit code.

    Raises
    ------
    RunError
        A folder does not exist.
    """
    limits = load_tolerances(tolerances) if tolerances is not None else None
    found = list_runs(paths or [Path("runs")], machine=machine, method=method, since=date("--since", since))
    decisions = judge_runs(found.runs, limits) if limits is not None else []
    if decisions:
        judged = zip(found.runs, decisions, strict=True)
        verdicts = ((path, entry, each.verdict if each is not None else "") for (path, entry), each in judged)
        found = replace(found, runs=tuple((path, replace(entry, verdict=verdict)) for path, entry, verdict in verdicts))
    conformities = [each.plain() for each in decisions if each is not None]
    if as_json:
        plain = [each.plain() if each is not None else None for each in decisions] or [None] * len(found.runs)
        listed = zip(found.runs, plain, strict=True)
        show_json(
            {
                "ok": True,
                "runs": [
                    {**_plain(path, entry), **({"conformity": each} if decisions else {})}
                    for (path, entry), each in listed
                ],
                "notes": [plain_note(note) for note in found.notes],
                "skipped": list(found.skipped),
                "figures_not_read": found.waiting,
                "without_time": found.undated,
            }
        )
        end_with(conformities)
        return
    if found.runs:
        head = ["started (UTC)", "machine", "test", "method", "figure", "value", "U (k=2)", "unit", "verdict", "state"]
        show(table([*head, "run"], [_row(path, entry) for path, entry in found.runs]))
    for line in [*note_lines(found.notes), *_remarks(found, machine, method), *remarks(conformities)]:
        show(line)
    for each in decisions:
        if each is not None and each.failure:
            show(f"not decided: {each.failure}")
            break
    end_with(conformities)


def plain_note(note: Note) -> dict[str, Any]:
    """Return a note for JSON output."""
    return {**asdict(note), "time": note.time.isoformat() if note.time is not None else None}


def note_lines(notes: Sequence[Note]) -> list[str]:
    """Return a table of notes, the oldest first; empty without notes."""
    if not notes:
        return []
    rows = [
        [f"{each.time:%Y-%m-%d %H:%M}" if each.time else "unknown", each.machine, each.by, each.run, each.text]
        for each in notes
    ]
    return ["", table(["noted for (UTC)", "machine", "by", "run", "note"], rows), ""]


def _row(path: Path, entry: Entry) -> list[str]:
    time = entry.time
    started = f"{time:%Y-%m-%d %H:%M}" if time is not None else "unknown"
    figure = ["", "", "", ""]
    if entry.figures:
        first = as_printed(entry.figures[0])
        value, uncertainty = digits_of(first)
        figure = [first["name"], value, uncertainty, first["unit"]]
    return [started, entry.machine, entry.test, entry.method, *figure, entry.verdict, entry.state, _shown(path)]


def _plain(path: Path, entry: Entry) -> dict[str, Any]:
    found = entry.plain()
    figures = None if entry.figures is None else [as_printed(each) for each in entry.figures]
    return {**found, "folder": str(path), "figures": figures}


def _shown(path: Path) -> str:
    """Return a path, relative to the current folder if it is inside."""
    here = Path.cwd()
    return str(path.relative_to(here)) if path.is_relative_to(here) else str(path)


def _remarks(found: Listing, machine: str | None, method: str | None) -> list[str]:
    lines = [f"{len(found.runs)} run" + ("" if len(found.runs) == 1 else "s")]
    if not found.runs:
        for option, wanted, known in (("--machine", machine, found.machines), ("--method", method, found.methods)):
            if wanted is not None and wanted.casefold() not in map(str.casefold, known):
                lines.append(f"{option} {wanted}: not found; {nearest(wanted, known)}")
    if found.undated:
        lines.append(f"runs without a known time, not compared with --since: {found.undated}")
    if found.waiting:
        lines.append(f"runs whose figures are not read yet from the errors: {found.waiting}; repeat the command")
    if found.skipped:
        lines += [f"unreadable runs: {len(found.skipped)}", *(f"  {reason}" for reason in found.skipped)]
    return lines
