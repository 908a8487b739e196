"""Blocks of counted values, and readings in the order of their counter, for all controllers that send them."""

import random
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from coded import raises
from hypothesis import given
from hypothesis import strategies as st

from errormotion.errors import ErrormotionError
from errormotion.instruments.point_lds.blocks import MAX_BLOCK_BYTES, BlockDecoder
from errormotion.instruments.point_lds.capancdt import blocks as capancdt
from errormotion.instruments.point_lds.capancdt.codec import Channel
from errormotion.instruments.point_lds.confocaldt import blocks as confocaldt
from errormotion.instruments.point_lds.counted import CountedReadings


@dataclass(frozen=True)
class Controller:
    """Test data of one controller."""

    name: str
    header: Callable[[int, int], bytes]
    """Of a counter and a number of frames of one value."""
    decoder: Callable[[], BlockDecoder]
    readings: Callable[[], CountedReadings]
    resolution: float
    longest_gap: int

    @property
    def header_bytes(self) -> int:
        return len(self.header(0, 1))

    def block(self, counter: int, *values: int) -> bytes:
        return self.header(counter, len(values)) + np.array(values, dtype="<i4").tobytes()

    def read(self, *data: bytes) -> CountedReadings:
        found = self.readings()
        for each in self.decoder().feed(b"".join(data), last=True):
            found.add(each)
        return found


CONTROLLERS = (
    Controller(
        "capancdt",
        lambda counter, frames: capancdt.HEADER.pack(b"SAEM", 4711, 815, 1, 0, 4, frames, counter),
        capancdt.block_decoder,
        lambda: capancdt.readings_of(1, Channel("DL6220", "1", 0.0, 1e-3)),
        1e-3 / capancdt.FULL_SCALE,
        capancdt.MAX_GAP,
    ),
    Controller(
        "confocaldt",
        lambda counter, frames: confocaldt.HEADER.pack(
            b"SAEM", 2418004, 11020009, confocaldt.MEASURED | confocaldt.DISTANCE_1, 0, 4, frames, counter
        ),
        confocaldt.block_decoder,
        confocaldt.readings,
        confocaldt.RESOLUTION,
        confocaldt.MAX_GAP,
    ),
)
every = pytest.mark.parametrize("of", CONTROLLERS, ids=lambda each: each.name)


# ---------------------------------------------------------------------- blocks


@every
@given(st.lists(st.lists(st.integers(-(2**30), 2**30), min_size=1, max_size=9), min_size=1, max_size=6), st.data())
def test_blocks_are_found_however_they_arrive(of: Controller, parts: list[list[int]], data: st.DataObject) -> None:
    stream, counter = b"", 5
    for part in parts:
        stream += of.block(counter, *part)
        counter += len(part)
    decoder, found = of.decoder(), []
    while stream:
        size = data.draw(st.integers(1, len(stream)))
        found += decoder.feed(stream[:size], last=size == len(stream))
        stream = stream[size:]
    assert [each.values[:, 0].tolist() for each in found] == parts
    assert decoder.stray == 0


@every
def test_stray_bytes_are_discarded_and_the_block_before_them_is_not_trusted(of: Controller) -> None:
    decoder = of.decoder()
    found = decoder.feed(b"xy" + of.block(1, 1) + of.block(2, 2) + b"SAE" + of.block(3, 3) + of.block(4, 4))
    assert [(each.counter, each.intact) for each in found] == [(1, True), (2, False), (3, True)]
    assert decoder.stray == 5


@every
def test_bytes_within_a_block_only_damage_this_block(of: Controller) -> None:
    data = bytearray(of.block(1, *range(50)) + of.block(51, 7) + of.block(52, 8))
    data[100:100] = b"\x55\x66"
    found = of.decoder().feed(bytes(data), last=True)
    assert [(each.counter, each.count, each.intact) for each in found] == [(1, 50, False), (51, 1, True), (52, 1, True)]


@every
def test_a_preamble_outside_a_header_hides_no_block(of: Controller) -> None:
    for stray in (b"SAEM", b"SAEMSAEM", b"MEAS" + bytes(5), bytes(1) + b"SAE", b"SAEM" + bytes(20)):
        found = of.decoder().feed(stray + of.block(1, 5, 6) + of.block(3, 7), last=True)
        assert [(each.counter, each.count) for each in found] == [(1, 2), (3, 1)]


@every
def test_a_header_that_states_more_than_a_packet_is_invalid(of: Controller) -> None:
    longest = (MAX_BLOCK_BYTES - of.header_bytes) // 4
    data = of.header(0, longest) + of.block(9, 1) + of.block(10, 1)
    assert of.decoder().feed(data, last=True) == []  # the rest may follow
    data = of.header(0, longest + 1) + of.block(9, 1) + of.block(10, 1)
    try:
        found = of.decoder().feed(data, last=True)
    except ErrormotionError:
        return
    assert [each.counter for each in found] == [9, 10]


@every
def test_decoding_takes_linear_time_and_bounded_memory(of: Controller) -> None:
    worst = [
        b"SAEM" * 250_000,
        b"SAE" * 330_000,
        of.header(0, 16000) * 30_000,
        of.block(1, 1) * 27_000,
        bytes(1_000_000),
        b"\x00SAE" * 250_000,
    ]
    for data in worst:
        decoder = of.decoder()
        start = time.thread_time()
        for place in range(0, len(data), 65536):
            decoder.feed(data[place : place + 65536])
            assert len(decoder._buffer) <= MAX_BLOCK_BYTES + 4
        assert time.thread_time() - start < 5.0


@every
def test_mutated_blocks_give_blocks_or_errors_of_the_project(of: Controller) -> None:
    rng = random.Random(3)
    sound = b"".join(of.block(9 * number, *range(9)) for number in range(6))
    for _ in range(2000):
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
        try:
            found = of.decoder().feed(bytes(data), last=True)
        except ErrormotionError:
            continue
        for each in found:
            assert 0 < each.count <= MAX_BLOCK_BYTES // 4
            assert each.values.shape == ((each.count, len(each.channels)) if each.intact else (0, 0))


# ---------------------------------------------------------------------- readings


@every
def test_gaps_of_the_counter_are_lost_readings(of: Controller) -> None:
    found = of.read(of.block(2**32 - 2, 100, 200), of.block(3, 300))
    assert found.waiting == 6
    values, codes = found.take(6)
    assert found.counts(codes) == {"lost": 3}
    np.testing.assert_allclose(values / of.resolution, [100, 200, np.nan, np.nan, np.nan, 300])


@every
def test_a_jump_of_the_counter_back_or_far_is_an_error(of: Controller) -> None:
    for counter in (0, 11 + of.longest_gap + 1):
        with raises("protocol.counter.jump"):
            of.read(of.block(10, 1), of.block(counter, 1))


@every
def test_readings_of_a_damaged_block_are_counted(of: Controller) -> None:
    for data in ((of.block(1, 5, 6), b"stray"), (of.block(1, 5, 6)[:-3],)):
        found = of.read(*data, of.block(3, 7), of.block(4, 8))
        values, codes = found.take(4)
        assert found.counts(codes) == {"garbled": 2}
        np.testing.assert_allclose(values / of.resolution, [np.nan, np.nan, 7, 8])


@every
def test_blocks_and_gaps_are_taken_in_any_pieces(of: Controller) -> None:
    data = of.block(0, *range(1, 8)), of.block(9, *range(10, 15)), of.block(14, 15)[:-2], of.block(15, 16)
    whole = of.read(*data).take(16)
    for size in (1, 2, 3, 5, 8):
        found = of.read(*data)
        parts = [found.take(min(size, found.waiting)) for _ in range(-(-16 // size))]
        assert found.waiting == 0
        for one, all_of_it in zip(zip(*parts, strict=True), whole, strict=True):
            np.testing.assert_array_equal(np.concatenate(one), all_of_it)


@every
def test_gaps_take_no_memory_until_their_readings_are_taken(of: Controller) -> None:
    data = b"".join(of.block(number * of.longest_gap & 0xFFFFFFFF, 1) for number in range(500))
    blocks = of.decoder().feed(data, last=True)
    found = of.readings()
    tracemalloc.start()
    try:
        for each in blocks:
            found.add(each)
        held = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert found.waiting == 499 * of.longest_gap + 1
    assert held < 1 << 19
    values, codes = found.take(3)
    np.testing.assert_array_equal(np.isnan(values), [False, True, True])
    assert found.counts(codes) == {"lost": 2}
