"""SDO and PDO frames, values, units and states of CANopen thermometers: documented bytes, and any bytes."""

import math
import struct

import pytest
from coded import raises
from hypothesis import given
from hypothesis import strategies as st
from wire_vectors import Vector, vectors

from errormotion.errors import InstrumentError, ProtocolError
from errormotion.instruments.thermometer.cia404 import (
    CELSIUS,
    FAHRENHEIT,
    KELVIN,
    MAX_DIGITS,
    NUMBERS,
    flag_of,
    scale_of,
)
from errormotion.instruments.transports.can.pdo import decode_identifier, decode_mapping
from errormotion.instruments.transports.can.sdo import (
    ABORTS,
    SdoRefusal,
    abort_request,
    segment_reply,
    segment_request,
    upload_reply,
    upload_request,
)

DEVICE = "can_temperature"
FRAMES = st.binary(min_size=8, max_size=8)


@pytest.mark.parametrize("vector", vectors(DEVICE, "sdo"), ids=str)
def test_sdo_replies_of_documents(vector: Vector) -> None:
    at = vector.expected["index"], vector.expected["subindex"]
    if "abort" in vector.expected:
        with pytest.raises(SdoRefusal, match=vector.expected["meaning"]) as refusal:
            upload_reply(vector.data, *at)
        assert refusal.value.number == vector.expected["abort"]
    else:
        expected = vector.expected.get("size", bytes.fromhex(vector.expected.get("data", "")))
        assert upload_reply(vector.data, *at) == expected
    assert upload_reply(vector.data, at[0], at[1] + 1) is None
    assert upload_reply(vector.data, at[0] + 1, at[1]) is None


@pytest.mark.parametrize("vector", vectors(DEVICE, "segment"), ids=str)
def test_segments_of_documents(vector: Vector) -> None:
    toggle = vector.expected["toggle"]
    assert segment_reply(vector.data, toggle) == (bytes.fromhex(vector.expected["data"]), vector.expected["last"])
    assert segment_reply(vector.data, 1 - toggle) is None


@pytest.mark.parametrize("vector", vectors(DEVICE, "value"), ids=str)
def test_values_of_documents(vector: Vector) -> None:
    expected = vector.expected
    number = NUMBERS[expected["number"]].decode(vector.data)
    assert scale_of(expected["unit"], expected["digits"]).celsius(number) == expected["celsius"]


@pytest.mark.parametrize("vector", vectors(DEVICE, "unit"), ids=str)
def test_units_of_documents(vector: Vector) -> None:
    unit = int.from_bytes(vector.data, "little")
    if vector.expected["temperature"]:
        assert scale_of(unit).celsius(20.0) == 20.0
    else:
        with pytest.raises(InstrumentError, match=f"unit of the input is 0x{unit:08X}; expected degC"):
            scale_of(unit)


@pytest.mark.parametrize("vector", vectors(DEVICE, "status"), ids=str)
def test_states_of_documents(vector: Vector) -> None:
    assert flag_of(vector.data[0], 20.0) == vector.expected["flag"]


@pytest.mark.parametrize("vector", vectors(DEVICE, "mapping"), ids=str)
def test_mappings_of_documents(vector: Vector) -> None:
    mapped = decode_mapping(struct.unpack(f"<{len(vector.data) // 4}I", vector.data))
    assert [[each.index, each.subindex, each.offset, each.bits] for each in mapped] == vector.expected["places"]


# ---------------------------------------------------------------------- numbers


@given(st.floats(width=32, allow_nan=False))
def test_floats_round_trip(value: float) -> None:
    assert NUMBERS["float"].decode(struct.pack("<f", value)) == value


@given(st.integers(-(2**31), 2**31 - 1), st.integers(0, MAX_DIGITS))
def test_integers_round_trip_with_their_digits(value: int, digits: int) -> None:
    number = NUMBERS["integer 32"].decode(struct.pack("<i", value))
    assert scale_of(CELSIUS, digits).celsius(number) == float(f"{value}e-{digits}")


@given(st.sampled_from(sorted(NUMBERS)), st.binary(max_size=9))
def test_a_value_of_another_size_is_refused(name: str, data: bytes) -> None:
    number = NUMBERS[name]
    if len(data) in (number.size, 4):
        number.decode(data)
    else:
        with pytest.raises(ProtocolError, match=f"0x{number.index:04X}: expected"):
            number.decode(data)


def test_units_have_a_prefix_and_a_zero() -> None:
    assert scale_of(0xFF2D0000).celsius(203.0) == 20.3
    assert scale_of(0x012D0000).celsius(2.0) == 20.0
    assert scale_of(KELVIN).celsius(293.15) == pytest.approx(20.0)
    assert scale_of(0xFD050000).celsius(293150.0) == pytest.approx(20.0)
    assert scale_of(KELVIN, 2).celsius(29315.0) == pytest.approx(20.0)
    assert scale_of(FAHRENHEIT).celsius(68.0) == pytest.approx(20.0)


@pytest.mark.parametrize("digits", [-1, 10, 255])
def test_an_impossible_number_of_digits_is_refused(digits: int) -> None:
    with raises("protocol.reply.decimals"):
        scale_of(CELSIUS, digits)


def test_a_value_that_is_no_number_is_out_of_range() -> None:
    assert flag_of(0, math.nan) == "out of range"
    assert flag_of(0, math.inf) == "out of range"


# ---------------------------------------------------------------------- frames


def test_requests_are_those_of_the_standard() -> None:
    assert upload_request(0x6130, 1).hex() == "4030610100000000"
    assert segment_request(0).hex() == "6000000000000000"
    assert segment_request(1).hex() == "7000000000000000"
    assert abort_request(0x6130, 1, 0x05040000).hex() == "8030610100000405"


@given(FRAMES | st.binary(max_size=9), st.integers(0, 0xFFFF), st.integers(0, 255))
def test_any_bytes_are_a_reply_or_an_error_of_the_project(frame: bytes, index: int, subindex: int) -> None:
    try:
        found = upload_reply(frame, index, subindex)
    except (ProtocolError, SdoRefusal):
        return
    assert found is None or isinstance(found, int) or 1 <= len(found) <= 4


@given(FRAMES | st.binary(max_size=9), st.integers(0, 1))
def test_any_bytes_are_a_segment_or_an_error_of_the_project(frame: bytes, toggle: int) -> None:
    try:
        found = segment_reply(frame, toggle)
    except (ProtocolError, SdoRefusal):
        return
    assert found is None or len(found[0]) <= 7


@given(st.lists(st.integers(0, 2**32 - 1), max_size=64), st.binary(max_size=8))
def test_any_mapping_is_inside_a_frame(entries: list[int], frame: bytes) -> None:
    try:
        mapped = decode_mapping(entries)
    except ProtocolError:
        assert sum(entry & 0xFF for entry in entries) > 64 or any(not entry & 0xFF for entry in entries)
        return
    for each in mapped:
        if each.offset + each.bits <= 8 * len(frame):
            bits = "".join(f"{byte:08b}"[::-1] for byte in frame)[each.offset : each.offset + each.bits]
            assert int.from_bytes(each.data(frame), "little") == int(bits[::-1], 2)
        else:
            with raises("protocol.can.pdo"):
                each.data(frame)


def test_a_pdo_can_be_switched_off() -> None:
    assert decode_identifier(0x40000185) == 0x185
    assert decode_identifier(0x80000185) is None
    assert decode_identifier(0x20000185) is None  # 29 bits


def test_abort_codes_have_their_meaning() -> None:
    assert "0x06090011, Subindex does not exist" in str(SdoRefusal(0x06090011, "x"))
    assert str(SdoRefusal(0x12345678, "x")) == "x is refused: Code 0x12345678"
    assert len(ABORTS) >= 30
