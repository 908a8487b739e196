"""The simulated total station on its line: requests are written and replies read here, not with a codec."""

import math
import socket
from collections.abc import Iterator

import numpy as np
import pytest
from wire_vectors import Vector, vectors

from errormotion.instruments import simulators
from errormotion.instruments.simulators.laser_tracker.leica_geocom import SimulatedGeoComStation
from errormotion.instruments.simulators.laser_tracker.leica_geocom.grammar import CALLS, parse
from errormotion.instruments.simulators.laser_tracker.leica_geocom.telescope import atmospheric_ppm
from errormotion.instruments.transports import parse_address

EXACT = "noise=0&angle_noise=0&air_temperature=12&air_pressure=101325&air_humidity=60"
TIMEOUT = 10.0  # s
OK, IVPARAM, NO_TARGET = 0, 2, 8710
ANGLE_OK, DIST_ERROR, BUSY = 1285, 1292, 1293

Made = list[SimulatedGeoComStation | socket.socket]


class Client:
    """A client."""

    def __init__(self, line: socket.socket) -> None:
        self.line = line
        self._data = b""

    def send(self, data: bytes) -> None:
        self.line.sendall(data)

    def read(self) -> str:
        """Return the next reply without its end."""
        while b"\r\n" not in self._data:
            piece = self.line.recv(4096)
            if not piece:
                raise EOFError
            self._data += piece
        line, _, self._data = self._data.partition(b"\r\n")
        return line.decode("ascii")

    def raw(self, text: str) -> str:
        self.send(text.encode() + b"\r\n")
        return self.read()

    def ask(self, number: int, *values: object) -> tuple[int, list[str]]:
        """Return the return code and the values of a call that the link accepts."""
        reply = self.raw(f"%R1Q,{number}:{','.join(map(str, values))}")
        assert reply.startswith("%R1P,0,0:"), reply
        code, *found = reply.removeprefix("%R1P,0,0:").split(",")
        return int(code), found

    def numbers(self, number: int, *values: object) -> list[float]:
        code, found = self.ask(number, *values)
        assert code == OK
        return [float(text) for text in found]

    def measure(self) -> list[float]:
        assert self.ask(2008, 1, 1)[0] == OK
        return self.numbers(2108, 5000, 1)


@pytest.fixture
def made() -> Iterator[Made]:
    """Resources that are closed after the test."""
    found: Made = []
    yield found
    while found:
        found.pop().close()
    simulators.reset()


def station(made: Made, parameters: str = "") -> tuple[SimulatedGeoComStation, Client]:
    device = SimulatedGeoComStation(
        parse_address("&".join(filter(None, (f"sim://cframe/station?{EXACT}", parameters))))
    )
    made.append(device)
    host, port = device.url.removeprefix("tcp://").split(":")
    line = socket.create_connection((host, int(port)), TIMEOUT)
    made.append(line)
    return device, Client(line)


def truth(device: SimulatedGeoComStation) -> np.ndarray:
    """The reflector relative to the station: azimuth, zenith angle, distance."""
    return device.scene.seen(np.array([device.world.time]))[0]


# ------------------------------------------------------------------ grammar


@pytest.mark.parametrize(
    ("request_text", "reply"),
    [
        ("%R1Q,0:", "%R1P,0,0:0"),
        ("%R1Q,0,5:", "%R1P,0,5:0"),
        ("%R1Q,5003,17:", "%R1P,0,17:0,364123"),
        ("%R1Q,5004,1:", '%R1P,0,1:0,"TS30 0.5"'),
        ("%R1Q,9999,3:", "%R1P,3081,3:0"),
        ("%R1Q,2008,2:1", "%R1P,3080,2:0"),
        ("%R1Q,2008,2:1,1,1", "%R1P,3080,2:0"),
        ("%R1Q,2008,2:", "%R1P,3080,2:0"),
        ("%R1Q,2008,2:1,,1", "%R1P,3080,2:0"),
        ("%R1Q,2008,2:1,1,", "%R1P,3080,2:0"),
        ("%R1Q,2008,2: 1,1", "%R1P,3080,2:0"),
        ("%R1Q,2008,2:1.5,1", "%R1P,3080,2:0"),
        ("%R1Q,2008,2:a,1", "%R1P,3080,2:0"),
        ("%R1Q,2028,2:nan,1,1,1", "%R1P,3080,2:0"),
        ("%R1Q,0,2:1", "%R1P,3080,2:0"),
        ("%R1Q,2008,2:0x1,1", "%R1P,0,2:0"),
        ("%R1Q,0,2,4711:", "%R1P,3110,2:0"),
        ("%r1q,0:", "%R1P,3094,0:0"),
        ("%R1Q,0", "%R1P,3094,0:0"),
        ("%R1Q,:", "%R1P,3094,0:0"),
        (" %R1Q,0:", "%R1P,3094,0:0"),
        ("%R8Q,4:", "%R1P,3094,0:0"),
        ("%R1Q,0:" + 600 * "1", "%R1P,3100,0:0"),
        ("%R1Q,2008,1:5,1", "%R1P,0,1:2"),
        ("%R1Q,2008,1:1,3", "%R1P,0,1:2"),
        ("%R1Q,2020,1:0", "%R1P,0,1:2"),
        ("%R1Q,2020,1:15", "%R1P,0,1:2"),
        ("%R1Q,9027,1:0.0,1.5,0,0,1", "%R1P,0,1:2"),
    ],
)
def test_answers_each_request_as_the_manual_states(made: Made, request_text: str, reply: str) -> None:
    _, client = station(made)
    assert client.raw(request_text) == reply


@pytest.mark.parametrize("vector", vectors("leica_geocom", "request"), ids=str)
def test_understands_the_requests_of_the_vectors(vector: Vector) -> None:
    found = parse(vector.data.removesuffix(b"\r\n"))
    assert found.name == CALLS[vector.expected["call"]][0]
    assert found.transaction == vector.expected["transaction"]
    assert list(found.values) == vector.expected["parameters"]


def test_every_call_refuses_an_excess_parameter(made: Made) -> None:
    _, client = station(made)
    for number, (_, types) in CALLS.items():
        values = ",".join(["1"] * (len(types) + 1))
        assert client.raw(f"%R1Q,{number},7:{values}") == "%R1P,3080,7:0"


def test_a_line_feed_clears_the_buffer_and_an_empty_line_has_no_reply(made: Made) -> None:
    _, client = station(made)
    client.send(b"rubbish\n%R1Q,0,1:\r\n\r\n%R1Q,0,2:\r\n%R1Q,")
    client.send(b"0,3:\r")
    client.send(b"\n")
    assert [client.read() for _ in range(3)] == [f"%R1P,0,{k}:0" for k in (1, 2, 3)]


def test_a_request_without_end_is_bounded(made: Made) -> None:
    device, client = station(made)
    client.send(b"1" * 100_000 + b"\r\n")
    assert client.read() == "%R1P,3100,0:0"
    assert len(device._buffer) <= 513


def test_states_its_identity_and_clock(made: Made) -> None:
    _, client = station(made, "model=TCRP1201")
    assert client.ask(5004) == (OK, ['"TCRP1201+"'])
    assert client.ask(110) == (OK, ["1", "50", "0"])
    assert client.ask(5034) == (OK, ["6", "50", "0"])
    assert client.ask(5008) == (OK, ["2026", "'01'", "'05'", "'08'", "'00'", "'00'"])
    assert client.ask(5011) == (OK, ["18.0"])


# ------------------------------------------------------------------ measuring


def test_measures_the_reflector_at_the_tool(made: Made) -> None:
    device, client = station(made)
    before = client.measure()
    device.world.move_to((0.1, 0.05, 0.1))
    device.world.elapse(60.0)
    horizontal, zenith, distance = client.measure()
    azimuth, true_zenith, true_distance = truth(device)
    assert horizontal == pytest.approx(-azimuth % (2 * math.pi), abs=1e-12)
    assert zenith == pytest.approx(true_zenith, abs=1e-12)
    ppm = client.numbers(2151)[0]
    assert abs(ppm) < 0.5  # the air that is set by default is that of the address
    assert distance == pytest.approx(true_distance, abs=1e-6)
    assert abs(distance - before[2]) > 1e-3


def test_coordinates_are_right_handed_and_at_the_station(made: Made) -> None:
    device, client = station(made)
    client.measure()
    east, north, height = client.numbers(2082, 1000, 1)[:3]
    azimuth, zenith, distance = truth(device)
    x, y = distance * math.sin(zenith) * math.cos(azimuth), distance * math.sin(zenith) * math.sin(azimuth)
    assert (east, north) == (pytest.approx(-y, abs=1e-6), pytest.approx(x, abs=1e-6))
    assert height == pytest.approx(distance * math.cos(zenith), abs=1e-6)


def test_a_distance_must_be_started_and_waited_for(made: Made) -> None:
    _, client = station(made)
    code, values = client.ask(2108, 1000, 1)
    assert (code, values[2]) == (ANGLE_OK, "0.0")
    assert client.ask(2008, 1, 1)[0] == OK
    assert client.ask(2108, 0, 1)[0] == ANGLE_OK
    assert client.ask(2108, 5000, 1)[0] == OK
    assert client.ask(2108, 0, 1)[0] == OK  # the distance stays
    assert client.ask(2008, 3, 1)[0] == OK  # clear
    assert client.ask(2108, 0, 1)[0] == ANGLE_OK


def test_polling_without_waiting_ends_with_a_distance(made: Made) -> None:
    _, client = station(made)
    client.ask(2008, 1, 1)
    codes = [client.ask(2108, 0, 1)[0] for _ in range(60)]
    assert codes[0] == ANGLE_OK
    assert codes[-1] == OK


def test_prism_constant_and_air_change_the_distance(made: Made) -> None:
    device, client = station(made, "prism_constant=0.0175")
    true = truth(device)[2]
    assert client.measure()[2] == pytest.approx(true - 0.0175, abs=1e-6)
    assert client.ask(2028, 6.58e-7, 950.0, 30.0, 25.0)[0] == OK
    ppm = client.numbers(2151)[0]
    assert ppm == pytest.approx(34, abs=2)  # the user manual's chart: 0.3 ppm per mbar, 1 ppm per kelvin
    assert client.measure()[2] == pytest.approx((true - 0.0175) * (1 + 1e-6 * ppm), abs=1e-6)
    assert client.ask(2028, 6.58e-7, 95000.0, 30.0, 25.0)[0] == IVPARAM


def test_the_correction_of_the_air_is_zero_at_the_reference() -> None:
    assert abs(atmospheric_ppm(1013.25, 12.0, 8.55)) < 0.2
    assert atmospheric_ppm(1013.25, 13.0, 9.5) == pytest.approx(1.0, abs=0.2)


def test_angles_have_the_manuals_order(made: Made) -> None:
    _, client = station(made)
    simple = client.measure()
    angles = client.numbers(2003, 1)
    assert len(angles) == 9
    assert [*angles[:2], angles[8]] == [*simple[:2], 0.0]
    client.ask(2008, 4, 1)
    assert client.ask(2003, 1)[0] == BUSY


# ------------------------------------------------------------------ pointing


def test_both_faces_read_the_same_reflector(made: Made) -> None:
    _, client = station(made)
    first = client.measure()
    assert client.ask(9028, 0, 1, 0)[0] == OK
    assert client.numbers(2026) == [1.0]
    second = client.measure()
    assert second[0] == pytest.approx((first[0] + math.pi) % (2 * math.pi), abs=1e-9)
    assert second[1] == pytest.approx(2 * math.pi - first[1], abs=1e-9)
    assert second[2] == pytest.approx(first[2], abs=1e-6)


def test_after_turning_away_it_has_no_distance_until_it_aims(made: Made) -> None:
    _, client = station(made)
    horizontal, zenith, distance = client.measure()
    assert client.ask(9027, horizontal + 0.01, zenith, 0, 0, 0)[0] == OK
    assert client.numbers(2003, 1)[0] == pytest.approx(horizontal + 0.01, abs=1e-9)
    client.ask(2008, 1, 1)
    assert client.ask(2108, 5000, 1)[0] == DIST_ERROR
    assert client.ask(9037, 0.05, 0.05, 0)[0] == OK
    assert client.measure() == pytest.approx([horizontal, zenith, distance], abs=1e-6)
    assert client.ask(9027, horizontal + 1.0, zenith, 0, 1, 0)[0] == NO_TARGET


# ------------------------------------------------------------------ faults


def test_after_a_broken_beam_it_can_aim_again(made: Made) -> None:
    _, client = station(made, "fault=beam_broken&fault_at=1&fault_for=1")
    client.measure()
    client.ask(2008, 1, 1)
    code, values = client.ask(2108, 5000, 1)
    assert (code, values[2]) == (DIST_ERROR, "0.0")
    assert client.ask(9037, 0.05, 0.05, 0)[0] == OK
    client.measure()


def test_a_late_answer_precedes_the_next_with_its_own_transaction(made: Made) -> None:
    _, client = station(made, "fault=late&fault_at=1")
    assert client.raw("%R1Q,0,1:") == "%R1P,0,1:0"
    client.send(b"%R1Q,5003,2:\r\n")
    client.send(b"%R1Q,0,3:\r\n")
    assert [client.read(), client.read()] == ["%R1P,0,2:0,364123", "%R1P,0,3:0"]


@pytest.mark.parametrize(
    ("fault", "reply"), [("refuse", "%R1P,0,4:4"), ("refuse&code=14", "%R1P,0,4:14"), ("link_error", "%R1P,3080,4:0")]
)
def test_refuses_if_so_set(made: Made, fault: str, reply: str) -> None:
    _, client = station(made, f"fault={fault}&fault_at=1&fault_for=1")
    client.ask(0)
    assert client.raw("%R1Q,0,4:") == reply
    client.ask(0)


def test_split_and_garbage(made: Made) -> None:
    _, client = station(made, "fault=split")
    assert client.ask(5003) == (OK, ["364123"])


# ------------------------------------------------------------------ a foreign client


def test_geocompy_measures_with_the_simulator(made: Made) -> None:
    communication = pytest.importorskip("geocompy.communication")
    geo = pytest.importorskip("geocompy.geo")
    device, client = station(made)
    client.line.close()  # a line has one client
    host, port = device.url.removeprefix("tcp://").split(":")
    with communication.open_socket(host, int(port), "tcp", timeout=10) as line:
        total_station = geo.GeoCom(line)
        assert total_station.csv.get_instrument_name().params == "TS30 0.5"
        assert total_station.csv.get_serial_number().params == 364123
        assert total_station.csv.get_datetime().params.year == 2026
        assert total_station.tmc.set_atmospheric_corrections(6.58e-7, 1013.25, 12, 8.55)
        assert total_station.tmc.do_measurement("DISTANCE")
        found = total_station.tmc.get_simple_measurement()
        assert found
        horizontal, zenith, distance = map(float, found.params)
        azimuth, true_zenith, true_distance = truth(device)
        assert distance == pytest.approx(true_distance, abs=1e-6)
        assert (horizontal, zenith) == pytest.approx((-azimuth % (2 * math.pi), true_zenith), abs=1e-9)
        assert len(total_station.tmc.get_coordinate().params) == 4
        assert total_station.aut.change_face("NORMAL", "TARGET")
        assert total_station.tmc.get_face().params.name == "F2"
        assert total_station.request(9999).error.value == 3081
        assert not total_station.tmc.set_edm_mode_v2("NOTUSED")
