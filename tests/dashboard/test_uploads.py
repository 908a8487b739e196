"""Files that a browser sends: bounded, confined to the folder of runs, shown as a table, and added as a run."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
from coded import raises

pytest.importorskip("bokeh", reason="pip install 'errormotion[dashboard]'")

from errormotion.campaign.folder import RunFolder
from errormotion.dashboard import uploads
from errormotion.dashboard.pages import adding
from errormotion.dashboard.uploads import Uploads

MARCH = 1_772_438_400
"""2026-03-02 08:00 UTC, s."""
ORDERS = [adding.UPLOAD, "/results/add/table.json", "/results/add/save"]


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


def test_uploads_are_few_and_the_oldest_is_removed(tmp_path: Path) -> None:
    found = Uploads(tmp_path / "runs")
    keys = [found.store("", "a.csv", b"1") for _ in range(uploads.MAX_FOLDERS + 2)]
    assert len(list((tmp_path / "runs").iterdir())) == uploads.MAX_FOLDERS
    assert [path.name for path in found.files(keys[-1])] == ["a.csv"]
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
