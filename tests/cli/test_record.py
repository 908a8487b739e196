"""``errormotion record`` and ``replay``: recorded communication, with the identity, replayed to the driver."""

import json
from pathlib import Path
from typing import Any

import pytest
from coded import raises
from command_line import CliRunner

from errormotion.cli.app import app
from errormotion.errors import ReplayError
from errormotion.instruments.sessions.masking import mask, words_of
from errormotion.instruments.thermometer.dcon import DconTemperature
from errormotion.instruments.transports.recording import (
    INDEX_FORMAT,
    add_note,
    parts_of,
    read_note,
    read_recording,
    rewrite,
)

BENCH = """schema = "errormotion.bench/1"
name = "b"
machine = "cframe"

[instruments.air]
driver = "dcon_temperature"
address = "sim://cframe/air?seed=3"

[instruments.dead]
driver = "keyence_lk"
address = "sim://cframe?seed=3&fault=silence&fault_at=9"
timeout = "0.3 s"

[instruments.nobody]
driver = "keyence_lk"
address = "tcp://127.0.0.1:9"

[instruments.gauge]
driver = "optoncdt"
address = "sim://cframe/X1?seed=3"

[instruments.tracker]
driver = "leica_emscon"
address = "sim://cframe/tracker?seed=3"

[instruments.frame]
driver = "five_sensor_frame"
address = "sim://cframe?seed=3"
rate = "1.5 kHz"
bar_radius = "5 mm"
levels = ["10 mm", "50 mm"]
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bench.toml").write_text(BENCH)
    return tmp_path


def run(*words: str, code: int = 0) -> dict[str, Any]:
    result = CliRunner().invoke(app, [*words, "--json"])
    assert result.exit_code == code, result.output
    found: dict[str, Any] = json.loads(result.stdout)
    return found


@pytest.mark.parametrize("name", ["air", "gauge", "tracker", "frame"])
def test_a_recorded_session_is_reproduced_frame_by_frame(folder: Path, name: str) -> None:
    recorded = run("record", "bench.toml", name, "--for", "0.3 s", "--out", "a.rec")
    assert recorded["files"][0] == "a.rec"
    assert len(recorded["files"]) == (6 if name == "frame" else 1)
    again = run("replay", "a.rec")
    assert (again["reproduced"], again["differences"]) == (True, [])
    assert again["frames"] == sum(len(read_recording(part)[1]) for part in parts_of(Path("a.rec")))
    session = recorded["note"]["session"]
    assert again["readings"] == session["readings"]
    assert again["readings"]["count"] >= 3
    assert again["stream"] == session["stream"]
    assert (again["stream"]["count"] > 0) == (name != "air")
    identity = session["identity"]
    assert again["identity"]["serial_number"] == identity["serial_number"]
    assert recorded["note"]["plugin_version"]


def test_an_instrument_without_a_stream_is_read_for_the_whole_duration(folder: Path) -> None:
    recorded = run("record", "bench.toml", "air", "--for", "1 s", "--out", "a.rec")
    assert 4 <= recorded["note"]["session"]["readings"]["count"] <= 3 + 1.0 / 0.2
    result = CliRunner().invoke(app, ["replay", "a.rec"])
    assert "reproduced frame by frame" in result.stdout
    assert "DCON 7018 unit 01 A2.0" in result.stdout


def test_a_session_that_ends_with_an_error_is_recorded(folder: Path) -> None:
    recorded = run("record", "bench.toml", "dead", "--for", "0.3 s", "--out", "a.rec", code=1)
    assert recorded["note"]["session"]["error"] == "InstrumentTimeoutError"
    assert recorded["note"]["session"]["step"] == "stream"
    assert run("replay", "a.rec")["reproduced"]


def test_a_missing_instrument_leaves_no_recording(folder: Path) -> None:
    run("record", "bench.toml", "nobody", "--out", "a.rec", code=1)
    assert not Path("a.rec").exists()


def test_a_changed_driver_does_not_reproduce_the_session(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run("record", "bench.toml", "air", "--for", "0.1 s", "--out", "a.rec")
    dcon = "errormotion.instruments.thermometer.dcon"
    monkeypatch.setattr(f"{dcon}.OPEN_SENSOR", 10.0)
    found = run("replay", "a.rec", code=3)
    assert not found["reproduced"]
    assert found["differences"][0].startswith("the readings differ")
    monkeypatch.setattr(f"{dcon}.LINE_END", b"\n")
    assert "ReplayError in the step 'open'" in run("replay", "a.rec", code=3)["differences"][0]


@pytest.mark.parametrize(("name", "serial"), [("gauge", "00003186"), ("tracker", "390000")])
def test_a_masked_recording_replays_and_does_not_contain_the_serial_number(
    folder: Path, name: str, serial: str
) -> None:
    run("record", "bench.toml", name, "--for", "0.1 s", "--out", "open.rec")
    run("record", "bench.toml", name, "--for", "0.1 s", "--out", "masked.rec", "--mask-serial")
    shown = int(serial).to_bytes(4, "little") if name == "tracker" else serial.encode()
    for file, there in (("open.rec", True), ("masked.rec", False)):
        first = [data for way, data in read_recording(Path(file))[1] if way == "R"][:18]  # later the clock says 390 ms
        assert (shown in b"".join(first)) == there
        assert (f'"{serial}"' in Path(file).read_text()) == there
    again = run("replay", "masked.rec")
    assert again["reproduced"]
    assert again["masked"]
    assert again["identity"]["serial_number"] == "1" * len(serial)


def test_values_that_cannot_be_masked_are_removed(folder: Path) -> None:
    found = run("record", "bench.toml", "air", "--for", "0.1 s", "--out", "a.rec", "--mask-serial", code=1)
    assert "cannot be masked" in found["error"]["message"]
    assert list(folder.iterdir()) == [folder / "bench.toml"]


def test_a_serial_number_is_masked_across_frames(folder: Path) -> None:
    run("record", "bench.toml", "air", "--for", "0.1 s", "--out", "a.rec")
    path = Path("a.rec")
    frames = read_recording(path)[1]
    rewrite(path, [("R", b"xxSN-12"), ("R", b"34yy"), *frames[2:]])
    assert mask(path, words_of("SN-1234"), {}) == 1
    assert read_recording(path)[1][:2] == [("R", b"xxSN-11"), ("R", b"11yy")]


def test_recordings_without_a_note_load_and_are_rejected_by_replay(folder: Path) -> None:
    with DconTemperature("sim://cframe/air?seed=3", record=Path("old.rec")) as thermometer:
        reading = thermometer.read()
    with DconTemperature("replay://old.rec") as thermometer:
        assert thermometer.read() == reading
    assert "states no instrument" in run("replay", "old.rec", code=1)["error"]["message"]
    assert Path("old.rec").read_text().startswith("errormotion-session/1 ")


def test_a_note_that_is_not_json_has_a_specific_error(folder: Path) -> None:
    Path("a.rec").write_text("errormotion-session/2 t a\nNOTE {\nEND 0 00000000\n")
    with raises("recording.note.unreadable"):
        read_note(Path("a.rec"))
    Path("b.rec").write_text(f"{INDEX_FORMAT}\nx ../a.rec\n")
    with raises("recording.form"):
        parts_of(Path("b.rec"))


def test_a_file_that_is_no_recording_is_reported_as_such(folder: Path) -> None:
    (folder / "errors.nc").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(64))
    with pytest.raises(ReplayError, match=r"errors\.nc is not a recording"):
        read_note(folder / "errors.nc")


def test_a_note_replaces_an_earlier_one(folder: Path) -> None:
    run("record", "bench.toml", "air", "--for", "0.1 s", "--out", "a.rec")
    frames = read_recording(Path("a.rec"))
    add_note(Path("a.rec"), {"plugin": "x"})
    assert read_note(Path("a.rec")) == {"plugin": "x"}
    assert read_recording(Path("a.rec")) == frames


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["record", "bench.toml", "sensor"], "expected one of the instruments air, dead"),
        (["record", "bench.toml", "air", "--for", "2 h"], "at most 3600 s"),
        (["record", "bench.toml", "air", "--for", "soon"], "--for"),
        (["record", "bench.toml", "air", "--out", "bench.toml"], "exists"),
        (["replay", "bench.toml"], "states no instrument"),
        (["replay", "none.rec"], "cannot be read"),
    ],
)
def test_mistakes_are_explained(folder: Path, words: list[str], message: str) -> None:
    assert message in run(*words, code=1)["error"]["message"]
    assert (folder / "bench.toml").read_text() == BENCH
