"""The driver leica_geocom against the simulated station, and against a scripted line."""

import math
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
from coded import raises

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.laser_tracker.leica_geocom import GeoComSettings, LeicaGeoCom, air
from errormotion.plugins.readings import Environment

ADDRESS = "sim://cframe/station?seed=3&noise=0&angle_noise=0"


# ---------------------------------------------------------------------- the simulated station


def test_a_measurement_without_motion() -> None:
    with LeicaGeoCom(ADDRESS) as station:
        found = station.measure()
        azimuth, zenith = station.direction()
    assert (found.valid, found.reason, found.dead_path) == (True, "", 0)
    assert found.angles == pytest.approx((azimuth, zenith), abs=1e-6)
    assert found.std == pytest.approx((math.hypot(0.6e-3, 1e-6 * found.distance), 2.4e-6, 2.4e-6))


def test_the_station_only_moves_if_armed() -> None:
    with LeicaGeoCom(ADDRESS) as station:
        before = station.direction()
        with raises("instrument.not_armed"):
            station.measure((1.0, 1.0, 0.0))
        with raises("instrument.not_armed"):
            station.go_to((1.0, 1.0, 0.0))
        assert station.direction() == pytest.approx(before, abs=1e-6)


def test_an_armed_station_aims_at_the_reflector_near_a_position() -> None:
    with LeicaGeoCom(ADDRESS, GeoComSettings(move=True)) as station:
        here = station.measure()
        x, y, z = here.position
        again = station.measure((x + 0.002, y - 0.003, z))
        assert again.valid
        assert again.position == pytest.approx(here.position, abs=1e-4)
        nowhere = station.measure((-x, -y, z))
        assert not nowhere.valid
        assert "8710, no reflector found" in nowhere.reason
        assert math.isnan(nowhere.distance)


def test_the_position_of_the_reflector_is_that_of_the_world() -> None:
    with LeicaGeoCom(ADDRESS) as station:
        found = station.measure()
    assert found.position == pytest.approx((1.2, 0.9, -0.3), abs=1e-3)


def test_the_air_is_set_and_returned() -> None:
    given = Environment(23.0, 100_500.0, 40.0)
    with LeicaGeoCom(ADDRESS) as station:
        before, index = station.environment(), station.refraction()
        station.set_environment(given)
        found, after = station.environment(), station.refraction()
    assert found.temperature == pytest.approx(23.0, abs=1e-3)
    assert found.pressure == pytest.approx(100_500.0, abs=0.1)
    assert found.humidity == pytest.approx(40.0, abs=0.01)
    assert before.pressure == pytest.approx(101_325.0)
    assert (index, after) == pytest.approx((1.000286, 1.000273), abs=1e-6)


@pytest.mark.parametrize(
    "wrong", [Environment(), Environment(20.0, 1013.25, 50.0), Environment(20.0, 1e5, 120.0), Environment(290, 1e5, 50)]
)
def test_invalid_air_values_are_not_set(wrong: Environment) -> None:
    with LeicaGeoCom(ADDRESS) as station:
        with raises("tracker.air.outside"):
            station.set_environment(wrong)
        assert station.environment().pressure == pytest.approx(101_325.0)


def test_a_broken_beam_is_a_missing_distance_not_an_error() -> None:
    with LeicaGeoCom(f"{ADDRESS}&fault=beam_broken", GeoComSettings(measuring_timeout=0.5)) as station:
        found = station.measure()
        assert math.isnan(station.read())
    assert not found.valid
    assert found.reason


def test_after_a_late_answer_the_next_one_is_correct() -> None:
    address = f"{ADDRESS}&fault=late&fault_at=4&late_by=0.5"
    with LeicaGeoCom(address, GeoComSettings(timeout=0.3, measuring_timeout=0.5)) as station:
        found: list[object] = []
        for _ in range(4):
            try:
                found.append(station.identify().serial_number)
            except InstrumentTimeoutError as error:
                found.append(type(error))
    assert found.count(InstrumentTimeoutError) == 1
    assert set(found) == {"364123", InstrumentTimeoutError}


def test_over_a_serial_line() -> None:
    with LeicaGeoCom(f"{ADDRESS}&wire=pty") as station:
        assert station.measure().valid


# ---------------------------------------------------------------------- a scripted line


@contextmanager
def scripted(answer: Callable[[int, int, list[str]], bytes]) -> Iterator[str]:
    """Serve a line; a function of call, transaction and parameters returns the answers."""
    server = socket.create_server(("127.0.0.1", 0))
    server.settimeout(5.0)
    connections: list[socket.socket] = []

    def serve() -> None:
        connection, _ = server.accept()
        connections.append(connection)
        buffer = b""
        while data := connection.recv(4096):
            buffer += data
            while b"\r\n" in buffer:
                line, _, buffer = buffer.partition(b"\r\n")
                head, _, values = line.strip().decode().partition(":")
                _, call, transaction = head.split(",")
                connection.sendall(answer(int(call), int(transaction), values.split(",")))

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        yield f"tcp://127.0.0.1:{server.getsockname()[1]}"
    finally:
        thread.join(5.0)
        for connection in connections:
            connection.close()
        server.close()


def station_line(**changed: str) -> Callable[[int, int, list[str]], bytes]:
    """Return answers of a station; ``changed`` replaces those of some calls, as ``c2108="0,..."``."""
    plain = {
        "c0": "0",
        "c5004": '0,"TCRP1201"',
        "c5003": "0,212345",
        "c2008": "0",
        "c2108": "0,0.5,1.5,12.5",
        "c2029": "0,0.000000658,1013.25,20.0,15.0",
        "c2151": "0,5.0",
    } | changed

    def answer(call: int, transaction: int, values: list[str]) -> bytes:
        found = plain.get(f"c{call}")
        return (f"%R1P,3081,{transaction}:0" if found is None else f"%R1P,0,{transaction}:{found}").encode() + b"\r\n"

    return answer


def test_the_azimuth_is_opposite_to_the_horizontal_angle() -> None:
    with scripted(station_line()) as address, LeicaGeoCom(address) as station:
        found = station.measure()
    assert found.angles == (-0.5, 1.5)
    assert found.distance == 12.5
    assert found.refraction_index == pytest.approx(1.00028134)


def test_a_station_without_further_calls_is_identified() -> None:
    with scripted(station_line()) as address, LeicaGeoCom(address) as station:
        identity = station.identify()
    assert (identity.model, identity.serial_number, identity.firmware) == ("TCRP1201", "212345", "")


def test_a_warning_is_counted_and_the_measurement_valid() -> None:
    with scripted(station_line(c2108="1283,0.5,1.5,12.5")) as address, LeicaGeoCom(address) as station:
        assert station.measure().valid
        assert station.measure().valid
        assert station.warnings == {1283: 2}


@pytest.mark.parametrize("code", [1285, 1288, 1290, 1291, 1292, 1294])
def test_without_a_distance_the_reason_is_stated(code: int) -> None:
    with scripted(station_line(c2108=f"{code},0.5,1.5,0")) as address, LeicaGeoCom(address) as station:
        found = station.measure()
    assert not found.valid
    assert f"code {code}, " in found.reason


def test_a_distance_of_zero_is_none() -> None:
    with scripted(station_line(c2108="0,0.5,1.5,0.0")) as address, LeicaGeoCom(address) as station:
        assert "no distance" in station.measure().reason


def test_other_refusals_are_errors() -> None:
    with (
        scripted(station_line(c2108="13")) as address,
        LeicaGeoCom(address) as station,
        pytest.raises(InstrumentError, match="code 13, the station is busy"),
    ):
        station.measure()


def test_a_call_that_the_station_does_not_have_is_named() -> None:
    settings = GeoComSettings(distance_mode="precise")
    with (
        scripted(station_line()) as address,
        pytest.raises(InstrumentError, match=r"TMC_SetEdmMode \(2020\) failed: code 3081"),
    ):
        LeicaGeoCom(address, settings).open()


def test_an_answer_with_another_number_is_ignored() -> None:
    def answer(call: int, transaction: int, values: list[str]) -> bytes:
        stale = f"%R1P,0,{(transaction + 3) % 7}:0,99.0,1.0,99.0\r\n".encode()
        return stale + station_line()(call, transaction, values)

    with scripted(answer) as address, LeicaGeoCom(address) as station:
        assert station.measure().distance == 12.5


def test_endless_answers_with_other_numbers_end_with_the_time_limit() -> None:
    def answer(call: int, transaction: int, values: list[str]) -> bytes:
        return b"%R1P,0,0:0\r\n"

    with scripted(answer) as address, pytest.raises(InstrumentTimeoutError):
        LeicaGeoCom(address, GeoComSettings(timeout=0.3)).open()


RECORDED = [
    b"110001+00000001 21.102+17920860 22.102+07567500 31..00+00003387 \r\n",
    b"*110002+0000000000000PT2 21.302+0000000017920860 81..00+0000000000012345 \r\n",
    b"*41....+000000000000CODE \r\n",
]


@pytest.mark.parametrize("recorded", RECORDED)
def test_a_point_that_the_operator_records_does_not_end_the_session(recorded: bytes) -> None:
    def answer(call: int, transaction: int, values: list[str]) -> bytes:
        found = {5004: '0,"TS30"', 5003: "0,123"}.get(call, "0,1,2,3")
        return recorded + f"%R1P,0,{transaction}:{found}\r\n".encode() + recorded

    with scripted(answer) as address, LeicaGeoCom(address) as station:
        assert station.identify().serial_number == "123"
        assert station.identify().model == "TS30"


def test_a_station_that_only_sends_gsi_is_named() -> None:
    with (
        scripted(lambda call, transaction, values: RECORDED[0]) as address,
        pytest.raises(ProtocolError, match=r"lines of GSI and none of GeoCOM.*set to GeoCOM"),
    ):
        LeicaGeoCom(address, GeoComSettings(timeout=0.3)).open()


def test_replies_to_other_calls_are_named_where_none_came_to_this_one() -> None:
    def answer(call: int, transaction: int, values: list[str]) -> bytes:
        return f"%R1P,0,{transaction % 7 + 1}:0\r\n".encode()

    with (
        scripted(answer) as address,
        pytest.raises(InstrumentTimeoutError, match=r"No answer to .*, but 1 answer to other requests was discarded"),
    ):
        LeicaGeoCom(address, GeoComSettings(timeout=0.3)).open()


def test_another_protocol_is_an_error_that_names_the_interface() -> None:
    with (
        scripted(lambda call, transaction, values: b"@W127\r\n") as address,
        raises("protocol.reply.form"),
    ):
        LeicaGeoCom(address).open()


def test_the_index_follows_from_the_ppm() -> None:
    assert air.refraction_index(0.0) == pytest.approx(1.00028634)
