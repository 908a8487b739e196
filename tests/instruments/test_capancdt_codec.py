"""Commands, answers and blocks of a capaNCDT 6200, against documents and independent drivers."""

import numpy as np
import pytest
from coded import raises
from hypothesis import given
from hypothesis import strategies as st
from wire_vectors import Vector, vectors

from errormotion.errors import InstrumentError, ProtocolError
from errormotion.instruments.point_lds.capancdt import blocks, codec
from errormotion.instruments.point_lds.capancdt.blocks import HEADER, block_decoder, column


def layer(name: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("vector", vectors("capancdt", name), ids=str)


def block(counter: int, *frames: tuple[int, ...], preamble: bytes = b"SAEM", frames_first: bool = False) -> bytes:
    """Return the bytes of a block of the channels 1, 2, ..."""
    width, field = len(frames[0]), sum(1 << 2 * number for number in range(len(frames[0])))
    counts = (len(frames), 4 * width) if frames_first else (4 * width, len(frames))
    return HEADER.pack(preamble, 4711, 815, field, 0, *counts, counter) + np.array(frames, dtype="<i4").tobytes()


# ---------------------------------------------------------------------- answers


@layer("answer")
def test_answers(vector: Vector) -> None:
    assert codec.answer_to(vector.expected["command"], vector.data) == vector.expected["answer"]


@layer("error")
def test_refusals_are_errors_with_their_text(vector: Vector) -> None:
    with pytest.raises(InstrumentError, match=vector.expected["message"]):
        codec.answer_to(vector.expected["command"], vector.data)


@layer("channels")
def test_states_of_the_channels(vector: Vector) -> None:
    answer = codec.answer_to(vector.expected["command"], vector.data)
    assert list(codec.parse_channels(answer)) == vector.expected["states"]


@layer("channel")
@pytest.mark.parametrize("encoding", ["latin-1", "utf-8"])
def test_a_channel(vector: Vector, encoding: str) -> None:
    number = vector.expected["channel"]
    line = vector.data.decode("latin-1").encode(encoding)
    answer = codec.answer_to(f"CHI{number}", line)
    found = codec.parse_channel(number, answer)
    assert (found.name, found.serial_number) == (vector.expected["name"], vector.expected["serial"])
    assert found.offset == pytest.approx(vector.expected["low_um"] * 1e-6)
    assert found.measuring_range == pytest.approx(vector.expected["range_um"] * 1e-6)


def test_the_sample_time_is_the_actual_one() -> None:
    assert codec.parse_sample_time("STI1200", ",960") == pytest.approx(960e-6)
    assert codec.parse_sample_time("STI?", "960") == pytest.approx(960e-6)


@pytest.mark.parametrize(
    "line", [b"Welcome to the capaNCDT 6200\r\n", b"\r\n", b"$TRG?0OK\r\n", b"$AVT?1OK\r\n", b"TRG1OK\r\n"]
)
def test_lines_without_the_echo_are_not_an_answer(line: bytes) -> None:
    assert not codec.echoes("TRG1", line)
    with pytest.raises(ProtocolError):
        codec.answer_to("TRG1", line)


def test_an_echo_before_the_answer_is_not_part_of_it() -> None:
    assert codec.answer_to("CHS", b"$CHS\r$CHS1,0OK\r\n") == "1,0"


@pytest.mark.parametrize(
    "text",
    [
        ":ANO1",
        ":NAMx,RNG100",
        ":RNG100,UNTinch",
        ":RNG,UNTmm",
        ":RNG0,UNTmm",
        ":RNG-2,UNTmm",
        ":RNG1e400,UNTmm",
        "::",
        "",
    ],
)
def test_a_channel_without_a_usable_range_is_an_error(text: str) -> None:
    with pytest.raises(ProtocolError):
        codec.parse_channel(1, text)


@given(st.binary(max_size=600))
def test_any_line_gives_an_answer_or_an_error_of_the_project(line: bytes) -> None:
    try:
        codec.echoes("CHI1", line)
        codec.parse_channel(1, codec.answer_to("CHI1", line))
    except InstrumentError:
        pass
    try:
        answer = codec.answer_to("CHI1", b"$CHI1" + line + b"OK\r\n")
        codec.parse_channel(1, answer)
    except InstrumentError:
        pass


# ---------------------------------------------------------------------- blocks


@layer("block")
def test_blocks_in_any_pieces(vector: Vector) -> None:
    for size in (1, 7, 33, len(vector.data)):
        decoder = block_decoder()
        found = []
        for start in range(0, len(vector.data), size):
            found += decoder.feed(vector.data[start : start + size], last=True)
        (one,) = found
        assert (one.counter, list(one.channels)) == (vector.expected["counter"], vector.expected["channels"])
        assert one.values.tolist() == vector.expected["values"]
        assert one.intact
        assert decoder.stray == 0


@layer("value")
def test_values(vector: Vector) -> None:
    raws = np.frombuffer(vector.data, dtype="<i4").astype(np.int64)
    readings = raws / blocks.FULL_SCALE * vector.expected["range_um"]
    assert readings[0] == pytest.approx(vector.expected["reading_um"], abs=0.01)
    values, codes = blocks.scale(raws, 0.0, vector.expected["range_um"] * 1e-6)
    if raws[0] < blocks.FULL_SCALE:
        assert values[0] == pytest.approx(vector.expected["reading_um"] * 1e-6, abs=1e-8)
        assert codes[0] == blocks.VALID


def test_values_at_and_beyond_the_ends_of_the_scale_are_not_readings() -> None:
    raws = np.array([-1, 0, 1, 0xFFFFFE, 0xFFFFFF, 0x1000000])
    values, codes = blocks.scale(raws, 1e-4, 1e-3)
    assert [blocks.REASONS[code] for code in codes] == [
        "unknown code",
        "under range",
        "",
        "",
        "over range",
        "unknown code",
    ]
    assert np.isnan(values).tolist() == [True, True, False, False, True, True]
    assert values[2] == pytest.approx(1e-4, abs=1e-9)
    assert values[3] == pytest.approx(1.1e-3, abs=1e-9)


@pytest.mark.parametrize("frames_first", [False, True])
@pytest.mark.parametrize("preamble", [b"SAEM", b"MEAS"])
def test_both_orders_of_the_header_are_read(preamble: bytes, frames_first: bool) -> None:
    data = block(5, (1, 2), (3, 4), (5, 6), preamble=preamble, frames_first=frames_first)
    (found,) = block_decoder().feed(data, last=True)
    assert found.values.tolist() == [[1, 2], [3, 4], [5, 6]]


def test_a_channel_that_is_not_sent_is_an_error() -> None:
    (found,) = block_decoder().feed(block(1, (5, 6)), last=True)
    assert column(found, 2).tolist() == [6]
    with raises("sensor.channel.missing"):
        column(found, 3)
