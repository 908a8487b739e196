"""The codec of LK-G and LK-H."""

import math

import pytest
from coded import raises
from hypothesis import given
from hypothesis import strategies as st
from wire_vectors import Vector, vectors

from errormotion.errors import InstrumentError, ProtocolError
from errormotion.instruments.point_lds.keyence_lk import codec
from errormotion.instruments.point_lds.keyence_lk.codec import CONTROLLERS, DISPLAYS, REASONS
from errormotion.instruments.simulators.point_lds.keyence_lk_grammar import value_text

MM4 = DISPLAYS["0.0001 mm"]
UM2 = DISPLAYS["0.01 um"]
UM1 = DISPLAYS["0.1 um"]


# ---------------------------------------------------------------------- values


@pytest.mark.parametrize(
    ("text", "display", "value"),
    [
        ("+01.2345", MM4, 1.2345e-3),  # the four numbers printed in the manufacturer's manual, LK-G-M-NO5-E, page 5-6
        ("-00.0120", MM4, -0.0120e-3),
        ("+1234.56", UM2, 1234.56e-6),
        ("-00001.2", UM1, -1.2e-6),
    ],
)
def test_published_values(text: str, display: codec.Display, value: float) -> None:
    assert codec.parse_value(text, display) == (pytest.approx(value, rel=1e-15), 0)


@pytest.mark.parametrize(
    ("text", "reason"), [("XXXXXXXX", "no value"), ("+FFFFFFF", "over range"), ("-FFFFFFF", "under range")]
)
def test_published_texts_are_nan_with_their_reason(text: str, reason: str) -> None:
    value, code = codec.parse_value(text, MM4)
    assert math.isnan(value)
    assert REASONS[code] == reason


@pytest.mark.parametrize(
    "text",
    ["", "+01.234", "+01.23456", "01.23450", "+0123456", "+1.2.345", "+FFFFFF", "++1.2345", "+01.234 ", "+.123456x"],
)
def test_anything_else_is_garbled(text: str) -> None:
    value, code = codec.parse_value(text, MM4)
    assert math.isnan(value)
    assert REASONS[code] == "garbled"


def test_decimals_that_differ_from_the_display_are_an_error() -> None:
    with raises("protocol.reply.decimals"):
        codec.parse_value("+001.234", MM4)


def test_mm_and_um_can_be_ambiguous_so_the_display_decides() -> None:
    text = "+0001.25"
    assert codec.parse_value(text, DISPLAYS["0.01 mm"])[0] == pytest.approx(1.25e-3)
    assert codec.parse_value(text, UM2)[0] == pytest.approx(1.25e-6)


@given(st.sampled_from(sorted(DISPLAYS)), st.floats(-1, 1))
def test_a_value_round_trips_to_half_a_step(name: str, share: float) -> None:
    display = DISPLAYS[name]
    value = share * display.largest
    text = value_text(value, display.number)
    assert len(text) == codec.WIDTH
    back, reason = codec.parse_value(text, display)
    assert reason == 0
    assert abs(back - value) <= display.step / 2 * (1 + 1e-9)


@given(st.text(max_size=12) | st.from_regex(r"[+-][0-9F.X]{7}", fullmatch=True))
def test_any_answer_is_a_number_a_reason_or_a_protocol_error(text: str) -> None:
    try:
        value, reason = codec.parse_value(text, MM4)
    except ProtocolError:
        return
    assert math.isnan(value) == bool(reason)
    assert reason == 0 or reason in range(1, len(REASONS))
    assert not value > MM4.largest


@pytest.mark.parametrize("vector", vectors("keyence_lk", "answer"), ids=str)
def test_answers_that_foreign_clients_read_are_read(vector: Vector) -> None:
    expected = vector.expected
    display = next(each for each in DISPLAYS.values() if each.decimals == expected["decimals"])
    text = codec.parse_answer(expected["request"], codec.decode(vector.data + codec.LINE_END))
    assert codec.parse_value(text, display) == (pytest.approx(expected["value"] * display.unit, rel=1e-15), 0)


@pytest.mark.parametrize("vector", vectors("keyence_lk", "error"), ids=str)
def test_errors_of_both_series_are_named(vector: Vector) -> None:
    with pytest.raises(InstrumentError) as caught:
        codec.parse_answer(vector.expected["request"], vector.data.decode())
    assert "unknown code" not in str(caught.value)


# ---------------------------------------------------------------------- requests and answers


def test_requests_of_both_generations() -> None:
    assert codec.encode(CONTROLLERS["LK-G5000"].measure_request(1)) == b"MS,01\r"
    assert codec.encode(CONTROLLERS["LK-G5000"].measure_request(12)) == b"MS,12\r"
    assert codec.encode(CONTROLLERS["LK-G3000"].measure_request(2)) == b"M2\r"


@pytest.mark.parametrize("request_text", ["MS,01", "M1"])
def test_an_answer_repeats_the_request(request_text: str) -> None:
    assert codec.parse_answer(request_text, f"{request_text},+01.2345") == "+01.2345"
    assert codec.parse_answer(request_text, request_text) == ""
    assert codec.parse_answer("SW,OF,01,+000000", "SW,OF", header="SW,OF") == ""


@pytest.mark.parametrize("text", ["", "MS,02,+01.2345", "MS,011,+01.2345", "M", "R0", "xMS,01,+01.2345", "ER", "ER,MS"])
def test_an_answer_to_something_else_is_a_protocol_error(text: str) -> None:
    with pytest.raises(ProtocolError, match="starts with 'MS,01'"):
        codec.parse_answer("MS,01", text)


@pytest.mark.parametrize(
    ("code", "name"),
    [
        ("00", "unknown command"),
        ("01", "not possible in this mode"),
        ("20", "wrong length"),
        ("21", "wrong number of parameters"),
        ("22", "is out of range"),
        ("50", "unknown command"),
        ("51", "not possible in this mode"),
        ("60", "wrong length"),
        ("61", "wrong number of parameters"),
        ("62", "is out of range"),
        ("88", "timeout"),
        ("99", "another error"),
        ("47", "unknown code"),
    ],
)
def test_every_error_is_named(code: str, name: str) -> None:
    with pytest.raises(InstrumentError, match=rf"refuses 'MS,01' with error {code}: .*{name}") as caught:
        codec.parse_answer("MS,01", f"ER,MS,{code}")
    assert not isinstance(caught.value, ProtocolError)


@pytest.mark.parametrize("repeated", ["SR", "OF"])
def test_an_error_repeats_the_command_or_the_setting(repeated: str) -> None:
    assert codec.error_code("SR,OF,01", f"ER,{repeated},22") == "22"


def test_an_error_of_another_request_is_not_an_answer() -> None:
    assert codec.error_code("MS,01", "ER,SR,01") is None
    with pytest.raises(ProtocolError, match="found 'ER,SR,01'"):
        codec.parse_answer("MS,01", "ER,SR,01")


@given(st.from_regex(r"[A-Z0-9,+.]{0,40}", fullmatch=True))
def test_lines_round_trip(text: str) -> None:
    assert codec.decode(codec.encode(text)) == text


@given(st.binary(max_size=40))
def test_a_line_of_other_bytes_is_a_protocol_error(line: bytes) -> None:
    body = line.rstrip(b"\r\n")
    if all(0x20 <= byte < 0x7F for byte in body):
        assert codec.decode(line).encode() == body
    else:
        with raises("protocol.text.form"):
            codec.decode(line)


def test_a_rate_that_does_not_fit_is_refused_with_the_arithmetic() -> None:
    # 6 bytes to query, 15 to answer, 10 bits each: 210 bits a reading
    codec.check_rate(45.0, 9600, CONTROLLERS["LK-G5000"])
    with raises("sensor.rate.too_high"):
        codec.check_rate(50.0, 9600, CONTROLLERS["LK-G5000"])
