"""The simulated Modbus thermometer on its line: pieces, pipelined requests, refusals, other units, broken headers."""

import os
import socket
import struct
import termios
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
from hypothesis import given
from hypothesis import strategies as st
from wire_vectors import Vector, vectors

from errormotion.instruments.simulators.thermometer.modbus import SimulatedModbus, to_registers
from errormotion.instruments.transports import parse_address
from errormotion.instruments.transports.modbus.serving import ModbusServer, checksum

DEVICE = "modbus_temperature"
LOGGER = "sim://cframe/logger?seed=3&map=logger-16&noise=0&unit=5"
SPECIFIED = {107: 555, 108: 0, 109: 100}  # registers 108 to 110 of the specification's example
READ = bytes.fromhex("0300200001")  # the first channel of the logger
TIMEOUT = 10.0  # s


def mbap(pdu: bytes, number: int = 1, unit: int = 5, protocol: int = 0) -> bytes:
    return struct.pack(">HHHB", number, protocol, len(pdu) + 1, unit) + pdu


def rtu(pdu: bytes, unit: int = 5) -> bytes:
    return bytes((unit,)) + pdu + checksum(bytes((unit,)) + pdu)


def server(function: int = 3, unit: int = 1, framing: str = "tcp") -> ModbusServer:
    registers = SPECIFIED if function == 3 else {8: 10}
    return ModbusServer(framing, unit, function, {min(registers): len(registers)}, lambda: registers)  # type: ignore[arg-type]


def named(layer: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("vector", vectors(DEVICE, layer), ids=str)


# ------------------------------------------------------------------ vectors


@named("request pdu")
def test_requests_of_the_specification(vector: Vector) -> None:
    assert server(vector.expected["function"]).respond(vector.data).hex() == vector.expected["answer"]


@named("refused pdu")
def test_refusals_of_the_specification(vector: Vector) -> None:
    assert server().respond(vector.data).hex() == vector.expected["answer"]


@named("checksum")
def test_checksum_of_the_guide(vector: Vector) -> None:
    assert checksum(vector.data).hex() == vector.expected["checksum"]


@named("rtu request")
def test_serial_requests(vector: Vector) -> None:
    device = server(vector.expected["function"], vector.expected["unit"], "rtu")
    assert [answer.hex() for answer in device.receive(vector.data)] == [vector.expected["answer"]]


@named("tcp request")
def test_network_requests(vector: Vector) -> None:
    device = ModbusServer("tcp", 9, 3, {4: 1}, lambda: {4: 5})
    assert [answer.hex() for answer in device.receive(vector.data)] == [vector.expected["answer"]]


# ------------------------------------------------------------------ frames without a connection


@given(data=st.data(), framing=st.sampled_from(["tcp", "rtu"]), n=st.integers(1, 5))
def test_however_requests_are_split_or_joined_each_is_answered_once(data: st.DataObject, framing: str, n: int) -> None:
    pdu = bytes.fromhex("03006b0003")
    frames = [mbap(pdu, number, 1) if framing == "tcp" else rtu(pdu, 1) for number in range(n)]
    stream, device = b"".join(frames), server(framing=framing)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=12)))
    answers = [
        answer
        for start, stop in zip([0, *cuts], [*cuts, len(stream)], strict=True)
        for answer in device.receive(stream[start:stop])
    ]
    if framing == "tcp":
        assert [answer[:2] for answer in answers] == [struct.pack(">H", number) for number in range(n)]
        assert {answer[7:].hex() for answer in answers} == {"0306022b00000064"}
    else:
        assert answers == [rtu(bytes.fromhex("0306022b00000064"), 1)] * n


@given(st.lists(st.binary(max_size=300), max_size=10), st.sampled_from(["tcp", "rtu"]))
def test_for_any_bytes_little_is_kept_and_answers_are_frames(pieces: list[bytes], framing: str) -> None:
    device = server(framing=framing)
    for piece in pieces:
        for answer in device.receive(piece):
            assert answer[-2:] == checksum(answer[:-2]) if framing == "rtu" else answer[2:4] == b"\0\0"
        assert len(device._rest) <= 260


def test_stray_bytes_on_a_serial_line_do_not_hide_a_request() -> None:
    request = rtu(bytes.fromhex("03006b0003"), 1)
    for stray in (b"\xff", b"\x00", b"\x55\xaa", bytes(range(100, 117))):
        device = server(framing="rtu")
        answers = [answer for piece in (stray, request, request) for answer in device.receive(piece)]
        assert answers, stray
        assert set(answers) == {rtu(bytes.fromhex("0306022b00000064"), 1)}


def test_an_unknown_function_on_a_serial_line_is_refused_also_in_pieces() -> None:
    request = rtu(bytes.fromhex("4d0102"), 1)
    for cut in range(len(request)):
        device = server(framing="rtu")
        answers = [answer for piece in (request[:cut], request[cut:]) for answer in device.receive(piece)]
        assert answers == [rtu(bytes.fromhex("cd01"), 1)]


@pytest.mark.parametrize("unit", [0, 2, 255])
def test_a_serial_line_answers_no_other_unit_and_no_broadcast(unit: int) -> None:
    device = server(framing="rtu")
    assert not list(device.receive(rtu(bytes.fromhex("03006b0003"), unit)))
    assert not list(device.receive(rtu(bytes.fromhex("060001aaaa"), unit)))
    assert len(list(device.receive(rtu(bytes.fromhex("03006b0003"), 1)))) == 1


def test_units_0_and_255_reach_a_network_device_and_another_unit_does_not() -> None:
    pdu = bytes.fromhex("03006b0003")
    found = {unit: list(server(unit=7).receive(mbap(pdu, 9, unit))) for unit in (0, 7, 8, 255)}
    assert not found.pop(8)
    assert {unit: answer[0][6] for unit, answer in found.items()} == {0: 0, 7: 7, 255: 255}


def test_another_protocol_is_skipped_and_an_impossible_length_loses_the_connection() -> None:
    device, pdu = server(), bytes.fromhex("03006b0003")
    answers = list(device.receive(mbap(pdu, 1, 1, protocol=7) + mbap(pdu, 2, 1)))
    assert [answer[:2].hex() for answer in answers] == ["0002"]
    for length in (0, 1, 255, 0xFFFF):
        assert not device.lost
        assert not list(device.receive(struct.pack(">HHHB", 1, 0, length, 1) + pdu))
        assert device.lost
        device.reset()
    assert len(list(device.receive(mbap(pdu, 3, 1)))) == 1


@pytest.mark.parametrize(
    ("value", "kind", "expected"),
    [
        (21.4, "u16", [21]),
        (-1.0, "u16", [0]),
        (-1.0, "i16", [0xFFFF]),
        (70000.0, "i16", [0x7FFF]),
        (70000.0, "u32", [1, 0x1170]),
        (-2.0, "i32", [0xFFFF, 0xFFFE]),
        (20.25, "f32", [0x41A2, 0x0000]),
    ],
)
def test_numbers_in_registers(value: float, kind: str, expected: list[int]) -> None:
    assert to_registers(value, kind) == expected
    assert to_registers(value, kind, word_order="little") == expected[::-1]
    swapped = [(word & 0xFF) << 8 | word >> 8 for word in expected]
    assert to_registers(value, kind, byte_order="little") == swapped


# ------------------------------------------------------------------ over a connection


@contextmanager
def connected(device: SimulatedModbus) -> Iterator[tuple[Callable[[bytes], None], Callable[[int], bytes]]]:
    """Yield functions to write to the device and to read an exact number of bytes from it."""
    place = parse_address(device.url)
    if device.url.startswith("tcp"):
        with socket.create_connection((place.host, place.port), timeout=TIMEOUT) as line:
            line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            yield line.sendall, lambda n: line.recv(n, socket.MSG_WAITALL)
    else:
        descriptor = os.open(place.path, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(descriptor)
        settings = termios.tcgetattr(descriptor)
        settings[6][termios.VMIN], settings[6][termios.VTIME] = 0, int(10 * TIMEOUT)
        termios.tcsetattr(descriptor, termios.TCSANOW, settings)

        def read(n: int) -> bytes:
            data = b""
            while len(data) < n and (piece := os.read(descriptor, n - len(data))):
                data += piece
            return data

        try:
            yield lambda data: (os.write(descriptor, data), None)[1], read
        finally:
            os.close(descriptor)


@pytest.fixture(params=["tcp", "pty"])
def device(request: pytest.FixtureRequest) -> Iterator[SimulatedModbus]:
    found = SimulatedModbus(parse_address(f"{LOGGER}&wire={request.param}"))
    yield found
    found.close()


def framed(device: SimulatedModbus, pdu: bytes, number: int = 1) -> bytes:
    return mbap(pdu, number) if device.url.startswith("tcp") else rtu(pdu)


def test_a_request_split_after_its_first_byte_is_answered(device: SimulatedModbus) -> None:
    request = framed(device, READ)
    with connected(device) as (write, read):
        write(request)
        whole = read(len(framed(device, bytes(4))))
        for cut in (1, 2, 5, len(request) - 1):
            write(request[:cut])
            time.sleep(0.02)
            write(request[cut:])
            assert read(len(whole)) == whole


def test_requests_in_one_segment_are_all_answered(device: SimulatedModbus) -> None:
    with connected(device) as (write, read):
        write(b"".join(framed(device, READ, number) for number in range(3)))
        size = len(framed(device, bytes(4)))
        answers = [read(size) for _ in range(3)]
    assert all(len(answer) == size for answer in answers)
    if device.url.startswith("tcp"):
        assert [answer[1] for answer in answers] == [0, 1, 2]


@pytest.mark.parametrize(
    ("pdu", "refusal"),
    [
        ("0300200000", "8303"),
        ("030020007e", "8303"),
        ("0300200006", "8302"),
        ("03ffff0001", "8302"),
        ("0400200001", "8401"),
        ("0100200001", "8101"),
        ("060020ffff", "8601"),
        ("2b0e0100", "ab01"),
        ("4d", "cd01"),
    ],
)
def test_refusals(device: SimulatedModbus, pdu: str, refusal: str) -> None:
    if pdu == "2b0e0100":
        request = framed(device, bytes.fromhex(pdu))
        assert device.url.startswith("tcp") or len(request) == 7
    with connected(device) as (write, read):
        write(framed(device, bytes.fromhex(pdu)))
        expected = framed(device, bytes.fromhex(refusal))
        assert read(len(expected)) == expected
        write(framed(device, READ))
        assert len(read(len(framed(device, bytes(4))))) == len(framed(device, bytes(4)))


def test_a_connection_with_an_impossible_header_is_closed_and_the_next_one_is_served() -> None:
    device = SimulatedModbus(parse_address(LOGGER))
    try:
        with connected(device) as (write, read):
            write(b"GET / HTTP/1.1\r\n\r\n")
            assert read(1) == b""
        with connected(device) as (write, read):
            write(mbap(READ)[:4])  # an incomplete request, then the client disconnects
        with connected(device) as (write, read):
            write(mbap(READ))
            assert len(read(11)) == 11
    finally:
        device.close()
