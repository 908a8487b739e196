"""The page Measure over HTTP: fields, messages, plan, and rejected requests without control."""

import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("bokeh", reason="pip install 'errormotion[dashboard]'")

from errormotion.campaign.background import processes
from errormotion.dashboard.cache import TimedCache
from errormotion.dashboard.campaigns import hash_of
from errormotion.dashboard.pages import measure

BENCH = """\
schema = "errormotion.bench/1"
name = "Virtual C-frame"
machine = "C-frame (virtual)"
[instruments.frame]
driver = "five_sensor_frame"
address = "sim://cframe?seed=3"
rate = "1.5 kHz"
[instruments.control]
driver = "virtual_controller"
arm = true
address = "sim://cframe/controller?seed=3"
"""
CAMPAIGN = """\
schema = "errormotion.campaign/1"
name = '{name}'
bench = "bench.toml"
[[test]]
name = "drift"
method = "spindle_drift"
[test.settings]
duration = "1 min"   # of the record
schedule = [{ at = "0 s", spindle_speed = "15000 /min" }]
"""
ORDERS = ["/measure/save", "/measure/start", "/measure/resume", "/measure/stop", "/measure/answer"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, markup: str) -> Path:
    root = tmp_path_factory.mktemp("campaigns")
    (root / "bench.toml").write_text(BENCH)
    (root / "drift.toml").write_text(CAMPAIGN.replace("{name}", markup.replace("'", "")))
    return root


@pytest.fixture(scope="module")
def reading(serving: Callable[..., Any], folder: Path) -> Any:
    return serving(folder / "runs", campaigns=folder)


@pytest.fixture(scope="module")
def controlling(serving: Callable[..., Any], folder: Path) -> Any:
    return serving(folder / "runs", campaigns=folder, control=True)


def _post(served: Any, path: str, **body: Any) -> tuple[int, dict[str, Any]]:
    headers = {"Origin": served.address.rstrip("/"), "Accept": "application/json"}
    status, _, text = served.ask(path, "POST", json.dumps(body), **headers)
    return status, json.loads(text)


def _field(form: dict[str, Any], *place: str | int) -> dict[str, Any]:
    fields = [each for group in form["groups"] for each in group["fields"]]
    return next(each for each in fields if each["place"] == list(place))


DURATION = ("test", 0, "settings", "duration")


def test_a_wrong_value_has_its_message_at_its_field_and_the_text_follows(reading: Any, folder: Path) -> None:
    text = (folder / "drift.toml").read_text()
    status, form = _post(reading, "/measure/form.json", file="drift.toml", text=text, place=DURATION, value="2")
    assert (status, form["count"], form["mistakes"]) == (200, 1, [])
    assert form["text"] == text.replace('"1 min"   # of', '"2"   # of')
    assert _field(form, *DURATION)["mistakes"] == ["expected a time with its unit, such as '104 min'; found '2'"]
    _, form = _post(reading, "/measure/form.json", file="drift.toml", text=form["text"], place=DURATION, value="")
    assert "duration" not in form["text"]
    assert (form["count"], _field(form, *DURATION)["default"]) == (0, "5 h")
    _, form = _post(reading, "/measure/form.json", file="drift.toml", text="name = ")
    assert (form["groups"], form["count"]) == ([], 1)
    _, form = _post(reading, "/measure/form.json", file="drift.toml", text=text, place=["test", 0, "method"], value="x")
    assert "x" in _field(form, "test", 0, "method")["mistakes"][0]


def test_tests_are_added_and_removed(reading: Any, folder: Path) -> None:
    text = (folder / "drift.toml").read_text()
    _, form = _post(reading, "/measure/form.json", file="drift.toml", text=text, add=True)
    assert form["text"] == text + '\n[[test]]\nname = "test-2"\nmethod = ""\n'
    assert [group["test"] for group in form["groups"]] == [None, 0, 1]
    assert _field(form, "test", 1, "method")["mistakes"]
    _, form = _post(reading, "/measure/form.json", file="drift.toml", text=form["text"], remove=1)
    assert (form["text"].rstrip(), form["count"]) == (text.rstrip(), 0)
    for wrong in (-1, "0", True, 7):
        status, found = _post(reading, "/measure/form.json", file="drift.toml", text=text, remove=wrong)
        assert (status, found["code"]) in ((400, "request.form"), (400, "toml.edit.no_key"))


def test_the_page_shows_names_as_text(reading: Any) -> None:
    status, _, text = reading.ask("/measure?file=drift.toml")
    assert status == 200
    assert "&lt;script&gt;" in text
    assert "<script>window" not in text
    assert reading.ask("/measure?file=bench.toml")[0] == 404
    for name in ("..%2Fdrift.toml", "x%00.toml", "%2Fetc%2Fhostname", ".."):
        assert reading.ask(f"/measure?file={name}")[0] == 404


def test_the_plan_is_that_of_the_commands(reading: Any, folder: Path) -> None:
    status, found = _post(reading, "/measure/plan.json", file="drift.toml", text=(folder / "drift.toml").read_text())
    (test,) = found["tests"]
    assert (status, test["headline"]) == (200, "1 min 00 s, 0 moves over 0.0 m, 0 touches")
    assert ["spindle/(1/min)", "up to 15000", "-"] in test["limits"]
    assert {row[0] for row in test["expected"]} == {"EX", "EY", "EZ", "EA", "EB"}
    assert test["picture"].startswith("data:image/png;base64,")


@pytest.mark.parametrize("path", ORDERS)
def test_nothing_is_started_or_stopped_without_control(reading: Any, folder: Path, path: str) -> None:
    text = (folder / "drift.toml").read_text()
    body = {"file": "x.toml", "text": text, "before": "", "run": "x", "process": "x", "number": 1}
    status, found = _post(reading, path, **body)
    assert (status, found) == (
        403,
        {"error": "The dashboard was started without --allow-control", "code": "request.forbidden"},
    )
    assert reading.ask(path, "POST", json.dumps(body), Origin="http://evil.example")[0] == 403
    assert not (folder / "x.toml").exists()
    assert not (folder / "runs").exists()


@pytest.mark.parametrize("path", ORDERS)
def test_actions_are_accepted_from_pages_of_this_server_only(controlling: Any, path: str) -> None:
    assert controlling.ask(path, "POST", "{}", Origin="http://evil.example")[0] == 403
    assert controlling.ask(path, "POST", "{}")[0] == 403
    assert controlling.ask(path)[0] == 405


def test_every_action_requires_control() -> None:
    handlers = dict(measure.HANDLERS)
    assert all(handlers[path].controls for path in ORDERS)
    reads = {"/measure", r"/measure/form\.json", r"/measure/plan\.json"}
    reads |= {r"/measure/processes\.json", r"/measure/live\.json"}
    assert set(handlers) - set(ORDERS) == reads


def test_a_file_is_saved_once_and_changes_of_others_are_not_overwritten(controlling: Any, folder: Path) -> None:
    text = (folder / "drift.toml").read_text()
    order = {"file": "other.toml", "text": text, "before": ""}
    assert _post(controlling, "/measure/save", **order) == (200, {"file": "other.toml", "before": hash_of(text)})
    changed = {**order, "text": text.replace("1 min", "2 min")}
    assert "was changed by another program" in _post(controlling, "/measure/save", **changed)[1]["error"]
    assert _post(controlling, "/measure/save", **{**changed, "before": hash_of(text)})[0] == 200
    assert (folder / "other.toml").read_text() == changed["text"]
    for name in ("../x.toml", "x.txt", ".x.toml", "a/b.toml", "bench.toml"):
        assert _post(controlling, "/measure/save", **{**order, "file": name})[0] in (400, 404)
    assert (folder / "bench.toml").read_text() == BENCH
    assert (
        "1 mistakes"
        in _post(controlling, "/measure/start", **{**order, "text": text.replace("1 min", "1")})[1]["error"]
    )
    assert processes.found(folder / "runs") == []


def test_without_control_no_other_files_are_read(reading: Any, folder: Path) -> None:
    text = (folder / "drift.toml").read_text()
    asked = itertools.product(("drift.toml", "", "none.toml", "../drift.toml"), ("/etc/hostname", "../b.toml", "C:/x"))
    for name, path in asked:
        status, found = _post(reading, "/measure/form.json", file=name, text=text.replace("bench.toml", path))
        assert (status, "reads files of its folder only" in found["error"]) == (400, True)


@pytest.mark.parametrize("body", ["", "[]", "{}", '{"file": 1, "text": "x"}', "[" * 100_000, "\xff"])
def test_an_invalid_request_is_rejected(reading: Any, body: str) -> None:
    headers = {"Origin": reading.address.rstrip("/"), "Accept": "application/json"}
    assert reading.ask("/measure/form.json", "POST", body, **headers)[0] == 400


def test_many_clients_do_not_increase_the_load_of_the_server() -> None:
    made: list[int] = []
    lately: TimedCache[int] = TimedCache(1000.0, most=2)

    def make() -> int:
        made.append(len(made))
        return made[-1]

    assert [lately.get("a", make) for _ in range(20)] == [0] * 20
    assert [lately.get(key, make) for key in "bca"] == [1, 2, 3]
    assert TimedCache(0.0).get("a", make) == 4


def _real(folder: Path, name: str) -> str:
    """Write a bench at real addresses that nothing answers, and return a campaign for it."""
    (folder / f"{name}-bench.toml").write_text(BENCH.replace("sim://cframe/controller?seed=3", "tcp://127.0.0.1:9"))
    return CAMPAIGN.replace("{name}", name).replace("bench.toml", f"{name}-bench.toml")


def test_a_real_machine_is_started_only_with_the_word_that_releases_its_motions(
    controlling: Any, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[list[str]] = []

    def spawn(where: Path, runs: Path, state: dict[str, Any], arguments: list[str]) -> None:
        started.append(list(arguments))

    monkeypatch.setattr(processes, "_spawn", spawn)
    order = {"file": "real.toml", "text": _real(folder, "real"), "before": hash_of("")}
    status, found = _post(controlling, "/measure/start", **order)
    assert (status, found["process"], found["word"], started) == (200, "", "move", [])
    (line,) = found["motions"]
    assert line.startswith("drift: the machine will move: spindle up to 15000 /min")
    for wrong in ("yes", "MOVE", "true"):
        status, found = _post(controlling, "/measure/start", **order, release=wrong)
        assert (status, started) == (400, [])
        assert "expected the word 'move'" in found["error"]
    for odd in (True, 1, ["move"]):
        assert _post(controlling, "/measure/start", **order, release=odd)[0] == 400
    assert started == []
    for shown in ({}, {"motions": []}, {"motions": [line.replace("15000", "1500")]}):  # the word alone, or for others
        status, found = _post(controlling, "/measure/start", **order, **shown, release="move")
        assert (status, found["process"], found["motions"], started) == (200, "", [line], [])
    status, found = _post(controlling, "/measure/start", **order, release="move", motions=[line])
    assert (status, bool(found["process"])) == (200, True)
    assert ["--move" in each for each in started] == [False]


def test_a_simulated_machine_is_started_at_once(
    controlling: Any, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[list[str]] = []
    monkeypatch.setattr(processes, "_spawn", lambda *values: started.append(list(values[-1])))
    text = (folder / "drift.toml").read_text()
    status, found = _post(controlling, "/measure/start", file="drift.toml", text=text, before=hash_of(text))
    assert (status, bool(found["process"])) == (200, True)
    assert ["--move" in each for each in started] == [False]
