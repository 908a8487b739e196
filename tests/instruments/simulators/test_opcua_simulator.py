"""The simulated OPC UA server, with the client of asyncua."""

import asyncio
import socket
import struct
import threading
import time
from contextlib import contextmanager
from urllib.parse import urlsplit

import pytest
from asyncua import Client, ua
from asyncua.ua.uaerrors import BadUserAccessDenied

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.controller.opcua import SimulatedServer
from errormotion.instruments.simulators.controller.opcua.sinumerik import VARIABLES
from errormotion.instruments.transports import load_simulator, parse_address

CNC = "http://opcfoundation.org/UA/CNC"
SIMULATOR = "errormotion.instruments.simulators.controller.opcua:SimulatedServer"
HELLO_FORM = "<4sIIIIIII"
TIMEOUT = 10.0


@contextmanager
def server(query=""):
    device = SimulatedServer(parse_address(f"sim://cframe/opcua?seed=3{'&' if query else ''}{query}"))
    try:
        yield device
    finally:
        device.close()


def ask(url, work, **client):
    """Return the result of a coroutine with a connected client."""

    async def session():
        connected = Client(url, timeout=TIMEOUT)
        for name, value in client.items():
            getattr(connected, f"set_{name}")(value)
        async with connected:
            return await work(connected)

    return asyncio.run(session())


async def found(client, *names):
    """Return a node below the object CncInterface by its path."""
    index = await client.get_namespace_index(CNC)
    return await client.nodes.objects.get_child([f"{index}:{name}" for name in ("CncInterface", *names)])


def values(url, *paths):
    """Return values with their status, all of one request; a path is of names, or the id of a node."""

    async def work(client):
        nodes = [client.get_node(path) if isinstance(path, str) else await found(client, *path) for path in paths]
        return await client.read_attributes(nodes)

    return [(each.Value.Value if each.Value else None, each.StatusCode.name) for each in ask(url, work)]


def x_axis(*names):
    return ("CncAxisList", "X", *names)


# ---------------------------------------------------------------------- OPC 40502


def test_the_model_has_the_types_of_the_published_nodeset():
    async def work(client):
        index = await client.get_namespace_index(CNC)
        assert index > 1, "the index is the server's own affair, and not that of the NodeSet"
        shown = {}
        for path in ((), ("CncAxisList",), x_axis(), x_axis("PosDirect"), ("CncSpindleList", "S1"), x_axis("ActLoad")):
            shown[path] = (await (await found(client, *path)).read_type_definition()).to_string()
        axis = await (await found(client, *x_axis())).get_children_descriptions()
        return index, shown, {each.BrowseName.Name for each in axis}

    with server() as device:
        index, shown, axis = ask(device.url, work)
    assert list(shown.values()) == [f"ns={index};i={i}" for i in (1007, 1008, 1004, 2001, 1005)] + ["i=2368"]
    table_13 = {"ActChannel", "ActLoad", "ActPower", "ActTorque", "CmdTorque", "IsInactive", "IsVirtual"}
    table_14 = {"ActStatus", "IsReferenced", "IsRotational", "PosDirect", "PosIndirect", "ZeroOffset"}
    assert axis == table_13 | table_14


def test_values_follow_the_machine_in_the_units_of_a_control():
    paths = [
        x_axis("PosDirect", "ActPos"),
        x_axis("PosIndirect", "CmdPos"),
        x_axis("PosDirect", "RemDist"),
        x_axis("IsReferenced"),
        ("CncSpindleList", "S1", "ActSpeed"),
        ("CncSpindleList", "S1", "ActStatus"),
        ("CncSpindleList", "S1", "ActTurnDirection"),
        ("CncChannelList", "Channel1", "ActFeedrate"),
        ("CncChannelList", "Channel1", "ActProgramStatus"),
        ("CncChannelList", "Channel1", "ActOperationMode"),
    ]
    with server() as device:
        device.world.move_to([0.010, 0.0, 0.0], 0.05)
        device.world.spindle(3000.0)
        device.world.elapse(60.0)
        resting = values(device.url, *paths)
        device.world.run_program("G1 X20 F300\nM2\n")
        device.world.elapse(1.0)
        moving = values(device.url, *paths)
    assert {status for _, status in resting} == {"Good"}
    assert [value for value, _ in resting] == pytest.approx([10.0, 10.0, 0.0, True, 3000.0, 1, 1, 0.0, 0, 1])
    assert 10.0 < moving[0][0] < 20.0
    assert moving[2] == (None, "BadNoData")  # the end of the motion is unknown
    assert [value for value, _ in moving[7:]] == pytest.approx([300.0, 1, 2])


def test_a_group_of_positions_is_a_structure_of_three():
    with server() as device:
        device.world.move_to([0.010, 0.0, 0.0], 0.05)
        device.world.elapse(10.0)
        (group, status), *_ = values(device.url, x_axis("PosDirect"))
    assert status == "Good"
    assert group.TypeId.Identifier == 5001  # Default Binary of CncPositionDataType
    assert struct.unpack("<3d", group.Body) == pytest.approx((10.0, 10.0, 0.0))


@pytest.mark.parametrize(("query", "namespace"), [("", CNC), ("units=ua", "http://opcfoundation.org/UA/")])
def test_the_unit_of_a_position_is_a_property_of_its_group(query, namespace):
    async def work(client):
        group = await found(client, *x_axis("PosDirect"))
        index = await client.get_namespace_index(namespace)
        unit = await (await group.get_child(f"{index}:EngineeringUnits")).read_value()
        parts = await (await group.get_child(f"{await client.get_namespace_index(CNC)}:ActPos")).get_children()
        speed = await found(client, "CncSpindleList", "S1", "ActSpeed")
        return unit, parts, await (await speed.get_child("0:EngineeringUnits")).read_value()

    with server(query) as device:
        unit, parts, speed = ask(device.url, work)
    assert (unit.UnitId, unit.DisplayName.Text) == (5066068, "mm")  # MMT, as in the NodeSet
    assert unit.NamespaceUri == "http://www.opcfoundation.org/UA/units/un/cefact"
    assert parts == []
    assert speed.UnitId == int.from_bytes(b"RPM", "big")


def test_the_values_of_enumerations_are_stated():
    async def work(client):
        index = await client.get_namespace_index(CNC)
        node = await client.get_node(f"ns={index};i=3002").get_child("0:EnumValues")
        return await node.read_value()

    with server() as device:
        stated = [(each.Value, each.DisplayName.Text) for each in ask(device.url, work)]
    assert stated == list(enumerate(["Stopped", "Running", "Waiting", "Interrupted", "Canceled"]))


# ---------------------------------------------------------------------- services


def test_nothing_can_be_written_and_no_node_added():
    async def work(client):
        for name in (x_axis("PosDirect", "ActPos"), ("CncChannelList", "Channel1", "ActProgramName")):
            node = await found(client, *name)
            with pytest.raises(BadUserAccessDenied):
                await node.write_value(await node.read_value())
        with pytest.raises(BadUserAccessDenied):
            await client.nodes.objects.add_object(2, "new")
        return True

    with server() as device:
        assert ask(device.url, work)
        assert ask(device.url, work, user="admin")


def test_the_time_of_a_value_is_that_of_its_last_change():
    async def work(client):
        node = await found(client, *x_axis("PosDirect", "ActPos"))
        times = []
        for _ in range(2):
            times.append((await node.read_data_value()).SourceTimestamp)
            device.world.elapse(5.0)
        device.world.move_to([0.010, 0.0, 0.0], 0.05)
        device.world.elapse(5.0)
        times.append((await node.read_data_value()).SourceTimestamp)
        return times, await client.nodes.server.get_child(["0:ServerStatus", "0:CurrentTime"]), client

    async def whole(client):
        times, clock, _ = await work(client)
        return times, await clock.read_value()

    with server() as device:
        (first, second, changed), clock = ask(device.url, whole)
    assert first == second
    assert (changed - first).total_seconds() >= 15.0
    assert clock >= changed  # one clock, that of the world


def test_a_subscription_reports_what_changes():
    class Seen:
        def __init__(self):
            self.values, self.event = [], threading.Event()

        def datachange_notification(self, node, value, data):
            self.values.append(value)
            if value and value > 2900:
                self.event.set()

    async def work(client):
        subscription = await client.create_subscription(20, seen)
        await subscription.subscribe_data_change(await found(client, "CncSpindleList", "S1", "ActSpeed"))
        device.world.spindle(3000.0)
        device.world.elapse(60.0)
        reported = await asyncio.to_thread(seen.event.wait, TIMEOUT)
        await subscription.delete()
        return reported

    seen = Seen()
    with server() as device:
        assert ask(device.url, work), seen.values
    assert seen.values[0] == 0.0


# ---------------------------------------------------------------------- SINUMERIK


def test_a_sinumerik_takes_the_ids_of_the_manual():
    ids = {
        "/Channel/GeometricAxis/actToolBasePos[u1,3]": 5.0,  # Table 5-1
        "/Channel/GeometricAxis/name[u1,3]": "Z",
        "/Channel/Parameter/R[u1,10]": 0.0,
        "/Channel/Parameter/R[u1, 1]": 0.0,
        "/Channel/Parameter/R[u1,1,5]": [0.0] * 5,
        "/Channel/Parameter/R[u1,1,#5]": [0.0] * 5,
        "/Channel/Parameter/R[u1,3,5]": [0.0] * 3,
        "/Channel/Parameter/R[u1,3,#5]": [0.0] * 5,
        "/Channel/MachineAxis/actToolBasePos[u1,1,#3]": [10.0, 0.0, 5.0],
        "/Channel/GeometricAxis/actToolBasePos": 10.0,  # without index: the first one
        "/Channel/GeometricAxis/actToolBasePos[u1]": 10.0,
        "/Channel/Spindle/actSpeed[u1,1]": 3000.0,
        "/Channel/State/progStatus[u1]": 5,
        "/Bag/State/opMode[u1]": 1,
    }
    with server("style=sinumerik") as device:
        device.world.move_to([0.010, 0.0, 0.005], 0.05)
        device.world.spindle(3000.0)
        device.world.elapse(60.0)
        shown = values(device.url, *(f"ns=2;s={each}" for each in ids))
    assert {status for _, status in shown} == {"Good"}
    for (value, _), (identifier, expected) in zip(shown, ids.items(), strict=True):
        assert value == (expected if isinstance(expected, str) else pytest.approx(expected)), identifier


def test_a_sinumerik_refuses_other_ids():
    refused = {
        "/Channel/GeometricAxis/actToolBasePos[u1,4]": "BadAttributeIdInvalid",
        "/Channel/GeometricAxis/actToolBasePos[u1,0]": "BadAttributeIdInvalid",
        "/Channel/GeometricAxis/actToolBasePos[u2,1]": "BadAttributeIdInvalid",
        "/Channel/GeometricAxis/actToolBasePos[u1,2,1]": "BadAttributeIdInvalid",
        "/Channel/Parameter/R[u1,99,#3]": "BadAttributeIdInvalid",
        "/Channel/GeometricAxis/ActToolBasePos[u1,1]": "BadNodeIdUnknown",  # upper and lower case count
        "/channel/GeometricAxis/actToolBasePos[u1,1]": "BadNodeIdUnknown",
        "/Channel/GeometricAxis/actToolBasePos[1]": "BadNodeIdUnknown",
        "/Channel/GeometricAxis/actToolBasePos[u1,1": "BadNodeIdUnknown",
        "/Channel/GeometricAxis/actToolBasePos[u1,1]" + " " * 300: "BadNodeIdUnknown",
        "/Channel/Nothing/here": "BadNodeIdUnknown",
    }
    with server("style=sinumerik") as device:
        shown = values(device.url, *(f"ns=2;s={each}" for each in refused))
    assert shown == [(None, status) for status in refused.values()]


def test_browsing_a_sinumerik_shows_paths_without_index_or_unit():
    async def below(node):
        shown = []
        for each in await node.get_children():
            shown += [each.nodeid.Identifier, *await below(each)]
        return shown

    async def work(client):
        return await client.get_namespace_array(), await below(await client.nodes.objects.get_child("2:Sinumerik"))

    with server("style=sinumerik") as device:
        namespaces, shown = ask(device.url, work)
    assert namespaces[2] == "SinumerikVarProvider"
    assert set(VARIABLES) <= set(shown)
    assert not [each for each in shown if "[" in each or "Units" in each]


# ---------------------------------------------------------------------- faults and life cycle


def hello(url):
    """Return a connection that has said hello (OPC 10000-6, 7.1.2.3)."""
    parts = urlsplit(url)
    line = socket.create_connection((parts.hostname, parts.port), timeout=TIMEOUT)
    text = url.encode()
    line.sendall(struct.pack(HELLO_FORM, b"HELF", 32 + len(text), 0, 65536, 65536, 0, 0, len(text)) + text)
    return line


def received(line, size):
    data = b""
    while len(data) < size and (piece := line.recv(size - len(data))):
        data += piece
    return data


def test_an_acknowledgement_is_received_whole_or_in_pieces():
    for query in ("", "fault=split"):
        with server(query) as device, hello(device.url) as line:
            answer = received(line, 28)
        assert struct.unpack_from("<4sI", answer) == (b"ACKF", 28)


def test_a_silent_server_accepts_and_does_not_answer():
    with server("fault=silence") as device, hello(device.url) as line:
        line.settimeout(0.3)
        with pytest.raises(TimeoutError):
            line.recv(1)


def test_a_late_message_is_delayed():
    with server("fault=late&late_by=0.4") as device, hello(device.url) as line:
        line.settimeout(0.1)
        with pytest.raises(TimeoutError):
            line.recv(1)
        line.settimeout(TIMEOUT)
        assert received(line, 28)[:4] == b"ACKF"


def test_stray_bytes_precede_a_message():
    with server("fault=garbage") as device, hello(device.url) as line:
        answer = received(line, 29)
    assert 0 < answer.index(b"ACKF") <= 5


def test_two_connections_break_in_succession():
    with server("fault=disconnect") as device:
        for _ in range(2):
            with hello(device.url) as line:
                assert line.recv(1) == b""


def test_a_machine_out_of_reach_gives_a_bad_status():
    with server("fault=unavailable") as device:
        shown = values(device.url, x_axis("PosDirect", "ActPos"), x_axis("IsReferenced"), "i=2259")
    assert [status for _, status in shown] == ["BadNotConnected", "BadNotConnected", "Good"]
    assert [value for value, _ in shown] == [None, None, 0]  # the server itself runs


def test_after_a_restart_it_is_the_same_machine_at_the_same_port():
    def position():
        return values(device.url, x_axis("PosDirect", "ActPos"))

    with server("fault=restart&fault_at=6") as device:
        with pytest.raises((ConnectionError, TimeoutError, ua.UaError, asyncio.CancelledError)):
            position()
        deadline = time.monotonic() + TIMEOUT
        while True:
            try:
                assert position() == [(0.0, "Good")]
                break
            except ConnectionError:
                assert time.monotonic() < deadline
                time.sleep(0.05)


def test_it_listens_at_the_stated_address_and_reports_if_it_cannot():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    start = load_simulator(SIMULATOR, "sim://")
    device = start(parse_address(f"sim://cframe/opcua?port={port}"))
    try:
        assert device.url == f"opc.tcp://127.0.0.1:{port}/opcua"
        with pytest.raises(InstrumentError, match=f"cannot listen at 127.0.0.1:{port}"):
            start(parse_address(f"sim://cframe/opcua?port={port}"))
    finally:
        device.close()


@pytest.mark.parametrize("query", ["style=other", "units=none", "fault=checksum"])
def test_unknown_parameters_are_refused(query):
    before = threading.active_count()
    with pytest.raises(InstrumentError, match=r"found|expected one of"), server(query):
        pass
    assert threading.active_count() == before


def test_closed_with_a_client_connected_it_leaves_no_thread():
    before = threading.active_count()
    with server() as device, hello(device.url) as line:
        received(line, 28)
        device.close()
        device.close()
        assert line.recv(1) == b""
    assert threading.active_count() == before
