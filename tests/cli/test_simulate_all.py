"""Every simulated device in a separate process on a stated port: its driver connects and reads."""

import contextlib
import json
import os
import random
import signal
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from forked_commands import Commands

from errormotion import plugins
from errormotion.campaign.files import load_bench
from errormotion.errors import InstrumentTimeoutError
from errormotion.instruments.simulators.controller import linuxcnc_process
from errormotion.plugins import Touch
from errormotion.testing.sessions import numbers

pytestmark = pytest.mark.slow

WAIT = 60  # s
ROOM = 600  # s; a computer has room for one LinuxCNC, and other tests use it
MAX_LINES = 4


def first_reading(instrument: Any) -> None:
    """Take one reading, of finite numbers."""
    found = numbers(instrument.read())
    assert len(found) > 0
    assert np.isfinite(found).any()


def no_line_without_a_program(instrument: Any) -> None:
    """A printer port sends nothing while no program prints."""
    with pytest.raises(InstrumentTimeoutError):
        next(instrument.measure([Touch((0.0, 0.0, 0.0), (1e-3, 0.0, 0.0))]))


@dataclass(frozen=True)
class Case:
    """Address of a device that another process simulates."""

    arguments: tuple[str, ...] = ()
    settings: str = ""
    read: Callable[[Any], None] = first_reading
    lines: int = 0


CASES = {
    "attocube_ids": Case(),
    "can_temperature": Case(("--set", "bus=udp_multicast"), settings="timeout = '5 s'"),
    "capancdt": Case(lines=1),
    "confocaldt": Case(lines=1),
    "controller_probe": Case(),
    "dcon_temperature": Case(),
    "dprnt": Case(settings="start_timeout = '0.3 s'", read=no_line_without_a_program),
    "five_sensor_frame": Case(lines=4),
    "keyence_ljx": Case(lines=1),
    "keyence_lk": Case(),
    "leica_emscon": Case(),
    # the simulated machine takes any token
    "linuxcnc": Case(("--set", f"wait={ROOM:g}"), settings="token_file = 'token'"),
    "modbus_temperature": Case(),
    "mtconnect": Case(),
    "leica_geocom": Case(),
    "opcua": Case(),
    "optoncdt": Case(),
    "scpi_temperature": Case(),
    "shdr": Case(),
    "virtual_controller": Case(),
}


def free_port() -> int:
    """Return the first of several free ports outside the range of ephemeral ports."""
    while True:
        port = random.randrange(10_000, 32_000)
        with contextlib.suppress(OSError), contextlib.ExitStack() as stack:
            for number in range(MAX_LINES + 1):
                stack.enter_context(socket.create_server(("127.0.0.1", port + number)))
            return port


@pytest.fixture(scope="module")
def commands() -> Iterator[Commands]:
    with Commands() as commands:
        yield commands


@contextmanager
def simulated(commands: Commands, plugin_id: str, *arguments: str) -> Iterator[tuple[dict[str, Any], int]]:
    """Start a device; yield its output and its port. It must end at SIGTERM and leave no process."""
    port = free_port()
    process = commands.start("simulate", plugin_id, "--port", port, *arguments, "--json")
    with contextlib.closing(process):
        try:
            text = ""
            while not text.rstrip().endswith("\n}"):
                line = process.stdout.readline()
                assert line, process.communicate(timeout=WAIT)[1]
                text += line
            printed = json.loads(text)
            assert printed["ok"], printed
            yield printed, port
            process.send_signal(signal.SIGTERM)
            rest, complaints = process.communicate(timeout=WAIT)
            assert (process.returncode, rest) == (0, "")
            assert "Traceback" not in complaints
        finally:
            process.send_signal(signal.SIGKILL)
    assert nobody_left_of(process.pid)
    with socket.create_server(("127.0.0.1", port)):  # the port is free again
        pass


def nobody_left_of(session: int) -> bool:
    """Return whether all processes of a session have ended."""
    until = time.monotonic() + 10.0
    while members := [pid for pid in map(int, filter(str.isdigit, os.listdir("/proc"))) if session_of(pid) == session]:
        if time.monotonic() > until:
            raise AssertionError([Path(f"/proc/{pid}/cmdline").read_text() for pid in members])
        time.sleep(0.05)
    return True


def session_of(pid: int) -> int:
    """Return the session of a process; 0 if it has ended."""
    try:
        return os.getsid(pid)
    except OSError:
        return 0


def test_every_simulated_instrument_is_listed() -> None:
    ours = [each for each in plugins.available("instruments") if each.distribution.startswith("errormotion ")]
    simulated = {each.id for each in ours if plugins.get("instruments", each.id).info.simulator}
    assert simulated == set(CASES)


@pytest.mark.timeout(2 * WAIT + ROOM)
@pytest.mark.parametrize("plugin_id", CASES)
def test_a_bench_with_the_printed_address_reads_a_device_in_another_process(
    plugin_id: str, commands: Commands, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "token").write_text("x" * 64)
    (tmp_path / "token").chmod(0o600)
    if plugin_id == "linuxcnc" and (reason := linuxcnc_process.why_not()):
        pytest.skip(reason)
    case = CASES[plugin_id]
    with simulated(commands, plugin_id, *case.arguments) as (printed, port):
        assert str(port) in printed["url"]
        assert [url.rpartition(":")[2] for url in printed["lines"].values()] == [
            str(port + number) for number in range(1, case.lines + 1)
        ]
        bench = tmp_path / "bench.toml"
        bench.write_text(
            'schema = "errormotion.bench/1"\nname = "b"\nmachine = "cframe"\n\n[instruments.device]\n'
            f"driver = '{plugin_id}'\naddress = '{printed['address']}'\n{case.settings}\n"
        )
        (device,) = load_bench(bench).instruments
        for _ in range(2):  # the device outlives its clients
            with device.driver(device.address, device.settings) as instrument:
                assert not instrument.identify().simulated
                case.read(instrument)
