"""The lines between driver and bridge."""

import contextlib
import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from errormotion.errors import InstrumentError, ProtocolError
from errormotion.instruments.controller.linuxcnc.codec import (
    Answer,
    Beat,
    decode,
    decode_state,
    decode_touch,
    encode_request,
)

STATE = {
    "time": 3.5,
    "position": [0.1, 0.2, 0.3],
    "commanded_position": [0.1, 0.2, 0.3],
    "spindle_speed": 3000.0,
    "spindle_commanded": 3000.0,
    "spindle_load": None,
    "feed": 0.0,
    "mode": "mdi",
    "program": "",
    "running": False,
    "homed": True,
    "enabled": True,
    "estop": False,
    "alarms": ["text"],
}


def test_a_request_is_a_line_of_json_without_infinities() -> None:
    assert encode_request(7, "elapse", {"seconds": 1.5}) == b'{"id": 7, "op": "elapse", "seconds": 1.5}\n'
    with pytest.raises(InstrumentError, match="finite"):
        encode_request(7, "elapse", {"seconds": math.inf})


def test_lines_are_answers_and_heartbeats() -> None:
    assert decode(b'{"id": 7, "ok": true, "result": [1]}\n') == Answer(7, True, [1])
    assert decode(b'{"id": 7, "ok": false, "error": "no"}\n') == Answer(7, False, error="no")
    assert decode(b'{"id": 7, "beat": 3, "time": 1.5}\n') == Beat(7, 1.5)


@pytest.mark.parametrize(
    "line", [b"", b"hello", b"[]", b"7", b"{}", b'{"id": 1, "ok": 1, "result": 0}', b'{"id": 1, "ok": true}', b"\xff"]
)
def test_other_lines_are_neither_and_refused(line: bytes) -> None:
    with pytest.raises(ProtocolError, match="Expected an answer of the bridge"):
        decode(line)


@given(st.binary(max_size=60))
def test_any_bytes_are_a_message_or_a_protocol_error(line: bytes) -> None:
    with contextlib.suppress(ProtocolError):
        assert isinstance(decode(line), Answer | Beat)


def test_a_state_has_its_keys_and_unknown_numbers_are_nan() -> None:
    state = decode_state(STATE)
    assert math.isnan(state.pop("spindle_load"))
    assert state == {name: value for name, value in STATE.items() if name not in ("spindle_load", "spindle_commanded")}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("time", None),
        ("position", [1, 2]),
        ("position", ["a", 0, 0]),
        ("feed", True),
        ("mode", "flying"),
        ("estop", 1),
        ("alarms", None),
    ],
)
def test_a_state_of_another_kind_is_refused(name: str, value: object) -> None:
    with pytest.raises(ProtocolError, match="Expected the state"):
        decode_state({**STATE, name: value})
    with pytest.raises(ProtocolError, match="Expected the state"):
        decode_state({key: each for key, each in STATE.items() if key != name})


def test_a_touch_is_known_or_did_not_occur() -> None:
    assert decode_touch({"tripped": False, "position": None, "time": 2.0})["position"] is None
    assert decode_touch({"tripped": True, "position": [0.1, 0.2, 0.3], "time": 2.0})["position"] == [0.1, 0.2, 0.3]
    for wrong in ({"tripped": True, "position": None, "time": 2.0}, {"tripped": True, "position": [0, 0, None]}, None):
        with pytest.raises(ProtocolError, match="result of a touch"):
            decode_touch(json.loads(json.dumps(wrong)))
