"""Requests and replies of GeoCOM against published vectors, and any bytes against the codec."""

import time
from contextlib import suppress

import pytest
from coded import raises
from hypothesis import given
from hypothesis import strategies as st
from wire_vectors import Vector, vectors

from errormotion.errors import ProtocolError
from errormotion.instruments.laser_tracker.leica_geocom import air, codec


@pytest.mark.parametrize("vector", vectors("leica_geocom", "request"), ids=str)
def test_requests(vector: Vector) -> None:
    expected = vector.expected
    assert codec.request(expected["call"], expected["transaction"], *expected["parameters"]) == vector.data


@pytest.mark.parametrize("vector", vectors("leica_geocom", "reply"), ids=str)
def test_replies(vector: Vector) -> None:
    found = codec.reply(vector.data)
    expected = vector.expected
    assert found.communication == expected["communication"]
    assert found.transaction == expected["transaction"]
    assert found.code == expected["code"]
    assert len(found.values) == len(expected["values"])
    take = {int: found.whole, float: found.number, str: found.text}
    assert [take[type(value)](index) for index, value in enumerate(expected["values"])] == expected["values"]


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"%R1P",
        b"%R1P,0,0",
        b"%R1P,x:0",
        b"%R8P,0,0:0",
        b'%R1P,0,0:0,"TS30',
        b'%R1P,0,0:0,"TS30"5,6',
        b"%R1Q,5004,1:",
        b"%R1P,0,1:0," + codec.MAX_REPLY * b"1",
    ],
)
def test_invalid_replies_are_an_error(line: bytes) -> None:
    with pytest.raises(ProtocolError):
        codec.reply(line)


def test_values_of_another_kind_are_errors() -> None:
    found = codec.reply(b"%R1P,0,1:0,1e999,TS30,1.5")
    for wrong in (
        lambda: found.number(0),
        lambda: found.number(1),
        lambda: found.whole(2),
        lambda: found.text(1),
        lambda: found.number(3),
    ):
        with pytest.raises(ProtocolError):
            wrong()


def test_a_parameter_that_is_not_finite_is_not_sent() -> None:
    with raises("request.not_finite"):
        codec.request(9027, 1, float("nan"), 1.5)


def examine(line: bytes) -> None:
    try:
        found = codec.reply(line)
    except ProtocolError:
        return
    for index in range(len(found.values) + 1):
        for take in (found.number, found.whole, found.text):
            try:
                take(index)
            except ProtocolError:
                continue


@given(st.binary(max_size=codec.MAX_REPLY + 10))
def test_any_bytes_are_a_reply_or_an_error(line: bytes) -> None:
    examine(line)
    examine(b"%R1P,0,1:0," + line)


@given(
    st.sampled_from([vector.data for vector in vectors("leica_geocom", "reply")]),
    st.lists(st.tuples(st.integers(0, 200), st.integers(0, 255)), max_size=4),
)
def test_mutated_replies_are_replies_or_errors(line: bytes, changes: list[tuple[int, int]]) -> None:
    data = bytearray(line)
    for position, value in changes:
        data[position % len(data)] = value
    examine(bytes(data))


@pytest.mark.parametrize("filling", [b",", b'"', b"\\", b'"\\', b"'", b"9", b'"",', b"0x"])
def test_the_longest_replies_are_decoded_in_linear_time(filling: bytes) -> None:
    head = b"%R1P,0,1:0,"
    line = head + (filling * codec.MAX_REPLY)[: codec.MAX_REPLY - len(head)]
    best = 1.0
    for _ in range(3):
        start = time.perf_counter()
        with suppress(ProtocolError):
            codec.reply(line)
        best = min(best, time.perf_counter() - start)
    assert best < 0.01


@given(st.floats(-20, 45), st.floats(0, 100), st.floats(6e4, 1.1e5))
def test_wet_temperature_and_humidity_are_inverse(dry: float, relative: float, pressure: float) -> None:
    wet = air.wet_temperature(dry, relative, pressure)
    assert wet <= dry
    assert air.humidity(dry, wet, pressure) == pytest.approx(relative, abs=1e-6)


def test_humidity_calculated_manually() -> None:
    # E(14) = 15.98 hPa, less 0.662 * 6 = 3.97 hPa, over E(20) = 23.33 hPa
    assert air.humidity(20.0, 14.0, 1e5) == pytest.approx(51.5, abs=0.2)
    assert air.humidity(20.0, 20.0, 1e5) == pytest.approx(100.0)
