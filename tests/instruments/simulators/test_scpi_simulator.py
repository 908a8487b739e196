"""The simulated data acquisition unit on its line: grammar, refusals, formats, and a foreign client."""

import socket
from urllib.parse import urlsplit

import pytest

from errormotion.instruments import simulators
from errormotion.instruments.simulators.thermometer.scpi import SimulatedScpiUnit
from errormotion.instruments.transports import parse_address


@pytest.fixture
def unit():
    """Open a unit; return a function that sends a command."""
    made = []

    def unit(**params):
        query = "&".join(f"{name}={value}" for name, value in {"noise": 0, **params}.items())
        device = SimulatedScpiUnit(parse_address(f"sim://cframe/unit?{query}"))
        parts = urlsplit(device.url)
        line = socket.create_connection((parts.hostname, parts.port), timeout=5)
        made.append((device, line))

        def ask(*lines):
            for each in lines:
                line.sendall(each.encode() + b"\n")
            found = b""
            while not found.endswith(b"\n"):
                found += line.recv(4096)
            return found.decode().strip()

        ask.device = device
        return ask

    yield unit
    for device, line in made:
        line.close()
        device.close()
    simulators.reset()


NO_ERROR = '+0,"No error"'


def test_the_time_of_a_reading_is_relative_or_absolute(unit):
    ask = unit()
    setup = ("CONF:TEMP TC,K,(@101)", "FORM:READ:TIME ON", "FORM:READ:CHAN ON")
    assert ask(*setup, "FORM:READ:TIME:TYPE?") == "REL"
    assert ask("READ?").split(",")[1:] == ["00000000.017", "101"]
    ask.device.world.elapse(86400.0 + 3723.5)
    assert ask("FORMAT:READING:TIME:TYPE ABSOLUTE", "READ?").endswith(",2025,01,02,01,02,03.517,101")
    assert ask("form:read:time:type abs", "FORM:READ:TIME:TYPE?") == "ABS"
    assert ask("FORM:READ:TIME:TYPE LATE", "SYST:ERR?") == '-224,"Illegal parameter value"'
    assert ask("*RST", "FORM:READ:TIME:TYPE?") == "REL"


def test_long_and_short_forms_in_any_case_are_the_same(unit):
    ask = unit()
    for form in ("SYST:ERR?", "system:error?", ":SYSTem:ERRor?", "SYST:ERR:NEXT?"):
        assert ask(form) == NO_ERROR
    assert ask("ROUTE:SCAN (@101,103:105)", "ROUT:SCAN?") == "#218(@101,103,104,105)"
    assert ask("rout:scan:size?") == "+4"


@pytest.mark.parametrize(
    ("line", "error"),
    [
        ("SYSTE:ERR?", '-113,"Undefined header"'),
        ("SYST:ERRO?", '-113,"Undefined header"'),
        ("HELLO", '-113,"Undefined header"'),
        ("ROUT:SCAN", '-109,"Missing parameter"'),
        ("CONF:TEMP FRTD,85", '-109,"Missing parameter"'),
        ("*RST 1", '-108,"Parameter not allowed"'),
        ("CONF:TEMP PT100,85,(@101)", '-224,"Illegal parameter value"'),
        ("CONF:TEMP FRTD,92,(@101)", '-224,"Illegal parameter value"'),
        ("CONF:TEMP FRTD,85,(@111)", '+305,"Not able to perform requested operation"'),
        ("CONF:TEMP FRTD,85,(@201)", '+111,"Channel list: slot number out of range"'),
        ("CONF:TEMP TC,K,(@121)", '+112,"Channel list: channel number out of range"'),
        ("CONF:TEMP TC,K,101", '-102,"Syntax error"'),
        ("TEMP:NPLC 500,(@101)", '-222,"Data out of range"'),
        ("TEMP:TRAN:FRTD:RES 10,(@101)", '-222,"Data out of range"'),
        ("READ?", '+113,"Channel list: empty scan list"'),
        ("FETC?", '-230,"Data stale"'),
    ],
)
def test_refused_commands_are_in_the_queue_once(unit, line, error):
    ask = unit()
    assert ask(line, "SYST:ERR?") == error
    assert ask("SYST:ERR?") == NO_ERROR


def test_a_query_that_is_refused_has_no_answer(unit):
    assert unit()("NONSENSE?", "*IDN?").startswith("HEWLETT-PACKARD,34970A,")


def test_a_command_continues_the_path_of_the_previous_one(unit):
    ask = unit()
    assert ask("ROUT:SCAN (@101);SCAN:SIZE?;:SYST:ERR?") == f"+1;{NO_ERROR}"
    assert ask("SENS:TEMP:NPLC 10,(@101);NPLC? (@101)") == "+1.00000000E+01"


def test_the_queue_keeps_ten_errors_and_reports_that_it_was_full(unit):
    ask = unit()
    found = [ask(*["NONSENSE"] * 12, "SYST:ERR?"), *(ask("SYST:ERR?") for _ in range(9))]
    assert found == ['-113,"Undefined header"'] * 9 + ['-350,"Error queue overflow"']
    assert ask("NONSENSE", "*CLS", "SYST:ERR?") == NO_ERROR


def test_a_scan_reads_the_sensors_of_the_machine_in_its_units(unit):
    ask = unit(sensors="frame,ambient")
    first, second, open_ = map(float, ask("CONF:TEMP FRTD,85,(@101:103)", "READ?").split(","))
    machine = ask.device.world.machine
    truth = machine.temperatures([ask.device.world.time])[0]
    names = list(machine.temperature_sensors)
    assert first == pytest.approx(truth[names.index("frame")], abs=0.01)
    assert second == pytest.approx(truth[names.index("ambient")], abs=0.01)
    assert open_ == 9.9e37
    assert float(ask("UNIT:TEMP K,(@101)", "READ?").split(",")[0]) == pytest.approx(first + 273.15, abs=0.01)
    assert ask("READ?").split(",")[2] == "+9.90000000E+37"
    assert ask("FORM:READ:UNIT ON;CHAN ON", "FETC?").split(",")[1] == "101"


def test_a_foreign_client_reads_it(unit):
    pyvisa = pytest.importorskip("pyvisa", reason="the package pyvisa, another client, is not installed")
    pytest.importorskip("pyvisa_py", reason="the package pyvisa-py, another client, is not installed")
    device = SimulatedScpiUnit(parse_address("sim://cframe/visa?noise=0"))
    try:
        parts = urlsplit(device.url)
        manager = pyvisa.ResourceManager("@py")
        with manager.open_resource(
            f"TCPIP::{parts.hostname}::{parts.port}::SOCKET", read_termination="\r\n", write_termination="\n"
        ) as line:
            assert line.query("*IDN?").startswith("HEWLETT-PACKARD,34970A")
            line.write("CONF:TEMP TC,K,(@101:102)")
            assert all(-20 < value < 80 for value in line.query_ascii_values("READ?"))
            assert line.query("SYST:ERR?") == NO_ERROR
        manager.close()
    finally:
        device.close()
        simulators.reset()
