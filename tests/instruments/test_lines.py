"""A device with several connections."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from coded import raises

from errormotion.errors import InstrumentError
from errormotion.instruments.transports import parse_address
from errormotion.instruments.transports.lines import ManyLines, open_lines
from errormotion.instruments.transports.loopback.serving import TcpServer


class Twofold:
    """A device that repeats on its second line, in capitals, the bytes of its first line."""

    def __init__(self) -> None:
        self.second = TcpServer("second", lambda data: None)
        self.first = TcpServer("first", self.answer)
        for server in (self.first, self.second):
            server.start()

    def answer(self, data: bytes) -> None:
        self.first.send(b"ok")
        assert self.second.await_connection(1.0)
        self.second.send(data.upper())

    @property
    def url(self) -> str:
        return f"{self.first.url}?data={self.second.url.rpartition(':')[2]}"

    def close(self) -> None:
        self.first.close()
        self.second.close()


@pytest.fixture
def device() -> Iterator[Twofold]:
    both = Twofold()
    yield both
    both.close()


def talk(lines: ManyLines) -> bytes:
    lines.write(b"hello")
    assert lines.read_exactly(2) == b"ok"
    return lines.line("data").read_exactly(5)


def test_each_line_goes_to_its_port(device: Twofold) -> None:
    lines = open_lines(device.url, {"data": 1})
    assert talk(lines) == b"HELLO"
    assert not lines.simulated
    lines.close()
    lines.close()
    with raises("connection.closed"):
        lines.line("data").read()


def test_without_a_parameter_the_default_port_is_used(device: Twofold) -> None:
    port = parse_address(device.second.url).port
    lines = open_lines(device.first.url, {"data": port})
    assert talk(lines) == b"HELLO"
    lines.close()


def test_if_one_line_cannot_be_opened_none_stays_open(device: Twofold) -> None:
    with raises("connection.not_opened"):
        open_lines(f"{device.first.url}?data=9", {"data": 1})


@pytest.mark.parametrize("port", ["x", "0", "65536", "1.5"])
def test_an_invalid_port_is_named(device: Twofold, port: str) -> None:
    with pytest.raises(InstrumentError, match=f"'data' in .*found '?{port}"):
        open_lines(f"{device.first.url}?data={port}", {"data": 1})


def test_a_serial_line_is_only_one() -> None:
    with raises("address.type"):
        open_lines("serial:///dev/ttyUSB0", {"data": 1})


def test_a_simulated_device_without_such_a_line_is_refused() -> None:
    simulator = "errormotion.instruments.simulators.thermometer.dcon:SimulatedDcon"
    with raises("simulator.line.missing"):
        open_lines("sim://cframe/thermometer", {"data": 1}, simulator=simulator)


def test_parallel_lines_are_recorded_and_play_back(device: Twofold, tmp_path: Path) -> None:
    recording = tmp_path / "both.rec"
    lines = open_lines(device.url, {"data": 1}, record=recording)
    assert talk(lines) == b"HELLO"
    lines.close()
    assert recording.read_text().splitlines()[1:] == ["command both.command.rec", "data both.data.rec"]
    replay = open_lines(f"replay://{recording}", {"data": 1})
    assert talk(replay) == b"HELLO"
    replay.close()
    replay = open_lines(f"replay://{recording}", {"data": 1})
    with raises("replay.incomplete"):
        replay.close()
    with raises("recording.not_created"):
        open_lines(device.url, {"data": 1}, record=recording)
    with raises("recording.line.missing"):
        open_lines(f"replay://{recording}", {"light": 1})


def test_silence_on_one_line_does_not_affect_the_other(device: Twofold) -> None:
    lines = open_lines(device.url, {"data": 1}, timeout=0.2)
    with raises("instrument.no_answer"):
        lines.line("data").read()
    assert talk(lines) == b"HELLO"
    lines.close()
