"""The OPC UA driver against servers of the package asyncua: the CNC model, nodes by name, units, faults."""

import asyncio
import socket
import threading
import time

import numpy as np
import pytest

pytest.importorskip("asyncua", reason="the package asyncua is not installed")

from asyncua import Server, ua
from coded import raises

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.controller.opcua import OpcUa, OpcUaSettings
from errormotion.instruments.simulators.controller.opcua.space import SmallServer

CNC = "http://opcfoundation.org/UA/CNC"
MM, RPM, PERCENT, MM_MIN = ("MMT", "mm"), ("RPM", "r/min"), ("P1", "%"), ("H81", "mm/min")


class Cnc:
    """A server on a free port, in its own thread; ``build`` adds its nodes.

    The 6000 nodes of ``standard`` take more than a second; a small server has those that its clients use.
    """

    def __init__(self, build, *, standard=False):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.url = f"opc.tcp://127.0.0.1:{self.port}/cnc"
        self.nodes = {}
        self._build = build
        self._standard = standard
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        self.start()

    def start(self):
        self.run(self._start())

    async def _start(self):
        self.server = Server(None if self._standard else SmallServer())
        await self.server.init()
        self.server.set_endpoint(self.url)
        self.server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
        self.nodes.clear()
        await self._build(self)
        await self.server.start()

    def run(self, work):
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(60)

    def set(self, name, value, *, bad=False, kind=None):
        node = self.nodes[name]
        if bad:
            data = ua.DataValue(StatusCode=ua.StatusCode(ua.StatusCodes.BadNoCommunication))
            self.run(self.server.write_attribute_value(node.nodeid, data))
        else:
            self.run(self.server.write_attribute_value(node.nodeid, ua.DataValue(ua.Variant(value, kind))))

    def stop(self):
        self.run(self.server.stop())

    def close(self):
        self.stop()
        self.run(self._loop.shutdown_default_executor())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def variable(self, parent, index, name, value, unit=None, node_id=None):
        node = await parent.add_variable(node_id or index, name, value)
        if unit is not None:
            code, text = unit
            eu = ua.EUInformation(
                UnitId=int.from_bytes(code.encode(), "big") if code else -1, DisplayName=ua.LocalizedText(text)
            )
            await node.add_property(0, "EngineeringUnits", eu)
        self.nodes[name if name not in self.nodes else f"{name}{len(self.nodes)}"] = node
        return node


async def cnc_model(cnc, *, spindles=("S1",), axes="XYZ"):
    """Add the object CncInterface with three axes, a spindle and a channel."""
    index = await cnc.server.register_namespace(CNC)
    root = await cnc.server.nodes.objects.add_object(index, "CncInterface")
    await cnc.variable(root, index, "VendorName", "Lab")
    await cnc.variable(root, index, "CncTypeName", "CNC 1")
    await cnc.variable(root, index, "VendorRevision", "7.2")
    listed = await root.add_object(index, "CncAxisList")
    for axis in axes:
        part = await listed.add_object(index, axis)
        for feedback in ("PosDirect", "PosIndirect"):
            position = await cnc.variable(part, index, feedback, 0.0, MM)  # the unit belongs to the group
            for name, value in (("ActPos", 10.5), ("CmdPos", 10.0)):
                await cnc.variable(position, index, name, value + "XYZ".index(axis))
                cnc.nodes[f"{axis}.{feedback}.{name}"] = cnc.nodes[next(reversed(cnc.nodes))]
    listed = await root.add_object(index, "CncSpindleList")
    for name in spindles:
        part = await listed.add_object(index, name)
        await cnc.variable(part, index, "ActSpeed", 12000.0, RPM)
        await cnc.variable(part, index, "ActLoad", 25.0, PERCENT)
    listed = await root.add_object(index, "CncChannelList")
    part = await listed.add_object(index, "CH1")
    await cnc.variable(part, index, "ActFeedrate", 1500.0, MM_MIN)
    await cnc.variable(part, index, "ActOperationMode", 2)
    await cnc.variable(part, index, "ActProgramName", "WARMUP.MPF")
    await cnc.variable(part, index, "ActProgramStatus", 1)


async def two_spindles(cnc):
    await cnc_model(cnc, spindles=("S1", "S2"))


async def plain_nodes(cnc):
    """Add variables with ids as texts, without units, as the controls of some manufacturers do."""
    index = await cnc.server.register_namespace("Lab")
    for name, value in {
        "/Channel/MachineAxis/pos[u1,1]": 12.5,
        "/Channel/MachineAxis/pos[u1,2]": -3.0,
        "/Channel/MachineAxis/pos[u1,3]": 0.25,
        "/Channel/Spindle/actSpeed[u1,1]": 3000.0,
        "/Channel/State/progStatus[u1,1]": 3,
        "/Nck/State/emergency": False,
    }.items():
        await cnc.variable(
            cnc.server.nodes.objects, index, name, value, node_id=ua.NodeId.from_string(f"ns={index};s={name}")
        )


@pytest.fixture(scope="module", autouse=True)
def shared():
    """Servers shared by tests that only read; tests that stop or change a server use their own."""
    made = {build: Cnc(build, standard=build is cnc_model) for build in (cnc_model, two_spindles, plain_nodes)}
    yield made.__getitem__
    for cnc in made.values():
        cnc.close()


@pytest.fixture
def own():
    made = []

    def own(build):
        made.append(Cnc(build))
        return made[-1]

    yield own
    for cnc in made:
        cnc.close()


@pytest.mark.slow
def test_the_cnc_model_is_found_and_read_in_the_units_of_the_server(shared):
    with OpcUa(shared(cnc_model).url) as cnc:
        identity, state = cnc.identify(), cnc.state()
    assert (identity.manufacturer, identity.model, identity.firmware) == ("Lab", "CNC 1", "7.2")
    assert not identity.simulated
    assert state["position"] == pytest.approx([0.0105, 0.0115, 0.0125])
    assert state["commanded_position"] == pytest.approx([0.010, 0.011, 0.012])
    assert state["spindle_speed"] == pytest.approx(12000)
    assert state["spindle_load"] == pytest.approx(0.25)
    assert state["feed"] == pytest.approx(0.025)
    assert (state["mode"], state["program"], state["running"]) == ("automatic", "WARMUP.MPF", True)
    assert state["estop"] is None
    assert state["unavailable"] == ["estop"]
    assert state["time"] >= 0
    assert state["position_time"] <= state["time"]


@pytest.mark.slow
def test_a_value_with_a_bad_status_is_unknown_and_named(own):
    server = own(cnc_model)
    with OpcUa(server.url) as cnc:
        server.set("Y.PosDirect.ActPos", None, bad=True)
        server.set("ActSpeed", None, bad=True)
        state = cnc.state()
    assert np.isnan(state["position"][1])
    assert np.isfinite([state["position"][0], state["position"][2]]).all()
    assert np.isnan(state["spindle_speed"])
    assert state["unavailable"] == ["position", "spindle_speed", "estop"]


def test_the_simulated_control_has_all_quantities_of_the_model():
    with OpcUa("sim://cframe/opcua?seed=3") as cnc:
        state = cnc.state()
    assert state["homed"] is True  # IsReferenced of every axis, OPC 40502, Table 14
    assert state["program"] == ""
    assert state["unavailable"] == ["estop"]  # it is known that no program is selected


def test_a_program_that_waits_is_running(shared):
    server = shared(cnc_model)
    found = {}
    with OpcUa(server.url) as cnc:
        for status in (0, 2, 3, 4, 1):  # CncChannelProgramStatus, OPC 40502, Table 26
            server.set("ActProgramStatus", status)
            found[status] = cnc.state()["running"]
    assert found == {0: False, 1: True, 2: True, 3: False, 4: False}


@pytest.mark.parametrize("units", ["model", "ua"])
def test_the_unit_is_found_in_either_namespace(units):
    with OpcUa(f"sim://cframe/opcua?seed=3&units={units}") as cnc:
        cnc.transport._device.world.move_to([0.010, 0.0, 0.0], 0.05)
        cnc.transport._device.world.elapse(10.0)
        assert cnc.state()["position"] == pytest.approx([0.010, 0.0, 0.0])


def test_a_sinumerik_is_read_with_the_settings_of_its_page():
    nodes = {
        **{
            f"position.{axis}": f"ns=2;s=/Channel/GeometricAxis/actToolBasePos[u1,{i}]"
            for i, axis in enumerate("XYZ", 1)
        },
        "spindle_speed": "ns=2;s=/Channel/Spindle/actSpeed[u1,1]",
        "execution": "ns=2;s=/Channel/State/progStatus[u1]",
    }
    settings = OpcUaSettings(nodes=nodes, units={"position": "mm", "spindle_speed": "1/min"}, running=("3",))
    with OpcUa("sim://cframe/opcua?seed=3&style=sinumerik", settings) as cnc:
        world = cnc.transport._device.world
        world.run_program("G1 X20 F300\nM2\n")
        world.elapse(2.0)
        state = cnc.state()
    assert 0.0 < state["position"][0] < 0.020
    assert state["running"] is True


def test_the_encoder_of_the_motor_is_read_where_the_settings_say_so(shared):
    server = shared(cnc_model)
    server.set("X.PosIndirect.ActPos", 99.0)
    with OpcUa(server.url, OpcUaSettings(feedback="indirect")) as cnc:
        assert cnc.state()["position"][0] == pytest.approx(0.099)


def test_several_spindles_need_a_name(shared):
    url = shared(two_spindles).url
    with raises("opc.object.ambiguous"):
        OpcUa(url).open()
    with OpcUa(url, OpcUaSettings(spindle="S2")) as cnc:
        assert cnc.state()["spindle_speed"] == pytest.approx(12000)
    with raises("opc.object.unknown"):
        OpcUa(url, OpcUaSettings(spindle="S9")).open()


def test_a_server_without_the_model_needs_nodes(shared):
    with raises("opc.object.missing"):
        OpcUa(shared(plain_nodes).url).open()


NODES = {
    **{f"position.{axis}": f"ns=2;s=/Channel/MachineAxis/pos[u1,{i}]" for i, axis in enumerate("XYZ", 1)},
    "spindle_speed": "ns=2;s=/Channel/Spindle/actSpeed[u1,1]",
    "execution": "ns=2;s=/Channel/State/progStatus[u1,1]",
    "estop": "ns=2;s=/Nck/State/emergency",
}
UNITS = {"position": "mm", "spindle_speed": "1/min"}


def test_nodes_by_name_are_read_in_the_units_of_the_settings(shared):
    server = shared(plain_nodes)
    with OpcUa(server.url, OpcUaSettings(nodes=NODES, units=UNITS, running=("3",))) as cnc:
        state = cnc.state()
        assert state["position"] == pytest.approx([0.0125, -0.003, 0.00025])
        assert state["spindle_speed"] == pytest.approx(3000)
        assert (state["running"], state["estop"]) == (True, False)
        assert np.isnan(state["commanded_position"]).all()
        server.set("/Nck/State/emergency", True)
        changed = cnc.state()["estop"]
        server.set("/Nck/State/emergency", False)
    assert changed is True


def test_a_number_without_a_unit_is_refused(shared):
    with raises("opc.unit.missing"):
        OpcUa(shared(plain_nodes).url, OpcUaSettings(nodes=NODES, units={"spindle_speed": "1/min"})).open()
    with raises("opc.unit.other"):
        OpcUa(shared(plain_nodes).url, OpcUaSettings(nodes=NODES, units=UNITS | {"position": "kg"})).open()


def test_a_node_that_does_not_exist_is_refused_by_its_key(shared):
    nodes = NODES | {"program": "ns=2;s=/no/such"}
    with raises("opc.node.no_value"):
        OpcUa(shared(plain_nodes).url, OpcUaSettings(nodes=nodes, units=UNITS)).open()
    with raises("opc.node.form"):
        OpcUa(shared(plain_nodes).url, OpcUaSettings(nodes=NODES | {"program": "nonsense"}, units=UNITS)).open()


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        ([1.0, 2.0, 3.0], "an array of 3 values"),
        ([], "an array of 0 values"),
        (float("nan"), "the number is nan"),
    ],
)
def test_what_is_not_a_single_number_is_unknown_with_a_reason(shared, value, reason):
    server = shared(plain_nodes)
    speed = "/Channel/Spindle/actSpeed[u1,1]"
    kind = ua.VariantType.Double if isinstance(value, list) else None
    try:
        with OpcUa(server.url, OpcUaSettings(nodes=NODES, units=UNITS, running=("3",))) as cnc:
            assert cnc.state()["reasons"] == {}
            server.set(speed, value, kind=kind)
            state = cnc.state()
    finally:
        server.set(speed, 3000.0)
    assert np.isnan(state["spindle_speed"])
    assert "spindle_speed" in state["unavailable"]
    assert list(state["reasons"]) == ["spindle_speed"]
    assert reason in state["reasons"]["spindle_speed"]
    assert np.isfinite(state["position"]).all()


def test_an_array_is_no_text(shared):
    server = shared(plain_nodes)
    execution = "/Channel/State/progStatus[u1,1]"
    try:
        with OpcUa(server.url, OpcUaSettings(nodes=NODES, units=UNITS, running=("[3]",))) as cnc:
            server.set(execution, [3], kind=ua.VariantType.Int64)
            state = cnc.state()
    finally:
        server.set(execution, 3)
    assert state["running"] is False
    assert "execution" in state["unavailable"]
    assert state["reasons"]["execution"] == "the node has an array of 1 values; expected a single value"


@pytest.mark.slow
def test_a_server_that_was_restarted_is_read_again(own):
    server = own(cnc_model)
    with OpcUa(server.url, OpcUaSettings(timeout=2.0)) as cnc:
        before = cnc.state()["position"]
        server.stop()
        with pytest.raises(InstrumentError):
            cnc.state()
        server.start()
        assert cnc.state()["position"] == before


def test_a_port_without_a_server_is_an_error_and_leaves_nothing_open():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    before = threading.active_count()
    with pytest.raises(InstrumentError, match="is lost"):
        OpcUa(f"opc.tcp://127.0.0.1:{port}").open()
    assert threading.active_count() == before


@pytest.mark.parametrize("answer", [b"", b"HTTP/1.1 400 Bad Request\r\n\r\n", b"ACKF\x08\x00\x00\x00", b"\xff" * 4096])
def test_another_service_at_the_port_is_an_error_within_the_timeout(answer):
    with socket.create_server(("127.0.0.1", 0)) as listener:
        held = []

        def work():
            line, _ = listener.accept()
            held.append(line)
            line.sendall(answer)

        thread = threading.Thread(target=work, daemon=True)
        thread.start()
        start = time.monotonic()
        with pytest.raises((InstrumentTimeoutError, ProtocolError, InstrumentError)):
            OpcUa(f"opc.tcp://127.0.0.1:{listener.getsockname()[1]}", OpcUaSettings(timeout=0.5)).open()
        assert time.monotonic() - start < 30
        thread.join()
        for line in held:
            line.close()


def test_a_recorded_session_is_replayed_without_a_server(shared, tmp_path):
    record = tmp_path / "session.rec"
    with OpcUa(shared(cnc_model).url, record=record) as cnc:
        recorded = cnc.identify(), cnc.state()
    with OpcUa(f"replay://{record}") as cnc:
        identity, state = cnc.identify(), cnc.state()
    assert identity.model == recorded[0].model
    assert state == recorded[1]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"nodes": {"speed": "i=1"}}, "expected position.X.*found speed"),
        ({"units": {"estop": "mm"}}, "expected position, commanded_position.*found estop"),
        ({"timeout": "0 s"}, "greater than 0"),
    ],
)
def test_settings_are_checked(settings, message):
    with pytest.raises(ValueError, match=message):
        OpcUaSettings(**settings)


def test_a_password_is_read_from_a_file(tmp_path):
    with raises("opc.password.unreadable"):
        OpcUa("opc.tcp://127.0.0.1:1", OpcUaSettings(user="lab", password_file=str(tmp_path / "missing.txt"))).open()
