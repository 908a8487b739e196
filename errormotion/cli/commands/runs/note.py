"""``errormotion note``: what happened to a machine, kept beside its runs."""

from __future__ import annotations

from dataclasses import asdict
from datetime import datetime
from pathlib import Path

import typer

from errormotion.cli.guard import USAGE
from errormotion.cli.output import show, show_json
from errormotion.datasets.files.events import append, event
from errormotion.errors import RunError
from errormotion.record.runs.entry import read_entry


def note(folder: Path, text: str, machine: str | None, at: str | None, by: str, as_json: bool) -> None:
    """Append a note to a run, or to a folder of runs for one of its machines.

    Raises
    ------
    RunError
        No such folder, a damaged run, or a note that cannot be written.
    """
    if not folder.is_dir():
        raise RunError(f"{folder}: expected a run folder, or a folder of runs; there is no such folder")
    time = None
    if at is not None:
        try:
            time = datetime.fromisoformat(at)
        except ValueError:
            typer.echo(f"--at {at}: expected a date, as in 2026-03-31 or 2026-03-31T08:00+01:00", err=True)
            raise typer.Exit(USAGE) from None
    if (folder / "run.json").exists():
        if machine is not None:
            typer.echo(f"--machine: is not allowed for a run; {folder} states its machine", err=True)
            raise typer.Exit(USAGE)
        read_entry(folder)
    elif machine is None or time is None:
        typer.echo(f"{folder} is not a run; a note on a machine needs --machine NAME and --at DATE", err=True)
        raise typer.Exit(USAGE)
    made = event(text, by=by, at=time, machine=machine or "")
    file = append(folder, made)
    if as_json:
        show_json({"ok": True, "file": str(file), "note": asdict(made)})
    else:
        show(f"noted in {file}")
