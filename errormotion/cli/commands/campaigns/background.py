"""``errormotion background``: campaigns that run in processes of their own."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from errormotion.campaign.background import processes
from errormotion.cli.output import show, show_json, table
from errormotion.errors import RunError


def started(name: str, runs: Path, as_json: bool) -> None:
    """Print where a campaign runs now."""
    if as_json:
        show_json({"ok": True, "process": name, "runs": str(runs)})
        return
    show(f"Started as {name}. 'errormotion background list {runs}' shows where it is.")


def listed(runs: Path, as_json: bool) -> None:
    """Print every process, the newest first, with the request that waits."""
    found = processes.found(runs)
    if as_json:
        plain = [{k: None if v != v else v for k, v in asdict(each).items()} for each in found]  # NaN is no JSON
        show_json({"ok": True, "processes": plain})
        return
    rows = [[each.name, each.campaign, each.machine, each.test, each.ended or each.stage] for each in found]
    show(table(["process", "campaign", "machine", "test", "state"], rows) if rows else f"No process in {runs}.")
    for each in found:
        if each.request is not None:
            show(f"{each.campaign}, request {each.request.number}: {each.request.text}")
            show(f"When it is done: errormotion background answer {runs} --process {each.name}")


def answer(runs: Path, name: str | None) -> None:
    """State that the request that waits is done.

    Raises
    ------
    RunError
        No request waits, or requests of several processes do.
    """
    waiting = [each for each in processes.found(runs) if each.request is not None and name in (None, each.name)]
    if len(waiting) != 1 or waiting[0].request is None:
        names = ", ".join(each.name for each in waiting) or "none"
        raise RunError(f"{runs}: expected one process with a request; found {names}. Choose it with --process.")
    processes.answer(runs, waiting[0].name, waiting[0].request.number)
    show(f"Done: {waiting[0].request.text}")


def stop(runs: Path, name: str | None) -> None:
    """Ask a process to stop.

    Raises
    ------
    RunError
        Nothing runs, or several processes do.
    """
    alive = [each for each in processes.found(runs) if each.alive and name in (None, each.name)]
    if len(alive) != 1:
        names = ", ".join(each.name for each in alive) or "none"
        raise RunError(f"{runs}: expected one process that runs; found {names}. Choose it with --process.")
    processes.stop(runs, alive[0].name)
    show(f"{alive[0].campaign}: was asked to stop. 'errormotion run --resume' continues it.")
