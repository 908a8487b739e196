"""The simulated DCON module: the manufacturers' documented dialogues, its grammar, other units of the bus, faults."""

import socket
import time
from urllib.parse import urlsplit

import pytest
from hypothesis import given
from hypothesis import strategies as st
from wire_vectors import Vector, vectors

from errormotion.errors import InstrumentError
from errormotion.instruments import simulators
from errormotion.instruments.simulators.thermometer.dcon import MAX_LINE, SimulatedDcon
from errormotion.instruments.simulators.thermometer.dcon_module import SPANS, Module, format_reading, sum_of_characters
from errormotion.instruments.transports import parse_address

DEVICE = "dcon_temperature"
QUIET = 0.1  # s, longer than the answer time of a module


class Bench:
    """A module with known inputs and a clock that is set."""

    def __init__(self, **settings):
        self.time = 0.0
        self.inputs = [20.0, 21.5, float("nan"), -3.25]
        self.module = Module(lambda: self.inputs, lambda: self.time, lambda: 25.4, **settings)

    def ask(self, line):
        return self.module.answer(line.encode("latin-1"))


# ------------------------------------------------------------------ documented dialogues


@pytest.mark.parametrize("vector", vectors(DEVICE, "dialogue"), ids=str)
def test_documented_dialogues(vector: Vector) -> None:
    bench = Bench(**vector.expected.get("settings", {}))
    for line in vector.expected.get("before", []):
        if line.startswith("wait"):
            bench.time += float(line.split()[1])
        else:
            assert bench.ask(line.rstrip("\r")) == "!01"
    assert bench.ask(vector.data.decode().rstrip("\r")) == vector.expected["answer"].rstrip("\r")


@pytest.mark.parametrize("vector", vectors(DEVICE, "written"), ids=str)
def test_documented_readings(vector: Vector) -> None:
    expected = dict(vector.expected)
    span = SPANS[expected["model"]][expected["type_code"]]
    assert format_reading(expected["value"], span, expected["form"], expected["model"]) == vector.data.decode()


@pytest.mark.parametrize("vector", vectors(DEVICE, "checked line"), ids=str)
def test_documented_checksums(vector: Vector) -> None:
    line = vector.data.decode().rstrip("\r")
    assert sum_of_characters(line[:-2]) == line[-2:]


def test_the_reading_follows_the_cold_junction_offset():
    bench = Bench()
    assert bench.ask("#010") == ">+020.00"
    assert bench.ask("$019+0010") == "!01"
    assert (bench.ask("#010"), bench.ask("$013")) == (">+020.16", ">+0025.6")
    assert bench.ask("$019-0010") == "!01"
    assert bench.ask("#010") == ">+019.84"


# ------------------------------------------------------------------ grammar


@pytest.mark.parametrize(
    "line",
    [
        "",
        "#",
        "#0",
        "#1",
        "$01",
        "~01",
        " #01",
        "\n#01",
        "#0100",
        "#0184",  # the checksum is not enabled
        "$0155",
        "$01555A",
        "$01MM",
        "$019+001",
        "%01020506",
        "%010205060000",
        "~013",
        "$01m",
        "$01f",
        "$015a5",
        "&01M",
        "!01",
        ">+020.00",
        "01M",
        "$0xM",
        "$0\xffM",
        "\xff\xfe\x00",
        "#**",
        "~**",
    ],
)
def test_a_syntax_error_has_no_answer(line):
    assert Bench().ask(line) is None


@pytest.mark.parametrize("line", ["#02", "#020", "$02M", "$022", "%0202100600", "~020", "#0A"])
def test_another_address_has_no_answer(line):
    bench = Bench()
    assert bench.ask(line) is None
    assert bench.ask("$012") == "!01100600"


def test_lower_case_addresses_are_not_understood():
    assert Bench(address=0xAB).ask("#AB0") == ">+020.00"
    assert Bench(address=0xAB).ask("#ab0") is None


@pytest.mark.parametrize(
    "line",
    [
        "#018",
        "#01A",
        "#01 ",
        "$010",  # calibration is not enabled
        "$011",
        "$014",  # of the I-7011 only
        "$018",
        "$01B",
        "$01Q",
        "@01DI",
        "@01RH",
        "~01Q",
        "~01E1",
        "$015G0",
        "$019+1001",
        "$019 0010",
        "~013264",
        "~013100",
        "~0131G4",
        "~01O",
        "~01O7018XYZ",
        "%0102170600",  # no such type
        "%0102100200",  # no such baud rate
        "%0102100B00",
        "%0102100603",  # no such format
        "%0102100604",  # reserved bits
        "%0102100700",  # baud rate, INIT* is open
        "%0102100640",  # checksum, INIT* is open
        "%01021006GG",
    ],
)
def test_invalid_commands_are_refused_and_have_no_effect(line):
    bench = Bench()
    before = [bench.ask(each) for each in ("$012", "$016", "$01M", "$013", "~010", "~012")]
    assert bench.ask(line) == "?01"
    assert [bench.ask(each) for each in ("$012", "$016", "$01M", "$013", "~010", "~012")] == before


def test_an_adam_has_no_commands_of_icp_das_and_no_other_format():
    bench = Bench(model="4018")
    assert bench.ask("~010") == "?01"
    assert bench.ask("%0101100602") == "?01"
    assert bench.ask("$01M") == "!014018"


def test_formats_and_disabled_channels():
    bench = Bench(enabled=0x0F)
    assert bench.ask("#01") == ">+020.00+021.50+9999.9-003.25" + " " * 28
    assert bench.ask("%0101100601") == "!01"
    assert bench.ask("#01") == ">+005.00+005.38+999.99-000.81" + " " * 28
    assert bench.ask("%0101100682") == "!01"
    assert bench.ask("#01") == ">066606E17FFFFEF6" + " " * 16
    assert bench.ask("$01500") == "!01"
    assert bench.ask("#01") == ">" + " " * 32
    assert bench.ask("#010") == ">0666"  # a single channel is read even if it is disabled


def test_a_wrong_or_missing_checksum_has_no_answer():
    bench = Bench(form=0x40)
    assert bench.ask("#010" + sum_of_characters("#010")) == ">+020.00" + sum_of_characters(">+020.00")
    for line in ("#010", "#01000", "#010" + sum_of_characters("#010").lower(), "", "B", "B7", "#010B5 "):
        assert bench.ask(line) is None
    assert bench.ask("#019" + sum_of_characters("#019")) == "?01" + sum_of_characters("?01")


def test_init_identifies_a_module_and_permits_changes_of_its_line():
    bench = Bench(address=7, form=0x40, grounded=True)
    assert bench.ask("#070") is None
    assert bench.ask("#000") == ">+020.00"
    assert bench.ask("%0009100A00") == "!09"
    assert (bench.ask("$092"), bench.ask("$002")) == (None, "!09100A00")  # until the next power on


def test_the_new_address_applies_immediately():
    bench = Bench()
    assert bench.ask("%01021006 0") == "?01"
    assert bench.ask("%01FF100600") == "!FF"
    assert (bench.ask("$01M"), bench.ask("$FFM")) == (None, "!FF7018")


def test_host_ok_prevents_the_watchdog_timeout():
    bench = Bench()
    assert bench.ask("~013101") == "!01"
    assert bench.ask("~010") == "!0180"
    for _ in range(5):
        bench.time += 0.08
        assert bench.ask("~**") is None
    assert bench.ask("~010") == "!0180"
    bench.time += 0.08
    assert bench.ask("#010") == ">+020.00"  # other requests do not reset the watchdog
    bench.time += 0.08
    assert bench.ask("~010") == "!0104"
    assert bench.ask("~**") is None
    assert bench.ask("~010") == "!0104"  # stored until it is reset


def test_millivolts_come_from_the_temperature_above_the_terminals():
    bench = Bench(type_code=0x01)
    bench.inputs = [125.4]
    assert bench.ask("#010") == ">+04.060"


@given(st.binary(max_size=40))
def test_any_line_is_silence_or_an_answer(line):
    answer = Bench().module.answer(line)
    assert answer is None or answer[0] in "!?>"


@given(st.text("#$%~@*0123456789ABCDEFMO+-", max_size=12), st.booleans())
def test_lines_of_the_alphabet_are_silence_or_an_answer(line, checked):
    bench = Bench(form=0x40 * checked)
    answer = bench.ask(line + (sum_of_characters(line) if checked else ""))
    if answer is not None:
        assert answer[0] in "!?>"
        assert line[1:3] == "01"
        assert not checked or sum_of_characters(answer[:-2]) == answer[-2:]


# ------------------------------------------------------------------ on its line


@pytest.fixture
def module():
    """Open a module; return a function that sends a request."""
    made = []

    def module(**params):
        query = "&".join(f"{name}={value}" for name, value in {"noise": 0, **params}.items())
        device = SimulatedDcon(parse_address(f"sim://cframe/thermometer?{query}"))
        parts = urlsplit(device.url)
        line = socket.create_connection((parts.hostname, parts.port), timeout=5)
        made.append((device, line))

        def ask(data):
            line.sendall(data)
            found = b""
            line.settimeout(5)
            while not found.endswith(b"\r"):
                found += line.recv(4096)
            return found

        def silent(data):
            line.sendall(data)
            line.settimeout(QUIET)
            try:
                return line.recv(4096)
            except TimeoutError:
                return b""

        ask.device, ask.silent = device, silent
        return ask

    yield module
    for device, line in made:
        line.close()
        device.close()
    simulators.reset()


def test_readings_are_the_temperatures_of_the_machine(module):
    ask = module(sensors="frame,ambient", open="1")
    world = ask.device.world
    truth = world.machine.temperatures([world.time])[0, world.machine.temperature_sensors.index("frame")]
    answer = ask(b"#01\r").decode()
    assert float(answer[1:8]) == pytest.approx(truth, abs=0.005)
    assert answer[8:] == "+9999.9" + " " * 42 + "\r"
    assert ask(b"$016\r") == b"!0103\r"


def test_only_the_addressed_unit_answers(module):
    ask = module(unit=5)
    assert ask.silent(b"#01\r$01M\r#0500\r$05m\r") == b""
    assert ask(b"$05M\r") == b"!057018\r"


def test_requests_may_be_split_or_joined(module):
    ask = module()
    assert ask.silent(b"$0") == b""
    assert ask(b"1M\r") == b"!017018\r"
    both = ask(b"$01M\r$012\r")
    assert both + (ask(b"") if both.count(b"\r") == 1 else b"") == b"!017018\r!01100600\r"


def test_a_line_without_end_is_bounded(module):
    ask = module()
    assert ask.silent(b"#01" * MAX_LINE) == b""
    assert len(ask.device._buffer) <= MAX_LINE
    assert ask.silent(b"#01\r") == b""  # still the same line
    assert ask(b"$01M\r") == b"!017018\r"


def test_the_checksum_fault_only_changes_the_sum(module):
    ask = module(checksum=1, fault="checksum")
    answer = ask(b"$01M" + sum_of_characters("$01M").encode() + b"\r").decode().rstrip("\r")
    assert answer[:-2] == "!017018"
    assert answer[-2:] != sum_of_characters(answer[:-2])


def test_a_late_answer_precedes_the_next_one(module):
    ask = module(fault="late", fault_at=1)
    assert ask(b"$01M\r") == b"!017018\r"
    assert ask.silent(b"$012\r") == b""
    answer = ask(b"$01M\r")
    time.sleep(QUIET)
    assert (answer + ask.silent(b"")) == b"!01100600\r!017018\r"


def test_silence_is_not_counted_as_an_answer(module):
    ask = module(fault="late", fault_at=0)
    assert ask.silent(b"#02\r") == b""
    assert ask.silent(b"$01M\r") == b""
    assert ask(b"$012\r")[:8] == b"!017018\r"


@pytest.mark.parametrize(
    "params", ["model=7017", "format=ohm", "model=4018&format=percent", "type=23", "type=21&model=4018", "unit=256"]
)
def test_parameters_that_no_module_has_are_refused(params):
    with pytest.raises(InstrumentError, match=params.partition("=")[0]):
        SimulatedDcon(parse_address(f"sim://cframe/thermometer?{params}"))
