"""Modbus frames and registers: published bytes, and round trips of any numbers."""

import math
import struct

import pytest
from coded import raises
from hypothesis import assume, given
from hypothesis import strategies as st
from pydantic import ValidationError

from errormotion.errors import InstrumentError, ProtocolError
from errormotion.instruments.thermometer.registers import ModbusSettings, decode_number, encode_number
from errormotion.instruments.transports.modbus.codec import (
    ModbusRefusal,
    crc16,
    decode_answer,
    encode_answer,
    encode_request,
    missing,
)

FRAMINGS = st.sampled_from(["tcp", "rtu"])
REGISTERS = st.lists(st.integers(0, 65535), min_size=1, max_size=125)
KINDS = st.sampled_from(["u16", "i16", "u32", "i32", "f32"])
ORDERS = st.sampled_from(["big", "little"])


def test_the_checksum_is_the_published_one() -> None:
    assert crc16(b"123456789") == bytes.fromhex("37 4b")  # check value 4B37 of CRC-16/MODBUS, low byte first
    assert crc16(bytes.fromhex("02 07")) == bytes.fromhex("41 12")  # Modbus over serial line 1.02, appendix B


def test_a_request_has_the_published_bytes() -> None:
    # Modbus application protocol 1.1b3, 6.3: registers 108 to 110, which are 6B to 6D on the wire
    assert encode_request("tcp", 0x11, 3, 0x6B, 3, number=1) == bytes.fromhex("0001 0000 0006 11 03 006b 0003")
    assert encode_request("rtu", 0x11, 3, 0x6B, 3) == bytes.fromhex("11 03 006b 0003 7687")
    assert encode_request("rtu", 1, 3, 0, 10) == bytes.fromhex("01 03 0000 000a c5cd")


def test_an_answer_is_read_as_published() -> None:
    body = bytes.fromhex("11 03 06 022b 0000 0064")
    assert decode_answer("rtu", body + crc16(body), 0x11, 3, 3) == [555, 0, 100]
    assert decode_answer("tcp", bytes.fromhex("0001 0000 0009") + body, 0x11, 3, 3, number=1) == [555, 0, 100]


@given(FRAMINGS, st.integers(0, 255), st.sampled_from([3, 4]), REGISTERS, st.integers(0, 65535))
def test_registers_round_trip(framing: str, unit: int, function: int, registers: list[int], number: int) -> None:
    frame = encode_answer(framing, unit, function, registers, number)
    assert decode_answer(framing, frame, unit, function, len(registers), number) == registers
    assert missing(framing, frame) == 0
    for size in range(len(frame)):
        assert 0 < missing(framing, frame[:size]) <= len(frame) - size  # never waits for more than available


@given(st.data(), REGISTERS)
def test_a_changed_byte_of_an_rtu_answer_is_detected(data: st.DataObject, registers: list[int]) -> None:
    frame = bytearray(encode_answer("rtu", 1, 3, registers))
    frame[data.draw(st.integers(0, len(frame) - 1))] ^= data.draw(st.integers(1, 255))
    with pytest.raises(ProtocolError):
        decode_answer("rtu", bytes(frame), 1, 3, len(registers))


@given(FRAMINGS, st.binary(max_size=300))
def test_invalid_data_are_a_protocol_error(framing: str, rubbish: bytes) -> None:
    try:
        found = decode_answer(framing, rubbish, 1, 3, 5, number=7)
    except (ProtocolError, ModbusRefusal):
        return
    assume(rubbish[:2] != b"\0\7")
    assert found is None  # an older transaction


@pytest.mark.parametrize(
    ("framing", "frame"), [("tcp", bytes.fromhex("0009 0000 0003 01 83 02")), ("rtu", bytes.fromhex("01 83 02 C0F1"))]
)
def test_an_exception_reply_is_a_refusal_with_a_text(framing: str, frame: bytes) -> None:
    with pytest.raises(ModbusRefusal, match=r"exception 2 \(illegal data address\)") as refusal:
        decode_answer(framing, frame, 1, 3, 5, 9)
    assert refusal.value.number == 2
    assert isinstance(refusal.value, InstrumentError)


@pytest.mark.parametrize("framing", ["tcp", "rtu"])
@pytest.mark.parametrize(
    ("frame", "message"),
    [
        ((2, 3, [1, 2]), "expected an answer of unit 1; found that of unit 2"),
        ((1, 4, [1, 2]), "expected an answer to function 3"),
        ((1, 3, [1]), "expected 2 registers; found 2 bytes"),
    ],
)
def test_the_answer_to_something_else_is_refused(framing: str, frame: tuple[int, int, list[int]], message: str) -> None:
    with pytest.raises(ProtocolError, match=f"(?i){message}"):
        decode_answer(framing, encode_answer(framing, *frame, number=5), 1, 3, 2, 5)


def test_a_late_answer_is_skipped_but_one_to_a_later_request_is_not() -> None:
    assert decode_answer("tcp", encode_answer("tcp", 1, 3, [1], 4), 1, 3, 1, 5) is None
    assert decode_answer("tcp", encode_answer("tcp", 1, 3, [1], 65535), 1, 3, 1, 0) is None
    with raises("protocol.reply.number"):
        decode_answer("tcp", encode_answer("tcp", 1, 3, [1], 6), 1, 3, 1, 5)


@given(KINDS, ORDERS, ORDERS, st.floats(-40000, 40000, width=32))
def test_numbers_round_trip_in_every_order(kind: str, words: str, octets: str, number: float) -> None:
    encoded = encode_number(number, kind, words, octets)
    found = decode_number(encoded, kind, words, octets)
    low, high = {"u16": (0, 65535), "i16": (-32768, 32767), "u32": (0, math.inf)}.get(kind, (-math.inf, math.inf))
    assert found == (number if kind == "f32" else min(max(round(number), low), high))


def test_words_and_bytes_have_the_stated_orders() -> None:
    a, b = struct.unpack(">HH", struct.pack(">f", 21.5))
    swapped = [int.from_bytes(word.to_bytes(2, "big"), "little") for word in (a, b)]
    assert encode_number(21.5, "f32") == [a, b]
    assert encode_number(21.5, "f32", "little") == [b, a]
    assert encode_number(21.5, "f32", "big", "little") == swapped
    assert encode_number(21.5, "f32", "little", "little") == swapped[::-1]


def test_the_adam_is_linear_over_the_range_of_its_thermocouple() -> None:
    adam = ModbusSettings(map="adam-6018", channels=("a", "b", "c"), thermocouples=("J", "K", "T"))
    assert adam.temperature(0, [0]) == (0.0, "")
    assert adam.temperature(0, [65534])[0] == pytest.approx(760.0, abs=0.012)  # 65535 itself: open
    assert adam.temperature(1, [957])[0] == pytest.approx(20.006, abs=1e-3)
    assert adam.temperature(2, [0]) == (-100.0, "")
    value, flag = adam.temperature(1, [65535])
    assert (math.isnan(value), flag) == (True, "open")
    assert list(adam.blocks()) == [(0, 3)]


def test_the_logger_counts_tenths_and_is_open_from_10000_on() -> None:
    logger = ModbusSettings(map="logger-16", channels=tuple(f"t{i}" for i in range(16)))
    assert list(logger.blocks()) == [(0x20, 16)]
    assert logger.temperature(0, [214]) == (21.4, "")
    assert logger.temperature(0, [65531]) == (-0.5, "")
    assert logger.temperature(0, [9999])[1] == ""
    assert [logger.temperature(0, [code])[1] for code in (10000, 10001, 32767)] == ["open"] * 3


def test_a_setting_overrides_its_map() -> None:
    settings = ModbusSettings(map="logger-16", first=0x40, scale=0.01)
    assert (settings.first, settings.scale, settings.open_from) == (0x40, 0.01, 10000)
    assert ModbusSettings.model_validate_json(settings.model_dump_json()) == settings


def test_codes_and_limits_become_flags() -> None:
    settings = ModbusSettings(open_codes=(32767,), shorted_codes=(-32768,), lowest=-20.0, highest=100.0)
    flags = [settings.temperature(0, encode_number(n, "i16"))[1] for n in (20, 32767, -32768, 101, -21)]
    assert flags == ["", "open", "shorted", "out of range", "out of range"]
    assert ModbusSettings(type="f32").temperature(0, encode_number(math.nan, "f32"))[1] == "open"


def test_blocks_take_what_lies_between_even_channels_only() -> None:
    names = tuple("abc")
    assert list(ModbusSettings(channels=names, stride=10).blocks()) == [(0, 21)]
    assert list(ModbusSettings(channels=names, stride=10, most=11).blocks()) == [(0, 11), (20, 1)]
    assert list(ModbusSettings(channels=names, registers=(100, 5, 101)).blocks()) == [(5, 1), (100, 2)]
    assert next(ModbusSettings(channels=tuple(map(str, range(200))), type="f32").blocks()) == (0, 124)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"map": "adam-6018", "channels": tuple("abcdefghi")}, "has 8 channels; found 9"),
        ({"registers": (1, 2)}, "one for each of the 5 channels; found 2"),
        ({"scale": (1.0, 2.0)}, "one, or one for each of the 5 channels"),
        ({"type": "f32", "stride": 1}, "a f32 needs 2 registers"),
        ({"first": 65533}, "registers up to 65535"),
        ({"channels": ("a", "a")}, "has a twice"),
        ({"places": {"bed": (0, 0, 0)}}, "'places' has bed"),
        ({"map": "adam-6017"}, "custom"),
    ],
)
def test_an_invalid_map_is_refused(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        ModbusSettings.model_validate(settings)
