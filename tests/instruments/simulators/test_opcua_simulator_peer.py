"""The simulated OPC UA server, with another implementation as its client: node-opcua, from npm."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from errormotion.instruments.simulators.controller.opcua import SimulatedServer
from errormotion.instruments.transports import parse_address

PEERS = Path(__file__).parents[2] / "peers"
INSTALLED = (PEERS / "node_modules" / "node-opcua-client").is_dir() and shutil.which("node")

pytestmark = pytest.mark.skipif(not INSTALLED, reason="needs Node.js and 'npm ci --prefix tests/peers'")

CHANNEL, SPINDLE = "CncInterface/CncChannelList/Channel1", "CncInterface/CncSpindleList/S1"


@pytest.mark.slow
def test_a_foreign_client_finds_the_model_reads_it_and_writes_nothing():
    paths = {
        "CncInterface/VendorName": "errormotion",
        "CncInterface/CncAxisList/X/PosDirect/ActPos": 10.0,
        "CncInterface/CncAxisList/X/PosDirect/EngineeringUnits": {"code": 5066068, "unit": "mm"},
        "CncInterface/CncAxisList/X/IsReferenced": True,
        f"{SPINDLE}/ActSpeed": 3000.0,
        f"{SPINDLE}/ActStatus": 1,
        f"{CHANNEL}/ActOperationMode": 1,
        f"{CHANNEL}/ActProgramName": "",
    }
    device = SimulatedServer(parse_address("sim://cframe/opcua?seed=3"))
    try:
        device.world.move_to([0.010, 0.0, 0.0], 0.05)
        device.world.spindle(3000.0)
        device.world.elapse(60.0)
        answer = subprocess.run(
            ["node", PEERS / "cnc_client.mjs", device.url, *paths, "CncInterface/CncAxisList/X/ActTorque"],
            capture_output=True,
            text=True,
            timeout=60,
        )
    finally:
        device.close()
    assert answer.returncode == 0, answer.stdout + answer.stderr
    found = json.loads(answer.stdout.splitlines()[-1])
    assert found["values"].pop("CncInterface/CncAxisList/X/ActTorque") == {"value": None, "status": "BadNoData"}
    assert {each["status"] for each in found["values"].values()} == {"Good"}
    for path, expected in paths.items():
        value = found["values"][path]["value"]
        assert value == (pytest.approx(expected) if isinstance(expected, float) else expected), path
    assert {"PosDirect", "PosIndirect", "IsReferenced", "ActLoad"} <= set(found["axis"])
    assert found["written"] == "BadUserAccessDenied"
