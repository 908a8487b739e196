"""SCPI data acquisition units: codec against vectors, driver against a scripted unit."""

import math
import os
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import mutants
import pytest
from coded import raises
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from wire_vectors import Vector, vectors

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.thermometer.scpi import codec
from errormotion.instruments.thermometer.scpi.driver import ScpiTemperature
from errormotion.instruments.thermometer.scpi.settings import ScpiSettings

DEVICE = "scpi_temperature"
IDENTITY = "HEWLETT-PACKARD,34970A,0,13-2-2"
QUICK = {"timeout": 0.3, "retry": 0.0}


# ---------------------------------------------------------------------- codec


@pytest.mark.parametrize("vector", vectors(DEVICE, "identity"), ids=str)
def test_identities(vector: Vector) -> None:
    manufacturer, model, serial, _ = codec.parse_identity(codec.decode(vector.data))
    assert {"manufacturer": manufacturer, "model": model, "serial": serial} == vector.expected


@pytest.mark.parametrize("vector", vectors(DEVICE, "scan list"), ids=str)
def test_scan_lists(vector: Vector) -> None:
    assert codec.parse_channels(codec.decode(vector.data)) == vector.expected["channels"]


@pytest.mark.parametrize("vector", vectors(DEVICE, "error"), ids=str)
def test_entries_of_the_error_queue(vector: Vector) -> None:
    number, message = codec.parse_error(codec.decode(vector.data))
    assert {"number": number, "message": message} == vector.expected


@pytest.mark.parametrize("vector", vectors(DEVICE, "number"), ids=str)
def test_numbers(vector: Vector) -> None:
    assert codec.parse_readings(vector.data.decode() + ",101") == [(101, vector.expected["value"])]


@pytest.mark.parametrize("vector", vectors(DEVICE, "readings"), ids=str)
def test_readings(vector: Vector) -> None:
    assert codec.parse_readings(codec.decode(vector.data)) == [tuple(pair) for pair in vector.expected["pairs"]]


@pytest.mark.parametrize("vector", vectors(DEVICE, "channel list"), ids=str)
def test_channel_lists(vector: Vector) -> None:
    assert codec.channel_list(vector.expected["channels"]).encode() == vector.data


@pytest.mark.parametrize("vector", vectors(DEVICE, "command"), ids=str)
def test_commands(vector: Vector) -> None:
    names = tuple(f"sensor {k}" for k in range(len(vector.expected["inputs"])))
    settings = ScpiSettings(channels=names, **vector.expected)
    assert vector.data.decode() in list(settings.commands())


@pytest.mark.parametrize(
    ("parse", "text"),
    [
        (codec.parse_identity, "+2.1E+01,101,+2.2E+01,102"),
        (codec.parse_identity, "HEWLETT-PACKARD,34970A"),
        (codec.parse_error, "-113"),
        (codec.parse_error, '-113,"Undefined'),
        (codec.parse_channels, "#214(@101,102)"),
        (codec.parse_channels, "(@101)"),
        (codec.parse_channels, "#18(@1:3,4)"),
        (codec.parse_channels, "#9999999999"),
        (codec.parse_readings, ""),
        (codec.parse_readings, "+2.1E+01"),
        (codec.parse_readings, "+2.1E+01,101,"),
        (codec.parse_readings, "+2.1E+01 C,101"),
        (codec.parse_readings, "nan,101"),
        (codec.parse_readings, IDENTITY),
    ],
)
def test_other_texts_are_protocol_errors(parse: Callable[[str], object], text: str) -> None:
    with pytest.raises(ProtocolError, match=r"expected|Expected"):
        parse(text)


@given(st.binary(max_size=80))
def test_any_bytes_give_values_or_protocol_errors(data: bytes) -> None:
    for parse in (codec.parse_identity, codec.parse_error, codec.parse_channels, codec.parse_readings):
        try:
            parse(codec.decode(data))
        except ProtocolError:
            continue


@given(st.sets(st.integers(101, 340), max_size=60))
def test_a_channel_list_names_each_channel_once(channels: set[int]) -> None:
    text = codec.channel_list(sorted(channels))
    found: list[int] = []
    for part in filter(None, text[2:-1].split(",")):
        first, _, last = part.partition(":")
        found += range(int(first), int(last or first) + 1)
    assert found == sorted(channels)


# ---------------------------------------------------------------------- settings


def test_settings_state_the_unit_in_its_terms() -> None:
    settings = ScpiSettings(
        channels=("frame", "motor", "oil"),
        inputs=(103, 101, 205),
        sensors=("FRTD 85", "TC K", "FRTD 85"),
        resistance=(100.0, 100.0, 1000.0),
        power_cycles="10",
        reference_junction=20.0,
    )
    assert list(settings.commands()) == [
        "CONF:TEMP FRTD,85,(@103,205)",
        "CONF:TEMP TC,K,(@101)",
        "TEMP:TRAN:TC:CHEC ON,(@101)",
        "TEMP:TRAN:TC:RJUN:TYPE FIX,(@101)",
        "TEMP:TRAN:TC:RJUN 20,(@101)",
        "TEMP:TRAN:FRTD:RES 100,(@103)",
        "TEMP:TRAN:FRTD:RES 1000,(@205)",
        "TEMP:NPLC 10,(@101,103,205)",
        "UNIT:TEMP C,(@101,103,205)",
        "ROUT:SCAN (@101,103,205)",
        "TRIG:SOUR IMM",
        "TRIG:COUN 1",
        "FORM:READ:ALAR OFF",
        "FORM:READ:CHAN ON",
        "FORM:READ:TIME OFF",
        "FORM:READ:UNIT OFF",
    ]


@pytest.mark.parametrize(
    ("given_", "message"),
    [
        ({"inputs": (101,)}, "'inputs': expected one for each of the 5 channels; found 1"),
        ({"inputs": (101, 102, 103, 104, 104)}, "'inputs' has a channel twice"),
        ({"inputs": (1, 102, 103, 104, 105)}, "expected slot and channel, such as 101 or 1001; found 1"),
        ({"sensors": ("FRTD 85", "TC K")}, "'sensors': expected one, or one for each"),
        ({"sensors": ("TC X",)}, "sensors"),
        ({"resistance": 10.0}, "'resistance': expected 49 to 2100 ohm; found 10"),
        ({"reference_junction": 200.0}, "'reference_junction': expected -20 to 80 degC"),
    ],
)
def test_settings_that_no_unit_takes_are_refused(given_: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        ScpiSettings(**given_)


# ---------------------------------------------------------------------- driver


class Unit:
    """A scripted unit: answers commands in order, one line each; has a scan list and an error queue."""

    def __init__(self, identity: str = IDENTITY) -> None:
        self.identity, self.received, self.queue = identity, [], []
        self.readings: dict[int, float] = {}
        self.scan: list[int] = [101, 102]
        self.refused: tuple[str, ...] = ()
        self.delays: list[float] = []  # s, of the next answers to READ?
        self.end = "\n"

    def answer(self, command: str) -> str | None:
        self.received.append(command)
        if command == "*IDN?":
            return self.identity
        if command == "SYST:ERR?":
            return self.queue.pop(0) if self.queue else '+0,"No error"'
        if command == "*CLS":
            self.queue.clear()
        elif command == "ROUT:SCAN?":
            text = "(@" + ",".join(map(str, self.scan)) + ")"
            return f"#{len(str(len(text)))}{len(text)}{text}"
        elif command == "READ?":
            if self.delays:
                time.sleep(self.delays.pop(0))
            return ",".join(f"{self.readings.get(channel, 20.0):+.8E},{channel}" for channel in self.scan)
        elif command.startswith(self.refused) and self.refused:
            self.queue.append('-113,"Undefined header"')
        elif match := re.fullmatch(r"ROUT:SCAN \(@(.*)\)", command):
            self.scan = []
            for part in match[1].split(","):
                first, _, last = part.partition(":")
                self.scan += range(int(first), int(last or first) + 1)
        return None

    def serve(self, connection: socket.socket) -> None:
        rest = b""
        with connection:
            while True:
                try:
                    data = connection.recv(4096)
                except OSError:
                    return
                if not data:
                    return
                *lines, rest = (rest + data).split(b"\n")
                for line in lines:
                    text = self.answer(line.decode())
                    if text is not None:
                        try:
                            connection.sendall((text + self.end).encode("latin-1"))
                        except OSError:
                            return


@contextmanager
def listening(unit: Unit, port: int = 0) -> Iterator[str]:
    """Serve the unit on a port; at the end every connection is closed, as when the unit is switched off."""
    server = socket.create_server(("127.0.0.1", port))
    threads: list[threading.Thread] = []
    connections: list[socket.socket] = []

    def accept() -> None:
        while True:
            try:
                connection, _ = server.accept()
            except OSError:
                return
            connections.append(connection)
            threads.append(threading.Thread(target=unit.serve, args=(connection,), daemon=True))
            threads[-1].start()

    acceptor = threading.Thread(target=accept, daemon=True)
    acceptor.start()
    try:
        yield f"tcp://127.0.0.1:{server.getsockname()[1]}"
    finally:
        server.shutdown(socket.SHUT_RDWR)
        server.close()
        acceptor.join()
        for connection in connections:
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
        for thread in threads:
            thread.join()


def pt100(**more: object) -> ScpiSettings:
    return ScpiSettings(channels=("frame", "oil"), **{**QUICK, **more})


def test_a_scan_is_read_by_channel() -> None:
    unit = Unit()
    unit.readings = {101: 26.195, 102: -3.5}
    with listening(unit) as address, ScpiTemperature(address, pt100(inputs=(102, 101))) as thermometer:
        assert thermometer.read() == {"frame": -3.5, "oil": 26.195}
        assert thermometer.flags == {"frame": "", "oil": ""}
        assert thermometer.identify().model == "34970A"
    assert "ROUT:SCAN (@101:102)" in unit.received


@pytest.mark.parametrize(
    ("reading", "flag"), [(9.9e37, "open"), (-9.9e37, "out of range"), (-300.0, "out of range"), (9.91e37, "open")]
)
def test_a_missing_temperature_has_its_reason(reading: float, flag: str) -> None:
    unit = Unit()
    unit.readings = {102: reading}
    with listening(unit) as address, ScpiTemperature(address, pt100()) as thermometer:
        found = thermometer.read()
        assert (found["frame"], math.isnan(found["oil"])) == (20.0, True)
        assert (thermometer.flags["oil"], thermometer.open_sensors) == (flag, ("oil",))


def test_readings_are_corrected_by_the_calibration_of_their_sensor() -> None:
    unit = Unit()
    settings = pt100(scale=(1.0, 1.01), offset=(0.05, -0.2))
    with listening(unit) as address, ScpiTemperature(address, settings) as thermometer:
        assert thermometer.read() == {"frame": pytest.approx(20.05), "oil": pytest.approx(20.0)}


def test_a_serial_line_ends_its_answers_with_carriage_return() -> None:
    unit = Unit()
    unit.end = "\r\n"
    with listening(unit) as address, ScpiTemperature(address, pt100()) as thermometer:
        assert thermometer.read() == {"frame": 20.0, "oil": 20.0}


def test_a_refused_command_is_named_with_the_entry_of_the_error_queue() -> None:
    unit = Unit()
    unit.refused = ("TEMP:NPLC",)
    with listening(unit) as address:
        thermometer = ScpiTemperature(address, pt100(power_cycles="10"))
        with pytest.raises(InstrumentError, match=r"refuses 'TEMP:NPLC 10,\(@101:102\)': -113 Undefined header"):
            thermometer.open()


def test_another_device_is_refused() -> None:
    unit = Unit("FLUKE,8846A,1234567,08/02/10-14:53")
    with (
        listening(unit) as address,
        raises("instrument.model.unknown"),
    ):
        ScpiTemperature(address, pt100()).open()
    unit = Unit("FLUKE,8846A,1234567,08/02/10-14:53")
    with listening(unit) as address, ScpiTemperature(address, pt100(models=("8846A",))) as thermometer:
        assert thermometer.identify().manufacturer == "FLUKE"


def test_errors_of_an_earlier_user_are_reported_separately() -> None:
    unit = Unit()
    unit.queue = ['-222,"Data out of range"', '-410,"Query INTERRUPTED"']
    with listening(unit) as address, ScpiTemperature(address, pt100()) as thermometer:
        assert thermometer.unit_errors == ("-222 Data out of range", "-410 Query INTERRUPTED")
        assert thermometer.errors() == []


def test_an_error_queue_without_end_is_read_to_its_limit() -> None:
    unit = Unit()
    unit.queue = ['-113,"Undefined header"'] * 1000
    with listening(unit) as address, ScpiTemperature(address, pt100()) as thermometer:
        assert len(thermometer.unit_errors) == 32


def test_without_setup_only_the_format_is_written() -> None:
    unit = Unit()
    with listening(unit) as address, ScpiTemperature(address, pt100(setup=False)) as thermometer:
        assert thermometer.read() == {"frame": 20.0, "oil": 20.0}
    written = [command for command in unit.received if not command.endswith("?")]
    assert written == ["*CLS", *ScpiSettings.format_commands()]


def test_without_setup_another_scan_list_is_refused() -> None:
    unit = Unit()
    unit.scan = [101, 103]
    with (
        listening(unit) as address,
        pytest.raises(InstrumentError, match=r"expected the scan list \(@101:102\); found"),
    ):
        ScpiTemperature(address, pt100(setup=False)).open()


def test_a_scan_of_other_channels_is_an_error_and_the_unit_is_set_again() -> None:
    unit = Unit()
    with listening(unit) as address, ScpiTemperature(address, pt100()) as thermometer:
        unit.scan = [101]
        with raises("thermometer.channels.differ"):
            thermometer.read()
        assert set(thermometer.flags.values()) == {"no answer"}
        assert thermometer.read() == {"frame": 20.0, "oil": 20.0}


def test_a_late_answer_is_never_read_as_the_next_one() -> None:
    unit = Unit()
    with listening(unit) as address, ScpiTemperature(address, pt100()) as thermometer:
        unit.delays, unit.readings = [0.6], {101: 10.0, 102: 11.0}
        with raises("instrument.no_answer"):
            thermometer.read()
        unit.readings = {101: 30.0, 102: 31.0}
        time.sleep(0.6)
        assert [thermometer.read() for _ in range(3)] == [{"frame": 30.0, "oil": 31.0}] * 3


class Line:
    """A line without connections, such as a serial one: late answers stay on it."""

    flow_control = simulated = False

    def __init__(self, unit: Unit) -> None:
        self.unit, self.url, self.waiting, self.late = unit, "serial:///dev/none", [], 0
        self.timeout, self.reconnects = 0.05, False

    def write(self, data: bytes) -> None:
        text = self.unit.answer(data.decode().strip())
        if text is not None:
            self.waiting.append(text.encode() + b"\r\n")

    def read(self, max_bytes: int = 65536, timeout: float | None = None) -> bytes:
        raise InstrumentTimeoutError("no data")

    def reopen(self) -> None:
        """A serial line is not changed."""

    def read_until(self, terminator: bytes, *, limit: int = 65536, timeout: float | None = None) -> bytes:
        if self.late:  # this answer arrives after the next request
            self.late -= 1
            raise InstrumentTimeoutError("no answer")
        return self.waiting.pop(0)

    def close(self) -> None:
        pass


@pytest.mark.parametrize("late", [1, 2, 5])
def test_late_answers_on_a_serial_line_are_discarded_until_the_identity(
    late: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    unit = Unit()
    line = Line(unit)
    monkeypatch.setattr(ScpiTemperature, "_connect", lambda self: line)
    with ScpiTemperature("serial:///dev/none", pt100()) as thermometer:
        unit.readings = {101: 10.0, 102: 11.0}
        line.late = late
        for _ in range(late):
            with pytest.raises(InstrumentTimeoutError):
                thermometer.read()
        unit.readings = {101: 30.0, 102: 31.0}
        found = []
        for _ in range(10):
            try:
                found.append(thermometer.read())
            except InstrumentError:
                continue
        assert found[-3:] == [{"frame": 30.0, "oil": 31.0}] * 3
        assert all(each == {"frame": 30.0, "oil": 31.0} for each in found)


def test_garbage_is_a_typed_error_and_the_next_reading_is_correct() -> None:
    unit = Unit()
    with listening(unit) as address, ScpiTemperature(address, pt100()) as thermometer:
        unit.end = "\xff\n"
        with raises("protocol.text.form"):
            thermometer.read()
        unit.end = "\n"
        assert thermometer.read() == {"frame": 20.0, "oil": 20.0}


def test_an_answer_without_end_is_cut_at_the_longest_line() -> None:
    unit = Unit()
    with listening(unit) as address, ScpiTemperature(address, pt100(timeout=3.0)) as thermometer:
        unit.end = "0" * 100_000
        with raises("protocol.reply.too_long"):
            thermometer.read()


def test_a_unit_that_was_switched_off_is_set_again() -> None:
    unit = Unit()
    with listening(unit) as address:
        thermometer = ScpiTemperature(address, pt100())
        thermometer.open()
        port = int(address.rpartition(":")[2])
    with pytest.raises(InstrumentError):
        thermometer.read()
    unit.scan, unit.received = [], []
    with listening(unit, port):
        assert thermometer.read() == {"frame": 20.0, "oil": 20.0}
        thermometer.close()
    assert "ROUT:SCAN (@101:102)" in unit.received


def test_a_recorded_session_gives_the_same_readings(tmp_path: Path) -> None:
    unit = Unit()
    unit.readings = {102: 9.9e37}
    with listening(unit) as address, ScpiTemperature(address, pt100(), record=tmp_path / "s.rec") as thermometer:
        recorded = thermometer.read()
    with ScpiTemperature(f"replay://{tmp_path / 's.rec'}", pt100()) as thermometer:
        replayed = thermometer.read()
        assert replayed["frame"] == recorded["frame"]
        assert thermometer.flags["oil"] == "open"


def test_a_pty_carries_the_session_of_a_serial_line(tmp_path: Path) -> None:
    import pty

    unit = Unit()
    unit.end = "\r\n"
    master, slave = pty.openpty()
    name = os.ttyname(slave)
    stop = threading.Event()

    def serve() -> None:
        rest = b""
        while not stop.is_set():
            try:
                rest += os.read(master, 1024)
            except OSError:
                return
            *lines, rest = rest.split(b"\n")
            for line in lines:
                text = unit.answer(line.decode())
                if text is not None:
                    os.write(master, (text + unit.end).encode())

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        address, settings = f"serial://{name}?baudrate=9600", pt100(timeout=2.0)
        with ScpiTemperature(address, settings, record=tmp_path / "s.rec") as thermometer:
            assert thermometer.read() == {"frame": 20.0, "oil": 20.0}
        end = time.monotonic() + 5
        while "SYST:LOC" not in unit.received and time.monotonic() < end:
            time.sleep(0.01)
    finally:
        stop.set()
        os.write(slave, b"\n")
        thread.join(timeout=5)
        os.close(slave)
        os.close(master)
    commands = [command for command in unit.received if command and not command.endswith("?")]
    assert (commands[:2], commands[-1]) == (["*CLS", "SYST:REM"], "SYST:LOC")
    with ScpiTemperature(f"replay://{tmp_path / 's.rec'}", settings) as thermometer:
        assert thermometer.read() == {"frame": 20.0, "oil": 20.0}


@pytest.mark.parametrize(
    ("parse", "text"),
    [
        (codec.parse_readings, "+2.61950000E+01,101,+9.90000000E+37,102,-1.5,103"),
        (codec.parse_identity, IDENTITY),
        (codec.parse_error, '-113,"Undefined header"'),
        (codec.parse_channels, "#214(@101,102,103)"),
    ],
)
def test_damaged_answers_give_values_or_protocol_errors(parse: Callable[[str], object], text: str) -> None:
    mutants.check(
        lambda data: parse(codec.decode(data)), text.encode() + b"\n", seed=1, number=mutants.count(2000), limit=0.1
    )
