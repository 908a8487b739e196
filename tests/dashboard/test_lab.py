"""Runs of a folder, their selection, and the files that may be fetched."""

from pathlib import Path

import pytest
from coded import raises

from errormotion.dashboard.lab import Choice, Lab
from errormotion.errors import RunError


@pytest.fixture
def lab(runs: Path) -> Lab:
    return Lab(runs)


def test_every_run_is_listed_newest_first_with_its_first_figure(lab: Lab) -> None:
    table = lab.table(Choice())
    assert table.total == len(table.rows) == 2
    finished = next(row for row in table.rows if row.status == "finished")
    assert (finished.figure, finished.value, finished.unit) == ("EX after 60.0 min", "0.00", "µm")
    assert table.statuses == ("failed", "finished")
    assert "" not in (*table.machines, *table.methods, *table.verdicts)
    assert {lab.folder(row.key) for row in table.rows} == {
        path.resolve() for path in lab.runs.iterdir() if path.is_dir()
    }


@pytest.mark.parametrize(
    ("choice", "number"),
    [
        (Choice(status="failed"), 1),
        (Choice(text="DRIFT script"), 1),
        (Choice(text="nowhere"), 0),
        (Choice(machine="Mill"), 0),
        (Choice(since="2020-01-01"), 2),
        (Choice(since="2999-01-01"), 0),
    ],
)
def test_filters_select(lab: Lab, choice: Choice, number: int) -> None:
    assert len(lab.table(choice).rows) == number


def test_an_invalid_date_is_an_error(lab: Lab) -> None:
    with raises("request.date.form"):
        lab.table(Choice(since="yesterday"))


def test_a_missing_folder_is_an_empty_table(tmp_path: Path) -> None:
    assert Lab(tmp_path / "later").table(Choice()).rows == ()


@pytest.mark.parametrize("key", ["", ".", "..", "../{name}", "/etc", "{name}/.", "{name}/../{name}", "a\0b", "a" * 700])
def test_a_key_cannot_leave_the_folder(lab: Lab, runs: Path, key: str) -> None:
    with pytest.raises(RunError, match="No run"):
        lab.folder(key.format(name=next(path.name for path in runs.iterdir() if path.is_dir())))


def test_only_named_files_inside_the_folder_are_served(tmp_path: Path, lab: Lab, key: str) -> None:
    assert set(lab.run(key)[1]) == {"report", "run", "log", "errors"}
    assert lab.file(key, "errors").name == "errors.nc"
    for word in ("errors.nc", "../run.json", "", "raw"):
        with pytest.raises(RunError, match="has no file"):
            lab.file(key, word)
    run = tmp_path / "runs" / "linked"
    run.mkdir(parents=True)
    (run / "run.json").write_text('{"schema": "errormotion.run/1", "errors": "secret.nc"}')
    (tmp_path / "secret.nc").write_text("x")
    (run / "secret.nc").symlink_to(tmp_path / "secret.nc")
    (run / "report.html").symlink_to(tmp_path / "secret.nc")
    assert Lab(tmp_path / "runs").run("linked")[1] == ("run",)
