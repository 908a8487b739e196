"""A run folder of somebody else is continued, noted and reported without writing through a link in it."""

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from coded import raises

from errormotion.campaign import runner
from errormotion.campaign.files import CampaignPlan
from errormotion.campaign.folder import RunFolder, list_runs
from errormotion.datasets.files import events, writing
from errormotion.errors import RunError
from errormotion.report import write_run_report
from errormotion.report.page import logo

Plan = Callable[..., CampaignPlan]


@pytest.fixture
def home(tmp_path: Path) -> Iterator[Path]:
    """Files of the user outside of the run; none is changed and none is added."""
    folder = tmp_path / "home"
    (folder / "papers").mkdir(parents=True)
    (folder / "mine.txt").write_text("mine")
    (folder / "papers" / "thesis.txt").write_text("thesis")
    yield folder
    assert {each.name: each.read_text() for each in folder.rglob("*.txt")} == {
        "mine.txt": "mine",
        "thesis.txt": "thesis",
    }
    assert sorted(each.name for each in folder.rglob("*")) == ["mine.txt", "papers", "thesis.txt"]


@pytest.fixture
def unfinished(plan: Plan, tmp_path: Path) -> tuple[CampaignPlan, RunFolder]:
    """A run whose identification failed, and which can be continued."""
    made = plan(f'name = "a"\nsettings = {{needs_file = "{tmp_path / "needed"}"}}')
    with raises("method.other"):
        runner.run(made)
    (tmp_path / "needed").touch()
    (folder,) = list_runs(tmp_path / "runs")
    return made, folder


def put(folder: RunFolder, name: str, target: Path) -> None:
    path = folder.path / name
    path.unlink(missing_ok=True)
    path.parent.mkdir(exist_ok=True)
    path.symlink_to(target)


@pytest.mark.parametrize("name", [".reserve", "run.json.part", "report.html.part", "report.html"])
def test_links_in_place_of_written_files_are_replaced_or_left(unfinished, home: Path, name: str) -> None:
    made, folder = unfinished
    put(folder, name, home / "mine.txt")
    (done,) = runner.resume(made)
    done.take_reserve()
    done.give_reserve()
    assert done.finished
    assert not write_run_report(done.path).is_symlink()


def test_a_temporary_file_has_another_name_each_time_and_is_never_an_existing_one(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = set()
    for _ in range(2):
        with writing.replacing(tmp_path / "a") as part:
            names.add(part.name)
    assert len(names) == 2
    monkeypatch.setattr(writing.secrets, "token_hex", lambda count: "0" * 2 * count)
    (tmp_path / f".a.{16 * '0'}.part").symlink_to(home / "mine.txt")
    with pytest.raises(FileExistsError):
        writing.replace_bytes(tmp_path / "a", b"not mine")


@pytest.mark.parametrize("name", ["log.jsonl", "errors", "errors/ramp-{hash}", "errors/ramp-{hash}/errors.nc"])
def test_a_run_with_a_link_in_place_of_its_results_is_refused(unfinished, home: Path, name: str) -> None:
    made, folder = unfinished
    name = name.format(hash=folder.data["settings_hash"])
    (folder.path / name).parent.mkdir(parents=True, exist_ok=True)
    put(folder, name, home / ("mine.txt" if "." in name else "papers"))
    with pytest.raises(RunError, match="link"):
        runner.resume(made)


def test_a_note_is_not_written_through_a_link_and_does_not_wait_for_a_pipe(unfinished, home: Path) -> None:
    _, folder = unfinished
    note = events.event("a note", by="me")
    put(folder, events.FILE, home / "mine.txt")
    with raises("event.file.unwritable"):
        events.append(folder.path, note)
    (folder.path / events.FILE).unlink()
    os.mkfifo(folder.path / events.FILE)
    with raises("event.file.unwritable"):
        events.append(folder.path, note)


def test_a_report_contains_nothing_that_lies_outside_of_the_run(unfinished, home: Path, tmp_path: Path) -> None:
    made, folder = unfinished
    (tmp_path / "secret.svg").write_text('<svg xmlns="http://www.w3.org/2000/svg"/>')
    put(folder, "logo.svg", tmp_path / "secret.svg")
    (done,) = runner.resume(made)
    assert logo.of_folder(done.path) == ""
    (done.path / "logo.svg").unlink()
    shutil.copy(tmp_path / "secret.svg", done.path / "logo.svg")
    assert logo.of_folder(done.path).startswith("data:image/svg+xml;base64,")
    assert done.errors is not None
    shutil.move(done.errors, tmp_path / "errors.nc")
    put(done, done.data["errors"], tmp_path / "errors.nc")
    with raises("run.no_errors"):
        write_run_report(done.path)


@pytest.mark.parametrize(
    ("text", "is_picture"),
    [
        ('<?xml version="1.0"?>\n<!-- made by hand -->\n<svg width="1">', True),
        ("\ufeff<svg:svg>", True),
        ("<html><body>secret</body></html>", False),
        ("<project><password>secret</password></project>", False),
        ("<svgx>", False),
    ],
)
def test_a_logo_is_a_picture(tmp_path: Path, text: str, is_picture: bool) -> None:
    (tmp_path / "logo.svg").write_text(text, encoding="utf-8")
    assert (logo.mistake(tmp_path / "logo.svg") == "") == is_picture
