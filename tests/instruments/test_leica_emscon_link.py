"""The driver against a small server that is written from the C definitions of the interface alone.

It answers late, changes units without the driver, and records the commands that it receives.
"""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator

import pytest
from coded import raises

from errormotion.errors import InstrumentError, InstrumentTimeoutError
from errormotion.instruments.laser_tracker.leica_emscon import EmSconSettings, LeicaEmScon

SETTINGS = EmSconSettings(timeout=0.3, measuring_time=0.1, busy_timeout=2.0)
STATUS, SET_UNITS, GET_UNITS, SET_KIND, GET_KIND, GET_AIR, GET_INDEX = 1, 5, 6, 26, 27, 21, 23
SET_SYSTEM, GET_SYSTEM, START, SET_CONTINUOUS = 47, 48, 49, 30
NAME_BYTES = 64  # 32 wide characters


class HeaderServer:
    """A server for one client at a time; its state is the bytes that the client sent."""

    def __init__(self) -> None:
        self.kept = {SET_UNITS: bytes(20), SET_KIND: bytes(4), SET_SYSTEM: bytes(36)}
        self.received: list[tuple[int, bytes]] = []
        self.temperature = 20.0
        self.distance = 1.0
        self.before: Callable[[HeaderServer, int], None] = lambda server, number: None
        self.busy_until = 0.0
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.line: socket.socket | None = None
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    @property
    def url(self) -> str:
        return f"tcp://127.0.0.1:{self.listener.getsockname()[1]}"

    def close(self) -> None:
        self.listener.close()
        self.thread.join(10)

    def send(self, kind: int, body: bytes) -> None:
        assert self.line is not None
        self.line.sendall(struct.pack("<iI", 8 + len(body), kind) + body)

    def change(self, number: int) -> None:
        self.send(8, struct.pack("<I", number))

    def _run(self) -> None:
        self.listener.settimeout(20)
        try:
            self.line, _ = self.listener.accept()
        except OSError:
            return
        with self.line:
            data = b""
            while piece := self.line.recv(4096):
                data += piece
                while len(data) >= 12 and len(data) >= (size := struct.unpack_from("<i", data)[0]):
                    self._obey(struct.unpack_from("<I", data, 8)[0], data[12:size])
                    data = data[size:]

    def _obey(self, number: int, parameters: bytes) -> None:
        self.received.append((number, parameters))
        if number in self.kept:
            self.kept[number] = parameters
        if time.monotonic() < self.busy_until:
            self.send(0, struct.pack("<II", number, 1))
            return
        self.before(self, number)
        values = {
            STATUS: struct.pack("<10i", 0, 5, 3, 2, 3, 6, 0, 2, 0, 4711),
            GET_UNITS: self.kept[SET_UNITS],
            GET_KIND: self.kept[SET_KIND],
            GET_SYSTEM: self.kept[SET_SYSTEM],
            GET_AIR: struct.pack("<3d", self.temperature, 1013.25, 50.0),
            GET_INDEX: struct.pack("<2d", 1.00027, 1.00027),
        }
        self.send(0, struct.pack("<II", number, 0) + values.get(number, b""))
        if number == START:
            self.send_result()

    def send_result(self) -> None:
        numbers = [0.1, 1.5, self.distance, *[1e-6] * 4, *[0.0] * 7, self.temperature, 1013.25, 50.0]
        self.send(2, struct.pack("<IIi17d", 0, 0, 0, *numbers))


@pytest.fixture
def server() -> Iterator[HeaderServer]:
    made = HeaderServer()
    yield made
    made.close()


def delayed(number: int, seconds: float) -> Callable[[HeaderServer, int], None]:
    """Answer the next command of a number late."""

    def before(server: HeaderServer, received: int) -> None:
        if received == number:
            server.before = lambda *_: None
            time.sleep(seconds)

    return before


def test_a_measurement_has_the_units_and_coordinates_that_were_set_and_requested_again(server: HeaderServer) -> None:
    with LeicaEmScon(server.url, SETTINGS) as tracker:
        found = tracker.measure()
    assert (found.distance, found.angles) == (1.0, (0.1, 1.5))
    numbers = [number for number, _ in server.received]
    assert dict(server.received)[SET_KIND] == struct.pack("<I", 7)
    for number in (GET_UNITS, GET_KIND, GET_SYSTEM):
        assert number in numbers[numbers.index(SET_KIND) : numbers.index(START)]


def test_a_late_answer_is_not_taken_for_that_of_the_next_command(server: HeaderServer) -> None:
    with LeicaEmScon(server.url, SETTINGS) as tracker:
        server.before = delayed(GET_AIR, 0.5)
        with raises("instrument.no_answer"):
            tracker.environment()
        time.sleep(0.4)
        server.temperature = 25.0
        assert tracker.environment().temperature == 25.0
        assert tracker.measure().valid


def test_a_late_measurement_is_not_taken_for_the_next_one(server: HeaderServer) -> None:
    held: list[float] = []

    def before(self: HeaderServer, number: int) -> None:
        if number == START:
            held.append(self.distance)
            self.before = lambda *_: None
            self.send(0, struct.pack("<II", START, 0))
            time.sleep(3.0)  # longer than the driver waits: the result follows later

    with LeicaEmScon(server.url, SETTINGS) as tracker:
        tracker.refraction()
        server.before = before
        with raises("instrument.no_answer"):
            tracker.measure()
        server.distance = 2.0
        deadline = time.monotonic() + 20
        while True:  # errors are typed until the server answers again
            try:
                found = tracker.measure()
                break
            except InstrumentTimeoutError:
                assert time.monotonic() < deadline
        assert found.distance == 2.0


def test_the_driver_waits_for_a_server_busy_with_a_late_command(server: HeaderServer) -> None:
    def before(self: HeaderServer, number: int) -> None:
        if number == GET_AIR:
            self.before = lambda *_: None
            time.sleep(0.4)
            self.busy_until = time.monotonic() + 0.5

    with LeicaEmScon(server.url, SETTINGS) as tracker:
        server.before = before
        with pytest.raises(InstrumentTimeoutError):
            tracker.environment()
        server.temperature = 30.0
        assert tracker.environment().temperature == 30.0


def test_a_server_that_stays_silent_gives_typed_errors(server: HeaderServer) -> None:
    with LeicaEmScon(server.url, SETTINGS) as tracker:
        server._obey = lambda number, parameters: None  # type: ignore[method-assign]
        for _ in range(6):
            with pytest.raises(InstrumentError):
                tracker.environment()


def test_a_refused_part_of_an_answer_is_an_error(server: HeaderServer) -> None:
    reflector = struct.pack("<iiId", 2, 1, 1, 0.0) + bytes(NAME_BYTES)

    def two_parts(number: int, parameters: bytes) -> None:
        server.send(0, struct.pack("<II", number, 0) + reflector)
        server.send(0, struct.pack("<II", number, 3))

    with LeicaEmScon(server.url, SETTINGS) as tracker:
        server._obey = two_parts  # type: ignore[method-assign]
        with pytest.raises(InstrumentError, match="GetReflectors"):
            tracker.reflectors()


@pytest.mark.parametrize(
    ("number", "value", "event"),
    [
        (SET_UNITS, struct.pack("<5I", 1, 0, 0, 0, 0), 6),
        (SET_KIND, struct.pack("<I", 0), 12),
        (SET_SYSTEM, struct.pack("<9i", 2, 1, 0, 0, 1, 0, 0, 0, 0), 8),
    ],
    ids=["mm", "rectangular", "transformed"],
)
def test_a_change_by_another_client_is_an_error_until_reconfigured(
    server: HeaderServer, number: int, value: bytes, event: int
) -> None:
    with LeicaEmScon(server.url, SETTINGS) as tracker:
        assert tracker.measure().valid
        server.kept[number] = value
        server.change(event)
        tracker.environment()  # reads the message
        for _ in range(2):
            with raises("tracker.settings.differ"):
                tracker.measure()
        tracker.configure(SETTINGS)
        assert tracker.measure().valid


def test_a_stream_names_no_region_that_older_servers_lack(server: HeaderServer) -> None:
    with LeicaEmScon(server.url, SETTINGS) as tracker, pytest.raises(InstrumentTimeoutError):
        next(tracker.stream())
    assert dict(server.received)[SET_CONTINUOUS] == struct.pack("<iiiI", 10, 0, 0, 0)
