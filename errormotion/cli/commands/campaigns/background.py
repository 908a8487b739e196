"""``errormotion background``: campaigns that run in separate processes."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from errormotion.campaign.background import processes
from errormotion.cli.output import show, show_json, table
from errormotion.errors import RunError


def started(name: str, runs: Path, as_json: bool) -> None:
    """Print the name of the process that runs a campaign."""
    if as_json:
        show_json({"ok": True, "process": name, "runs": str(runs)})
        return
    show(f"Started as {name}. 'errormotion background list {runs}' shows its progress.")


def listed(runs: Path, as_json: bool) -> None:
    """Print every process, the newest first, with its open request to the operator."""
    found = processes.found(runs)
    if as_json:
        plain = [{k: None if v != v else v for k, v in asdict(each).items()} for each in found]  # JSON has no NaN
        show_json({"ok": True, "processes": plain})
        return
    rows = [[each.name, each.campaign, each.machine, each.test, each.ended or each.stage] for each in found]
    show(table(["process", "campaign", "machine", "test", "state"], rows) if rows else f"No process in {runs}.")
    for each in found:
        if each.request is not None:
            show(f"{each.campaign}, request {each.request.number}: {each.request.text}")
            show(f"When it is done: errormotion background answer {runs} --process {each.name}")


def answer(runs: Path, name: str | None) -> None:
    """State that the open request to the operator is done.

    Raises
    ------
    RunError
        No process, or more than one, has an open request.
    """
    waiting = [each for each in processes.found(runs) if each.request is not None and name in (None, each.name)]
    if len(waiting) != 1 or waiting[0].request is None:
        names = ", ".join(each.name for each in waiting) or "none"
        raise RunError(
            f"{runs}: expected one process with an open request; found {names}. Choose one with --process.",
            code="process.ambiguous",
        )
    processes.answer(runs, waiting[0].name, waiting[0].request.number)
    show(f"Done: {waiting[0].request.text}")


def stop(runs: Path, name: str | None) -> None:
    """Ask a process to stop.

    Raises
    ------
    RunError
        No process, or more than one, is running.
    """
    alive = [each for each in processes.found(runs) if each.alive and name in (None, each.name)]
    if len(alive) != 1:
        names = ", ".join(each.name for each in alive) or "none"
        raise RunError(
            f"{runs}: expected one process that runs; found {names}. Choose one with --process.",
            code="process.ambiguous",
        )
    processes.stop(runs, alive[0].name)
    show(f"{alive[0].campaign}: stop requested. 'errormotion run --resume' continues it.")
