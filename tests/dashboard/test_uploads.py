"""Files that a browser sends: bounded, confined to the folder of runs, shown as a table, and added as a run."""

import json
import os
import time
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
from coded import raises

pytest.importorskip("bokeh", reason="pip install 'errormotion[dashboard]'")

from errormotion.campaign.folder import RunFolder
from errormotion.dashboard import door, uploads
from errormotion.dashboard.access import CONTROL_HEADER
from errormotion.dashboard.pages import adding
from errormotion.dashboard.uploads import Uploads

MARCH = 1_772_438_400
"""2026-03-02 08:00 UTC, s."""
ORDERS = [adding.UPLOAD, "/results/add/table.json", "/results/add/save", "/results/add/cancel"]


def positioning(axis: str = "X") -> str:
    """Return a test according to ISO 230-2 as measured, with a title that has markup."""
    lines = [f"<b>{axis}-Achse</b>", "", "Sollposition [mm];Abweichung [µm]"]
    for run in range(5):
        for k, targets in enumerate((range(10, 460, 45), range(415, 0, -45))):
            lines += [f"{t};{0.04 * t - 0.8 * k + 0.1 * ((7 * run + t) % 5):.2f}".replace(".", ",") for t in targets]
    return "\n".join(lines) + "\n"


@pytest.fixture
def controlling(serving: Callable[..., Any], tmp_path: Path) -> Any:
    return serving(tmp_path / "runs", control=True)


def send(served: Any, name: str, content: str, key: str = "") -> tuple[int, dict[str, Any]]:
    path = f"{adding.UPLOAD}?name={quote(name)}&key={key}&changed={1000 * MARCH}"
    headers = {"Origin": served.address.rstrip("/"), "Accept": "application/json"}
    status, _, text = served.ask(path, "POST", content, **headers)
    return status, json.loads(text)


def post(served: Any, path: str, **body: Any) -> tuple[int, dict[str, Any]]:
    headers = {"Origin": served.address.rstrip("/"), "Accept": "application/json"}
    status, _, text = served.ask(path, "POST", json.dumps(body), **headers)
    return status, json.loads(text)


def test_a_file_is_shown_with_its_questions_and_becomes_a_run(controlling: Any, tmp_path: Path) -> None:
    key = send(controlling, "Messung X.csv", positioning())[1]["key"]
    status, draft = post(controlling, "/results/add/table.json", key=key, answers={})
    [table] = draft["tables"]
    assert (status, table["count"], table["meanings"]) == (200, 100, ["target_position", "deviation.?"])
    proposed = {each["key"]: each["proposed"] for each in draft["questions"]}
    assert (proposed["attributes.axis"], proposed["columns.deviation"], proposed["machine"]) == ("X", "EXX", "")
    answers = {"machine": "Mill <1>", "attributes.axis": "X", "columns.deviation": "EXX"}
    status, added = post(controlling, "/results/add/save", key=key, answers=answers)
    assert status == 200, added
    folder = RunFolder.open(tmp_path / "runs" / added["run"])
    assert folder.finished
    assert (folder.data["created"], folder.data["created_from"]) == (
        "2026-03-02T08:00:00+00:00", "last change of the file"
    )  # fmt: skip
    assert not list((tmp_path / "runs").glob(".upload-*"))
    page = controlling.ask("/results")[2]
    assert "Mill &lt;1&gt;" in page
    assert "imported" in page


def test_a_missing_answer_adds_nothing_and_keeps_the_upload(controlling: Any, tmp_path: Path) -> None:
    key = send(controlling, "X.csv", positioning())[1]["key"]
    status, refused = post(controlling, "/results/add/save", key=key, answers={"attributes.axis": "X"})
    assert (status, refused["code"]) == (400, "add.answers.missing")
    assert not list((tmp_path / "runs").glob("*/run.json"))
    status, refused = post(controlling, "/results/add/table.json", key=key, answers={"attributes.axis": "Q"})
    assert (status, refused["code"]) == (400, "map.answer")


@pytest.mark.parametrize("name", ["../a.csv", "a/b.csv", "..", ".hidden", "a\\b.csv", "x" * 121, ""])
def test_a_name_that_leaves_the_folder_is_refused(controlling: Any, tmp_path: Path, name: str) -> None:
    status, refused = send(controlling, name, "1;2\n")
    assert (status, refused["code"]) == (400, "upload.name")
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


@pytest.mark.parametrize("key", ["../runs", "0" * 16, "", "x" * 16, "0123456789abcde/"])
def test_a_key_of_no_upload_is_refused(controlling: Any, key: str) -> None:
    status, refused = post(controlling, "/results/add/table.json", key=key, answers={})
    assert (status, refused["code"]) == (400, "upload.gone")


@pytest.mark.parametrize("order", ORDERS)
def test_without_control_nothing_is_stored(serving: Callable[..., Any], runs: Path, order: str, tmp_path: Path) -> None:
    served = serving(tmp_path / "runs")
    headers = {"Origin": served.address.rstrip("/"), "Accept": "application/json"}
    assert served.ask(f"{order}?name=a.csv", "POST", "{}", **headers)[0] == 403
    assert not (tmp_path / "runs").exists()
    assert "Drop the files" not in served.ask("/results")[2]


def test_a_file_that_is_too_large_is_refused(controlling: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adding, "MAX_UPLOAD", 100)
    assert send(controlling, "a.csv", "1" * 101)[0] == 400
    large = {"key": "0" * 16, "answers": {"machine": "x" * (adding.MAX_TEXT + 1)}}
    assert post(controlling, "/results/add/table.json", **large)[0] == 400


def test_uploads_are_few_and_none_in_use_is_removed(tmp_path: Path) -> None:
    found = Uploads(tmp_path / "runs")
    keys = [found.store("", "a.csv", b"1") for _ in range(uploads.MAX_FOLDERS)]
    with raises("upload.full"):
        found.store("", "a.csv", b"1")
    assert all([path.name for path in found.files(key)] == ["a.csv"] for key in keys)
    old = time.time() - uploads.MAX_AGE - 60
    for key in keys[:3]:
        os.utime(tmp_path / "runs" / f".upload-{key}", (old, old))
    found.files(keys[0])  # a use
    found.forget(keys[-1])
    keys = [keys[0], *keys[3:-1], found.store("", "b.csv", b"1")]
    assert {path.name for path in (tmp_path / "runs").iterdir()} == {f".upload-{key}" for key in keys}


def test_links_among_the_uploads_are_left_alone(tmp_path: Path) -> None:
    found = Uploads(tmp_path / "runs")
    found.store("", "a.csv", b"1")
    (tmp_path / "outside").mkdir()
    for number, target in (("b", tmp_path / "nowhere"), ("c", tmp_path / "outside")):
        (tmp_path / "runs" / f".upload-{number * 16}").symlink_to(target)
    assert found.store("", "a.csv", b"1")
    assert (tmp_path / "outside").is_dir()


def test_a_file_replaces_no_other_one_of_its_upload(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = Uploads(tmp_path / "runs")
    key = found.store("", "a.csv", b"first")
    for name in ("a.csv", "A.csv"):
        with raises("upload.twice"):
            found.store(key, name, b"second")
    assert [path.read_bytes() for path in found.files(key)] == [b"first"]
    monkeypatch.setattr(uploads, "MAX_TOTAL", 8)
    found.store(key, "b.csv", b"123")
    with raises("upload.too_large"):
        found.store(key, "c.csv", b"1")


def test_cancel_removes_the_files(controlling: Any, tmp_path: Path) -> None:
    key = send(controlling, "X.csv", positioning())[1]["key"]
    for _ in range(2):
        assert post(controlling, "/results/add/cancel", key=key, answers={})[0] == 200
        assert not list((tmp_path / "runs").glob(".upload-*"))


def test_old_uploads_are_removed_at_the_start(serving: Callable[..., Any], tmp_path: Path) -> None:
    found = Uploads(tmp_path / "runs")
    keys = [found.store("", "a.csv", b"1") for _ in range(2)]
    old = time.time() - uploads.MAX_AGE - 60
    os.utime(tmp_path / "runs" / f".upload-{keys[0]}", (old, old))
    serving(tmp_path / "runs", control=True)
    assert [path.name for path in (tmp_path / "runs").iterdir()] == [f".upload-{keys[1]}"]


@pytest.mark.parametrize("control", [False, True])
def test_only_those_who_may_write_send_the_body_of_a_file(
    serving: Callable[..., Any], tmp_path: Path, control: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    served = serving(tmp_path / "runs", control=control)
    stored: list[int] = []
    inner = door._Request.data_received
    monkeypatch.setattr(
        door._Request, "data_received", lambda self, chunk: stored.append(self._answered) or inner(self, chunk)
    )
    headers = {"Origin": served.address.rstrip("/"), "Accept": "application/json", CONTROL_HEADER: "wrong"}
    status = served.ask(f"{adding.UPLOAD}?name=a.csv", "POST", "1;2\n" * 10_000, **headers)[0]
    assert status == 403
    assert all(stored)


def test_the_names_of_files_are_plain(tmp_path: Path) -> None:
    found = Uploads(tmp_path / "runs")
    keys = [found.store("", "a.csv", b"1")]
    for name in ("a\x00.csv", " a", "a\n", "..", "C:a"):
        with raises("upload.name"):
            found.store(keys[-1], name, b"1")
    with raises("upload.empty"):
        found.store(keys[-1], "b.csv", b"")
    (tmp_path / "outside").mkdir()
    (tmp_path / "runs" / f".upload-{'a' * 16}").symlink_to(tmp_path / "outside")
    with raises("upload.gone"):
        found.store("a" * 16, "b.csv", b"1")
    assert list((tmp_path / "outside").iterdir()) == []


def test_only_columns_that_can_be_corrected_have_a_key(controlling: Any) -> None:
    """Each column of a matrix is one run of one variable; a correction of it would be ignored."""
    matrix = "Position [mm];R1 [µm];R2 [µm];R3 [µm]\n" + "".join(f"{t};{t}.1;{t}.2;{t}.3\n" for t in range(10, 100, 9))
    key = send(controlling, "X.csv", matrix)[1]["key"]
    [table] = post(controlling, "/results/add/table.json", key=key, answers={})[1]["tables"]
    assert table["meanings"][1].startswith("deviation.?, run")
    assert table["keys"] == ["columns.target_position", "", "", ""]


def test_each_key_of_a_column_changes_its_meaning(controlling: Any) -> None:
    log = "Time [s];front [°C];back [°C];spare [°C]\n" + "".join(f"{60 * k};{20 + k};{k};{2 * k}\n" for k in range(20))
    key = send(controlling, "a.csv", log)[1]["key"]
    [table] = post(controlling, "/results/add/table.json", key=key, answers={})[1]["tables"]
    changed = 0
    for own, title in zip(table["keys"], table["titles"], strict=True):
        other = next(each for each in table["titles"] if each != title)
        if own:
            [again] = post(controlling, "/results/add/table.json", key=key, answers={own: other})[1]["tables"]
            assert again["meanings"] != table["meanings"], own
            changed += 1
    assert changed >= 3


def test_a_second_table_has_no_keys(controlling: Any) -> None:
    """Its time has the name of that of the first table, which would be changed."""
    key = send(controlling, "X.csv", positioning())[1]["key"]
    log = "Time [s];bar [°C]\n" + "".join(f"{60 * k};{20 + 0.1 * k:.1f}\n" for k in range(20))
    send(controlling, "b.csv", log, key)
    first, second = post(controlling, "/results/add/table.json", key=key, answers={})[1]["tables"]
    assert first["keys"] == ["columns.target_position", ""]
    assert second["keys"] == ["", ""]


def test_files_of_the_record_are_added_once_more_on_request_only(controlling: Any, tmp_path: Path) -> None:
    answers = {"machine": "Mill", "attributes.axis": "X", "columns.deviation": "EXX"}
    runs, found = tmp_path / "runs", []
    for again in (False, False, True):
        key = send(controlling, "X.csv", positioning())[1]["key"]
        draft = post(controlling, "/results/add/table.json", key=key, answers={})[1]
        assert draft["known"] == ("" if not found else found[0])
        status, added = post(controlling, "/results/add/save", key=key, answers=answers, again=again)
        assert (status, added["known"]) == (200, bool(found) and not again)
        assert (runs / f".upload-{key}").exists() == added["known"]  # what was corrected can be added
        found.append(added["run"])
    assert found[1] == found[0] != found[2]
    assert {path.parent.name for path in runs.glob("*/run.json")} == {*found}


def test_what_is_shown_is_saved_and_an_answer_can_be_changed(controlling: Any, tmp_path: Path) -> None:
    """A log needs no answer: the map of an earlier one of its kind, with corrected columns, is not used for it."""
    titles = "Time [s];front [°C];back [°C]\n"
    texts = [titles + "".join(f"{60 * k};{20 + k / 10};{30 + j + k / 10}\n" for k in range(20)) for j in range(2)]
    saved = []
    for text, corrected in zip(texts, ({"columns.temperature.front": "back"}, {}), strict=True):
        key = send(controlling, "a.csv", text)[1]["key"]
        draft = post(controlling, "/results/add/table.json", key=key, answers=corrected)[1]
        answers = {"machine": "Mill", **corrected}
        status, added = post(controlling, "/results/add/save", key=key, answers=answers)
        assert status == 200, added
        with (tmp_path / "runs" / added["run"] / "map.toml").open("rb") as file:
            saved.append(tomllib.load(file))
        meanings = dict(zip(draft["tables"][0]["titles"], draft["tables"][0]["meanings"], strict=True))
        columns = saved[-1]["parts"][0]["columns"] if "parts" in saved[-1] else saved[-1]["columns"]
        assert columns["temperature"][meanings["front [°C]"].partition(".")[2]] == "front [°C]"
    key = send(controlling, "X.csv", positioning())[1]["key"]
    draft = post(controlling, "/results/add/table.json", key=key, answers={"attributes.axis": "Y"})[1]
    [axis] = [each for each in draft["questions"] if each["key"] == "attributes.axis"]
    assert axis["proposed"] == "Y"


def test_errors_name_the_files_without_the_folder_of_the_upload(controlling: Any) -> None:
    key = send(controlling, "letter.txt", "Dear customer,\nthank you.\n")[1]["key"]
    status, refused = post(controlling, "/results/add/table.json", key=key, answers={})
    assert status == 400
    assert "letter.txt" in refused["error"]
    assert ".upload-" not in refused["error"]
