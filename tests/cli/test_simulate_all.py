"""Every simulated device by itself, on a stated port, in a process of its own: its driver connects to it and reads."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from errormotion import plugins
from errormotion.errors import InstrumentTimeoutError
from errormotion.instruments.simulators.controller import linuxcnc_process
from errormotion.plugins import Touch
from errormotion.testing.sessions import numbers

pytestmark = pytest.mark.slow

WAIT = 60  # s


def first_reading(instrument: Any) -> None:
    """Take one reading, of finite numbers."""
    found = numbers(instrument.read())
    assert len(found) > 0
    assert np.isfinite(found).any()


def no_line_without_a_program(instrument: Any) -> None:
    """A printer port is silent while no program prints."""
    with pytest.raises(InstrumentTimeoutError):
        next(instrument.measure([Touch((0.0, 0.0, 0.0), (1e-3, 0.0, 0.0))]))


@dataclass(frozen=True)
class Case:
    """How a driver reaches a device that another process simulates."""

    arguments: tuple[str, ...] = ()
    url: Callable[[dict[str, Any], int], str] = lambda printed, port: printed["url"]
    settings: dict[str, Any] = field(default_factory=dict)
    read: Callable[[Any], None] = first_reading
    driver: str = ""


def on_two_ports(printed: dict[str, Any], port: int) -> str:
    """A second line listens at the next port."""
    (name,) = printed["lines"]
    assert printed["lines"][name] == f"tcp://127.0.0.1:{port + 1}"
    return f"{printed['url']}?{name}={port + 1}"


CASES = {
    "can_temperature": Case(("--set", "bus=udp_multicast"), settings={"timeout": 5.0}),
    "capancdt": Case(url=on_two_ports),
    "confocaldt": Case(url=on_two_ports),
    "controller_probe": Case(),
    "dcon_temperature": Case(),
    "dprnt": Case(settings={"start_timeout": 0.3}, read=no_line_without_a_program),
    "five_sensor_frame": Case(driver="optoncdt"),  # one sensor: five processes share no clock
    "keyence_ljx": Case(url=on_two_ports),
    "keyence_lk": Case(),
    "leica_emscon": Case(),
    # a computer has room for one; the simulated machine takes any token
    "linuxcnc": Case(("--set", "wait=60"), settings={"token_file": "token"}),
    "modbus_temperature": Case(url=lambda printed, port: f"modbus+tcp://127.0.0.1:{port}?unit=1"),
    "mtconnect": Case(url=lambda printed, port: f"http://127.0.0.1:{port}/"),
    "leica_geocom": Case(),
    "opcua": Case(),
    "optoncdt": Case(),
    "scpi_temperature": Case(),
    "shdr": Case(),
    "virtual_controller": Case(),
}


def free_port() -> int:
    """Return a port that is free, and the next one too."""
    while True:
        with socket.create_server(("127.0.0.1", 0)) as server:
            port = int(server.getsockname()[1])
            with contextlib.suppress(OSError, OverflowError), socket.create_server(("127.0.0.1", port + 1)):
                return port


@contextmanager
def simulated(plugin_id: str, *arguments: str) -> Iterator[tuple[dict[str, Any], int]]:
    """Start a device; yield what was printed and its port. It must end at SIGTERM and leave nothing."""
    port = free_port()
    command = [sys.executable, "-m", "errormotion", "simulate", plugin_id, "--port", str(port), *arguments, "--json"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        assert process.stdout is not None
        try:
            text = ""
            while not text.rstrip().endswith("\n}"):
                line = process.stdout.readline()
                assert line, process.communicate(timeout=WAIT)[1]
                text += line
            yield json.loads(text), port
            process.send_signal(signal.SIGTERM)
            rest, complaints = process.communicate(timeout=WAIT)
            assert (process.returncode, rest) == (0, "")
            assert "Traceback" not in complaints
        finally:
            process.kill()
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
    """Return the session of a process; 0 where it has ended."""
    try:
        return os.getsid(pid)
    except OSError:
        return 0


def test_every_simulated_instrument_is_here() -> None:
    ours = [each for each in plugins.available("instruments") if each.distribution.startswith("errormotion ")]
    simulated = {each.id for each in ours if plugins.get("instruments", each.id).info.simulator}
    assert simulated == set(CASES)


@pytest.mark.parametrize("plugin_id", CASES)
def test_a_driver_reads_a_device_in_another_process(
    plugin_id: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "token").write_text("x" * 64)
    (tmp_path / "token").chmod(0o600)
    if plugin_id == "linuxcnc" and (reason := linuxcnc_process.why_not()):
        pytest.skip(reason)
    case = CASES[plugin_id]
    driver = plugins.get("instruments", case.driver or plugin_id)
    with simulated(plugin_id, *case.arguments) as (printed, port):
        assert str(port) in printed["url"]
        url = case.url(printed, port)
        for _ in range(2):  # the device outlives its clients
            with driver(url, driver.Settings(**case.settings)) as instrument:
                assert not instrument.identify().simulated
                case.read(instrument)
