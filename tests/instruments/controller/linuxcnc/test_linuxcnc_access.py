"""The bridge as a separate process, and access to it, with a fake LinuxCNC."""

import http.client
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from coded import raises

from errormotion.errors import InstrumentError
from errormotion.instruments.compensator.linuxcnc import LinuxCNCCompensatorSettings, LinuxCNCOffset
from errormotion.instruments.controller.linuxcnc import BRIDGE, LinuxCNC, LinuxCNCSettings
from errormotion.instruments.controller.linuxcnc.codec import decode_welcome, encode_request, parts_of
from errormotion.instruments.controller.linuxcnc.driver import client_name

LINUXCNC = """
import os
from linuxcnc_fakes import FakeLinuxCNC
made = FakeLinuxCNC()
class Command:
    serial = 0
    def __getattr__(self, name):
        def command(*arguments):
            self.serial += 1
            with open(os.environ["COMMANDS"], "a") as file:
                print(name, *arguments, file=file)
        return command
def command(): return Command()
stat, error_channel, ini, version = made.stat, made.error_channel, made.ini, made.version
for name in dir(FakeLinuxCNC):
    if name.isupper():
        globals()[name] = getattr(FakeLinuxCNC, name)
made.values.echo_serial_number = 1 << 30
"""
HAL = """
from types import SimpleNamespace
from linuxcnc_fakes import FakeHAL
def component(name): return SimpleNamespace(ready=lambda: None)
_hal = FakeHAL()
get_value, pin_has_writer, set_p = _hal.get_value, _hal.pin_has_writer, _hal.set_p
"""
Start = Callable[..., dict[str, Any]]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Return a function that starts a bridge in a separate home folder and returns its announcement."""
    (tmp_path / "linuxcnc.py").write_text(LINUXCNC)
    (tmp_path / "hal.py").write_text(HAL)
    started: list[subprocess.Popen[bytes]] = []

    def begin(*words: str) -> dict[str, Any]:
        reported = tmp_path / "announced.json"
        path = os.pathsep.join([str(tmp_path), *sys.path])
        environment = {**os.environ, "HOME": str(tmp_path), "PYTHONPATH": path, "COMMANDS": str(tmp_path / "commands")}
        started.append(
            subprocess.Popen([sys.executable, str(BRIDGE), "--announce", str(reported), *words], env=environment)
        )
        until = time.monotonic() + 20
        while not reported.exists():
            assert started[-1].poll() is None
            assert time.monotonic() < until
            time.sleep(0.02)
        return dict(json.loads(reported.read_text()))

    yield begin
    for process in started:
        process.terminate()
        assert process.wait(10) == 0
    assert not (tmp_path / ".errormotion" / "linuxcnc.sock").exists()


def commands(folder: Path) -> list[str]:
    """Return what was sent to LinuxCNC."""
    path = folder / "commands"
    return path.read_text().splitlines() if path.exists() else []


def closed_without_answer(line: socket.socket) -> bool:
    """Return whether the other end closes without sending anything."""
    line.settimeout(10)
    try:
        return line.recv(100) == b""
    except ConnectionResetError:
        return True


def test_by_default_it_listens_on_a_socket_of_its_user(start: Start, tmp_path: Path) -> None:
    reported = start()
    path = tmp_path / ".errormotion" / "linuxcnc.sock"
    assert reported["socket"] == str(path)
    assert path.stat().st_mode & 0o777 == 0o600
    listening = [line.split() for line in Path(f"/proc/{reported['pid']}/net/tcp").read_text().splitlines()[1:]]
    inodes = {
        link.removeprefix("socket:[").removesuffix("]")
        for each in Path(f"/proc/{reported['pid']}/fd").iterdir()
        if (link := os.readlink(each)).startswith("socket:")
    }
    assert not [row for row in listening if row[9] in inodes]  # no TCP unless requested
    settings = LinuxCNCSettings(token_file=tmp_path / ".errormotion" / "linuxcnc.token")
    with LinuxCNC(f"unix://{path}", settings) as machine:
        assert machine.state()["enabled"]
        with pytest.raises(InstrumentError, match="arm = true"):
            machine.move_to([0.0, 0.0, 0.0])
    assert commands(tmp_path) == []


def test_a_web_page_gets_no_answer_and_moves_nothing(start: Start, tmp_path: Path) -> None:
    port = start("--port", "0")["port"]
    body = b"".join(encode_request(k, op, {}) for k, op in enumerate(("reset", "enable", "home")))
    for method, content in (("POST", body), ("GET", b""), ("OPTIONS", b"")):
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
        connection.connect()
        with suppress(ConnectionError):  # closed already while it is sent
            connection.request(method, "/", content)
        with pytest.raises((http.client.HTTPException, OSError)):
            connection.getresponse()
    with socket.create_connection(("127.0.0.1", port)) as line:
        line.sendall(b"G")
        assert closed_without_answer(line)
    with socket.create_connection(("127.0.0.1", port)) as line:
        line.sendall(body)
        line.settimeout(10)
        assert b"expected 'hello'" in line.recv(1000)
        assert closed_without_answer(line)
    assert commands(tmp_path) == []


def test_one_process_controls_and_loses_control_with_its_connection(start: Start, tmp_path: Path) -> None:
    port = start("--port", "0")["port"]
    token = tmp_path / ".errormotion" / "linuxcnc.token"
    armed = LinuxCNCSettings(token_file=token, arm=True)
    with socket.create_connection(("127.0.0.1", port)) as line:
        hello = {"token": token.read_text().strip(), "control": True, "client": "another"}
        line.sendall(encode_request(0, "hello", hello))
        assert b'"control": true' in line.recv(1000)
        with raises("linuxcnc.controlled_by_other"):
            LinuxCNC(f"tcp://127.0.0.1:{port}", armed).open()
    with LinuxCNC(f"tcp://127.0.0.1:{port}", armed) as machine:
        machine.enable()
    assert commands(tmp_path) == ["state 4"]


def test_a_token_that_others_can_read_is_not_used(start: Start, tmp_path: Path) -> None:
    port = start("--port", "0")["port"]
    token = tmp_path / ".errormotion" / "linuxcnc.token"
    for mode in (0o644, 0o640, 0o604):
        token.chmod(mode)
        with pytest.raises(InstrumentError, match=f"only this user can read; found the mode 0{mode:o}"):
            LinuxCNC(f"tcp://127.0.0.1:{port}", LinuxCNCSettings(token_file=token)).open()
    again = subprocess.run([sys.executable, BRIDGE], env={"HOME": str(tmp_path)}, capture_output=True, check=False)
    assert again.returncode == 1
    assert b"no other user can read" in again.stderr


def test_without_a_token_the_message_states_the_remedy(start: Start, tmp_path: Path) -> None:
    port = start("--port", "0")["port"]
    with pytest.raises(InstrumentError, match=r"expected the token.*Copy this file.*'token_file'"):
        LinuxCNC(f"tcp://127.0.0.1:{port}", LinuxCNCSettings(token_file=tmp_path / "none")).open()
    wrong = tmp_path / "wrong"
    wrong.write_text("x" * 64)
    wrong.chmod(0o600)
    with pytest.raises(InstrumentError, match=r"the token is not valid for this bridge.*Copy this file"):
        LinuxCNC(f"tcp://127.0.0.1:{port}", LinuxCNCSettings(token_file=wrong)).open()


def test_the_token_is_in_no_recording(start: Start, tmp_path: Path) -> None:
    path = start()["socket"]
    token = tmp_path / ".errormotion" / "linuxcnc.token"
    record = tmp_path / "session.rec"
    with LinuxCNC(f"unix://{path}", LinuxCNCSettings(token_file=token), record=record) as machine:
        state = machine.state()
    assert token.read_text().strip().encode().hex() not in record.read_text()
    with LinuxCNC(f"replay://{record}") as machine:
        assert machine.state()["position"] == state["position"]


def test_no_secret_is_in_the_recording_of_a_compensator(start: Start, tmp_path: Path) -> None:
    path = start("--compensate")["socket"]
    token = tmp_path / ".errormotion" / "linuxcnc.token"
    record = tmp_path / "session.rec"
    with LinuxCNCOffset(f"unix://{path}", LinuxCNCCompensatorSettings(token_file=token), record=record) as compensator:
        identity = compensator.identify()
    written = record.read_text()
    assert token.read_text().strip().encode().hex() not in written
    assert b"hello".hex() not in written
    with LinuxCNCOffset(f"replay://{record}") as compensator:
        assert compensator.identify().firmware == identity.firmware


def test_a_driver_replaces_its_lost_connection_and_no_namesake_does(start: Start, tmp_path: Path) -> None:
    port = start("--port", "0")["port"]
    token = tmp_path / ".errormotion" / "linuxcnc.token"
    armed = LinuxCNCSettings(token_file=token, arm=True, timeout=5.0)
    with LinuxCNC(f"tcp://127.0.0.1:{port}", armed) as machine:
        machine.enable()
        reader = LinuxCNC(f"tcp://127.0.0.1:{port}", LinuxCNCSettings(token_file=token))
        with reader, socket.create_connection(("127.0.0.1", port)) as line:
            answers = line.makefile("rb")
            for name in (client_name(), "", "another"):
                hello = {"token": token.read_text().strip(), "control": True, "client": name, "secret": "0" * 64}
                line.sendall(encode_request(0, "hello", hello))
                assert json.loads(answers.readline())["result"]["control"] is False
            kept = machine.transport  # open: the bridge does not notice the cut
            machine._lost, machine._transport = True, None
            machine._reconnect()
            machine.enable()
            line.sendall(encode_request(0, "hello", hello))
            assert json.loads(answers.readline())["result"]["control"] is False
            kept.close()
    assert commands(tmp_path) == ["state 4"] * 2


def test_an_earlier_bridge_is_named_as_such() -> None:
    with raises("protocol.linuxcnc.version"):
        decode_welcome({"protocol": 1, "control": True, "controlled_by": None})


def test_a_program_is_sent_in_parts_that_fit_a_line() -> None:
    text = "é" * 20000 + "\U0001f600" * 20000  # six and twelve bytes a character in JSON
    assert "".join(parts_of(text)) == text
    assert parts_of("") == [""]
    for part in parts_of(text):
        encode_request(1, "program_part", {"text": part})
    with raises("request.too_long"):
        encode_request(1, "run_program", {"text": "x" * 65536})
