"""Lines of SHDR adapters: published ones, hostile ones, and assignment to keys."""

import math
import time

import pytest
from coded import raises
from hypothesis import given
from hypothesis import strategies as st
from wire_vectors import Vector, vectors

from errormotion.errors import ProtocolError
from errormotion.instruments.controller.shdr.codec import (
    MAX_ASSET_BYTES,
    MAX_LINE_BYTES,
    Command,
    Keys,
    Lines,
    parse_line,
    parse_numbers,
    parse_time,
    pong,
    split_fields,
)


@pytest.mark.parametrize("vector", vectors("shdr", "line"), ids=str)
def test_published_lines(vector: Vector) -> None:
    found = parse_line(vector.data)
    assert isinstance(found, list)
    assert [[each.key, each.value, each.level, each.code] for each in found] == vector.expected["values"]
    for each in found:
        if "time" in vector.expected:
            assert each.time == pytest.approx(vector.expected["time"], abs=1e-6)
        else:
            assert math.isnan(each.time)


@pytest.mark.parametrize("vector", vectors("shdr", "stream"), ids=str)
@pytest.mark.parametrize("piece", [1, 7, 10_000])
@pytest.mark.parametrize("end", [b"\n", b"\r\n"])
def test_published_streams_in_pieces(vector: Vector, piece: int, end: bytes) -> None:
    data, lines = vector.data.replace(b"\n", end), Lines()
    found = [line for k in range(0, len(data), piece) for line in lines.feed(data[k : k + piece])]
    assert [line.decode() for line in found] == vector.expected["lines"]


@pytest.mark.parametrize("vector", vectors("shdr", "command"), ids=str)
def test_published_commands(vector: Vector) -> None:
    found = parse_line(vector.data)
    assert found == Command(**vector.expected)


def test_the_heartbeat_is_in_milliseconds() -> None:
    assert pong(Command("PONG", "10000")) == 10.0
    assert pong(Command("PONG", "999999999")) == 86400.0
    assert pong(Command("manufacturer", "XXX")) is None


def test_a_key_may_occur_twice_in_a_line() -> None:
    found = parse_line(b"|Xact|1|Xact|2")
    assert [(each.key, each.value) for each in found] == [("Xact", "1"), ("Xact", "2")]


def test_unavailable_values_are_not_a_condition() -> None:
    found = parse_line(b"|avail|UNAVAILABLE|Xact|UNAVAILABLE|Yact|UNAVAILABLE")
    assert [each.level for each in found] == ["", "", ""]
    (condition,) = parse_line(b"|servo|UNAVAILABLE||||")
    assert (condition.level, condition.value) == ("UNAVAILABLE", "")


def test_keys_that_are_stated_may_share_a_line() -> None:
    keys = Keys(conditions={"servo"}, messages={"msg"}, series={"load"})
    found = parse_line(b"|Xact|1|servo|fault|12|1|HIGH|hot|msg|7|open|load|3|100|4 5 6|Yact|2", keys)
    assert [(each.key, each.value, each.level, each.code) for each in found] == [
        ("Xact", "1", "", ""),
        ("servo", "hot", "FAULT", "12"),
        ("msg", "open", "", "7"),
        ("load", "6", "", ""),
        ("Yact", "2", "", ""),
    ]
    with pytest.raises(ProtocolError, match="'servo': expected NORMAL"):
        parse_line(b"|servo|BROKEN|12|1|HIGH|hot", keys)


@pytest.mark.parametrize(
    "line", [b"HTTP/1.1 400 Bad Request", b"", b"time|", b"noon|Xact|1", b"|Xact|1|Yact|2|Zact", b"||1", b"x|y"]
)
def test_other_lines_are_refused(line: bytes) -> None:
    with pytest.raises(ProtocolError, match="Expected"):
        parse_line(line)


@pytest.mark.parametrize(("text", "expected"), [("1.5", [1.5]), ("1 2 3", [1, 2, 3]), ("-.5e1", [-5]), ("0:DAY", [0])])
def test_numbers(text: str, expected: list[float]) -> None:
    assert parse_numbers(text) == expected


@pytest.mark.parametrize("text", ["", "UNAVAILABLE", "unavailable"])
def test_unknown_numbers_are_nan(text: str) -> None:
    assert math.isnan(parse_numbers(text)[0])


@pytest.mark.parametrize("text", ["two", "1,5", "0x10", "nan", "inf", "1e999", "1_0"])
def test_invalid_numbers_are_an_error(text: str) -> None:
    with raises("protocol.shdr.number"):
        parse_numbers(text)


@pytest.mark.parametrize("text", ["", "12.5", "100@5"])
def test_no_time_and_relative_times_are_unknown(text: str) -> None:
    assert math.isnan(parse_time(text))


@pytest.mark.parametrize("text", ["now", "2009-13-01T00:00:00Z", "0001-01-01T00:00:00+23:59x", "9" * 100])
def test_other_times_are_refused(text: str) -> None:
    with raises("protocol.time.form"):
        parse_time(text)


@pytest.mark.parametrize(
    ("text", "fields"),
    [
        ('a|"b"|c', ["a", "b", "c"]),
        (r'a|"b\|c\|d"|e', ["a", "b|c|d", "e"]),
        (r'a|"b\|c', ["a", '"b|c']),  # a quotation without an end
        ('a|"', ["a", '"']),
    ],
)
def test_quoted_fields(text: str, fields: list[str]) -> None:
    assert split_fields(text) == fields


def feed(lines: Lines, data: bytes, times: int) -> None:
    for _ in range(times):
        list(lines.feed(data))


def test_a_line_without_an_end_is_refused_and_the_next_one_is_read() -> None:
    lines = Lines()
    with pytest.raises(ProtocolError, match=f"at most {MAX_LINE_BYTES} bytes"):
        feed(lines, b"x" * 1000, 100)
    assert list(lines.feed(b"|a|1\n")) == [b"|a|1"]


def test_an_asset_without_an_end_is_refused() -> None:
    lines = Lines()
    assert len(list(lines.feed(b"|@ASSET@|1|CuttingTool|--multiline--AB\n"))) == 1
    with pytest.raises(ProtocolError, match=f"within {MAX_ASSET_BYTES} bytes"):
        feed(lines, b"x" * 999 + b"\n", 2000)
    assert list(lines.feed(b"|a|1\n")) == [b"|a|1"]


def test_too_many_fields_are_refused() -> None:
    with pytest.raises(ProtocolError, match="at most 4096 fields"):
        parse_line(b"|a|1" * 2100)


@given(st.binary(max_size=200))
def test_any_invalid_bytes_are_a_protocol_error(data: bytes) -> None:
    lines = Lines()
    for line in lines.feed(data + b"\n"):
        try:
            found = parse_line(line)
        except ProtocolError:
            continue
        assert isinstance(found, Command | list)


@pytest.mark.parametrize(
    "line",
    [
        b"|k|" + b"1" * 60_000 + b"x",
        b"|" * 60_000,
        b'|k|"' + b"\\|" * 4000,
        b"9" * 60_000 + b"|k|1",
        b"|k|5|1|" + b"1 " * 30_000,
        b"*" + b" " * 60_000 + b":",
    ],
)
def test_the_longest_lines_are_parsed_in_linear_time(line: bytes) -> None:
    start = time.thread_time()
    try:
        for each in parse_line(line):
            parse_numbers(each.value)
    except (ProtocolError, TypeError):  # TypeError: a command is not a list
        pass
    assert time.thread_time() - start < 2.0  # quadratic: minutes
