"""The lines of the protocol on its page, with bridge and driver."""

from typing import Any

import pytest
from wire_vectors import Vector, vectors

from errormotion.instruments.controller.linuxcnc import codec
from errormotion.instruments.controller.linuxcnc.bridge import PROTOCOL, parse_request


def of(layer: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("vector", vectors("linuxcnc", layer), ids=str)


def known(values: dict[str, Any]) -> dict[str, Any]:
    """Return values with null as None: TOML has none."""
    return {name: None if value == "null" else value for name, value in values.items()}


@of("request")
def test_the_driver_writes_and_the_bridge_reads_a_request(vector: Vector) -> None:
    arguments = known(vector.expected["arguments"])
    number, op = vector.expected["id"], vector.expected["op"]
    assert codec.encode_request(number, op, arguments) == vector.data + codec.LINE_END
    assert parse_request(vector.data) == (number, op, arguments)


@of("welcome")
def test_a_welcome_states_who_has_control(vector: Vector) -> None:
    answer = codec.decode(vector.data)
    assert isinstance(answer, codec.Answer)
    assert codec.decode_welcome(answer.result) == (vector.expected["control"], vector.expected["other"])
    assert answer.result["protocol"] == PROTOCOL == codec.PROTOCOL


@of("answer")
def test_answers(vector: Vector) -> None:
    expected = dict(vector.expected)
    assert codec.decode(vector.data) == codec.Answer(expected.pop("id"), expected.pop("ok"), **expected)


@of("beat")
def test_beats(vector: Vector) -> None:
    assert codec.decode(vector.data) == codec.Beat(vector.expected["id"], vector.expected["time"])


@of("touch")
def test_touches(vector: Vector) -> None:
    answer = codec.decode(vector.data)
    assert isinstance(answer, codec.Answer)
    assert codec.decode_touch(answer.result) == vector.expected
