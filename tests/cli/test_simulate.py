"""``errormotion simulate``: a separate simulated device, for drivers and other clients."""

import json
import signal
import socket
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from coded import raises
from command_line import CliRunner
from forked_commands import Command, Commands

from errormotion import plugins
from errormotion.campaign.files import parse_bench
from errormotion.cli.app import app
from errormotion.cli.commands.instruments import simulate
from errormotion.cli.commands.plugins.listing import group_of
from errormotion.errors import InstrumentTimeoutError
from errormotion.instruments.line_profiler.keyence_ljx.driver import KeyenceLJX
from errormotion.instruments.thermometer.dcon import DconSettings, DconTemperature
from errormotion.instruments.thermometer.modbus_temperature import ModbusTemperature
from errormotion.instruments.transports import load_simulator, parse_address
from errormotion.plugins import get

WAIT = 60  # s


@pytest.fixture(scope="module")
def commands() -> Iterator[Commands]:
    # A shell that starts the tests in the background has SIGINT ignored, and so would its children.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        started = Commands()
    finally:
        signal.signal(signal.SIGINT, before)
    with started as commands:
        yield commands


@contextmanager
def device(commands: Commands, *arguments: Any) -> Iterator[tuple[Command, dict[str, Any]]]:
    """Start the command in a separate process; return its output."""
    process = commands.start("simulate", *arguments, "--json")
    with closing(process):
        try:
            text = ""
            while not text.rstrip().endswith("\n}"):
                line = process.stdout.readline()
                assert line, process.communicate(timeout=WAIT)[1]
                text += line
            yield process, json.loads(text)
        finally:
            process.send_signal(signal.SIGKILL)


def free_port(lines: int = 1) -> int:
    """Return a free port that is followed by as many more as further lines need."""
    while True:
        with ExitStack() as servers:
            first = int(servers.enter_context(socket.create_server(("127.0.0.1", 0))).getsockname()[1])
            with suppress(OSError, OverflowError):
                for further in range(1, lines):
                    servers.enter_context(socket.create_server(("127.0.0.1", first + further)))
                return first


def test_a_simulated_device_serves_several_clients_in_turn(commands: Commands) -> None:
    port = free_port()
    with device(commands, "dcon_temperature", "--port", port, "--set", "noise=0") as (process, printed):
        assert printed["url"] == f"tcp://127.0.0.1:{port}"
        readings = []
        for _ in range(3):
            with DconTemperature(printed["url"]) as thermometer:
                readings.append(thermometer.read())
                assert not thermometer.identify().simulated  # for its driver it is any device on the network
            with socket.create_connection(("127.0.0.1", port)) as line:
                line.sendall(b"#0")  # half a request, which the next client must not complete
        assert readings[0] == pytest.approx(readings[2], abs=0.1)
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=WAIT)
        assert process.returncode == 0
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", port), timeout=1.0)


def test_a_fault_is_one_of_the_device(commands: Commands) -> None:
    with device(commands, "dcon_temperature", "--fault", "silence", "--set", "fault_at=4") as (process, printed):
        with DconTemperature(printed["url"], DconSettings(timeout=0.3)) as thermometer:
            thermometer.read()
            with pytest.raises(InstrumentTimeoutError):
                thermometer.read()
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=WAIT)
        assert process.returncode == 0


def test_all_lines_of_a_device_are_printed(commands: Commands) -> None:
    port = free_port(lines=2)
    with device(commands, "keyence_ljx", "--port", port) as (_, printed):
        assert printed["url"] == f"tcp://127.0.0.1:{port}"
        assert printed["lines"] == {"stream": f"tcp://127.0.0.1:{port + 1}"}
        with KeyenceLJX(printed["address"]) as profiler:
            assert profiler.read().size > 0


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> Any:
    """Run the command without its wait."""
    monkeypatch.setattr(simulate, "_wait", lambda: None)
    return CliRunner().invoke(app, ["simulate", *arguments])


@pytest.mark.parametrize("wire", ["wire=tcp", "framing=rtu", "wire=pty"])
def test_the_printed_address_is_that_of_the_driver(monkeypatch: pytest.MonkeyPatch, wire: str) -> None:
    addresses, readings = [], []
    inner = simulate._driver_address
    monkeypatch.setattr(simulate, "_driver_address", lambda *given: addresses.append(inner(*given)) or addresses[-1])

    def read() -> None:
        with ModbusTemperature(addresses[0]) as thermometer:
            readings.append(thermometer.read())

    monkeypatch.setattr(simulate, "_wait", read)
    result = CliRunner().invoke(app, ["simulate", "modbus_temperature", "--set", wire])
    assert result.exit_code == 0
    assert result.stdout.startswith(f"modbus_temperature: {addresses[0]}\n")
    assert len(readings) == 1


def test_only_what_can_be_simulated_is_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    for wrong in ("nosuch", "tracker_table", "spindle_drift"):
        listed = run(monkeypatch, wrong).stderr.replace("\n", " ").partition("Known here: ")[2]
        assert {"dcon_temperature", "optoncdt", "offset_file"} <= set(listed.strip(". ").split(", "))
        for name in listed.strip(". ").split(", "):
            assert plugins.get(group_of(name), name).info.simulator


def test_a_bench_file_states_machine_and_device(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    bench = tmp_path / "bench.toml"
    bench.write_text(
        'schema = "errormotion.bench/1"\nname = "b"\nmachine = "cframe"\n\n[instruments.air]\n'
        'driver = "dcon_temperature"\naddress = "sim://gantry/air?seed=5&unit=7"\n'
    )
    result = run(monkeypatch, "dcon_temperature", "--bench", str(bench), "--seed", "6", "--json")
    address = parse_address(json.loads(result.stdout)["simulator"])
    assert (address.host, address.path) == ("gantry", "air")
    assert {name: address.params[name] for name in ("seed", "unit", "pace")} == {"seed": "6", "unit": "7", "pace": "1"}


def test_a_machine_that_accepts_offsets_states_the_settings_of_a_bench_file(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    shown = run(monkeypatch, "modbus_registers", "--set", "type=i16").stdout.splitlines()
    assert shown[0].startswith("modbus_registers: modbus+tcp://127.0.0.1:")
    head = 'schema = "errormotion.bench/1"\nname = "b"\nmachine = "m"\n[compensator]\ndriver = "modbus_registers"\n'
    address = shown[0].partition(" ")[2]
    text = "\n".join([f'{head}address = "{address}"', *[line for line in shown if " = " in line]])
    compensator = parse_bench(text, tmp_path / "bench.toml").compensator
    assert compensator is not None
    assert (compensator.settings.applied, compensator.settings.type) == ((4, 5, 6), "i16")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["tracker_table"], "has no simulator of its own"),
        (["spindle_drift"], "expected an instrument"),
        (["dcon_temperatur"], "did you mean"),
        (["dcon_temperature", "--fault", "rust"], "unknown fault"),
        (["dcon_temperature", "--set", "unit"], "expected KEY=VALUE"),
        (["dcon_temperature", "--host", "192.0.2.1"], "cannot listen at 192.0.2.1:0"),
        (["can_temperature"], "bus=udp_multicast"),
    ],
)
def test_instruments_without_simulator_are_an_error(
    monkeypatch: pytest.MonkeyPatch, arguments: list[str], message: str
) -> None:
    result = run(monkeypatch, *arguments)
    assert result.exit_code == 1
    assert message.lower() in result.stderr.lower()
    assert "Traceback" not in result.output


def test_a_port_in_use_is_an_error() -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        address = parse_address(f"sim://cframe/thermometer?port={port}")
        with raises("simulator.not_listening"):
            load_simulator(get("instruments", "dcon_temperature").info.simulator, address.url)(address)


def test_a_separate_device_continues_after_a_request_it_cannot_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    name = get("instruments", "dcon_temperature").info.simulator
    module, _, cls = name.partition(":")
    monkeypatch.setattr(f"{module}.{cls}.answer", lambda self, request: 1 / 0)
    address = parse_address(f"sim://cframe/thermometer?port={free_port()}")
    device = load_simulator(name, address.url)(address)
    try:
        for _ in range(2):
            with socket.create_connection(("127.0.0.1", int(address.params["port"])), timeout=WAIT) as line:
                line.sendall(b"#01\r")
                assert line.recv(10) == b""
    finally:
        device.close()
