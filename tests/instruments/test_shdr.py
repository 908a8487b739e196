"""SHDR adapters: states, units, conditions, heartbeat, lost connections, faults."""

import math
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from armed import CONTROLLER
from coded import raises

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.controller.shdr import Shdr, ShdrSettings
from errormotion.instruments.controller.virtual import VirtualController

ADDRESS = "sim://cframe/shdr?seed=3&style=vmc"
OKUMA = {
    **{f"position.{axis}": f"{key}1actm" for axis, key in (("X", "X"), ("Y", "YI"), ("Z", "Z"))},
    "spindle_speed": "S1speed",
    "spindle_load": "S1load",
    "feed": "p1Fact",
    "mode": "pmode",
    "execution": "pexecution",
}
WAIT = 2.0  # s, for reports of an adapter that polls the machine


class Adapter:
    """A scripted adapter: its lines after the connection, and for each ``* PING``."""

    def __init__(self, first: bytes, pong: bytes = b"* PONG 10000\n") -> None:
        self.first, self.pong = first, pong
        self.connections = 0
        self.pings = 0
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"tcp://127.0.0.1:{self._listener.getsockname()[1]}"
        self._line: socket.socket | None = None
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def send(self, data: bytes) -> None:
        assert self._line is not None
        self._line.sendall(data)

    def disconnect(self) -> None:
        if self._line is not None:
            self._line.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._thread.join()

    def _run(self) -> None:
        while True:
            try:
                self._line, _ = self._listener.accept()
            except OSError:
                return
            self.connections += 1
            with self._line:
                try:
                    self._line.sendall(self.first)
                    while data := self._line.recv(4096):
                        self.pings += data.count(b"* PING\n")
                        self._line.sendall(self.pong)
                except OSError:
                    continue


@contextmanager
def adapter(first: bytes, pong: bytes = b"* PONG 10000\n") -> Iterator[Adapter]:
    made = Adapter(first, pong)
    try:
        yield made
    finally:
        made.close()


def until(driver: Shdr, wanted: Callable[[Mapping[str, Any]], bool]) -> Mapping[str, Any]:
    end = time.monotonic() + WAIT
    while not wanted(state := driver.state()) and time.monotonic() < end:
        time.sleep(0.01)
    return state


@pytest.mark.parametrize(
    ("query", "settings"),
    [
        ("style=vmc", {}),
        ("style=vmc&heartbeat=0", {"timeout": 0.3}),
        ("style=vmc&times=none", {}),
        ("style=okuma&series=1&assets=1", {"items": OKUMA, "feed_unit": "mm/min"}),
        ("style=okuma&device=OKUMA", {"items": OKUMA, "feed_unit": "mm/min", "device": "OKUMA"}),
    ],
)
def test_the_state_is_that_of_the_machine(query: str, settings: dict[str, Any]) -> None:
    with (
        Shdr(f"sim://cframe/shdr?seed=3&{query}", ShdrSettings(**settings)) as driver,
        VirtualController("sim://cframe/controller?seed=3", CONTROLLER) as control,
    ):
        assert driver.identify().simulated
        control.spindle(6000.0)
        control.move_to((0.1, 0.05, 0.2), 0.05)
        true = control.state()
        state = until(driver, lambda state: state["position"] == pytest.approx(true["position"], abs=1e-6))
    assert state["position"] == pytest.approx(true["position"], abs=1e-7)
    assert state["spindle_speed"] == pytest.approx(true["spindle_speed"], abs=0.06)
    assert state["spindle_load"] == pytest.approx(true["spindle_load"], abs=1e-3)
    assert state["mode"] == "mdi"
    assert state["enabled"]
    assert state["homed"] is None
    assert state["alarms"] == []
    if "times=none" not in query:
        assert state["time"] == pytest.approx(true["time"], abs=0.1)
        assert state["position_time"] <= state["time"]
    else:
        assert math.isnan(state["time"])


def test_a_feed_in_millimetres_per_minute() -> None:
    settings = ShdrSettings(items=OKUMA, feed_unit="mm/min")
    with (
        Shdr("sim://cframe/shdr?seed=3&style=okuma", settings) as driver,
        VirtualController("sim://cframe/controller?seed=3", CONTROLLER) as control,
    ):
        control.run_program("G1 X100 F600\nG1 X0\nM30\n")
        control.elapse(5.0)
        state = until(driver, lambda state: state["running"] and state["feed"] > 0)
    assert state["feed"] == pytest.approx(0.01, abs=1e-6)


def test_units_are_those_of_the_settings() -> None:
    line = b"|Xact|1|Yact|-2|Zact|0.5|spindle_speed|10|path_feedrate|60|Cload|0.5|Stemp|212|Babs|180\n"
    settings = ShdrSettings(
        length_unit="inch",
        feed_unit="inch/min",
        speed_unit="1/s",
        load_unit="1",
        temperature_unit="degF",
        temperatures={"spindle": "Stemp", "column": "Ctemp"},
        angles={"B": "Babs"},
    )
    with adapter(line) as there, Shdr(there.url, settings) as driver:
        state = driver.state()
    assert state["position"] == pytest.approx([0.0254, -0.0508, 0.0127])
    assert state["feed"] == pytest.approx(0.0254)
    assert state["spindle_speed"] == 600.0
    assert state["spindle_load"] == 0.5
    assert state["temperatures"]["spindle"] == pytest.approx(100.0)
    assert math.isnan(state["temperatures"]["column"])
    assert state["angles"]["B"] == pytest.approx(math.pi)
    assert "temperatures.column" in state["unavailable"]


def test_a_position_of_three_numbers_and_a_second_key() -> None:
    with (
        adapter(b"2025-03-01T12:00:00Z|pos|1 2 3|pos|4 5 6\n") as there,
        Shdr(there.url, ShdrSettings(items={"position": "pos"})) as driver,
    ):
        assert driver.state()["position"] == pytest.approx([0.004, 0.005, 0.006])
        there.send(b"2025-03-01T12:00:01Z|pos|7 8\n")
        time.sleep(0.05)
        assert "position" in driver.state()["unavailable"]


def test_conditions_start_and_end_by_their_codes() -> None:
    with adapter(b"|servo|FAULT|12|1|HIGH|hot|\n".replace(b"hot|", b"hot")) as there, Shdr(there.url) as driver:
        assert driver.state()["alarms"] == ["servo 12: hot"]
        there.send(b"|servo|FAULT|13|1||torn\n|oil|WARNING|7|||low\n")
        state = until(driver, lambda state: len(state["alarms"]) == 2)
        assert state["alarms"] == ["servo 12: hot", "servo 13: torn"]
        assert state["warnings"] == ["oil 7: low"]
        there.send(b"|servo|NORMAL|12|||\n")
        assert until(driver, lambda state: len(state["alarms"]) == 1)["alarms"] == ["servo 13: torn"]
        there.send(b"|servo|NORMAL||||\n|oil|UNAVAILABLE||||\n")
        state = until(driver, lambda state: not state["alarms"] and not state["warnings"])
        assert state["alarms"] == state["warnings"] == []


def test_alarms_and_machines_that_are_off() -> None:
    with Shdr(f"{ADDRESS}&fault=alarm") as driver:
        assert until(driver, lambda state: bool(state["alarms"]))["alarms"]
    with Shdr(f"{ADDRESS}&fault=unavailable") as driver:
        state = driver.state()
    assert all(math.isnan(x) for x in [*state["position"], state["spindle_speed"], state["feed"]])
    assert not state["enabled"]


def test_a_connection_that_is_older_than_its_heartbeat_is_renewed() -> None:
    with adapter(b"|Xact|1|Yact|2|Zact|3\n", b"* PONG 1200\n") as there, Shdr(there.url) as driver:
        assert driver.heartbeat == 1.2
        driver.state()
        assert there.connections == 1
        time.sleep(1.3)  # the adapter closes a connection without '* PING' after twice its heartbeat
        there.first = b"|Xact|4\n"
        state = driver.state()
        assert there.connections == 2
        assert state["position"][0] == 0.004
        assert math.isnan(state["position"][1])  # values that the adapter has not repeated are unknown


def test_a_lost_connection_is_an_error_and_the_next_reading_is_correct() -> None:
    with adapter(b"|Xact|1|Yact|2|Zact|3\n") as there, Shdr(there.url) as driver:
        driver.state()
        there.disconnect()
        time.sleep(0.05)
        with pytest.raises(InstrumentError):
            driver.state()
        deadline = time.monotonic() + 3.0
        while True:  # two attempts to connect are a second apart
            try:
                assert driver.state()["position"] == pytest.approx([0.001, 0.002, 0.003])
                break
            except InstrumentError:
                assert time.monotonic() < deadline
                time.sleep(0.1)


def test_reopening_a_driver_discards_the_values_of_the_previous_session() -> None:
    with adapter(b"2026-01-01T00:00:00Z|S1speed|240\n") as device:
        driver = Shdr(device.url, ShdrSettings(items=OKUMA))
        with driver:
            assert driver.state()["spindle_speed"] == 240.0
        device.first = b"* device: M1\n"  # its values arrive later
        with driver:
            assert math.isnan(driver.state()["spindle_speed"])


def test_values_of_an_adapter_without_heartbeat_are_valid_for_a_time() -> None:
    settings = ShdrSettings(timeout=0.2, silence=1.0)
    with adapter(b"|Xact|1\n", b"") as there, Shdr(there.url, settings) as driver:
        assert math.isinf(driver.heartbeat)
        assert driver.state()["position"][0] == 0.001
        assert there.pings == 1  # there are no further requests
        time.sleep(1.1)
        with raises("instrument.no_answer"):
            driver.state()


@pytest.mark.parametrize(
    ("sent", "error", "code"),
    [
        (b"HTTP/1.1 400 Bad Request\n", ProtocolError, "protocol.shdr.line"),
        (b"\x00\xff\x01|x\n", ProtocolError, "protocol.shdr.line"),
        (b"x" * 100_000, ProtocolError, "protocol.shdr.line"),
        (b"", InstrumentTimeoutError, "instrument.no_answer"),
        (b"|@ASSET@|1|T|--multiline--A\n" + b"<a/>\n" * 300_000, ProtocolError, "protocol.shdr.asset"),
        (b"".join(b"|k%d|1\n" % k for k in range(10_001)), ProtocolError, "protocol.shdr.too_many"),
        (b"".join(b"|k|FAULT|%d|||x\n" % k for k in range(1001)), ProtocolError, "protocol.shdr.too_many"),
    ],
)
def test_another_service_instead_of_an_adapter_is_a_typed_error(
    sent: bytes, error: type[InstrumentError], code: str
) -> None:
    with adapter(sent, b"") as there, raises(code):
        Shdr(there.url, ShdrSettings(timeout=5.0 if sent else 0.5)).open()  # megabytes, on a busy computer


def test_an_endless_stream_without_an_answer_ends_at_the_time_limit() -> None:
    with adapter(b"|Xact|1\n", b"|Xact|2\n" * 100) as there, Shdr(there.url, ShdrSettings(timeout=0.3)) as driver:
        assert math.isinf(driver.heartbeat)
        assert driver.state()["position"][0] == 0.002


def test_invalid_lines_are_counted_if_so_set() -> None:
    with adapter(b"|Xact|1\nnonsense\n|Xact|2\n") as there:
        with raises("protocol.shdr.line"):
            Shdr(there.url).open()
        with Shdr(there.url, ShdrSettings(lenient=True)) as driver:
            assert driver.state()["position"][0] == 0.002
            assert driver.malformed == 1


@pytest.mark.parametrize("word", ["near", "1,5", "NaN", "nan", "inf", "1.234,5", "1 2"])
def test_a_value_that_is_no_number_is_unknown_with_a_reason_and_the_others_are_known(word: str) -> None:
    lines = f"2026-03-01T12:00:00Z|Xact|{word}|Yact|2|Zact|3|spindle_speed|6000|estop|ARMED\n".encode()
    with adapter(lines) as there, Shdr(there.url) as driver:
        state = driver.state()
    assert math.isnan(state["position"][0])
    assert state["position"][1:] == pytest.approx([0.002, 0.003])
    assert state["spindle_speed"] == 6000.0
    assert state["estop"] is False
    assert "position" in state["unavailable"]
    assert list(state["reasons"]) == ["Xact"]
    assert word in state["reasons"]["Xact"]


@pytest.mark.parametrize("words", ["1 NaN 3", "1 2,5 3"])
def test_one_unknown_coordinate_of_three_is_unknown_alone(words: str) -> None:
    settings = ShdrSettings(items={"position": "Ppos"})
    with adapter(f"|Ppos|{words}\n".encode()) as there, Shdr(there.url, settings) as driver:
        state = driver.state()
    assert state["position"] == pytest.approx([0.001, math.nan, 0.003], nan_ok=True)
    assert list(state["reasons"]) == ["Ppos"]


@pytest.mark.parametrize(
    ("line", "program", "others"),
    [
        ("avail|AVAILABLE|estop|ARMED|program|O1|23", "", {"availability": True, "estop": False}),
        ("program|A|B|avail|AVAILABLE|estop|TRIGGERED", "", {"estop": True}),
        ("avail|AVAILABLE|program|a|b|c|d|estop|ARMED", "", {"estop": False}),
        ("avail|AVAILABLE|program|a|b|estop|TRIGGERED|Xact", "", {"estop": True}),
        ("avail|AVAILABLE|program|O1|other|5|estop|ARMED|x", "O1", {}),
    ],
)
def test_a_separator_in_a_value_makes_this_value_unknown(line: str, program: str, others: dict[str, bool]) -> None:
    with adapter(f"2026-11-27T11:33:50.303089Z|{line}\n".encode()) as there, Shdr(there.url) as driver:
        state = driver.state()
        assert driver.malformed >= 1
    assert state["program"] == program
    assert ("program" in state["unavailable"]) == (not program)
    assert ("program" in state["reasons"]) == (not program)
    if "estop" in others:
        assert state["estop"] is others["estop"]
    if others.get("availability"):
        assert state["enabled"] is True
        assert "availability" not in state["unavailable"]


def test_commands_identify_the_device() -> None:
    text = b"* manufacturer: Maker\n* serialNumber: 123\n* adapterVersion: 2.1\n* device: M1\n|Xact|1\n"
    with adapter(text) as there, Shdr(there.url) as driver:
        found = driver.identify()
    assert (found.manufacturer, found.model, found.serial_number) == ("Maker", "M1", "123")
    assert found.firmware == "adapter 2.1"


def test_settings_name_known_quantities() -> None:
    with pytest.raises(ValueError, match="found colour"):
        ShdrSettings(items={"colour": "x"})


def test_a_recorded_session_plays_back(tmp_path: Path) -> None:
    path = tmp_path / "adapter.rec"

    def session(driver: Shdr) -> list[object]:
        with driver:
            return [driver.read(), driver.read(), driver.identify().model]

    recorded = session(Shdr(ADDRESS, record=path))
    assert session(Shdr(f"replay://{path}")) == recorded
