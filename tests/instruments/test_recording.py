"""A recorded session is replayed exactly, and deviations are errors."""

import threading
from pathlib import Path

import pytest
from coded import raises

from errormotion.errors import ReplayError
from errormotion.instruments.transports import Transport, open_transport, parse_address
from errormotion.instruments.transports.loopback.serving import make_server
from errormotion.instruments.transports.recording import Recorder, read_index, read_recording, write_index


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Two requests and their answers, recorded from a real connection."""
    path = tmp_path / "session.rec"
    server = make_server("tcp", "echo", lambda data: server.send(data.upper()))
    server.start()
    line = open_transport(server.url, recorder=path)
    for question in (b"abc;", b"de;"):
        line.write(question)
        line.read_until(b";")
    line.close()
    server.close()
    return path


def play(path: Path) -> Transport:
    return open_transport(f"replay://{path}", timeout=0.2)


def test_a_session_plays_back(recording: Path) -> None:
    line = play(recording)
    line.write(b"abc;")
    assert line.read_until(b";") == b"ABC;"
    line.write(b"de;")
    assert line.read_until(b";") == b"DE;"
    line.close()
    line.close()


def test_the_recording_can_be_read_by_a_person(recording: Path) -> None:
    lines = recording.read_text().splitlines()
    assert lines[0].startswith("errormotion-session/1 20")
    assert lines[1].split()[0] == "W"
    assert bytes.fromhex(lines[1].split()[3]) == b"abc;"
    assert lines[-1].startswith("END 4 ")


def test_writes_and_reads_may_be_split_otherwise(recording: Path) -> None:
    line = play(recording)
    line.write(b"a")
    line.write(b"bc;d")
    line.write(b"e;")
    assert b"".join(line.read(1) for _ in range(7)) == b"ABC;DE;"
    line.close()


def test_a_changed_byte_in_a_write_is_an_error(recording: Path) -> None:
    line = play(recording)
    with raises("replay.write.differs"):
        line.write(b"abd;")
    with raises("replay.incomplete"):
        line.close()


def test_an_excess_write_is_an_error(recording: Path) -> None:
    line = play(recording)
    line.write(b"abc;de;")
    with raises("replay.write.unexpected"):
        line.write(b"x")
    line.read_until(b"E;")
    with pytest.raises(ReplayError):
        line.close()


def test_an_excess_read_is_an_error(recording: Path) -> None:
    line = play(recording)
    line.write(b"abc;de;")
    line.read_until(b"DE;")
    with raises("replay.ended"):
        line.read()
    line.close()


def test_an_answer_does_not_precede_its_request(recording: Path) -> None:
    line = play(recording)
    with raises("instrument.no_answer"):
        line.read()
    waiting = threading.Timer(0.02, line.write, [b"abc;"])
    waiting.start()
    assert line.read(timeout=5.0) == b"ABC;"
    waiting.join()
    with pytest.raises(ReplayError):
        line.close()


@pytest.mark.parametrize("stop_after", [0, 1, 2, 3])
def test_leftovers_at_the_end_are_an_error(recording: Path, stop_after: int) -> None:
    line = play(recording)
    for step in [
        lambda: line.write(b"abc;"),
        lambda: line.read_until(b";"),
        lambda: line.write(b"de;"),
        lambda: line.read(1),
    ][:stop_after]:
        step()
    with raises("replay.incomplete"):
        line.close()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"abc;".hex(), b"abd;".hex(), "line 2: this frame was changed after the recording"),
        (b"DE;".hex(), b"DF;".hex(), "line 5"),
        (f" {b'ABC;'.hex()}", " zz", "line 3"),
        ("W 0", "R 0", None),
        ("END 4", "END 5", "its last line does not match"),
        ("errormotion-session/1", "errormotion-session/2", "not a recording"),
    ],
)
def test_a_changed_byte_in_the_recording_is_an_error(recording: Path, old: str, new: str, message: str | None) -> None:
    text = recording.read_text()
    recording.write_text(text.replace(old, new, 1))
    assert recording.read_text() != text
    with pytest.raises(ReplayError, match=message):
        play(recording)


def test_a_missing_frame_is_an_error(recording: Path) -> None:
    lines = recording.read_text().splitlines(keepends=True)
    recording.write_text("".join(lines[:2] + lines[3:]))
    with pytest.raises(ReplayError, match="line 3"):
        play(recording)


def test_a_cut_recording_is_an_error(recording: Path) -> None:
    recording.write_text("".join(recording.read_text().splitlines(keepends=True)[:-1]))
    with raises("recording.incomplete"):
        play(recording)


def test_a_missing_or_foreign_file_is_an_error(tmp_path: Path) -> None:
    with raises("recording.unreadable"):
        play(tmp_path / "none.rec")
    (tmp_path / "image.rec").write_bytes(b"\x89PNG\r\n")
    with raises("recording.damaged"):
        play(tmp_path / "image.rec")
    (tmp_path / "empty.rec").touch()
    with raises("recording.form"):
        play(tmp_path / "empty.rec")


def test_a_recording_is_never_overwritten(recording: Path) -> None:
    with raises("recording.exists"):
        Recorder(recording, "tcp://x:1")


def test_a_recorder_that_was_not_closed_leaves_a_recording_that_is_refused(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "a.rec", "tcp://x:1")
    recorder.frame("W", b"abc")
    recorder._file.flush()  # as after a crash
    with raises("recording.incomplete"):
        read_recording(tmp_path / "a.rec")
    recorder.close()
    assert read_recording(tmp_path / "a.rec") == ("tcp://x:1", [("W", b"abc")])


def test_an_instrument_of_several_lines_has_a_list_of_recordings(tmp_path: Path) -> None:
    files = write_index(tmp_path / "frame.rec", ["X1", "Z"])
    assert files == {"X1": tmp_path / "frame.X1.rec", "Z": tmp_path / "frame.Z.rec"}
    assert read_index(tmp_path / "frame.rec") == files
    with raises("recording.not_created"):
        write_index(tmp_path / "frame.rec", ["X1"])
    (tmp_path / "other.rec").write_text("hello\n")
    with raises("recording.form"):
        read_index(tmp_path / "other.rec")


def test_a_recording_beyond_the_limit_is_refused_before_it_is_read(
    recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("errormotion.instruments.transports.recording.MAX_RECORDING", recording.stat().st_size - 1)
    monkeypatch.setattr(Path, "read_text", lambda *_, **__: pytest.fail("it was read"))
    with raises("recording.too_large"):
        read_recording(recording)


@pytest.mark.parametrize("scheme", ["http", "tcp", "opc.tcp", "modbus+tcp", "can"])
def test_an_address_with_a_password_is_refused_and_not_repeated(scheme: str) -> None:
    """It would be stored in recordings, runs and reports."""
    with raises("address.password") as found:
        parse_address(f"{scheme}://user:top-secret@192.0.2.7:5000/a")
    assert "top-secret" not in str(found.value)
