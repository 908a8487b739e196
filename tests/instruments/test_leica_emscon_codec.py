"""Packets of an emScon server: layouts of the interface's C definitions."""

import importlib
import struct

import pytest
from coded import raises
from emscon_answers import encode_answer, encode_result
from hypothesis import given
from hypothesis import strategies as st
from wire_vectors import Vector, vectors

from errormotion.errors import ProtocolError
from errormotion.instruments.laser_tracker.leica_emscon import codec, statuses

NUMBERS = {
    "i": st.integers(-(2**31), 2**31 - 1),
    "I": st.integers(0, 2**32 - 1),
    "d": st.floats(allow_nan=False),
    codec.NAME: st.text(st.characters(min_codepoint=1, max_codepoint=0xD7FF), max_size=31),
}


def values_of(layout: codec.Layout) -> st.SearchStrategy[dict[str, object]]:
    return st.fixed_dictionaries({name: NUMBERS[code] for name, code in layout.fields})


def command_and_values(part: str) -> st.SearchStrategy[tuple[int, dict[str, object]]]:
    numbers = st.sampled_from(sorted(codec.COMMANDS))
    return numbers.flatmap(lambda n: st.tuples(st.just(n), values_of(getattr(codec.COMMANDS[n], part))))


def decoded(data: bytes) -> codec.Packet:
    size, kind = codec.decode_header(data[: codec.HEADER.size])
    assert size == len(data) - codec.HEADER.size
    return codec.decode_packet(kind, data[codec.HEADER.size :])


@pytest.mark.parametrize("vector", vectors("leica_emscon", "command"), ids=str)
def test_commands_are_those_of_the_published_interface(vector: Vector) -> None:
    values = dict(vector.expected)
    number = values.pop("number")
    assert codec.encode_command(number, **values) == vector.data


@pytest.mark.parametrize("vector", vectors("leica_emscon", "answer"), ids=str)
def test_answers_are_those_of_the_published_interface(vector: Vector) -> None:
    values = dict(vector.expected)
    packet = decoded(vector.data)
    assert (packet.kind, packet.command, packet.status) == (codec.COMMAND, values.pop("number"), statuses.OK)
    assert {name: packet.values[name] for name in values} == values


@pytest.mark.parametrize("vector", vectors("leica_emscon", "result"), ids=str)
def test_results_are_those_of_the_published_interface(vector: Vector) -> None:
    values = dict(vector.expected)
    packet = decoded(vector.data)
    assert (packet.kind, packet.command, packet.status) == (values.pop("type"), -1, values.pop("status"))
    assert {name: packet.values[name] for name in values} == values


def test_points_and_errors_are_those_of_the_published_interface() -> None:
    (vector,) = vectors("leica_emscon", "points")
    packet = decoded(vector.data)
    assert (packet.values["count"], packet.values["mode"]) == (vector.expected["count"], vector.expected["mode"])
    for name, field in (("statuses", "status"), ("microseconds", "microseconds"), ("distances", "val3")):
        assert [point[field] for point in packet.points] == vector.expected[name]
    (vector,) = vectors("leica_emscon", "error")
    packet = decoded(vector.data)
    assert (packet.kind, packet.command, packet.status) == (codec.ERROR, codec.UNKNOWN, vector.expected["status"])


#: Sizes in bytes of the structures of ES_C_API_Def.h 3.6 (4-byte alignment): command, answer.
SIZES = {
    codec.GET_SYSTEM_STATUS: (12, 56),
    codec.SET_UNITS: (32, 16),
    codec.GET_UNITS: (12, 36),
    codec.INITIALIZE: (12, 16),
    codec.SET_ENVIRONMENT: (36, 16),
    codec.GET_ENVIRONMENT: (12, 40),
    codec.SET_REFRACTION: (28, 16),
    codec.GET_REFRACTION: (12, 32),
    codec.SET_MODE: (16, 16),
    codec.SET_COORDINATES: (16, 16),
    codec.GET_COORDINATES: (12, 20),
    codec.SET_STATIONARY: (20, 16),
    codec.SET_CONTINUOUS_TIME: (28, 16),
    codec.SET_REFLECTOR: (16, 16),
    codec.GET_REFLECTOR: (12, 20),
    codec.GET_REFLECTORS: (12, 100),
    codec.SET_SEARCH: (24, 16),
    codec.SET_SYSTEM_SETTINGS: (48, 16),
    codec.GET_SYSTEM_SETTINGS: (12, 52),
    codec.START_MEASUREMENT: (12, 16),
    codec.STOP_MEASUREMENT: (12, 16),
    codec.GO_POSITION: (40, 16),
    codec.FIND_REFLECTOR: (20, 16),
    codec.GET_DIRECTION: (12, 32),
    codec.GO_BIRD_BATH2: (16, 16),
    codec.GET_TRACKER_INFO: (12, 164),
    codec.GO_AND_MEASURE: (36, 16),
    codec.GET_METEO_STATION: (12, 92),
}


def test_all_commands_have_the_sizes_of_the_c_structures() -> None:
    assert {
        number: (len(codec.encode_command(number)), len(encode_answer(number))) for number in codec.COMMANDS
    } == SIZES


def test_a_continuous_measurement_names_a_region_that_every_version_of_the_interface_has() -> None:
    assert codec.SPHERE in (0, 1)


@given(command_and_values("request"))
def test_a_command_round_trips(pair: tuple[int, dict[str, object]]) -> None:
    number, values = pair
    data = codec.encode_command(number, **values)
    assert codec.COMMANDS[number].request.unpack(data, codec.HEADER.size + 4) == values


@given(command_and_values("answer"))
def test_an_answer_round_trips(pair: tuple[int, dict[str, object]]) -> None:
    number, values = pair
    packet = decoded(encode_answer(number, 0, **values))
    assert (packet.kind, packet.command, packet.status, packet.values) == (codec.COMMAND, number, 0, values)


@given(st.sampled_from([codec.MULTI, codec.MULTI2]), st.data())
def test_points_round_trip(kind: int, data: st.DataObject) -> None:
    points = data.draw(st.lists(values_of(codec.POINTS[kind]), max_size=5))
    packet = decoded(encode_result(kind, {"temperature": 21.5}, points=points))
    assert list(packet.points) == points
    assert (packet.values["count"], packet.values["temperature"]) == (len(points), 21.5)


def test_a_single_measurement_has_156_bytes_with_the_distance_after_two_angles() -> None:
    # size, type, status, mode, try flag; 3 values, 4 deviations, 3 pointing errors, 4 a priori, 3 of the air
    numbers = [float(k) for k in range(1, 18)]
    data = struct.pack("<iIIIi17d", 156, 2, 0, 0, 0, *numbers)
    packet = decoded(data)
    assert len(data) == 156
    assert [packet.values[f"val{k}"] for k in (1, 2, 3)] == [1.0, 2.0, 3.0]
    assert [packet.values[name] for name in ("temperature", "pressure", "humidity")] == [15.0, 16.0, 17.0]
    assert encode_result(codec.SINGLE, packet.values) == data


@pytest.mark.parametrize(
    ("kind", "size"), [(codec.SINGLE2, 204), (codec.LEVEL, 40), (codec.REFLECTOR, 36), (codec.MULTI, 48)]
)
def test_results_have_the_sizes_of_the_c_structures(kind: int, size: int) -> None:
    assert len(encode_result(kind, {})) == size


def test_a_refusal_has_no_values_after_its_status() -> None:
    packet = decoded(encode_answer(codec.GET_REFLECTORS, statuses.BUSY))
    assert (packet.status, dict(packet.values)) == (statuses.BUSY, {})


def test_an_unknown_command_is_reported_by_its_number() -> None:
    assert decoded(encode_answer(9999, statuses.NOT_IMPLEMENTED)).command == 9999


@pytest.mark.parametrize(
    "header",
    [
        b"HTTP/1.1",
        struct.pack("<iI", 4, 0),
        struct.pack("<iI", -12, 8),
        struct.pack("<iI", 156, 77),
        struct.pack("<iI", 1 << 17, 3),
    ],
)
def test_invalid_headers_are_reported(header: bytes) -> None:
    with raises("protocol.reply.form"):
        codec.decode_header(header)


def test_a_packet_that_ends_early_is_refused() -> None:
    data = encode_result(codec.SINGLE, {})
    with raises("protocol.reply.length"):
        codec.decode_packet(codec.SINGLE, data[8:100])


def test_points_that_do_not_fill_their_packet_are_refused() -> None:
    data = encode_result(codec.MULTI, {}, points=[{}, {}])
    with raises("protocol.reply.length"):
        codec.decode_packet(codec.MULTI, data[8:-1])


@given(st.binary(min_size=12, max_size=300))
def test_any_bytes_are_a_packet_or_a_protocol_error(data: bytes) -> None:
    try:
        _, kind = codec.decode_header(data[:8])
        codec.decode_packet(kind, data[8:])
    except ProtocolError:
        return


@pytest.mark.parametrize("number", sorted(codec.COMMANDS.keys() - {codec.SET_CONTINUOUS_TIME}))
def test_commands_are_byte_for_byte_those_of_another_implementation(number: int) -> None:
    """CESAPI (PyPI) is made from the manufacturer's C definitions for the AT4xx; each field has another number."""
    pytest.importorskip("CESAPI", reason="the package CESAPI, another implementation, is not installed")
    theirs = importlib.import_module("CESAPI.packet")
    for suffix, layout in (("CT", codec.COMMANDS[number].request), ("RT", codec.COMMANDS[number].answer)):
        packet = getattr(theirs, codec.COMMANDS[number].name + suffix)()
        packed = packet.pack()
        head = 12 if suffix == "CT" else 16
        values = {
            name: "Name" if code == codec.NAME else k if code != "d" else k + 0.5
            for k, (name, code) in enumerate(layout.fields, 1)
        }
        ours = codec.encode_command(number, **values) if suffix == "CT" else encode_answer(number, 0, **values)
        assert ours[:head] == packed[:head]
        packet.unpack(ours)
        assert packet.pack() == ours
