"""Requests and replies of an IDS3010 against published exchanges, and any bytes against the codec."""

from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st
from wire_vectors import Vector, vectors

from errormotion.errors import ProtocolError
from errormotion.instruments.interferometer.attocube_ids import codec


@pytest.mark.parametrize("vector", vectors("attocube_ids", "request"), ids=str)
def test_requests(vector: Vector) -> None:
    expected = vector.expected
    assert codec.request(expected["method"], expected["number"], *expected["parameters"]) == vector.data


@pytest.mark.parametrize("vector", vectors("attocube_ids", "reply"), ids=str)
@pytest.mark.parametrize("end", [b"", b"\r\n"])
def test_replies(vector: Vector, end: bytes) -> None:
    found, expected = codec.reply(vector.data + end), vector.expected
    assert (found.number, found.code, list(found.values)) == (
        expected.get("number"),
        expected["code"],
        expected["values"],
    )
    assert bool(found.refusal) == expected["refusal"]


def test_lengths_are_in_metres() -> None:
    found = codec.reply(b'{"jsonrpc":"2.0","result":[1,0,-14673553,3317430],"id":1}')
    assert [found.length(index) for index in range(3)] == pytest.approx([0.0, -14.673553e-6, 3.317430e-6], rel=1e-12)


def test_the_maker_takes_null_for_no_error() -> None:
    assert codec.reply(b'{"jsonrpc":"2.0","id":1,"result":["null",1]}').code == 0
    assert codec.reply(b'{"jsonrpc":"2.0","id":1,"result":[null,1]}').code == 0


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"[]",
        b'{"jsonrpc":"2.0"}',
        b'{"jsonrpc":"2.0","id":1,"result":[]}',
        b'{"jsonrpc":"2.0","id":1,"result":{"0":0}}',
        b'{"jsonrpc":"2.0","id":"1","result":[0]}',
        b'{"jsonrpc":"2.0","id":true,"result":[0]}',
        b'{"jsonrpc":"2.0","result":[0]}',
        b'{"jsonrpc":"1.0","id":1,"result":[0]}',
        b'{"jsonrpc":"2.0","id":1,"result":[0,NaN]}',
        b'{"jsonrpc":"2.0","id":1,"result":["system idle"]}',  # an old interface
        b'{"jsonrpc":"2.0","id":1,"result":' + 1500 * b"[" + 1500 * b"]" + b"}",
        b'{"jsonrpc":"2.0","id":1,"result":[0,"' + codec.MAX_REPLY * b"x" + b'"]}',
        b'{"jsonrpc":"2.0","id":1,"result":[0]}{"jsonrpc":"2.0","id":2,"result":[0]}',
    ],
)
def test_invalid_replies_are_an_error(line: bytes) -> None:
    with pytest.raises(ProtocolError):
        codec.reply(line)


def test_values_of_another_kind_are_errors() -> None:
    found = codec.reply(b'{"jsonrpc":"2.0","id":1,"result":[0,true,"IDS3010",1e999,' + b"9" * 400 + b',"a\\u0000b"]}')
    for wrong in (
        lambda: found.length(0),
        lambda: found.flag(1),
        lambda: found.quantity(1),
        lambda: found.quantity(2),
        lambda: found.quantity(3),
        lambda: found.text(0),
        lambda: found.text(4),
        lambda: found.text(5),
    ):
        with pytest.raises(ProtocolError):
            wrong()


@given(st.binary(max_size=300))
def test_any_bytes_are_a_reply_or_an_error(data: bytes) -> None:
    with suppress(ProtocolError):
        codec.reply(b'{"jsonrpc":"2.0","id":1,"result":[' + data + b"]}")
