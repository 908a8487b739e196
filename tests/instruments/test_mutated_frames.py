"""Damaged frames of every codec: only the project's errors, in bounded time and memory (long form: ``make fuzz``)."""

import json
import re
import time
import tracemalloc

import mutants
import pytest
from fuzzing import Codec, fuzz
from wire_codecs import CODECS
from wire_readers import Received, dprnt_line, opcua_lines

from errormotion import plugins
from errormotion.errors import ProtocolError, ReplayError
from errormotion.instruments.controller import virtual
from errormotion.instruments.controller.linuxcnc import codec as linuxcnc
from errormotion.instruments.controller.shdr import codec as shdr
from errormotion.instruments.laser_tracker.leica_geocom import codec as geocom
from errormotion.instruments.point_lds.optoncdt.commands import MAX_LINES, parse_answer
from errormotion.instruments.touch_probe.dprnt.codec import MAX_LINE, PATTERN, parse_line
from errormotion.instruments.transports.recording import read_index

QUICK = 200
HUGE = 10**400
"""A whole number beyond the range of float."""
WITHOUT_CODEC = {
    "compensated_lds",  # reads another instrument
    "controller_probe",  # moves a controller
    "five_sensor_frame",  # several sensors
    "profile_files",  # tests/instruments/test_damaged_files.py
}


@pytest.mark.parametrize("codec", CODECS, ids=lambda codec: codec.name)
def test_damaged_frames_are_read_or_refused(codec: Codec) -> None:
    found = fuzz(codec, range(mutants.count(QUICK)), sampled=20)
    assert not found.failures, "\n".join(found.failures)


def test_every_instrument_is_among_them() -> None:
    ours = {each.id for each in plugins.available("instruments") if each.distribution.startswith("errormotion ")}
    named = {codec.device.partition(" ")[0] for codec in CODECS}
    assert ours <= named | WITHOUT_CODEC
    assert named - {"all"} <= ours


def refuse(data: bytes) -> None:
    if data != b"good":
        raise ProtocolError("damaged")


def raise_other(data: bytes) -> None:
    if data != b"good":
        raise ValueError("not of the project")


def need_time(data: bytes) -> None:
    end = time.thread_time() + 0.02
    while data != b"good" and time.thread_time() < end:
        pass


def need_memory(data: bytes) -> None:
    assert len(bytearray(8 if data == b"good" else 1 << 21))


@pytest.mark.parametrize(
    ("read", "failure"),
    [(raise_other, "ValueError"), (need_time, "ms for"), (need_memory, "bytes of memory")],
)
def test_forbidden_motion_is_detected(read, failure: str) -> None:
    found = fuzz(Codec("a", "b", read, lambda: [b"good"], 8), range(1, 3), sampled=1)
    assert found.failures
    assert failure in found.failures[0]


def test_results_of_several_processes_are_added() -> None:
    codec = Codec("a", "b", refuse, lambda: [b"good"], 8)
    whole, parts = fuzz(codec, range(60)), fuzz(codec, range(30)) + fuzz(codec, range(30, 60))
    assert (whole.frames, whole.lengthened, whole.errors) == (parts.frames, parts.lengthened, parts.errors)
    assert whole.errors["ProtocolError"] > 40
    assert not whole.failures


def test_good_frames_that_nothing_accepts_are_found() -> None:
    with pytest.raises(AssertionError, match="none of its good frames"):
        fuzz(Codec("a", "b", refuse, lambda: [b"bad"], 8), range(1))


# ---------------------------------------------------------------------- errors found with damaged frames


def test_a_long_line_of_digits_is_refused_quickly() -> None:
    digits = "1" * 300
    start = time.thread_time()
    assert not re.fullmatch(PATTERN, f"X{digits}Y{digits}Z{digits}?")
    assert time.thread_time() - start < 1.0
    for text in (f"X{'1' * 80}Y{'1' * 80}Z{'1' * 80}?", f"X{' ' * 250}", f"A{'a' * 240}X1Y2Z"):
        with pytest.raises(ProtocolError, match="such as 'N12"):
            dprnt_line(text.encode())
    with pytest.raises(ProtocolError, match=f"at most {MAX_LINE}"):
        parse_line("X1 Y2 Z3" + " " * MAX_LINE, re.compile(PATTERN))


def test_an_answer_of_a_sensor_has_a_limited_number_of_lines() -> None:
    assert len(parse_answer("PRINT", b"MEASRATE 4\r\n" * MAX_LINES)) == MAX_LINES
    for end in (b"\n", b"->"):
        with pytest.raises(ProtocolError, match=f"more than {MAX_LINES} lines"):
            parse_answer("PRINT", end * (2 * MAX_LINES + 1))


@pytest.mark.parametrize("text", ["s", r"\s", r"\\"])
def test_an_incomplete_text_of_a_station_takes_no_more_memory_than_its_length(text: str) -> None:
    line = b'%R1P,0,1:0,"' + (1000 // len(text) * text).encode()
    with pytest.raises(ProtocolError, match="incomplete"):
        geocom.reply(line)
    tracemalloc.start()
    try:
        with pytest.raises(ProtocolError, match="incomplete"):
            geocom.reply(line)
        assert tracemalloc.get_traced_memory()[1] < 32 << 10
    finally:
        tracemalloc.stop()


def test_integers_beyond_a_float_are_errors_of_the_bridge() -> None:
    with pytest.raises(ProtocolError, match="an answer of the bridge"):
        linuxcnc.decode(json.dumps({"id": 1, "beat": 1, "time": HUGE}).encode())
    with pytest.raises(ProtocolError, match="result of a touch"):
        linuxcnc.decode_touch({"tripped": True, "position": [0.1, HUGE, 0.0], "time": 1.0})
    with pytest.raises(ProtocolError, match="an answer of the bridge"):
        linuxcnc.decode(json.dumps({"id": 1, "ok": True, "result": {"travel": {"X": [0, HUGE]}}}).encode())
    with pytest.raises(ProtocolError, match="an answer in JSON"):
        virtual.decode_answer(json.dumps({"id": 1, "ok": True, "result": {"position": [0, HUGE, 0]}}).encode(), 1)
    numbers = {"time": HUGE, "position": [0.0] * 3, "commanded_position": [0.0] * 3}
    with pytest.raises(ProtocolError, match="state of LinuxCNC"):
        linuxcnc.decode_state({"mode": "mdi", **numbers, "spindle_speed": 1})


@pytest.mark.parametrize("line", [b"* PONG", b"* PONG ", b"* PONG: 12x", b"* PONG x"])
def test_a_heartbeat_without_a_number_is_not_one(line: bytes) -> None:
    command = shdr.parse_line(line)
    assert isinstance(command, shdr.Command)
    assert shdr.pong(command) is None


@pytest.mark.parametrize(
    "lines",
    [
        ["[" * 50_000],
        [{"namespaces": 5}],
        [{"namespaces": ["http://opcfoundation.org/UA/CNC"]}, [{"id": [], "name": {}, "namespace": 0}]],
    ],
    ids=["deep", "no list", "no names"],
)
def test_answers_of_other_types_are_errors_of_a_server(lines: list[object]) -> None:
    data = b"".join((each if isinstance(each, str) else json.dumps(each)).encode() + b"\n" for each in lines)
    with pytest.raises(ProtocolError):
        opcua_lines(data)


def test_a_list_of_recordings_names_files(tmp_path) -> None:
    path = tmp_path / "list.rec"
    path.write_text("errormotion-sessions/1\nframe list.\0frame.rec\n")
    with pytest.raises(ReplayError, match="not a list of recordings"):
        read_index(path)
    path.write_text("errormotion-sessions/1\n" + "frame a.rec\n" * 65)
    with pytest.raises(ReplayError, match="at most 64 recordings"):
        read_index(path)


def test_a_long_list_of_recordings_is_refused_before_it_is_parsed(tmp_path) -> None:
    path = tmp_path / "list.rec"
    path.write_text("errormotion-sessions/1\n" + 50_000 * "\n")
    tracemalloc.start()
    try:
        with pytest.raises(ReplayError, match="at most 64 recordings; found 50000"):
            read_index(path)
        assert tracemalloc.get_traced_memory()[1] < 40 * 50_000
    finally:
        tracemalloc.stop()
    path.write_text("errormotion-sessions/1\n" + "frame a.rec\n" * 100_000)
    with pytest.raises(ReplayError, match="of at most"):
        read_index(path)


def test_the_end_of_an_answer_is_found_wherever_pieces_end() -> None:
    line = Received(b"")
    for data in (b"abc-->d->", b"-" * 9 + b">x", b"->"):
        for size in range(1, len(data) + 1):
            pieces = [data[i : i + size] for i in range(0, len(data), size)]
            line._receive = lambda most, timeout, pieces=pieces: pieces.pop(0)
            line._rest = b""
            place = data.index(b"->") + 2
            assert line.read_until(b"->", limit=100) == data[:place]
            assert line._rest + b"".join(pieces) == data[place:]
    line._receive, line._rest = lambda most, timeout: b"x" * 10, b""
    with pytest.raises(ProtocolError, match="30 bytes without"):
        line.read_until(b"->", limit=25)


def test_a_long_answer_in_small_pieces_is_searched_once() -> None:
    line, left = Received(b""), [4_000_000]

    def receive(most: int, timeout: float) -> bytes:
        left[0] -= 100
        return b"x" * 100 if left[0] > 0 else b"->"

    line._receive = receive
    start = time.thread_time()
    assert len(line.read_until(b"->", limit=1 << 24)) > 3_900_000
    assert time.thread_time() - start < 5.0
