"""Bytes of an optoNCDT to values and back: published vectors, any split, any garbage."""

import re

import numpy as np
import pytest
from coded import raises
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from optoncdt_by_the_manual import Sensor
from wire_vectors import Vector, vectors

from errormotion.errors import InstrumentError
from errormotion.instruments.point_lds.optoncdt import codec, commands, kernels
from errormotion.instruments.point_lds.optoncdt.decoder import StreamDecoder
from errormotion.instruments.point_lds.optoncdt.models import MODELS

ALL_CODES = sorted(codec.ERROR_CODES)
HIGHEST = MODELS["ILD2300"].highest
compiled = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])


def wire(raws: list[int], first: int = 0, counter: bool = True, *, counter_first: bool = False) -> bytes:
    """What the sensor sends, by the plain codec."""
    values: list[bytes] = []
    for number, raw in enumerate(raws, first):
        row = [raw, number & 0x3FFFF] if counter else [raw]
        for position, value in enumerate(reversed(row) if counter_first else row):
            values.append(codec.encode_value(value, first=position == 0))
    return b"".join(values)


def decode(
    pieces: list[bytes], counter: bool = True, from_zero: bool = True, *, counter_first: bool = False
) -> tuple[np.ndarray, np.ndarray, bytes]:
    """Values (range 1: relative), reasons and text."""
    decoder = StreamDecoder(1.0, highest=HIGHEST, counter=counter, counter_first=counter_first, from_zero=from_zero)
    another = [codec.encode_value(0), codec.encode_value(0, first=False)]  # confirms the last one
    confirming = another[:1] if not counter else another if counter_first else []
    chunks = [decoder(piece) for piece in [*pieces, *confirming]]
    return (
        np.concatenate([chunk.values for chunk in chunks]),
        np.concatenate([chunk.reasons for chunk in chunks]),
        b"".join(chunk.text for chunk in chunks),
    )


def value_of(triple: bytes) -> int:
    low, middle, high = triple
    return low | (middle & 0x3F) << 6 | (high & 0x3F) << 12


def expected(raws: list[int]) -> list[float]:
    return [codec.distance(raw, 1.0) if not codec.reason(raw, HIGHEST) else np.nan for raw in raws]


@pytest.mark.parametrize("vector", vectors("optoncdt", "value"), ids=str)
def test_values_by_the_documents(vector: Vector) -> None:
    raw, first = vector.expected["raw"], vector.expected["first"]
    assert codec.encode_value(raw, first=first) == vector.data
    assert value_of(vector.data) == raw
    if "reason" in vector.expected:
        assert codec.reason(raw, HIGHEST) == vector.expected["reason"]


@pytest.mark.parametrize("vector", vectors("optoncdt", "distance"), ids=str)
def test_distances_by_the_documents(vector: Vector) -> None:
    raw = value_of(vector.data)
    assert raw == vector.expected["raw"]
    found = codec.distance(raw, vector.expected["range_mm"])
    assert found == pytest.approx(vector.expected["distance_mm"], abs=5e-6)  # some were printed from a 32-bit float


@pytest.mark.parametrize("vector", vectors("optoncdt", "getinfo"), ids=str)
def test_identities_by_the_manuals(vector: Vector) -> None:
    facts = commands.parse_info(commands.parse_answer("GETINFO", vector.data))
    expected = dict(vector.expected)
    assert commands.reported_range(facts) == pytest.approx(expected.pop("range_mm") * 1e-3)
    assert {key: facts[key] for key in expected} == expected


@pytest.mark.parametrize("vector", vectors("optoncdt", "answer"), ids=str)
def test_answers_by_the_documents(vector: Vector) -> None:
    command = vector.expected["command"]
    if "refused" in vector.expected:
        for answer in (vector.data, command.encode() + b" " + vector.data, command.encode() + b"\r\n" + vector.data):
            with pytest.raises(commands.RefusedCommandError, match=f"'{command}': {vector.expected['refused']}"):
                commands.parse_answer(command, answer)
    else:
        assert commands.parse_answer(command, vector.data) == vector.expected["lines"]


@pytest.mark.parametrize("vector", vectors("optoncdt", "command"), ids=str)
def test_the_scripted_sensor_accepts_the_commands_of_the_manuals(vector: Vector) -> None:
    for model in MODELS:
        sensor = Sensor(model)
        try:
            answer = sensor._answer(vector.data.decode().strip())
        finally:
            sensor.wire.close()
        assert (b" ok\r\n->" in answer) == (model in vector.expected["models"])


@pytest.mark.parametrize(("raw", "millimetres"), [(0, -0.1), (32760, 5.0), (65520, 10.1)])
def test_published_scale_at_10_mm(raw: int, millimetres: float) -> None:
    assert codec.distance(raw, 10.0) == pytest.approx(millimetres, abs=1e-12)


def test_measuring_range_ends_where_it_is_published() -> None:
    for model, last in (("ILD2300", 64876), ("ILD1420", 64877)):
        highest = MODELS[model].highest
        found = [codec.reason(raw, highest) for raw in (642, 643, last, last + 1)]
        assert found == ["below range", "", "", "above range"]
    step = 1.02 / 65520  # the published ends are whole numbers within two steps of 0 and 1
    assert codec.distance(643, 1.0) == pytest.approx(0, abs=2 * step)
    assert codec.distance(64876, 1.0) == pytest.approx(1, abs=2 * step)


@pytest.mark.parametrize("code", ALL_CODES)
def test_each_error_code_has_its_own_reason(code: int) -> None:
    values, reasons, _ = decode([wire([code])])
    assert np.isnan(values).all()
    assert codec.REASONS[reasons[0]] == codec.ERROR_CODES[code]
    assert list(codec.ERROR_CODES.values()).count(codec.ERROR_CODES[code]) == 1


def test_the_error_codes_are_the_published_ones() -> None:
    assert ALL_CODES == [262075, 262076, 262077, 262078, 262080, 262081, 262082]


@pytest.mark.parametrize(
    ("raw", "reason"),
    [
        (0, "below range"),
        (65520, "above range"),
        (65521, "unknown code"),
        (262074, "unknown code"),
        (262079, "unknown code"),
        (262083, "unknown code"),
    ],
)
def test_values_other_than_distances_have_a_reason(raw: int, reason: str) -> None:
    assert codec.reason(raw, HIGHEST) == reason
    _, reasons, _ = decode([wire([raw])])
    assert codec.REASONS[reasons[0]] == reason


def test_a_value_has_18_bits() -> None:
    for raw in (-1, 1 << 18):
        with raises("sensor.value.outside"):
            codec.encode_value(raw)


@given(st.integers(0, (1 << 18) - 1), st.booleans())
def test_every_value_round_trips(raw: int, first: bool) -> None:
    triple = codec.encode_value(raw, first=first)
    assert value_of(triple) == raw
    assert (triple[2] >> 6) == (0b10 if first else 0b11)


@st.composite
def splits(draw: st.DrawFn, data: bytes) -> list[bytes]:
    cuts = sorted(draw(st.lists(st.integers(0, len(data)), max_size=12)))
    return [data[a:b] for a, b in zip([0, *cuts], [*cuts, len(data)], strict=True)]


ORDERS = st.sampled_from([(False, False), (True, False), (True, True)])
"""With a counter, and whether it precedes the distance."""


@given(st.data(), st.lists(st.integers(0, 65535) | st.sampled_from(ALL_CODES), max_size=40), ORDERS)
@compiled
def test_any_split_gives_the_same_samples(data: st.DataObject, raws: list[int], order: tuple[bool, bool]) -> None:
    counter, counter_first = order
    pieces = data.draw(splits(wire(raws, counter=counter, counter_first=counter_first)))
    values, reasons, text = decode(pieces, counter, counter_first=counter_first)
    np.testing.assert_allclose(values, expected(raws), rtol=1e-12, atol=1e-12)
    assert [codec.REASONS[code] for code in reasons] == [codec.reason(raw, HIGHEST) for raw in raws]
    assert text == b""


def test_one_byte_at_a_time_gives_the_same_samples() -> None:
    raws = [1000, 64876, 262076, 0, 33333]
    values, _, _ = decode([bytes([byte]) for byte in wire(raws)])
    np.testing.assert_allclose(values, expected(raws), rtol=1e-12)


TEXT = st.text(st.characters(min_codepoint=0x20, max_codepoint=0x7E), max_size=30).map(
    lambda text: text.encode().replace(b"->", b"--") + b"\r\n->"
)


@given(st.data(), st.lists(st.integers(643, 64876), min_size=1, max_size=20), st.lists(TEXT, max_size=4))
@compiled
def test_answers_between_the_data_are_reported_separately_and_have_no_effect(
    data: st.DataObject, raws: list[int], answers: list[bytes]
) -> None:
    samples = [wire([raw], number) for number, raw in enumerate(raws)]
    for answer in answers:
        samples.insert(data.draw(st.integers(0, len(samples))), answer)
    order = [part for part in samples if part.endswith(b"->")]
    values, reasons, text = decode(data.draw(splits(b"".join(samples))))
    np.testing.assert_allclose(values, expected(raws), rtol=1e-12)
    assert not reasons.any()
    assert text == b"".join(order)


@given(
    st.data(),
    st.lists(st.integers(643, 64876), min_size=30, max_size=60),
    st.lists(st.binary(min_size=1, max_size=5), min_size=1, max_size=4),
    st.booleans(),
)
@compiled
def test_garbage_causes_no_wrong_value_and_loses_few_samples(
    data: st.DataObject, raws: list[int], garbage: list[bytes], counter_first: bool
) -> None:
    """One burst of stray bytes affects at most its sample and the next two; all remaining values are correct."""
    base = 123456  # no burst of 5 bytes is a sample with the right counter, which takes 6
    stream = wire(raws, base, counter_first=counter_first)
    places = sorted(data.draw(st.lists(st.integers(2, 25), min_size=len(garbage), max_size=len(garbage), unique=True)))
    for place, burst in reversed(list(zip(places, garbage, strict=True))):
        at = place * 6 + data.draw(st.integers(0, 5))
        stream = stream[:at] + burst + stream[at:]
    values, reasons, _ = decode(data.draw(splits(stream)), from_zero=False, counter_first=counter_first)
    known = np.isfinite(values)
    np.testing.assert_allclose(values[known], np.array(expected(raws))[: values.size][known], rtol=1e-12)
    assert (~known).sum() <= 3 * len(garbage)
    assert values.size == len(raws)
    assert {codec.REASONS[code] for code in reasons} <= {"", "lost", "garbled"}


@given(st.sets(st.integers(1, 98), max_size=97), st.integers(0, (1 << 18) - 1))
@example({1, 2, 3, *range(5, 99, 2)}, (1 << 18) - 50)  # across the overflow of the counter
@compiled
def test_missing_samples_are_lost_at_their_positions(missing: set[int], base: int) -> None:
    raws = [1000 + number for number in range(100)]
    data = b"".join(wire([raw], base + number) for number, raw in enumerate(raws) if number not in missing)
    values, reasons, _ = decode([data], from_zero=False)
    truth = np.array(expected(raws))
    truth[sorted(missing)] = np.nan
    # A jump is accepted if the next sample confirms it; a jump at the end remains unconfirmed.
    assert values.size == 100 or (values.size < 100 and 98 in missing)
    np.testing.assert_allclose(values, truth[: values.size], rtol=1e-12)
    assert set(np.flatnonzero(reasons)) == {number for number in missing if number < values.size}


def test_a_counter_that_starts_at_zero_shows_samples_lost_before() -> None:
    values, reasons, _ = decode([wire([2000, 2001, 2002], first=4)], from_zero=True)
    assert np.isnan(values[:4]).all()
    np.testing.assert_allclose(values[4:], expected([2000, 2001, 2002]), rtol=1e-12)
    assert [codec.REASONS[code] for code in reasons[:4]] == ["lost"] * 4


def test_a_counter_continues_beyond_18_bits() -> None:
    raws = np.full(300_000, 5000, dtype=np.int32)
    values, reasons, _ = decode([wire(raws.tolist())])
    assert values.size == 300_000
    assert not reasons.any()


def test_a_counter_that_starts_again_is_a_protocol_error() -> None:
    decoder = StreamDecoder(1.0, highest=HIGHEST, counter=True, from_zero=True)
    decoder(wire([1000] * 100))
    with raises("protocol.counter.jump"):
        decoder(wire([1000] * 100))


def reference_split(data: bytes) -> tuple[list[int], bytes]:
    """Reference implementation: separate values and other bytes of complete data."""
    triple = re.compile(rb"[\x00-\x3f][\x40-\x7f][\x80-\xff]")
    values = [value_of(match[0]) for match in triple.finditer(data)]
    return values, triple.sub(b"", data)


@given(st.lists(st.binary(max_size=12) | st.integers(0, (1 << 18) - 1).map(codec.encode_value), max_size=30))
@compiled
def test_the_compiled_splitter_agrees_with_the_plain_one(parts: list[bytes]) -> None:
    data = b"".join(parts) + b"\xff\xff"  # closes everything that was started
    values = np.empty(len(data), dtype=np.uint32)
    text = np.empty(len(data), dtype=np.uint8)
    used, n_values, n_text, _ = kernels.split(np.frombuffer(data, dtype=np.uint8), values, text, False)
    plain_values, plain_text = reference_split(data)
    assert used == len(data)
    assert [int(value) & 0x3FFFF for value in values[:n_values]] == plain_values
    assert text[:n_text].tobytes() == plain_text


@given(st.binary(max_size=200), st.sampled_from(["GETINFO", "SYNC", "GETOUTINFO_RS422", "MEASRATE 20"]))
@compiled
def test_any_answer_of_the_sensor_is_an_answer_or_an_error_of_the_project(text: bytes, command: str) -> None:
    try:
        lines = commands.parse_answer(command, text)
        commands.setting(command, lines)
        commands.reported_range(commands.parse_info(lines))
        commands.parse_layout(lines, counter=True)
    except InstrumentError:
        pass


def test_an_answer_that_is_too_long_is_a_protocol_error() -> None:
    with raises("protocol.reply.too_long"):
        commands.parse_answer("PRINT", b"x" * (commands.MAX_ANSWER + 1))


@pytest.mark.parametrize("wrong", ["20.00um", "mm", "-1.00mm", "0.00mm", "1e99mm", "9" * 400 + "mm"])
def test_an_invalid_range_is_a_protocol_error(wrong: str) -> None:
    with raises("protocol.reply.range"):
        commands.reported_range({"measuring range": wrong})


def test_a_rate_that_does_not_fit_is_refused_with_the_arithmetic() -> None:
    with raises("sensor.rate.too_high"):
        codec.check_line(20e3, 921600, counter=True)
    codec.check_line(20e3, 921600, counter=False)
    codec.check_line(49.14e3, 4000000, counter=True)
