"""The simulated SHDR adapter on its line."""

import re
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from urllib.parse import urlsplit

import pytest

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.controller import shdr
from errormotion.instruments.simulators.controller.mtconnect.devices import Devices
from errormotion.instruments.simulators.controller.mtconnect.machine import Condition, Series
from errormotion.instruments.simulators.controller.mtconnect.styles import STYLES
from errormotion.instruments.simulators.controller.shdr import SimulatedAdapter, escaped, field_text
from errormotion.instruments.simulators.faults import parse_fault
from errormotion.instruments.transports import parse_address

TIMEOUT = 5.0
STAMP = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{6}Z")


class Line:
    """A client of the adapter."""

    def __init__(self, adapter: SimulatedAdapter) -> None:
        parts = urlsplit(adapter.url)
        self.adapter = adapter
        self.socket = socket.create_connection((parts.hostname, parts.port), timeout=TIMEOUT)
        self.file = self.socket.makefile("rb")

    def close(self) -> None:
        self.file.close()
        self.socket.close()

    def next(self) -> str:
        """Return the next line; empty at the end."""
        line = self.file.readline()
        assert line == b"" or line.endswith(b"\n")
        return line.decode().rstrip("\r\n")

    def until(self, start: str) -> list[str]:
        """Return lines to the first that contains a text."""
        lines = [self.next()]
        while start not in lines[-1]:
            assert lines[-1], f"the connection ended before '{start}'"
            lines.append(self.next())
        return lines


@contextmanager
def adapter(query: str = "") -> Iterator[SimulatedAdapter]:
    device = SimulatedAdapter(parse_address(f"sim://cframe/shdr?seed=3{'&' if query else ''}{query}"))
    try:
        yield device
    finally:
        device.close()


@contextmanager
def connected(query: str = "") -> Iterator[Line]:
    with adapter(query) as device:
        line = Line(device)
        try:
            yield line
        finally:
            line.close()


def pairs(line: str) -> dict[str, str]:
    """Return keys and values of a line of simple data."""
    stamp, *fields = line.split("|")
    assert STAMP.fullmatch(stamp)
    return dict(zip(fields[::2], fields[1::2], strict=True))


def test_the_present_state_is_sent_after_the_connection() -> None:
    with connected() as line:
        *commands, state = line.until("avail|")
    assert commands == ["* shdrVersion: 2.0", "* adapterVersion: 1.0", "* mtconnectVersion: 2.0", "* device: cframe"]
    seen = pairs(state)
    assert seen["avail"] == "AVAILABLE"
    assert float(seen["X1actm"]) - float(seen["X1actw"]) == pytest.approx(-120.0)
    assert seen["S2speed"] == "UNAVAILABLE"


def test_only_changes_follow() -> None:
    with connected() as line:
        line.until("p1offsets|")
        line.until("CoolantSystem1_cond")
        line.adapter.world.move_to([0.010, 0.0, 0.0], 0.05)
        line.adapter.world.elapse(10.0)
        changed = pairs(line.until("X1actm|")[-1])
        while changed.get("X1actm") != "10.0000":
            changed = pairs(line.until("X1actm|")[-1])
    assert "YI1actm" not in changed
    assert "avail" not in changed


def test_a_second_connection_gets_the_whole_state_again() -> None:
    with adapter() as device:
        for _ in range(3):
            line = Line(device)
            assert "X1actm" in pairs(line.until("avail|")[-1])
            line.close()


def test_a_condition_has_six_fields_after_the_time() -> None:
    with connected("fault=alarm&fault_at=20") as line:
        normal = line.until("|system|")[-1]
        assert normal.split("|")[1:] == ["system", "NORMAL", "", "", "", ""]
        for _ in range(20):
            line.socket.sendall(b"* PING\n")
        fault = line.until("|system|")[-1]
    assert fault.split("|")[1:] == ["system", "FAULT", "1104", "", "", "the machine is in alarm"]


def test_series_data_sets_and_tables_have_their_own_lines() -> None:
    with connected("series=1") as line:
        series = line.until("Xseries")[-1].split("|")
        variables = line.until("morevars")[-1].split("|")
        table = line.until("moreoffsets")[-1].split("|")
    assert series[2:4] == ["10", "100"]
    assert len(series[4].split()) == 10
    assert variables[2] == "v100=0.0 v101=0.0000"
    assert table[2] == "G54={X=-120.0000 Y=40.0000 Z=25.5000}"


def test_an_asset_in_several_lines() -> None:
    with connected("assets=1") as line:
        start = line.until("@ASSET@")[-1].split("|")
        assert start[1:4] == ["@ASSET@", "1.7", "CuttingTool"]
        assert start[4].startswith("--multiline--")
        lines = line.until(start[4])
    assert lines[0].startswith("<CuttingTool ")
    assert lines[-2].endswith("</CuttingTool>")
    assert lines[-1] == start[4]


def test_ping_is_answered_with_the_heartbeat() -> None:
    with connected("heartbeat=2500") as line:
        line.socket.sendall(b"* PI")
        line.socket.sendall(b"NG\r\n* NOISE\nping\n")
        assert line.until("* PONG")[-1] == "* PONG 2500"


def test_an_incomplete_line_ends_with_its_connection() -> None:
    with adapter() as device:
        first = Line(device)
        first.until("avail|")
        first.socket.sendall(b"* PI")
        first.close()
        second = Line(device)
        second.until("avail|")
        second.socket.sendall(b"* PING\n")
        assert second.until("* PONG")[-1] == "* PONG 10000"
        second.close()


def test_an_adapter_without_heartbeat_ignores_ping() -> None:
    with connected("heartbeat=0") as line:
        line.socket.sendall(b"* PING\n")
        lines = line.until("CoolantSystem1_cond")
    assert not any("PONG" in each for each in lines)


def test_a_client_that_stops_its_pings_is_disconnected() -> None:
    with connected("heartbeat=30") as line:
        line.socket.sendall(b"* PING\n")
        line.until("* PONG")
        while line.next():
            pass


def test_the_device_has_the_name_in_the_address() -> None:
    for query, name in (("name=OKUMA", "OKUMA"), ("device=VMC", "VMC"), ("name=OKUMA&device=VMC", "OKUMA")):
        with connected(query) as line:
            assert "* device: " + name in [line.next() for _ in range(4)]


@pytest.mark.parametrize(("query", "expected"), [("", r'"O1\|23"'), ("pipes=raw", "O1|23")], ids=["escaped", "raw"])
def test_separators_in_values_are_escaped_or_not(query: str, expected: str, monkeypatch: pytest.MonkeyPatch) -> None:
    real = shdr.reading
    monkeypatch.setattr(
        shdr, "reading", lambda values, source: "O1|23" if source == "program" else real(values, source)
    )
    with connected(query) as line:
        for _ in range(20):
            if "pprogram|" in (text := line.next()):
                break
    assert f"pprogram|{expected}" in text


def test_keys_can_have_the_name_of_the_device() -> None:
    with connected("device=VMC") as line:
        assert "VMC:X1actm" in pairs(line.until("VMC:avail")[-1])


def test_lines_without_time_begin_with_the_separator() -> None:
    with connected("times=none") as line:
        assert line.until("avail|")[-1].startswith("|avail|")


def test_keys_are_sources_names_or_identifiers() -> None:
    with connected("style=vmc") as line:
        seen = pairs(line.until("avail|")[-1])
    assert {"Xact", "spindle_speed", "path_feedrate", "feed_ovr", "estop"} <= seen.keys()


def test_values_have_their_native_units() -> None:
    items = Devices(STYLES["okuma"].document("m", "u", "1")).items
    assert field_text("100.0000", items["Lp1Fact"]) == "6000.0000"
    assert field_text("UNAVAILABLE", items["Lp1Fact"]) == "UNAVAILABLE"
    assert field_text("1.0", items["LX1actm"]) == "1.0"


def test_separators_in_values_are_escaped() -> None:
    items = Devices(STYLES["vmc"].document("m", "u", "1")).items
    assert escaped("a|b") == '"a\\|b"'
    assert escaped("two\nlines") == "two lines"
    assert field_text(Condition("Warning", "7", "2", "HIGH", "a|b"), items["system"]) == 'WARNING|7|2|HIGH|"a\\|b"'
    assert field_text("UNAVAILABLE", items["system"]) == "UNAVAILABLE||||"
    assert field_text("hello", items["msg"]) == "|hello"
    assert field_text(Series(("1", "2"), 50.0), items["x2"]) == "2|50|1 2"
    assert field_text({"a": "two words"}, items["cn2"]) == "a={two words}"


def test_faults_of_lines() -> None:
    with connected("fault=silence&fault_at=2") as line:
        assert [line.next(), line.next()] == ["* shdrVersion: 2.0", "* adapterVersion: 1.0"]
        line.socket.settimeout(0.2)
        with pytest.raises(TimeoutError):
            line.next()
    with connected("fault=drop&fault_every=2") as line:
        assert line.next() == "* adapterVersion: 1.0"
    with connected("fault=split") as line:
        assert line.until("avail|")
    with connected("fault=garbage&fault_at=1&fault_every=100") as line:
        line.next()
        assert line.file.readline().rstrip(b"\n").endswith(b"* adapterVersion: 1.0")
    with adapter("fault=disconnect&fault_at=3") as device:
        line = Line(device)
        lines = list(iter(line.next, ""))
        line.close()
        assert len(lines) == 3


def test_a_late_line_is_sent_before_the_next_one_or_after_its_delay() -> None:
    with connected() as sound:
        expected = [sound.next() for _ in range(4)]
    for late in ("", "&late_by=0.2"):
        with connected(f"fault=late&fault_at=2{late}") as line:
            assert [line.next() for _ in range(4)] == expected
    for late, comes in (("&late_by=0.3", True), ("", False)):
        with adapter("heartbeat=5000") as device:
            line = Line(device)
            while device._server.connection is None or line.next() == "":
                pass
            time.sleep(0.2)  # after its unrequested lines
            device.fault = parse_fault(
                parse_address(f"sim://cframe?fault=late&fault_at={device._lines}{late}"), device.faults
            )
            line.socket.settimeout(1.0)
            line.socket.sendall(b"* PING\n")
            said = b""
            with suppress(TimeoutError):
                while b"PONG" not in said:
                    said += line.socket.recv(65536)
            assert (b"* PONG 5000" in said) == comes
            line.close()


def test_a_machine_that_is_off_is_unavailable() -> None:
    with connected("fault=unavailable") as line:
        assert set(pairs(line.until("avail|")[-1]).values()) == {"UNAVAILABLE"}
        assert line.until("|system|")[-1].endswith("|system|UNAVAILABLE||||")


@pytest.mark.parametrize("query", ["style=haas", "times=local", "offset=1", "fault=sulk"])
def test_unknown_parameters_of_the_address_are_refused(query: str) -> None:
    with pytest.raises(InstrumentError), adapter(query):
        pass
