"""``errormotion note``: stored next to the run, listed with it, limited in size, and independent of the data."""

import json
import os
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pytest
from coded import raises
from typer.testing import CliRunner, Result

from errormotion.cli.app import app
from errormotion.datasets.files import events
from errormotion.record.runs import listing


def make(path: Path, created: str = "2026-03-01T08:00:00+00:00", machine: str = "VM1") -> Path:
    """Write a run folder older than the resolution of time stamps."""
    path.mkdir(parents=True)
    state = {"schema": "errormotion.run/1", "created": created, "bench": {"machine": machine}, "results": []}
    (path / "run.json").write_text(json.dumps(state))
    os.utime(path / "run.json", (1, 1))
    return path


@pytest.fixture
def call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Result]:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("COLUMNS", "200")

    def run(*arguments: Any, code: int = 0) -> Result:
        result = CliRunner().invoke(app, list(map(str, arguments)))
        assert result.exit_code == code, result.output
        return result

    return run


def test_notes_are_appended_and_nothing_else_changes(tmp_path: Path, call: Callable[..., Result]) -> None:
    run = make(tmp_path / "runs" / "a")
    before = (run / "run.json").read_bytes()
    call("note", run, "spindle exchanged", "--by", "A. Turner")
    call("note", run, "door was open", "--at", "2026-03-01T10:30+01:00")
    first, second = (json.loads(line) for line in (run / "events.jsonl").read_text().splitlines())
    assert (first["text"], first["by"]) == ("spindle exchanged", "A. Turner")
    noted = datetime.fromisoformat(first["noted"])
    assert noted.utcoffset() == timedelta(0)
    assert abs((datetime.now(UTC) - noted).total_seconds()) < 60
    assert second["at"] == "2026-03-01T09:30:00+00:00"
    assert sorted(path.name for path in run.iterdir()) == ["events.jsonl", "run.json"]
    assert (run / "run.json").read_bytes() == before
    shown = call("runs", tmp_path / "runs").stdout
    assert shown.index("spindle exchanged") < shown.index("door was open")
    assert "A. Turner" in shown
    notes = json.loads(call("runs", tmp_path / "runs", "--json").stdout)["notes"]
    assert [note["time"] for note in notes] == ["2026-03-01T08:00:00+00:00", "2026-03-01T09:30:00+00:00"]


def test_a_note_on_a_machine_needs_no_run(tmp_path: Path, call: Callable[..., Result]) -> None:
    runs = tmp_path / "runs"
    make(runs / "a")
    make(runs / "b", machine="VM2")
    call("note", runs, "collision", "--machine", "VM1", "--at", "2026-02-01")
    for words in ([], ["--machine", "VM1"], ["--at", "2026-02-01"]):
        call("note", runs, "collision", *words, code=2)
    call("note", runs / "a", "collision", "--machine", "VM1", code=2)
    assert [note.text for note in listing.list_runs([runs], machine="vm1").notes] == ["collision"]
    assert listing.list_runs([runs], machine="VM2").notes == ()
    assert listing.list_runs([runs], since=datetime(2026, 2, 2)).notes == ()


def test_a_note_newer_than_the_index_is_listed(tmp_path: Path, call: Callable[..., Result]) -> None:
    run = make(tmp_path / "runs" / "a")
    assert listing.list_runs([tmp_path / "runs"]).notes == ()
    call("note", run, "repair")
    assert [note.text for note in listing.list_runs([tmp_path / "runs"]).notes] == ["repair"]
    os.utime(run / "events.jsonl", (1, 1))
    for _ in range(2):  # from the files, then from the index
        assert [note.text for note in listing.list_runs([tmp_path / "runs"]).notes] == ["repair"]
    (run / "events.jsonl").unlink()
    assert listing.list_runs([tmp_path / "runs"]).notes == ()


@pytest.mark.parametrize(
    ("text", "options"),
    [
        ("", []),
        ("  ", []),
        ("two\nlines", []),
        ("\x1b[31m", []),
        ("x" * 1001, []),
        ("x", ["--by", "y" * 101]),
        ("x", ["--at", "2999-01-01"]),
    ],
)
def test_a_note_that_cannot_be_stored_is_an_error(
    tmp_path: Path, call: Callable[..., Result], text: str, options: list[str]
) -> None:
    run = make(tmp_path / "a")
    assert "expected" in call("note", run, text, *options, code=1).stderr
    assert not (run / "events.jsonl").exists()


def test_wrong_folders_and_dates_are_an_error(tmp_path: Path, call: Callable[..., Result]) -> None:
    assert "no such folder" in call("note", tmp_path / "no", "x", code=1).stderr
    run = make(tmp_path / "a")
    assert "expected a date" in call("note", run, "x", "--at", "yesterday", code=2).stderr
    (run / "run.json").write_text("{")
    assert "not valid JSON" in call("note", run, "x", code=1).stderr


GOOD = '{"text": "good", "noted": "2026-03-01T08:00:00+00:00"}'


@pytest.mark.parametrize(
    "line",
    [
        "{",
        "3",
        "[]",
        "{}",
        "[" * 100000,
        '{"text": "x"}',
        '{"text": 3, "noted": "2026-03-01T08:00:00"}',
        '{"text": "x", "noted": "soon"}',
        '{"text": "x\\u001b", "noted": "2026-03-01T08:00:00"}',
        '{"text": "x", "noted": "2026-03-01T08:00:00", "at": {}}',
        "\\udcff\x00",
    ],
)
def test_a_damaged_line_is_counted_and_the_others_are_kept(
    tmp_path: Path, call: Callable[..., Result], line: str
) -> None:
    run = make(tmp_path / "runs" / "a")
    (run / "events.jsonl").write_text(f"{GOOD}\n{line}\n{GOOD}")
    os.utime(run / "events.jsonl", (1, 1))
    for _ in range(2):  # from the files, then from the index
        found = listing.list_runs([tmp_path / "runs"])
        assert [note.text for note in found.notes] == ["good", "good"]
        (reason,) = found.skipped
        assert "events.jsonl, line 2: " in reason
    assert "events.jsonl, line 2: " in call("validate", run, code=3).stdout
    call("note", run, "more")  # the last line was never completed
    assert [note.text for note in events.read(run)[0]] == ["good", "good", "more"]


def test_a_file_that_is_too_large_is_not_read_and_not_extended(tmp_path: Path) -> None:
    line = json.dumps({"text": "x" * 900, "noted": "2026-03-01T08:00:00"}) + "\n"
    (tmp_path / "events.jsonl").write_text(line * (events.MAX_FILE // len(line)))
    assert len(events.read(tmp_path)[0]) > 1000
    with raises("event.file.full"):
        events.append(tmp_path, events.event("x" * 1000))
    (tmp_path / "events.jsonl").write_text(line * (events.MAX_FILE // len(line) + 1))
    assert "it is larger" in events.read(tmp_path)[1][0]


def _write(folder: Path, number: int) -> None:
    for k in range(50):
        events.append(folder, events.event(f"{number} {k} " + "x" * 500))


def test_notes_of_several_processes_are_not_mixed(tmp_path: Path) -> None:
    context = get_context("fork")
    workers = [context.Process(target=_write, args=(tmp_path, number)) for number in range(3)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    made, wrong = events.read(tmp_path)
    assert (len({each.text for each in made}), wrong) == (150, ())
