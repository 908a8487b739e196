"""Imported runs of every method, and answers that are kept for a machine."""

from pathlib import Path
from threading import Thread
from typing import Any

import pytest
from coded import raises

from errormotion import datasets, plugins
from errormotion.datasets import provenance
from errormotion.plugins import MethodSubject
from errormotion.record.adding import machines
from errormotion.record.adding.add import add
from errormotion.record.adding.exclusive import exclusive
from errormotion.record.adding.questions import take_proposals
from errormotion.record.adding.request import Request
from errormotion.report import write_run_report

SLOW = {"crossbeam_scan", "multilateration", "spindle_drift"}
SUBJECTS = [
    pytest.param(subject, id=f"{each.id} {subject.name}", marks=[pytest.mark.slow] * (each.id in SLOW))
    for each in plugins.available("methods")
    if each.cls is not None and each.distribution.startswith("errormotion ")
    for subject in each.cls().conformance()
]


@pytest.mark.parametrize("subject", SUBJECTS)
def test_imported_data_of_every_method_have_a_report_without_defaults_of_the_acquisition(
    subject: MethodSubject, tmp_path: Path
) -> None:
    subject.warm_up()
    raw, _ = subject.make(1)
    file = datasets.save(raw.assign_attrs(machine="VMC 850"), tmp_path / "a.nc")
    settings = subject.effective_settings()
    added = add(
        Request((file,), tmp_path / "runs", settings=lambda model: settings), take_proposals, report=write_run_report
    )
    assert added.folder.finished
    assert [step["outcome"] for step in added.folder.data["steps"]] == ["done", "done"]
    unstated = {*subject.plugin.acquisition_settings} - settings.model_fields_set
    stated = provenance.of(datasets.load(str(added.folder.errors)))["settings"]
    assert not unstated & {*stated, *added.folder.data["settings"]}
    assert set(type(settings).model_fields) - unstated == set(stated)


def test_answers_are_kept_by_machine_and_schema_with_the_comments_of_the_user(tmp_path: Path) -> None:
    machines.remember(tmp_path, "VMC 850", "errormotion.raw.a/1", {"values.functional_point": "0 0 110 mm", "raw": "x"})
    file = tmp_path / machines.FILE
    file.write_text(file.read_text() + "# of the user\n")
    machines.remember(tmp_path, "VMC 850", "errormotion.raw.b/1", {"values.bar_radius": "5 mm"})
    machines.remember(tmp_path, "VMC 850", "errormotion.raw.a/1", {"values.functional_point": "0 0 90 mm"})
    known = machines.load_machines(tmp_path)
    assert known.answers("VMC 850", "errormotion.raw.a/1") == {"values.functional_point": "0 0 90 mm"}
    assert known.answers("VMC 850", "errormotion.raw.b/1") == {"values.bar_radius": "5 mm"}
    assert known.answers("other", "errormotion.raw.b/1") == {}
    assert "# of the user" in file.read_text()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            'schema = "errormotion.machines/1"\n[machines.A."b/1"]\n"values.x" = 3\n',
            "machines.A.b/1.values.x: expected",
        ),
        ('schema = "errormotion.machine/1"\n', "did you mean"),
        ('schema = "errormotion.machines/1"\nmachine = 1\n', "machine: unknown key"),
    ],
)
def test_a_damaged_file_of_answers_is_refused_with_its_key(tmp_path: Path, text: str, expected: str) -> None:
    (tmp_path / machines.FILE).write_text(text)
    with raises("toml.mistakes") as caught:
        machines.load_machines(tmp_path)
    assert expected in str(caught.value)


def test_a_file_that_is_a_folder_or_stated_twice_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b.csv").write_text("1")
    (tmp_path / "c.csv").write_text("1")

    def call(*files: Path) -> Any:
        return add(Request(files, tmp_path / "runs"), take_proposals)

    with raises("add.file.unreadable"):
        call(tmp_path / "a")
    with raises("add.file.twice"):
        call(tmp_path / "b.csv", tmp_path / "c.csv")
    (tmp_path / "other").mkdir()
    for name in ("B.csv", "b.CSV"):  # one file on a disk that ignores case
        (tmp_path / "other" / name).write_text("2")
        with raises("add.file.twice"):
            call(tmp_path / "b.csv", tmp_path / "other" / name)
    assert not (tmp_path / "runs").exists()


def test_a_file_that_is_added_meanwhile_becomes_one_run(tmp_path: Path) -> None:
    subject: Any = SUBJECTS[0].values[0]
    raw, _ = subject.make(1)
    file = datasets.save(raw.assign_attrs(machine="VMC 850"), tmp_path / "a.nc")

    def request(again: bool = False) -> Request:
        settings = subject.effective_settings()
        return Request((file,), tmp_path / "runs", settings=lambda model: settings, again=again)

    others: list[Path] = []

    def stage(name: str) -> None:
        if name == "reading the files" and not others:
            others.append(add(request(), take_proposals).folder.path)

    with raises("add.known.meanwhile"):
        add(request(), take_proposals, stage=stage)
    assert [each.parent for each in (tmp_path / "runs").glob("*/run.json")] == others
    assert add(request(again=True), take_proposals).folder.path not in others


def test_answers_of_two_processes_are_all_kept(tmp_path: Path) -> None:
    file = tmp_path / machines.FILE
    with exclusive(tmp_path):
        other = Thread(target=machines.remember, args=(tmp_path, "A", "a/1", {"values.x": "1 mm"}))
        other.start()
        other.join(0.3)
        assert not file.exists()
        file.write_text('schema = "errormotion.machines/1"\n[machines.A."a/1"]\n"values.y" = "2 mm"\n')
    other.join()
    assert machines.load_machines(tmp_path).answers("A", "a/1") == {"values.x": "1 mm", "values.y": "2 mm"}
