"""Commands, answers and blocks of a capaNCDT 6200, against what documents and independent drivers show."""

import random
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from wire_vectors import Vector, vectors

from errormotion.errors import InstrumentError, ProtocolError
from errormotion.instruments.point_lds.blocks import MAX_BLOCK_BYTES
from errormotion.instruments.point_lds.capancdt import blocks, codec
from errormotion.instruments.point_lds.capancdt.blocks import HEADER, LONGEST_GAP, block_decoder, column, readings_of
from errormotion.instruments.point_lds.counted import CountedReadings


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
def test_lines_without_the_echo_are_no_answer(line: bytes) -> None:
    assert not codec.echoes("TRG1", line)
    with pytest.raises(ProtocolError):
        codec.answer_to("TRG1", line)


def test_an_echo_ahead_of_the_answer_is_no_part_of_it() -> None:
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
def test_any_line_gives_an_answer_or_an_error_of_ours(line: bytes) -> None:
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


def test_values_at_and_beyond_the_ends_of_the_scale_are_no_readings() -> None:
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


def test_stray_bytes_are_discarded_and_the_block_before_them_is_not_trusted() -> None:
    decoder = block_decoder()
    found = decoder.feed(b"xy" + block(1, (1,)) + block(2, (2,)) + b"SAE" + block(3, (3,)) + block(4, (4,)))
    assert [(each.counter, each.intact) for each in found] == [(1, True), (2, False), (3, True)]
    assert decoder.stray == 5


def test_bytes_within_a_block_spoil_this_block_only() -> None:
    data = bytearray(block(1, *[(n,) for n in range(50)]) + block(51, (7,)) + block(52, (8,)))
    data[100:100] = b"\x55\x66"
    found = block_decoder().feed(bytes(data), last=True)
    assert [(each.counter, each.count, each.intact) for each in found] == [
        (1, 50, False),
        (51, 1, True),
        (52, 1, True),
    ]


def test_a_header_that_states_more_than_a_packet_is_none() -> None:
    longest = (MAX_BLOCK_BYTES - HEADER.size) // 4
    for frames, count in ((longest, 0), (longest + 1, 2)):
        data = HEADER.pack(b"SAEM", 1, 1, 1, 0, 4, frames, 0) + block(9, (1,)) + block(10, (1,))
        assert len(block_decoder().feed(data, last=True)) == count


def test_decoding_takes_linear_time_and_bounded_memory() -> None:
    worst = [
        b"SAEM" * 250_000,
        b"SAE" * 330_000,
        HEADER.pack(b"SAEM", 1, 1, 1, 0, 4, 16000, 0) * 30_000,
        block(1, (1,)) * 27_000,
        bytes(1_000_000),
    ]
    for data in worst:
        decoder = block_decoder()
        start = time.perf_counter()
        for place in range(0, len(data), 65536):
            decoder.feed(data[place : place + 65536])
            assert len(decoder._buffer) <= MAX_BLOCK_BYTES + 4
        assert time.perf_counter() - start < 5.0


def test_mutated_blocks_give_blocks_or_nothing() -> None:
    rng = random.Random(3)
    sound = b"".join(block(n, (n, 2 * n), (n, n)) for n in range(4))
    for _ in range(3000):
        data = bytearray(sound)
        for _ in range(rng.randint(1, 6)):
            place = rng.randrange(len(data))
            match rng.randrange(3):
                case 0:
                    data[place] = rng.randrange(256)
                case 1:
                    del data[place : place + rng.randint(1, 8)]
                case 2:
                    data[place:place] = rng.randbytes(rng.randint(1, 8))
        for each in block_decoder().feed(bytes(data), last=True):
            assert each.count > 0
            assert each.values.shape == ((each.count, len(each.channels)) if each.intact else (0, 0))


# ---------------------------------------------------------------------- sequence

RANGE = codec.Channel("DL6220", "1", 0.0, 1e-3)


def sequence(*data: bytes, channel: int = 1) -> CountedReadings:
    found = readings_of(channel, RANGE)
    for each in block_decoder().feed(b"".join(data), last=True):
        found.add(each)
    return found


def test_gaps_of_the_counter_are_lost_readings() -> None:
    found = sequence(block(0xFFFFFFFE, (100,), (200,)), block(3, (300,)))
    assert found.waiting == 6
    values, codes = found.take(6)
    assert found.counts(codes) == {"lost": 3}
    assert np.flatnonzero(np.isnan(values)).tolist() == [2, 3, 4]
    assert values[5] == pytest.approx(300 / 0xFFFFFF * 1e-3)


def test_a_jump_of_the_counter_back_or_far_is_an_error() -> None:
    for counter in (0, LONGEST_GAP + 12):
        with pytest.raises(ProtocolError, match="jumps from 11"):
            sequence(block(10, (1,)), block(counter, (1,)))


def test_readings_of_an_untrusted_block_are_counted() -> None:
    found = sequence(block(1, (5,), (6,)), b"stray", block(3, (7,)), block(4, (8,)))
    values, codes = found.take(4)
    assert found.counts(codes) == {"garbled": 2}
    assert np.isfinite(values).tolist() == [False, False, True, True]


def test_a_channel_that_is_not_sent_is_an_error() -> None:
    (found,) = block_decoder().feed(block(1, (5, 6)), last=True)
    assert column(found, 2).tolist() == [6]
    with pytest.raises(InstrumentError, match=r"sends the channels 1, 2; expected channel 3"):
        column(found, 3)
