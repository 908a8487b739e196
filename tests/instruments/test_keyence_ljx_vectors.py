"""Bytes of the LJ-X8000A from the sources that the device's page names, read and written by the codec."""

import numpy as np
import pytest
from wire_vectors import Vector, vectors

from errormotion.instruments.line_profiler.keyence_ljx import codec, kernels
from errormotion.instruments.line_profiler.keyence_ljx.codec import INTENSITY, REASONS, StreamLayout
from errormotion.instruments.line_profiler.keyence_ljx.decoder import HeightDecoder, StreamDecoder, StreamEndedError

DEVICE = "keyence_ljx"
UNIT = 0.8e-6  # m


def named(layer: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("vector", vectors(DEVICE, layer), ids=str)


def series(expected: dict[str, object], name: str) -> np.ndarray:
    """The values of a row: as they are, or from first value, step and number."""
    if name in expected:
        return np.array(expected[name], dtype=np.int64)
    first, step, number = expected[f"{name}_from"]  # type: ignore[misc]
    values = first + step * np.arange(number)
    return values % 1024 if name == "intensities" else values


@named("request")
def test_requests(vector: Vector) -> None:
    arguments = bytes.fromhex(vector.expected["arguments"])
    generation = vector.expected.get("generation", "LJ-X8000")
    assert codec.request(vector.expected["opcode"], arguments, generation=generation) == vector.data
    assert codec.parse_request(vector.data) == (vector.expected["opcode"], arguments, generation)


@named("reply")
def test_replies(vector: Vector) -> None:
    expected = vector.expected
    reply = codec.parse_reply(vector.data)
    assert (reply.command, reply.code, reply.program) == (expected["command"], expected["code"], expected["program"])
    assert list(reply.unpack(expected["unpack"])) == expected["values"]
    again = codec.reply(reply.data, code=reply.code, program=reply.program, command=reply.command)
    assert again == vector.data


@named("layout")
def test_announced_streams(vector: Vector) -> None:
    layout = codec.parse_layout(codec.parse_reply(vector.data))
    assert {name: getattr(layout, name) for name in vector.expected} == pytest.approx(vector.expected, rel=1e-12)


@named("profile")
def test_profiles(vector: Vector) -> None:
    raws, light = series(vector.expected, "heights"), series(vector.expected, "intensities")
    layout = StreamLayout(1, INTENSITY if light.size else 0, raws.size, UNIT, 0.0, 1e-5)
    assert layout.words * 4 == len(vector.data)
    decoder = StreamDecoder(layout)
    chunk = decoder(vector.data)
    assert chunk.end is None
    assert chunk.values.tobytes() == vector.data
    assert decoder.first_trigger == vector.expected["trigger"]

    unpack = HeightDecoder(layout)
    heights, counts = np.empty((1, raws.size)), np.zeros(len(REASONS), dtype=np.int64)
    unpack.heights(chunk.values, chunk.reasons, heights, counts)
    known = raws >= codec.MIN_HEIGHT
    assert heights[0][known] == pytest.approx(raws[known] * UNIT, rel=1e-15)
    assert counts[:4].tolist() == [int((raws == codec.MIN_HEIGHT - 4 + i).sum()) for i in range(4)]
    assert unpack.encoder(chunk.values[:, codec.ENCODER_WORD], chunk.reasons) == [vector.expected["encoder"]]
    if light.size:
        intensities = np.empty((1, raws.size), dtype=np.uint16)
        unpack.intensities(chunk.values, chunk.reasons, intensities)
        assert intensities[0].tolist() == light.tolist()

    words = np.empty(layout.words, dtype=np.uint32)
    kernels.pack(
        raws.astype(np.int32), light.astype(np.uint16), vector.expected["trigger"], vector.expected["encoder"], words
    )
    assert words.tobytes() == vector.data


@named("notice")
def test_notices(vector: Vector) -> None:
    end = StreamDecoder(StreamLayout(1, 0, 8, UNIT, 0.0, 1e-5))(vector.data).end
    assert isinstance(end, StreamEndedError) == vector.expected["ended"]


@pytest.mark.parametrize(("points", "first_bit"), [(3200, 64000), (300, 6000), (100, 2000), (4, 80), (12, 240)])
def test_intensities_start_at_bit_20_n_without_padding(points: int, first_bit: int) -> None:
    layout = StreamLayout(1, INTENSITY, points, UNIT, 0.0, 1e-5)
    assert layout.words == 6 + -(-20 * points // 32) + -(-10 * points // 32) + 1  # as reserved by Keyence's library
    words = np.zeros((1, layout.words), dtype=np.uint32)
    second = first_bit + 30  # the upper half of the second 20-bit field
    words[0, 6 + second // 32] |= np.uint32(1 << second % 32)
    words[0, -1] = words[0, :-1].sum(dtype=np.uint32)
    out = np.empty((1, points), dtype=np.uint16)
    HeightDecoder(layout).intensities(words, np.zeros(1, dtype=np.uint8), out)
    assert np.flatnonzero(out).tolist() == [2]
    assert out[0, 2] == 1
