"""Hostile or damaged bytes in the decoder of the LJ-X8000A: memory, effort, and only the errors of the project."""

import time
import tracemalloc

import numpy as np
from coded import raises
from hypothesis import given, settings
from hypothesis import strategies as st

from errormotion.errors import InstrumentError, ProtocolError
from errormotion.instruments.line_profiler.keyence_ljx import codec, kernels
from errormotion.instruments.line_profiler.keyence_ljx.blocks import SpacedRows
from errormotion.instruments.line_profiler.keyence_ljx.codec import GARBLED, LOST, TRIGGER_WORD, StreamLayout
from errormotion.instruments.line_profiler.keyence_ljx.decoder import PIECE, HeightDecoder, StreamDecoder

LARGE = StreamLayout(1, 0, 3200, 1e-7, 0.0, 1e-5)
SMALL = StreamLayout(1, 0, 8, 1e-7, 0.0, 1e-5)


def profile(layout: StreamLayout, trigger: int) -> bytes:
    words = np.empty(layout.words, dtype=np.uint32)
    kernels.pack(np.full(layout.points, trigger % 1000, np.int32), np.empty(0, np.uint16), trigger, 0, words)
    return words.tobytes()


def test_jumps_of_the_trigger_count_take_no_memory() -> None:
    data = b"".join(profile(LARGE, 60_000 * i) for i in range(9))  # 72 kB
    decoder = StreamDecoder(LARGE)
    HeightDecoder(LARGE).warm_up()
    tracemalloc.start()
    chunk = decoder(data)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert chunk.end is None
    assert chunk.values[:, TRIGGER_WORD].tolist() == [60_000 * i for i in range(9)]
    assert not chunk.reasons.any()
    assert peak < 10 * len(data)


def test_filled_gaps_stay_within_the_stated_memory() -> None:
    step = kernels.MAX_FILLED_PROFILES + 1
    data = b"".join(profile(LARGE, step * i) for i in range(9))
    decoder = StreamDecoder(LARGE)
    HeightDecoder(LARGE).warm_up()
    tracemalloc.start()
    chunk = decoder(data)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(chunk.values) == 8 * step + 1
    assert chunk.values[:, TRIGGER_WORD].tolist() == list(range(8 * step + 1))
    assert int((chunk.reasons == LOST).sum()) == 8 * kernels.MAX_FILLED_PROFILES
    assert peak < 2 * step * len(data) + 3 * PIECE


def test_effort_grows_with_the_length_of_damaged_data() -> None:
    damaged = b"".join(profile(SMALL, i) + b"\1" for i in range(8000))  # out of step at every profile
    start = time.perf_counter()
    chunk = StreamDecoder(SMALL)(damaged)
    took = time.perf_counter() - start
    assert chunk.end is None
    assert len(chunk.values) == 8000
    assert took < 8000 * 10e-3
    assert not (chunk.reasons == GARBLED).any()


@settings(max_examples=200, deadline=None)
@given(data=st.binary(max_size=400), pieces=st.lists(st.integers(1, 60), max_size=20), kind=st.sampled_from([0, 64]))
def test_for_any_bytes_only_errors_of_the_project_end_a_stream(data: bytes, pieces: list[int], kind: int) -> None:
    decoder = StreamDecoder(StreamLayout(1, kind, 3, 1e-7, 0.0, 1e-5))
    while data:
        n = pieces.pop() if pieces else len(data)
        end = decoder(data[:n]).end
        assert end is None or isinstance(end, InstrumentError)
        if end is not None:
            break
        data = data[n:]


@settings(max_examples=200, deadline=None)
@given(data=st.binary(max_size=120))
def test_replies_and_requests_raise_only_protocol_errors(data: bytes) -> None:
    for read in (codec.parse_reply, codec.parse_request):
        try:
            read(data)
        except ProtocolError:
            continue
    reply = codec.Reply(0, 0, data)
    for read in (codec.parse_layout, codec.parse_description, codec.parse_errors):
        try:
            read(reply)
        except ProtocolError:
            continue


def test_a_reply_whose_two_lengths_disagree_is_refused() -> None:
    frame = bytearray(codec.reply(bytes(4), command=0x37))
    frame[codec.BODY_LENGTH] += 1
    with raises("protocol.reply.length"):
        codec.parse_reply(bytes(frame))


# ------------------------------------------------------------------ rows with successive trigger counts


def spaced(triggers: list[int], batch: int = 4) -> SpacedRows:
    source = iter(triggers)

    def receive(values: np.ndarray, reasons: np.ndarray) -> None:
        values[:] = 0
        reasons[:] = 0
        for row in values:
            row[TRIGGER_WORD] = next(source)

    return SpacedRows(receive, batch, SMALL.words)


def take(rows: SpacedRows, n: int) -> list[int | None]:
    """Trigger counts of the next n rows; None where the profile is lost."""
    packed, reasons = np.empty((n, SMALL.words), dtype=np.uint32), np.empty(n, dtype=np.uint8)
    rows.fill(packed, reasons)
    return [None if reason else int(row[TRIGGER_WORD]) for row, reason in zip(packed, reasons, strict=True)]


def test_a_long_gap_fills_the_block_and_the_rest_of_it_is_skipped_and_counted() -> None:
    rows = spaced([5, 6, 1006, 1007, 1008, 1009, 1010])
    assert take(rows, 4) == [5, 6, None, None]
    assert rows.skip_gap() == 997
    assert take(rows, 4) == [1006, 1007, 1008, 1009]
    assert rows.skip_gap() == 0


def test_a_gap_that_ends_within_the_block_is_filled_there() -> None:
    rows = spaced([0xFFFFFFFE, 0xFFFFFFFF, 2, 3])
    assert take(rows, 4) == [0xFFFFFFFE, 0xFFFFFFFF, None, None]
    assert take(rows, 2) == [2, 3]


@given(steps=st.lists(st.integers(1, 9), min_size=30, max_size=30), size=st.integers(1, 7), batch=st.integers(1, 5))
def test_rows_and_skipped_profiles_add_up_to_the_trigger_count(steps: list[int], size: int, batch: int) -> None:
    triggers = np.cumsum([100, *steps]).tolist()
    rows, first = spaced(triggers, max(batch, size)), 100
    for _ in range(30 // size):
        for i, trigger in enumerate(take(rows, size)):
            assert trigger in (None, first + i)
            assert (trigger is None) == (first + i not in triggers)
        first += size + rows.skip_gap()
