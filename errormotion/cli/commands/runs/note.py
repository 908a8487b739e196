"""``errormotion note``: notes an event of a machine beside its runs."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from errormotion.cli.guard import UsageError
from errormotion.cli.options import date
from errormotion.cli.output import show, show_json
from errormotion.datasets.files.events import append, event
from errormotion.errors import RunError
from errormotion.record.runs.entry import read_entry


def note(folder: Path, text: str, machine: str | None, at: str | None, by: str, as_json: bool) -> None:
    """Append a note to a run, or to a folder of runs for one of its machines.

    Raises
    ------
    RunError
        The folder does not exist, the run cannot be read, or the note cannot be written.
    """
    if not folder.is_dir():
        raise RunError(
            f"{folder}: no such folder; expected a run folder or a folder of runs", code="run.folder.not_found"
        )
    time = date("--at", at)
    if (folder / "run.json").exists():
        if machine is not None:
            raise UsageError(
                f"--machine is not allowed for a run; {folder} states its machine", code="option.not_allowed"
            )
        read_entry(folder)
    elif machine is None or time is None:
        raise UsageError(
            f"{folder} is not a run folder; a note on a machine needs --machine NAME and --at DATE",
            code="option.missing",
        )
    entry = event(text, by=by, at=time, machine=machine or "")
    file = append(folder, entry)
    if as_json:
        show_json({"ok": True, "file": str(file), "note": asdict(entry)})
    else:
        show(f"noted in {file}")
