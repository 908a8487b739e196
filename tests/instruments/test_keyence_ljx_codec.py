"""Bytes of the LJ-X8000A: requests, replies, and profiles, also damaged ones."""

import struct
from itertools import pairwise

import numpy as np
import pytest
from coded import raises
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from errormotion.errors import InstrumentError, ProtocolError
from errormotion.instruments.line_profiler.keyence_ljx import codec, kernels
from errormotion.instruments.line_profiler.keyence_ljx.codec import GARBLED, INTENSITY, LOST, REASONS, StreamLayout
from errormotion.instruments.line_profiler.keyence_ljx.decoder import (
    UNSYNCHRONISED_PROFILES,
    HeightDecoder,
    StreamDecoder,
    StreamEndedError,
)

UNIT = 1e-7


def layout(points: int = 16, kind: int = 0) -> StreamLayout:
    return StreamLayout(7, kind, points, UNIT, -points / 2 * 12.5e-6, 12.5e-6)


def plain_pack(raws: list[int], intensities: list[int], trigger: int, encoder: int) -> bytes:
    """One profile, written with Python's integers: the reference for the compiled loop."""
    bits = sum((raw & 0xFFFFF) << 20 * i for i, raw in enumerate(raws))
    size = -(-20 * len(raws) // 32)
    if intensities:
        pairs = [*intensities, 0] if len(intensities) % 2 else intensities
        fields = [a << 10 | b for a, b in zip(pairs[::2], pairs[1::2], strict=True)]
        bits |= sum(field << 10 * 2 * k for k, field in enumerate(fields)) << 20 * len(raws)
        size += -(-10 * len(intensities) // 32)
    if (20 * len(raws) + 10 * (len(intensities) + len(intensities) % 2)) > 32 * size:
        bits &= (1 << 20 * len(raws) + 10 * (len(intensities) - 1)) - 1  # the last of an odd number does not fit
    body = bits.to_bytes(4 * size, "little")
    words = struct.pack("<IIiIII", 0, trigger, encoder, 0, 0, 0) + body
    total = sum(struct.unpack(f"<{len(words) // 4}I", words)) % (1 << 32)
    return words + struct.pack("<I", total)


def profile(trigger: int, points: int = 16, raws: list[int] | None = None) -> bytes:
    return plain_pack(raws or [100 * trigger + i for i in range(points)], [], trigger, trigger % 1000)


def decode(data: bytes, where: StreamLayout, pieces: list[int] | None = None) -> tuple[np.ndarray, np.ndarray, object]:
    """Return packed profiles, reasons and end of a stream that arrives in pieces."""
    decoder, values, reasons, end = StreamDecoder(where), [], [], None
    cuts = sorted({0, len(data), *(cut % (len(data) + 1) for cut in pieces or [])})
    for start, stop in pairwise(cuts):
        chunk = decoder(data[start:stop])
        values.append(chunk.values)
        reasons.append(chunk.reasons)
        end = chunk.end
        if end is not None:
            break
    if not values:
        return np.empty((0, where.words), dtype=np.uint32), np.empty(0), None
    return np.concatenate(values), np.concatenate(reasons), end


def heights(profiles: np.ndarray, reasons: np.ndarray, where: StreamLayout) -> tuple[np.ndarray, dict[str, int]]:
    out, counts = np.empty((len(profiles), where.points)), np.zeros(len(REASONS), dtype=np.int64)
    HeightDecoder(where).heights(np.ascontiguousarray(profiles), reasons, out, counts)
    return out, {name: int(n) for name, n in zip(REASONS, counts, strict=True) if n}


# ------------------------------------------------------------------ requests and replies


def test_the_published_request_for_errors() -> None:
    published = bytes.fromhex("10 00 00 00 03 00 f0 00 00 00 00 00 04 00 00 00 04 00 00 00")
    assert codec.request(codec.GET_ERROR) == published
    assert codec.parse_request(published) == (codec.GET_ERROR, b"", "LJ-X8000")


def test_the_older_generation_differs_in_one_byte() -> None:
    newer, older = (codec.request(codec.GET_ERROR, generation=name) for name in ("LJ-X8000", "LJ-V7000"))
    assert [(i, a, b) for i, (a, b) in enumerate(zip(newer, older, strict=True)) if a != b] == [(4, 3, 1)]


@given(opcode=st.integers(0, 255), arguments=st.binary(max_size=40), name=st.sampled_from(sorted(codec.GENERATIONS)))
def test_requests_round_trip(opcode: int, arguments: bytes, name: str) -> None:
    frame = codec.request(opcode, arguments, generation=name)
    assert struct.unpack_from("<I", frame)[0] + 4 == len(frame)
    assert codec.parse_request(frame) == (opcode, arguments, name)


@given(data=st.binary(max_size=80), code=st.integers(0, 255), program=st.integers(0, 15))
def test_replies_round_trip(data: bytes, code: int, program: int) -> None:
    assert codec.parse_reply(codec.reply(data, code=code, program=program)) == codec.Reply(code, program, data)


@given(st.binary(max_size=80))
def test_garbage_is_neither_a_request_nor_a_reply(data: bytes) -> None:
    with pytest.raises(ProtocolError):
        codec.parse_request(data)
    if len(data) < 28 or struct.unpack_from("<I", data)[0] + 4 != len(data):
        with pytest.raises(ProtocolError):
            codec.parse_reply(data)


def test_a_reply_that_is_too_short_for_the_request_is_refused() -> None:
    with raises("protocol.reply.length"):
        codec.parse_reply(codec.reply(bytes(4))).unpack("3h")


def test_a_refusal_contains_the_controllers_error_number() -> None:
    error = codec.refusal(codec.START_STREAM, 0xA3)
    assert isinstance(error, InstrumentError)
    assert "A0" in str(error)
    assert "80A3 (another start code was expected)" in str(error)


def test_the_reply_that_announces_a_stream_has_its_fields_at_their_positions() -> None:
    frame = bytearray(codec.reply(bytes(28)))
    struct.pack_into("<i", frame, 32, 4711)
    frame[40] = INTENSITY | 1
    struct.pack_into("<HHii", frame, 44, 3200, 80, -2_000_000, 1250)
    reported = codec.parse_layout(codec.parse_reply(bytes(frame)))
    assert (reported.start_code, reported.kind, reported.points) == (4711, 0x41, 3200)
    assert (reported.z_unit, reported.x_start, reported.x_pitch) == pytest.approx((0.8e-6, -0.02, 12.5e-6), rel=1e-12)
    assert reported.x[[0, 1, -1]] == pytest.approx([-0.02, -0.02 + 12.5e-6, 0.02 - 12.5e-6], rel=1e-12)
    assert codec.layout_data(reported) == bytes(frame[28:])


@pytest.mark.parametrize(("points", "unit"), [(0, 10), (3201, 10), (3200, 0)])
def test_an_impossible_stream_is_refused_when_it_is_announced(points: int, unit: int) -> None:
    data = codec.layout_data(StreamLayout(1, 0, points, unit * codec.LENGTH, 0.0, 0.0))
    with pytest.raises(ProtocolError, match=f"announces {points} points"):
        codec.parse_layout(codec.Reply(0, 0, data))


def test_models_serials_and_errors_are_read_from_their_positions() -> None:
    frame = bytearray(codec.reply(bytes(16 + 2 * 52)))
    frame[28] = 2
    frame[44:53], frame[76:80] = b"LJ-X8000A", b"0815"
    frame[96:104], frame[128:132] = b"LJ-X8060", b"4711"
    parsed = codec.parse_description(codec.parse_reply(bytes(frame)))
    assert parsed == [("LJ-X8000A", "0815"), ("LJ-X8060", "4711")]
    assert codec.description(parsed) == bytes(frame[28:])
    assert codec.parse_errors(codec.Reply(0, 0, struct.pack("<BBHHH", 2, 0, 0, 50, 71))) == [50, 71]
    assert codec.parse_errors(codec.Reply(0, 0, bytes(4))) == []


def test_a_profile_of_3200_points_takes_8028_bytes_and_12028_with_intensities() -> None:
    assert layout(3200).words * 4 == 24 + 8000 + 4
    assert layout(3200, INTENSITY).words * 4 == 24 + 8000 + 4000 + 4


# ------------------------------------------------------------------ profiles

RAW = st.integers(-(1 << 19), (1 << 19) - 1)
I32 = st.integers(-(1 << 31), (1 << 31) - 1)


@given(raws=st.lists(RAW, min_size=1, max_size=40), trigger=st.integers(0, (1 << 32) - 1), data=st.data())
def test_profiles_are_packed_as_in_the_reference_and_round_trip(
    raws: list[int], trigger: int, data: st.DataObject
) -> None:
    light = data.draw(st.one_of(st.just([]), st.lists(st.integers(0, 1023), min_size=len(raws), max_size=len(raws))))
    encoder = data.draw(I32)
    where = layout(len(raws), INTENSITY if light else 0)
    words = np.empty(where.words, dtype=np.uint32)
    intensities = np.array(light, dtype=np.uint16)
    kernels.pack(np.array(raws, dtype=np.int32), intensities, trigger, encoder, words)
    assert words.tobytes() == plain_pack(raws, light, trigger, encoder)

    profiles, reasons, end = decode(words.tobytes(), where)
    assert end is None
    assert profiles.shape == (1, where.words)
    got, counts = heights(profiles, reasons, where)
    known = np.array(raws) >= codec.MIN_HEIGHT
    assert got[0][known] == pytest.approx(np.array(raws)[known] * UNIT, rel=1e-15)
    assert np.isnan(got[0][~known]).all()
    assert sum(counts.values()) == (~known).sum()
    assert HeightDecoder(where).encoder(profiles[:, 2], reasons) == [encoder]
    if light:
        back = np.empty((1, len(raws)), dtype=np.uint16)
        HeightDecoder(where).intensities(profiles, reasons, back)
        n = len(light)
        whole = n % 2 == 0 or 20 * n + 10 * (n + 1) <= 32 * (where.height_words + where.intensity_words)
        assert back[0].tolist() == (light if whole else [*light[:-1], 0])


def test_each_code_for_no_height_is_nan_and_counted_by_its_name() -> None:
    raws = [-(1 << 19), *[-(1 << 19) + 1] * 2, *[-(1 << 19) + 2] * 3, *[-(1 << 19) + 3] * 4, -(1 << 19) + 4, 5]
    where = layout(len(raws))
    packed = plain_pack(raws, [], 0, 0)
    assert packed[24:27] == bytes((0x00, 0x00, 0x18))  # 0x80000, then the lowest four bits of 0x80001
    got, counts = heights(*decode(packed, where)[:2], where)
    assert counts == {"alarm": 1, "invalid": 2, "blind spot": 3, "unprocessed": 4}
    assert np.isnan(got[0, :10]).all()
    assert got[0, 10:] == pytest.approx([(-(1 << 19) + 4) * UNIT, 5 * UNIT], rel=1e-12)


@settings(max_examples=50)
@given(pieces=st.lists(st.integers(0, 10_000), max_size=30), n=st.integers(0, 12))
def test_however_a_stream_is_split_the_profiles_are_the_same(pieces: list[int], n: int) -> None:
    where = layout()
    stream = b"".join(map(profile, range(n))) + codec.notice(0) + profile(n) + codec.notice(1)
    profiles, reasons, end = decode(stream, where, pieces)
    assert profiles.tobytes() == b"".join(map(profile, range(n + 1)))
    assert not reasons.any()
    assert isinstance(end, StreamEndedError)


def test_profiles_that_the_trigger_count_shows_missing_are_lost() -> None:
    where = layout()
    profiles, reasons, _ = decode(profile(5) + profile(6) + profile(9), where)
    assert reasons.tolist() == [0, 0, LOST, LOST, 0]
    got, counts = heights(profiles, reasons, where)
    assert np.isnan(got).all(axis=1).tolist() == [False, False, True, True, False]
    assert got[4, 0] == pytest.approx(900 * UNIT, rel=1e-12)
    assert counts == {"lost": 2 * 16}


def test_the_trigger_count_may_overflow() -> None:
    last = (1 << 32) - 1
    stream = b"".join(profile(count, raws=[1] * 16) for count in (last - 1, last, 1))
    assert decode(stream, layout())[1].tolist() == [0, 0, LOST, 0]


@pytest.mark.parametrize("count", [3, 4, 5 + kernels.MAX_GAP_PROFILES + 1])
def test_a_trigger_count_that_decreases_or_jumps_is_a_protocol_error_after_the_previous_profiles(count: int) -> None:
    profiles, _, end = decode(profile(4) + profile(count), layout())
    assert len(profiles) == 1
    assert isinstance(end, ProtocolError)
    assert f"from 4 to {count}" in str(end)


@settings(max_examples=50)
@given(
    place=st.integers(0, 3 * 68 - 1),
    value=st.integers(1, 255),
    pieces=st.lists(st.integers(0, 10_000), max_size=10),
)
def test_a_changed_byte_costs_one_profile_and_is_counted(place: int, value: int, pieces: list[int]) -> None:
    where = layout()
    assert where.words * 4 == 68
    stream = bytearray(b"".join(map(profile, range(5))))
    stream[68 + place] ^= value
    profiles, reasons, end = decode(bytes(stream), where, pieces)
    assert end is None
    assert reasons.tolist() == [GARBLED if i == 1 + place // 68 else 0 for i in range(5)]
    for i in np.flatnonzero(reasons == 0):
        assert profiles[i].tobytes() == profile(int(i))


@settings(max_examples=50)
@given(
    place=st.integers(68, 4 * 68),
    stray=st.binary(min_size=1, max_size=9),
    pieces=st.lists(st.integers(0, 10_000), max_size=10),
)
def test_stray_bytes_cost_at_most_the_profile_that_they_hit(place: int, stray: bytes, pieces: list[int]) -> None:
    assume(not stray.startswith(b"\xff" * 4))  # this would be a notice
    where = layout()
    stream = b"".join(map(profile, range(6)))
    profiles, reasons, end = decode(stream[:place] + stray + stream[place:], where, pieces)
    assert end is None
    assert len(reasons) == 6
    assert set(np.flatnonzero(reasons)) <= {place // 68}
    assert set(reasons) <= {0, GARBLED}
    for i in np.flatnonzero(reasons == 0):
        assert profiles[i].tobytes() == profile(int(i))


@settings(max_examples=30)
@given(garbage=st.randoms(use_true_random=False), pieces=st.lists(st.integers(0, 10_000), max_size=10))
def test_endless_garbage_is_a_protocol_error_with_a_remedy(garbage: object, pieces: list[int]) -> None:
    where = layout()
    rubbish = garbage.randbytes((UNSYNCHRONISED_PROFILES + 3) * where.words * 4)
    profiles, _, end = decode(profile(0) + b"\1" + rubbish, where, pieces)
    assert len(profiles) == 1
    if end is not None or not pieces:
        assert isinstance(end, ProtocolError)
        assert "Start the stream again" in str(end)


def test_zeros_are_not_profiles_although_their_checksum_is_correct() -> None:
    end = decode(profile(0) + bytes(UNSYNCHRONISED_PROFILES * 68 + 100), layout())[2]
    assert isinstance(end, ProtocolError)


# ------------------------------------------------------------------ the encoder


@given(steps=st.lists(st.integers(-(1 << 31) + 1, (1 << 31) - 1), max_size=20), start=I32)
def test_the_encoders_overflow_is_undone(steps: list[int], start: int) -> None:
    truth = start + np.cumsum([0, *steps])
    wire = (truth % (1 << 32)).astype(np.uint32)
    decoder, n = HeightDecoder(layout()), len(truth) // 2
    got = [decoder.encoder(part, np.zeros(len(part), dtype=np.uint8)) for part in (wire[:n], wire[n:])]
    assert np.concatenate(got).tolist() == truth.tolist()


def test_the_encoder_of_a_lost_profile_is_unknown_and_the_overflow_inside_the_gap_is_undone() -> None:
    wire = np.array([2**31 - 10, 0, 2**31 + 20], dtype=np.uint32)
    got = HeightDecoder(layout()).encoder(wire, np.array([0, LOST, 0], dtype=np.uint8))
    assert np.isnan(got[1])
    assert got[[0, 2]].tolist() == [2**31 - 10, 2**31 + 20]
