"""The simulated emScon server on its line: packets are written and read here from the header, not with a codec."""

import math
import os
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from wire_vectors import Vector, vectors

from errormotion.instruments import simulators
from errormotion.instruments.laser_tracker.leica_emscon import codec
from errormotion.instruments.simulators.laser_tracker.leica_emscon import SimulatedEmScon
from errormotion.instruments.simulators.laser_tracker.leica_emscon.measures import SYSTEMS, from_system, to_system
from errormotion.instruments.simulators.laser_tracker.leica_emscon.packets import (
    AT4XX,
    COMMANDS,
    POINTS,
    RESULTS,
    Wire,
    size_of,
)
from errormotion.instruments.transports import parse_address

EXACT = "noise=0&angle_noise=0&dead_path=0&air_temperature=20&air_pressure=101325&air_humidity=50"
TIMEOUT = 20.0  # s
OK, BUSY, NOT_IMPLEMENTED, WRONG = 0, 1, 2, 3
ERROR, SINGLE, MULTI, NIVEL, REFLECTOR, CHANGE, SINGLE2, MULTI2 = 1, 2, 3, 6, 7, 8, 9, 10
INITIALIZE, STATUS, SET_UNITS, GET_UNITS, SET_CS, START, STOP = 7, 1, 5, 6, 26, 49, 52
SET_MODE, SET_TIME_MODE, GET_AIR, SET_AIR, BIRD_BATH, BIRD_BATH2, GO, FIND = 24, 30, 21, 20, 54, 95, 55, 63


@dataclass
class Client:
    """A client: the requested replies, and all other packets in their order."""

    line: socket.socket
    others: list[tuple[int, bytes]] = field(default_factory=list)

    def send(self, number: int, layout: str = "", *values: float) -> None:
        body = struct.pack("<i" + layout, number, *values)
        self.line.sendall(struct.pack("<iI", 8 + len(body), 0) + body)

    def packet(self) -> tuple[int, bytes]:
        """The next packet: its type and what follows the header."""
        size, kind = struct.unpack("<iI", self._exactly(8))
        return kind, self._exactly(size - 8)

    def _exactly(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            piece = self.line.recv(size - len(data))
            if not piece:
                raise EOFError
            data += piece
        return data

    def ask(self, number: int, layout: str = "", *values: float) -> tuple[int, bytes]:
        """Send a command; return status and data of its reply."""
        self.send(number, layout, *values)
        return self.reply(number)

    def reply(self, number: int) -> tuple[int, bytes]:
        while True:
            kind, data = self.packet()
            if kind == 0 and struct.unpack_from("<i", data) == (number,):
                return struct.unpack_from("<i", data, 4)[0], data[8:]
            self.others.append((kind, data))

    def until(self, kind: int, value: int | None = None) -> bytes:
        """Return the next packet of a type, and of a change with this number."""
        while True:
            found, data = self.packet()
            if found == kind and (value is None or struct.unpack_from("<i", data) == (value,)):
                return data
            self.others.append((found, data))

    def changes(self) -> list[int]:
        found = [struct.unpack("<i", data)[0] for kind, data in self.others if kind == CHANGE]
        self.others.clear()
        return found

    def measure(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Measure once: the three values, and the air."""
        assert self.ask(START)[0] == OK
        data = self.until(SINGLE)
        assert len(data) == 148
        values = struct.unpack("<iii17d", data)
        return values[3:6], values[-3:]


Made = list[SimulatedEmScon | socket.socket]


@pytest.fixture
def made() -> Iterator[Made]:
    """Resources that are closed after the test."""
    found: Made = []
    yield found
    clear(found)
    simulators.reset()


def clear(made: Made) -> None:
    while made:
        made.pop().close()


def tracker(made: Made, parameters: str = "") -> tuple[SimulatedEmScon, Client]:
    device = SimulatedEmScon(parse_address(f"sim://cframe/tracker?seed=3&{EXACT}&{parameters or 'seed=3'}"))
    made.append(device)
    place = parse_address(device.url)
    line = socket.create_connection((place.host, place.port), timeout=TIMEOUT)
    made.append(line)
    line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return device, Client(line)


def true_position(device: SimulatedEmScon) -> np.ndarray:
    azimuth, zenith, distance = device.scene.seen(np.array([0.0]))[0]
    return distance * np.array(
        [math.sin(zenith) * math.cos(azimuth), math.sin(zenith) * math.sin(azimuth), math.cos(zenith)]
    )


# ------------------------------------------------------------------ every command


@pytest.mark.parametrize("kind", ["AT901", "AT4xx"])
def test_every_command_of_the_header_is_answered_with_a_reply_of_its_size(made: Made, kind: str) -> None:
    statuses: dict[str, int] = {}
    for number, layout in COMMANDS.items():
        _, client = tracker(made, f"tracker={kind}")
        client.line.sendall(
            struct.pack("<iIi", 12 + size_of(layout.request), 0, number) + bytes(size_of(layout.request))
        )
        statuses[layout.name], data = client.reply(number)
        assert len(data) == size_of(layout.reply), layout.name
        clear(made)
        if kind == "AT4xx" and number not in AT4XX:
            assert statuses[layout.name] == NOT_IMPLEMENTED
    refused = {name for name, status in statuses.items() if status == NOT_IMPLEMENTED}
    if kind == "AT901":
        assert {layout.name for layout in codec.COMMANDS.values()} & refused == {"GoAndMeasure"}
        assert {"CallTransformation", "GetErrorEllipsoid", "MoveHV"} <= refused
        assert statuses["GetMeasurementCameraInfo"] == 67
        assert statuses["GetProbes"] == 75
        assert statuses["GetTipAdapter"] == 83
        assert statuses["SetReflector"] == 4  # number 0
        assert statuses["SetTransformationParams"] == 24  # a scale of 0 is out of range


def test_sizes_are_those_of_another_implementation_of_the_header() -> None:
    packet = pytest.importorskip("CESAPI.packet", reason="CESAPI, another implementation, is not installed")
    known = 0
    for layout in COMMANDS.values():
        for suffix, fields, base in (("CT", layout.request, 12), ("RT", layout.reply, 16)):
            found = getattr(packet, layout.name.replace("SystemParameter", "SystemParam") + suffix, None)
            if found is None:
                continue
            known += 1
            size = next(value for name, value in vars(found()).items() if name.endswith("__packet_size"))
            assert size == base + size_of(fields), layout.name
    assert known == 2 * len(AT4XX)


@pytest.mark.parametrize("vector", vectors("leica_emscon"), ids=str)
def test_golden_vectors(vector: Vector) -> None:
    size, kind = struct.unpack_from("<iI", vector.data)
    assert size == len(vector.data)
    number = struct.unpack_from("<i", vector.data, 8)[0]
    match vector.layer:
        case "command":
            layout = COMMANDS[number].request
            assert (kind, size) == (0, 12 + size_of(layout))
            found = np.hstack([0.0, *Wire().unpack(layout, vector.data[12:])])
            assert found[1:] == pytest.approx(list(vector.expected.values())[1:], rel=1e-12)
        case "answer":
            assert (kind, size) == (0, 16 + size_of(COMMANDS[number].reply))
        case "points":
            assert size == 8 + size_of(RESULTS[kind]) + vector.expected["count"] * size_of(POINTS[kind])
        case _:
            assert size == 8 + size_of(RESULTS[kind])


def test_unknown_commands_are_refused(made: Made) -> None:
    _, client = tracker(made)
    for number in (50, 64, 141, 999, -1):
        assert client.ask(number) == (NOT_IMPLEMENTED, b"")
    assert client.ask(SET_UNITS, "4i", 0, 0, 0, 0) == (WRONG, b"")  # a field is missing
    assert client.ask(INITIALIZE, "i", 0) == (WRONG, b"")  # a field too many
    client.line.sendall(struct.pack("<iIi", 12, SINGLE, START))
    assert client.until(ERROR) == struct.pack("<ii", 64, WRONG)
    assert client.ask(STATUS)[0] == OK
    client.line.sendall(struct.pack("<iI", 4, 0))
    with pytest.raises((EOFError, ConnectionResetError)):
        client.packet()


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e308])
@pytest.mark.parametrize("system", [0, 4, 7])
def test_nan_and_infinity_are_wrong_parameters(made: Made, value: float, system: int) -> None:
    _, client = tracker(made)
    assert client.ask(SET_CS, "i", system)[0] == OK
    assert client.ask(GO, "3di", value, 1.0, value, 0)[0] == WRONG
    assert client.ask(43, "di", value, 500)[0] == WRONG
    assert client.ask(SET_AIR, "3d", value, 1013.0, 50.0)[0] == WRONG


def test_requests_in_pieces_and_several_at_once(made: Made) -> None:
    _, client = tracker(made)
    request = struct.pack("<iIi", 12, 0, GET_UNITS)
    for byte in request:
        client.line.sendall(bytes((byte,)))
    assert client.reply(GET_UNITS)[0] == OK
    client.line.sendall(3 * request)
    assert [client.reply(GET_UNITS)[0] for _ in range(3)] == [OK] * 3


# ------------------------------------------------------------------ units and coordinates

LENGTHS = {0: 1.0, 1: 1e3, 2: 1e6, 3: 1 / 0.3048, 4: 1 / 0.9144, 5: 1 / 0.0254}
ANGLES = {0: 1.0, 1: 180 / math.pi, 2: 200 / math.pi}
PRESSURES = {0: 1013.25, 1: 1013.25, 2: 101.325, 3: 760.0, 4: 14.6959, 5: 406.78, 6: 29.9213}


@pytest.mark.parametrize("length", LENGTHS)
@pytest.mark.parametrize("angle", ANGLES)
def test_lengths_and_angles_are_in_the_units_of_the_client(made: Made, length: int, angle: int) -> None:
    device, client = tracker(made)
    azimuth, zenith, distance = device.scene.seen(np.array([0.0]))[0]
    assert client.ask(SET_UNITS, "5i", length, angle, 0, 0, 0)[0] == OK
    assert struct.unpack("<5i", client.ask(GET_UNITS)[1]) == (length, angle, 0, 0, 0)
    expected = (ANGLES[angle] * azimuth, ANGLES[angle] * zenith, LENGTHS[length] * distance)
    assert client.measure()[0] == pytest.approx(expected, rel=1e-9)
    assert struct.unpack("<2d", client.ask(66)[1]) == pytest.approx(expected[:2], rel=1e-9)
    offset = struct.unpack_from("<d", client.ask(42)[1], 12)[0]
    assert offset == pytest.approx(19.05e-3 * LENGTHS[length], rel=1e-12)
    assert client.ask(43, "di", 0.1 * LENGTHS[length], 500)[0] == OK
    assert client.ask(SET_UNITS, "5i", 0, 0, 0, 0, 0)[0] == OK
    assert struct.unpack("<di", client.ask(44)[1]) == pytest.approx((0.1, 500), rel=1e-12)


@pytest.mark.parametrize("pressure", PRESSURES)
@pytest.mark.parametrize(("temperature", "value"), [(0, 20.0), (1, 68.0)])
def test_the_air_is_in_the_units_of_the_client(made: Made, pressure: int, temperature: int, value: float) -> None:
    _, client = tracker(made)
    assert client.ask(SET_UNITS, "5i", 1, 0, temperature, pressure, 0)[0] == OK
    air = (value, PRESSURES[pressure], 50.0)
    assert client.ask(SET_AIR, "3d", *air)[0] == OK
    assert struct.unpack("<3d", client.ask(GET_AIR)[1]) == pytest.approx(air, rel=1e-12)
    assert client.measure()[1] == pytest.approx(air, rel=1e-12)
    assert client.ask(SET_UNITS, "5i", 0, 0, 0, 0, 0)[0] == OK
    assert struct.unpack("<3d", client.ask(GET_AIR)[1]) == pytest.approx((20.0, 1013.25, 50.0), rel=1e-4)
    assert client.ask(SET_AIR, "3d", 20.0, 101325.0, 50.0)[0] == 57


@pytest.mark.parametrize(("units", "status"), [((6, 0, 0, 0, 0), 4), ((0, 3, 0, 0, 0), 5), ((0, 0, 0, 7, 0), 7)])
def test_units_that_do_not_exist_are_wrong_parameters(made: Made, units: tuple[int, ...], status: int) -> None:
    _, client = tracker(made)
    assert client.ask(SET_UNITS, "5i", *units) == (status, b"")
    assert struct.unpack("<5i", client.ask(GET_UNITS)[1]) == (0, 0, 0, 0, 0)


@pytest.mark.parametrize("system", range(8))
def test_positions_are_in_the_coordinate_system_of_the_client(made: Made, system: int) -> None:
    device, client = tracker(made)
    x, y, z = true_position(device)
    across, angle, distance = math.hypot(x, y), math.atan2(y, x), math.sqrt(x * x + y * y + z * z)
    zenith = math.acos(z / distance)
    expected = {
        0: (x, y, z),
        1: (-x, y, z),
        2: (x, -y, z),
        3: (x, y, -z),
        4: (across, -angle, z),
        5: (across, angle, z),
        6: (-angle, zenith, distance),
        7: (angle, zenith, distance),
    }[system]
    assert client.ask(SET_CS, "i", system)[0] == OK
    assert struct.unpack("<i", client.ask(27)[1]) == (system,)
    assert client.measure()[0] == pytest.approx(expected, rel=1e-9)
    assert client.ask(GO, "3di", *expected, 0)[0] == OK
    assert client.measure()[0] == pytest.approx(expected, rel=1e-9)
    assert client.ask(GO, "3di", expected[0], expected[1] + 0.5, expected[2], 0)[0] == 10009
    assert client.ask(START)[0] == 10004
    assert client.ask(FIND, "d", distance)[0] == OK
    assert client.measure()[0] == pytest.approx(expected, rel=1e-9)


def test_a_coordinate_system_that_does_not_exist_is_a_wrong_parameter(made: Made) -> None:
    _, client = tracker(made)
    assert [client.ask(SET_CS, "i", kind)[0] for kind in (-1, 8)] == [4, 4]
    assert struct.unpack("<i", client.ask(27)[1]) == (7,)


@given(
    azimuth=st.floats(-3.1, 3.1),
    zenith=st.floats(0.1, 3.0),
    distance=st.floats(0.1, 80.0),
    system=st.integers(0, SYSTEMS - 1),
)
def test_coordinates_round_trip(azimuth: float, zenith: float, distance: float, system: int) -> None:
    there = (azimuth, zenith, distance)
    assert from_system(to_system(there, system), system) == pytest.approx(there, rel=1e-9, abs=1e-9)


def test_deviations_of_a_rectangular_position_are_lengths(made: Made) -> None:
    device, client = tracker(made, "noise=1e-6&angle_noise=3e-6")
    distance = float(np.linalg.norm(true_position(device)))
    client.ask(SET_UNITS, "5i", 1, 0, 0, 0, 0)
    client.ask(SET_CS, "i", 0)
    client.ask(START)
    spread = struct.unpack_from("<4d", client.until(SINGLE), 12 + 24)
    assert math.hypot(*spread[:3]) == pytest.approx(spread[3], rel=1e-12)
    assert 1e-3 < spread[3] < 1e3 * 5e-6 * distance


# ------------------------------------------------------------------ measuring


def points(client: Client) -> list[tuple[float, ...]]:
    """All points up to the end of the measurement."""
    found: list[tuple[float, ...]] = []
    while True:
        kind, data = client.packet()
        if kind in (MULTI, MULTI2):
            _, number, _, _ = struct.unpack_from("<4i", data)
            layout = "<3i3d" + ("7d" if kind == MULTI2 else "")
            assert len(data) == 16 + 24 + number * struct.calcsize(layout)
            found += struct.iter_unpack(layout, data[40:])
            continue
        client.others.append((kind, data))
        if kind == CHANGE and data == struct.pack("<i", 27):
            return found


@pytest.mark.parametrize("number", [1, 7, 20, 53])
def test_a_continuous_measurement_ends_after_the_number_of_points(made: Made, number: int) -> None:
    _, client = tracker(made)
    assert client.ask(SET_MODE, "i", 1)[0] == OK
    assert client.ask(SET_TIME_MODE, "4i", 10, number, 0, 0)[0] == OK
    assert struct.unpack("<4i", client.ask(31)[1]) == (10, number, 0, 0)
    for _ in range(2):
        client.others.clear()
        assert client.ask(START)[0] == OK
        found = points(client)
        assert len(found) == number
        times = [1000 * seconds + microseconds // 1000 for _, seconds, microseconds, *_ in found]
        assert np.diff(times).tolist() == [10] * (number - 1)
        assert client.changes()[-2:] == [28, 27]  # the number is reached, ready
        assert client.ask(STATUS)[0] == OK


def test_without_a_number_it_continues_until_it_is_stopped_and_the_server_is_busy(made: Made) -> None:
    _, client = tracker(made, "pace=1")
    client.ask(SET_MODE, "i", 1)
    client.ask(SET_TIME_MODE, "4i", 10, 0, 0, 1)
    assert client.ask(START)[0] == OK
    for _ in range(5):
        client.until(MULTI)
    assert client.ask(START)[0] == BUSY
    assert client.ask(SET_UNITS, "5i", 1, 0, 0, 0, 0)[0] == BUSY
    assert client.ask(GO, "3di", 0.0, 1.5, 1.0, 0)[0] == BUSY
    assert client.ask(2) == (OK, struct.pack("<i", 1))  # tracker status: busy
    assert client.ask(GET_AIR)[0] == OK
    assert client.ask(STOP)[0] == OK
    client.others.clear()
    assert client.ask(SET_UNITS, "5i", 1, 0, 0, 0, 0)[0] == OK
    assert all(kind not in (MULTI, MULTI2) for kind, _ in client.others)
    assert client.ask(2) == (OK, struct.pack("<i", 2))


def test_a_client_that_disconnects_ends_its_measurement(made: Made) -> None:
    device, client = tracker(made, "pace=1")
    client.ask(SET_MODE, "i", 1)
    client.ask(SET_TIME_MODE, "4i", 10, 0, 0, 0)
    assert client.ask(START)[0] == OK
    client.until(MULTI)
    client.line.sendall(b"\x0c\x00")  # the start of a request
    client.line.close()
    place = parse_address(device.url)
    with socket.create_connection((place.host, place.port), timeout=TIMEOUT) as line:
        other = Client(line)
        assert other.ask(SET_UNITS, "5i", 1, 0, 0, 0, 0)[0] == OK
        assert other.ask(2) == (OK, struct.pack("<i", 2))


@pytest.mark.parametrize(("server", "newest"), [("3.6", 7), ("3.8", 0)])
def test_region_types_are_those_of_the_header(made: Made, server: str, newest: int) -> None:
    _, client = tracker(made, f"server={server}")
    regions = {kind: client.ask(SET_TIME_MODE, "4i", 10, 5, 0, kind)[0] for kind in (0, 1, 2, 10)}
    assert regions == {0: OK, 1: OK, 2: 7, 10: newest}
    version = struct.unpack_from("<2i", client.ask(STATUS)[1], 16)
    assert ".".join(map(str, version)) == server


@pytest.mark.parametrize(
    ("values", "status"), [((0, 1, 0, 0), 12), ((10, -1, 0, 0), 14), ((10, 1, 2, 0), 6), ((10, 1, 1, 3), 7)]
)
def test_parameters_of_a_continuous_measurement_out_of_range(made: Made, values: tuple[int, ...], status: int) -> None:
    _, client = tracker(made)
    assert client.ask(SET_TIME_MODE, "4i", *values) == (status, b"")


def test_points_outside_the_region_are_not_sent(made: Made) -> None:
    device, client = tracker(made, "pace=1")
    x, y, z = true_position(device)
    client.ask(SET_CS, "i", 0)
    client.ask(SET_MODE, "i", 1)
    assert client.ask(SET_TIME_MODE, "4i", 10, 5, 1, 0)[0] == OK
    assert client.ask(18, "4d", x, y, z, 1e-3)[0] == OK
    assert client.ask(START)[0] == OK
    assert len(points(client)) == 5
    assert client.ask(18, "4d", x + 1.0, y, z, 1e-3)[0] == OK
    assert client.ask(START)[0] == OK
    assert client.ask(2)[1] == struct.pack("<i", 1)
    assert client.ask(STOP)[0] == OK
    assert all(kind != MULTI for kind, _ in client.others)


def test_by_distance_a_reflector_at_rest_gives_one_point(made: Made) -> None:
    _, client = tracker(made)
    client.ask(SET_MODE, "i", 2)
    assert client.ask(32, "d3i", 1e-3, 1, 0, 0)[0] == OK
    assert client.ask(START)[0] == OK
    assert len(points(client)) == 1


def test_extended_statistics_have_longer_packets(made: Made) -> None:
    _, client = tracker(made)
    assert client.ask(80, "2i", 1, 1)[0] == OK
    assert client.ask(START)[0] == OK
    assert len(client.until(SINGLE2)) == 196
    client.ask(SET_MODE, "i", 1)
    client.ask(SET_TIME_MODE, "4i", 10, 3, 0, 0)
    client.ask(START)
    assert len(points(client)) == 3


@pytest.mark.parametrize(
    ("mode", "at901", "at4xx"), [(0, 0, 0), (1, 0, 2), (4, 2, 2), (7, 92, 2), (12, 4, 4), (21, 2, 0)]
)
def test_measurement_modes_by_tracker(made: Made, mode: int, at901: int, at4xx: int) -> None:
    for kind, status in (("AT901", at901), ("AT4xx", at4xx)):
        _, client = tracker(made, f"tracker={kind}")
        assert client.ask(SET_MODE, "i", mode) == (status, b"")


def test_before_it_is_initialised_it_does_not_measure(made: Made) -> None:
    _, client = tracker(made, "initialised=0")
    assert client.ask(START)[0] == 39
    assert struct.unpack_from("<i", client.ask(STATUS)[1], 4) == (4,)
    assert client.ask(INITIALIZE)[0] == OK
    assert client.ask(START)[0] == OK


@pytest.mark.parametrize(("number", "arguments"), [(BIRD_BATH, ()), (BIRD_BATH2, (0,)), (BIRD_BATH2, (1,))])
def test_the_bird_bath_is_reached_by_both_commands(made: Made, number: int, arguments: tuple[int, ...]) -> None:
    _, client = tracker(made)
    assert client.ask(number, len(arguments) * "i", *arguments)[0] == OK
    assert client.changes() == [26, 0, 27]  # busy, distance set, ready
    assert client.measure()[0] == pytest.approx((0.0, math.pi / 2, 0.3), rel=1e-6)


def test_changes_are_reported_unless_they_are_switched_off(made: Made) -> None:
    _, client = tracker(made)
    commands: dict[int, tuple[str, tuple[float, ...], int]] = {
        SET_UNITS: ("5i", (0, 0, 0, 3, 0), 6),
        SET_CS: ("i", (0,), 12),
        SET_MODE: ("i", (1,), 17),
        28: ("2i", (1000, 0), 18),
        SET_TIME_MODE: ("4i", (10, 5, 0, 0), 19),
        40: ("i", (2,), 7),
        43: ("di", (0.1, 500), 4),
        80: ("2i", (0, 0), 24),
    }
    for number, (layout, values, change) in commands.items():
        client.others.clear()
        assert client.ask(number, layout, *values)[0] == OK
        client.ask(GET_UNITS)
        assert client.changes() == [change]
    settings = list(struct.unpack("<9i", client.ask(48)[1]))
    settings[4] = 0
    assert client.ask(47, "9i", *settings)[0] == OK
    client.ask(SET_CS, "i", 7)
    client.ask(GET_UNITS)
    assert client.changes() == []
    assert client.ask(47, "9i", 3, *settings[1:])[0] == 4
    assert client.ask(47, "9i", *settings[:8], 2)[0] == 48


def test_coordinates_that_it_cannot_transform_are_refused_and_not_ignored(made: Made) -> None:
    _, client = tracker(made)
    assert client.ask(12, "6d", 1.0, 0, 0, 0, 0, 0)[0] == OK
    assert struct.unpack("<6d", client.ask(13)[1])[0] == 1.0
    settings = list(struct.unpack("<9i", client.ask(48)[1]))
    settings[2] = 1
    assert client.ask(47, "9i", *settings)[0] == NOT_IMPLEMENTED


# ------------------------------------------------------------------ a foreign client

CLIENT = """
import logging, sys, time
from CESAPI.command import CommandSync
from CESAPI.connection import Connection, PacketStream
from CESAPI.packet import *
logging.disable(logging.CRITICAL)
unread = PacketStream.unreadCount  # asked without a pause while an answer is awaited
PacketStream.unreadCount = lambda stream: unread(stream) or time.sleep(0.005) or 0
connection = Connection()
connection.connect(host="127.0.0.1", port=int(sys.argv[1]))
command = CommandSync(connection)
units = SystemUnitsDataT()
units.lenUnitType, units.angUnitType = ES_LU_Millimeter, ES_AU_Degree
units.tempUnitType, units.pressUnitType = ES_TU_Celsius, ES_PU_MmHg
command.SetUnits(units)
command.SetCoordinateSystemType(ES_CS_RHR)
command.Initialize()
command.GoBirdBath()
nest = command.StartMeasurement()
air = EnvironmentDataT()
air.dTemperature, air.dPressure, air.dHumidity = 20.0, 760.0, 50.0
command.SetEnvironmentParams(air)
air = command.GetEnvironmentParams().environmentData
command.GoPosition(int(False), *map(float, sys.argv[2:5]))
found = command.StartMeasurement()
for packet in (nest, found):
    print(packet.dVal1, packet.dVal2, packet.dVal3, packet.dPressure)
print(air.dTemperature, air.dPressure, air.dHumidity, command.GetStationaryModeParams().stationaryModeData.lMeasTime)
connection.disconnect()
"""


@pytest.mark.slow
def test_a_foreign_client_uses_mmhg_and_rectangular_coordinates(made: Made) -> None:
    pytest.importorskip("CESAPI", reason="the package CESAPI, another implementation, is not installed")
    device = SimulatedEmScon(parse_address(f"sim://cframe/tracker?seed=3&tracker=AT4xx&{EXACT}"))
    made.append(device)
    position = 1e3 * true_position(device)
    done = subprocess.run(
        [sys.executable, "-c", CLIENT, device.url.rpartition(":")[2], *map(repr, map(float, position))],
        capture_output=True,
        text=True,
        timeout=100,
        env=os.environ,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    nest, found, air = ([float(word) for word in line.split()] for line in done.stdout.splitlines())
    assert nest == pytest.approx([300.0, 0.0, 0.0, 760.0], rel=1e-6, abs=1e-3)
    assert found == pytest.approx([*position, 760.0], rel=1e-6)
    assert air == pytest.approx([20.0, 760.0, 50.0, 2000.0])
