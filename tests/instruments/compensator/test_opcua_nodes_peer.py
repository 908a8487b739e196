"""Offsets in nodes of another implementation of OPC UA: the server of node-opcua, from npm."""

from typing import Any

import pytest
from node_opcua import needs_node_opcua, node_opcua, write_certificate

from errormotion.errors import InstrumentError
from errormotion.instruments.compensator.opcua_nodes import OpcUaNodes, OpcUaNodesSettings
from errormotion.instruments.transports.opc import open_session, request
from errormotion.instruments.transports.opc_security import Credentials

pytestmark = needs_node_opcua

X, Y, Z, BEAT, STOP, LIST, READ_ONLY = (
    f"ns=1;s={name}" for name in ("Offset.X", "Offset.Y", "Offset.Z", "Heartbeat", "Stop", "List", "ReadOnly")
)
GIVEN: dict[str, Any] = {"offset": (X, Y, Z), "heartbeat": BEAT, "stop": STOP, "timeout": 10.0}
OFFSET = (12.345e-6, -50e-6, 1e-6)


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    with node_opcua(tmp_path_factory.mktemp("node-opcua")) as url:
        yield url


def values(url: str, *nodes: str) -> list[Any]:
    """Return what another session reads."""
    line = open_session(url, Credentials(), timeout=10.0)
    try:
        return [each["value"] for each in request(line, {"read": list(nodes)})]
    finally:
        line.close()


@pytest.mark.parametrize("encrypted", [False, True])
def test_node_opcua_takes_the_offset_and_the_heartbeat(server, tmp_path, encrypted):
    security = f"Basic256Sha256,SignAndEncrypt,{write_certificate(tmp_path, ['urn:lab:em'])}" if encrypted else ""
    (before,) = values(server, BEAT)
    with OpcUaNodes(server, OpcUaNodesSettings(**GIVEN, security=security)) as compensator:
        compensator.arm(50e-6)
        compensator.write(OFFSET)
        assert values(server, X, Y, Z, BEAT) == pytest.approx([0.012345, -0.05, 0.001, before + 1])
        found = compensator.read()
        assert found.offset == pytest.approx(OFFSET)
        assert found.fault == ""
        compensator.write((0.0, 0.0, 0.0))
        assert values(server, X, Y, Z, BEAT) == [0.0, 0.0, 0.0, before + 2]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"offset": (X, Y, READ_ONLY)}, "'ns=1;s=ReadOnly': expected a number that can be written; .*writable False"),
        ({"offset": (X, Y, LIST)}, "'ns=1;s=List': .*found type array of Double"),
        ({"busy": LIST}, "'ns=1;s=List' has an array of 3 values; expected a number"),
        ({"busy": "ns=1;s=none"}, "'ns=1;s=none' has the status BadNodeIdUnknown"),
    ],
)
def test_nodes_of_node_opcua_that_cannot_be_used_are_named(server, settings, message):
    with pytest.raises(InstrumentError, match=message):
        OpcUaNodes(server, OpcUaNodesSettings(**{**GIVEN, **settings})).open()
