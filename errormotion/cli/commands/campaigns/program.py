"""``errormotion program``: the NC programs of the tests of a campaign."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from errormotion.campaign.files import load_campaign
from errormotion.campaign.planning.release import announced, refuse, released, to_release
from errormotion.cli.output import show, show_json, table
from errormotion.cli.progress import Bars, on_terminal
from errormotion.errors import BenchError
from errormotion.plugins import states


def write(campaign: Path, test: str | None, out: Path, *, move: bool, as_json: bool) -> None:
    """Write the NC programs of one test, or of every test whose method has programs; files are never replaced.

    The motions of the programs are printed on stderr, one line for each test. Unless all devices of the bench are
    simulated, a person releases them as for a run: a control moves as soon as it executes a program. With several such
    tests, each has its own folder in ``out``.

    Raises
    ------
    BenchError
        The test does not exist, its method has no programs, or a file already exists. Nothing is written.
    RunError
        The motions were not released. Nothing is written.
    """
    plan = load_campaign(campaign)
    chosen = [entry for entry in plan.tests if test is None or entry.name == test]
    if not chosen:
        raise BenchError(
            f"{campaign}: expected one of the tests {', '.join(entry.name for entry in plan.tests)}; found '{test}'",
            code="campaign.test.unknown",
        )
    with_programs = [entry for entry in chosen if states(entry.method, "programs")]
    if not with_programs:
        names = ", ".join(sorted({entry.method.info.id for entry in chosen}))
        raise BenchError(
            f"{campaign}: the method {names} has no NC programs; nothing was written", code="campaign.programs.none"
        )
    files: list[tuple[str, Path, str]] = []
    for entry in with_programs:
        folder = out / entry.name if len(with_programs) > 1 else out
        instruments = plan.bench.chosen(entry.instruments).settings_by_kind
        texts = entry.method().programs(entry.settings, instruments)
        files += [(entry.name, folder / name, text) for name, text in texts.items()]
    if existing := [str(path) for _, path, _ in files if path.exists()]:
        raise BenchError(
            f"{existing[0]} already exists; choose another folder, or remove the file. Nothing was written.",
            code="file.exists",
        )
    for entry in with_programs:
        show(announced(plan, entry), err=True)
    if motions := to_release(plan, with_programs):
        (released if move else Bars(quiet=True, announcing=True).release if on_terminal() else refuse)(motions)
    for _, path, text in files:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("x", encoding="ascii", newline="\r\n") as file:
            file.write(text)
    _show(files, as_json)


def _show(files: list[tuple[str, Path, str]], as_json: bool) -> None:
    rows: list[dict[str, Any]] = [
        {"test": name, "file": str(path), "lines": len(text.splitlines()), "comments": _comments(text)}
        for name, path, text in files
    ]
    if as_json:
        show_json({"ok": True, "programs": rows})
        return
    shown = [[row["test"], row["file"], str(row["lines"]), "; ".join(row["comments"])] for row in rows]
    show(table(["test", "file", "lines", "comments"], shown))


def _comments(text: str) -> list[str]:
    """Return the comments that take a whole line."""
    lines = [line.strip() for line in text.splitlines()]
    return [line[1:-1] for line in lines if line.startswith("(") and line.endswith(")")]
