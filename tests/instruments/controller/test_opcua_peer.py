"""Another implementation of OPC UA, with the published model for CNC systems: node-opcua, from npm."""

import shutil
import socket
import subprocess
from pathlib import Path

import pytest

from errormotion.instruments.controller.opcua import OpcUa, OpcUaSettings

PEERS = Path(__file__).parents[2] / "peers"
INSTALLED = (PEERS / "node_modules" / "node-opcua-server").is_dir() and shutil.which("node")

pytestmark = pytest.mark.skipif(not INSTALLED, reason="needs Node.js and 'npm ci --prefix tests/peers'")


@pytest.fixture(scope="module", autouse=True)
def server():
    """The address of a server in a separate process."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    process = subprocess.Popen(
        ["node", PEERS / "cnc_server.mjs", str(port)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    shown = []
    for line in process.stdout:
        shown.append(line)
        if line == "up\n":
            break
    else:
        raise AssertionError("".join(shown))
    yield f"opc.tcp://127.0.0.1:{port}"
    process.stdin.close()
    process.wait(20)
    process.stdout.close()


def test_the_published_model_is_read_with_its_units(server):
    with OpcUa(server, OpcUaSettings(timeout=20.0)) as cnc:
        identity, state = cnc.identify(), cnc.state()
    assert (identity.manufacturer, identity.model, identity.firmware) == ("node-opcua", "CNC of a test", "1.0")
    assert state["position"] == pytest.approx([0.10025, 0.10125, 0.10225])
    assert state["commanded_position"] == pytest.approx([0.100, 0.101, 0.102])
    assert (state["spindle_speed"], state["spindle_load"]) == pytest.approx((4500, 0.125))
    assert state["feed"] == pytest.approx(0.01)
    assert (state["mode"], state["program"], state["running"]) == ("mdi", "TEST.NC", True)
    assert state["unavailable"] == ["estop"]


@pytest.mark.slow
def test_two_sessions_one_after_the_other(server):
    found = []
    for _ in range(2):
        with OpcUa(server, OpcUaSettings(timeout=20.0)) as cnc:
            found.append(cnc.state()["position"])
    assert found[0] == found[1]
