"""``errormotion runs``: all runs, newest first; the index only saves time."""

import json
import os
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from coded import raises
from typer.testing import CliRunner, Result

from errormotion import datasets
from errormotion.campaign import folder as run_folder
from errormotion.cli.app import app
from errormotion.datasets import provenance
from errormotion.record.runs import entry, index, listing

LONG_AGO = 1_700_000_000_000_000_000
"""Time of change of files that have settled, ns."""


def state(number: int, **changes: Any) -> dict[str, Any]:
    """Return the content of a run.json."""
    return {
        "schema": "errormotion.run/1",
        "id": f"{number:08x}",
        "test": "drift",
        "created": f"2026-{1 + number % 12:02}-01T08:00:{number % 60:02}.000+00:00",
        "status": "finished",
        "campaign": {"name": "Monday", "text": "x" * 2000},
        "bench": {"machine": "VM1", "text": "y" * 2000},
        "method": {"id": "spindle_drift", "version": "1"},
        "errors": "errors/spindle_drift-1/errors.nc",
        "results": [
            {"name": f"EZ {k}", "value": k * 1e-6, "expanded_uncertainty": 4e-7, "unit": "m", "limit": None}
            for k in range(1, 9)
        ],
        **changes,
    }


def make(runs: Path, number: int, settled: bool = True, **changes: Any) -> Path:
    """Write a run folder."""
    path = runs / f"run-{number:05}"
    path.mkdir(parents=True, exist_ok=True)
    file = path / "run.json"
    file.write_text(json.dumps(state(number, **changes)))
    if settled:
        os.utime(file, ns=(LONG_AGO + number, LONG_AGO + number))
    return path


@pytest.fixture
def call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Result]:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))

    def run(*arguments: Any, code: int = 0) -> Result:
        result = CliRunner().invoke(app, ["runs", *map(str, arguments)])
        assert result.exit_code == code, result.output
        return result

    return run


def test_newest_first_with_machine_test_method_figure_and_state(tmp_path: Path, call: Callable[..., Result]) -> None:
    for number in (0, 1, 2):
        make(tmp_path / "runs", number)
    make(tmp_path / "runs", 3, status="failed", results=None, errors=None, bench={"machine": "VM2"})
    lines = call().stdout.splitlines()
    assert [line.split()[-1] for line in lines[2:6]] == [f"runs/run-{k:05}" for k in (3, 2, 1, 0)]
    for word in ("2026-03-01 08:00", "VM1", "drift", "spindle_drift", "EZ 1", "1.00", "0.40", "um", "finished"):
        assert word in lines[3]
    assert "VM2" in lines[2]
    assert "failed" in lines[2]
    assert lines[-1] == "4 runs"


def test_machine_method_and_date_select(tmp_path: Path, call: Callable[..., Result]) -> None:
    make(tmp_path / "runs", 0)
    make(tmp_path / "runs", 1, bench={"machine": "VM2"}, method={"id": "bars"})
    make(tmp_path / "runs", 2, created="some day")

    def names(*options: str) -> list[str]:
        return [Path(run["folder"]).name for run in json.loads(call("--json", *options).stdout)["runs"]]

    assert names() == ["run-00001", "run-00000", "run-00002"]
    assert names("--machine", "vm2") == ["run-00001"]
    assert names("--method", "spindle_drift") == ["run-00000", "run-00002"]
    assert names("--since", "2026-02-01") == ["run-00001"]
    assert names("--since", "2026-02-01T10:00+01:00") == []
    assert "runs without a known time, not compared with --since: 1" in call("--since", "2026-02-01").stdout
    assert "did you mean 'VM1'?" in call("--machine", "VM11").stdout
    assert "2026-03-31" in call("--since", "yesterday", code=2).stderr


def test_figures_of_the_json_are_those_of_the_run(tmp_path: Path, call: Callable[..., Result]) -> None:
    make(tmp_path / "runs", 0, results=[{"name": "q", "value": None, "expanded_uncertainty": 2e-6, "unit": "rad"}])
    (run,) = json.loads(call("--json").stdout)["runs"]
    (figure,) = run["figures"]
    assert figure["value"] is None
    assert figure["unit"] == "arcsec"
    assert figure["expanded_uncertainty"] == pytest.approx(2e-6 * 648000 / np.pi)
    assert "nan" in call().stdout


def test_broken_runs_are_skipped_named_and_counted(tmp_path: Path, call: Callable[..., Result]) -> None:
    make(tmp_path / "runs", 0)
    for number, text in ((1, "{"), (2, "[]"), (3, '{"schema": "other/1"}'), (4, "[" * 100000), (5, '"\\ud800"')):
        (make(tmp_path / "runs", number) / "run.json").write_text(text)
    found = call().stdout
    assert "1 run\nunreadable runs: 5\n" in found
    for number in (1, 2, 3, 4, 5):
        assert f"run-{number:05}" in found.partition("unreadable runs")[2]
    assert len(json.loads(call("--json").stdout)["skipped"]) == 5


@pytest.mark.parametrize("name", [b"bytes-\xff\xfe", b"title-\x1b]0;x\x07", b"new\nline"])
def test_a_name_that_cannot_be_printed_is_reported_and_hides_no_other_run(
    tmp_path: Path, call: Callable[..., Result], name: bytes
) -> None:
    good, bad = make(tmp_path, 1), make(tmp_path, 2)
    os.rename(os.fsencode(bad), os.path.join(os.fsencode(tmp_path), name))
    found = listing.list_runs([tmp_path])
    assert [path.name for path, _ in found.runs] == [good.name]
    (reason,) = found.skipped
    assert "printable characters" in reason
    assert reason.isprintable()
    for options in ([], ["--json"]):
        result = call(tmp_path, *options)
        assert (result.exit_code, good.name in result.output) == (0, True)


@pytest.mark.parametrize("key", ["test", "created", "status", "campaign", "bench", "method", "errors", "results"])
@pytest.mark.parametrize("value", [None, 7, [1], {"a": 1}, "\x1b[31m\n", 1e999])
def test_damage_of_any_field_is_reported(tmp_path: Path, call: Callable[..., Result], key: str, value: Any) -> None:
    path = make(tmp_path / "runs", 0)
    (path / "run.json").write_text(json.dumps({**state(0), "errors": None, key: value}))
    assert "\x1b" not in call().stdout
    assert len(json.loads(call("--json").stdout)["runs"]) == 1


@pytest.mark.parametrize("errors", ["../other/errors.nc", "/etc/passwd", "C:\\errors.nc", "a/../../b", "x" * 500])
def test_errors_outside_of_the_run_folder_are_not_opened(tmp_path: Path, errors: str) -> None:
    assert entry.read_entry(make(tmp_path, 0, errors=errors)).errors == ""


def test_changed_runs_are_read_again_and_others_are_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for number in range(5):
        make(tmp_path, number)
    read: list[str] = []

    def spy(folder: Path) -> entry.Entry:
        read.append(folder.name)
        return entry.read_entry(folder)

    monkeypatch.setattr(listing, "read_entry", spy)
    listing.list_runs([tmp_path])
    assert len(read) == 5
    assert (tmp_path / index.FILE).exists()
    read.clear()
    listing.list_runs([tmp_path])
    assert read == []
    make(tmp_path, 3, test="other", settled=False)
    (tmp_path / "run-00004" / "run.json").unlink()
    found = listing.list_runs([tmp_path]).runs
    assert read == ["run-00003"]
    assert {each.folder: each.test for _, each in found}["run-00003"] == "other"
    assert len(found) == 4


def test_a_file_that_may_change_within_its_time_stamp_is_not_indexed(tmp_path: Path) -> None:
    path = make(tmp_path, 0, settled=False)
    listing.list_runs([tmp_path])
    before = (path / "run.json").stat()
    (path / "run.json").write_text(json.dumps(state(0, test="tfird")))  # the same size
    os.utime(path / "run.json", ns=(before.st_mtime_ns, before.st_mtime_ns))
    ((_, found),) = listing.list_runs([tmp_path]).runs
    assert found.test == "tfird"


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        '{"schema": "errormotion.index/1", "runs": [3, {"folder": "run-00000"}]}',
        '{"schema": "errormotion.index/2"}\n3\n{"folder": "run-00000"}\n{',
        '{"schema": "errormotion.index/2"}\n' + 2 * ("[" * 100000 + "\n"),
        "[" * 100000,
    ],
)
def test_a_damaged_index_changes_nothing(tmp_path: Path, text: str) -> None:
    make(tmp_path, 0)
    expected = listing.list_runs([tmp_path]).runs
    (tmp_path / index.FILE).write_text(text)
    assert listing.list_runs([tmp_path]).runs == expected
    _, line = (tmp_path / index.FILE).read_text().splitlines()
    assert json.loads(line)["folder"] == "run-00000"


def test_a_long_line_of_an_index_is_not_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make(tmp_path, 0)
    listing.list_runs([tmp_path])
    assert list(index.load(tmp_path)) == ["run-00000"]
    monkeypatch.setattr(index, "MAX_LINE", 50)
    assert index.load(tmp_path) == {}


def test_a_folder_that_cannot_be_written_is_listed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make(tmp_path, 0)

    def refuse(*_: Any, **__: Any) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(index, "replace_text", refuse)
    assert len(listing.list_runs([tmp_path]).runs) == 1
    assert not (tmp_path / index.FILE).exists()


def test_folders_of_folders_and_single_runs_are_found_once(tmp_path: Path) -> None:
    make(tmp_path / "lab" / "VM1" / "runs", 0)
    path = make(tmp_path / "lab" / "VM2" / "runs", 1)
    (tmp_path / "lab" / "loop").symlink_to(tmp_path / "lab")
    assert len(listing.list_runs([tmp_path / "lab"]).runs) == 2
    assert len(listing.list_runs([path]).runs) == 1
    assert len(listing.list_runs([path, tmp_path / "lab"]).runs) == 2
    with raises("run.folder.not_found"):
        listing.list_runs([tmp_path / "nowhere"])


def test_a_single_run_keeps_the_index_of_its_neighbours(tmp_path: Path) -> None:
    for number in range(3):
        make(tmp_path, number)
    listing.list_runs([tmp_path])
    listing.list_runs([tmp_path / "run-00001"])
    assert len(index.load(tmp_path)) == 3


def test_figures_of_older_versions_are_computed_from_the_error_dataset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = np.full((2, 6), np.nan)
    values[:, 2] = [0.0, 3e-6]
    errors = datasets.build_errors(
        values,
        np.tile(1e-14 * np.eye(6), (2, 1, 1)),
        dims=("time",),
        coords={"time": [0.0, 60.0]},
        component="tool",
        machine="m",
        frame="machine",
        functional_point=np.zeros(3),
        reference="cold",
        method="foreign",
        method_version="1",
        provenance=provenance.make({}, None, None),
    )
    for number in range(3):
        path = make(tmp_path, number, results="none", errors="errors.nc")
        datasets.save(errors, path / "errors.nc")
    make(tmp_path, 3, results=None, errors="lost.nc")
    monkeypatch.setattr(listing, "MAX_READ", 3)
    found = listing.list_runs([tmp_path])
    assert found.waiting == 1
    assert "figures of merit cannot be read" in found.skipped[0]
    second = listing.list_runs([tmp_path])
    assert second.waiting == 0
    for _, each in second.runs[1:]:
        assert each.figures is not None
        assert each.figures[0].name == "EZ after 1.0 min"
        assert each.figures[0].value == pytest.approx(3e-6)


def test_the_schema_is_that_of_run_folders() -> None:
    assert entry.SCHEMA == run_folder.SCHEMA


def test_dates_without_zone_are_utc(tmp_path: Path) -> None:
    make(tmp_path, 0, created="2026-01-01T08:00:00")
    assert len(listing.list_runs([tmp_path], since=datetime(2026, 1, 1, 8)).runs) == 1
    assert listing.list_runs([tmp_path], since=datetime(2026, 1, 1, 9)).runs == ()


def test_thousands_of_runs_are_listed_quickly(tmp_path: Path) -> None:
    first = make(tmp_path, 0) / "run.json"
    for number in range(1, 2_000):
        folder = tmp_path / f"run-{number:05}"
        folder.mkdir()
        os.link(first, folder / "run.json")
    start = time.process_time()
    assert len(listing.list_runs([tmp_path]).runs) == 2_000
    without = time.process_time() - start
    start = time.process_time()
    assert len(listing.list_runs([tmp_path]).runs) == 2_000
    with_index = time.process_time() - start
    print(f"without index {without:.2f} s, with index {with_index:.2f} s")
    assert with_index < 0.6
