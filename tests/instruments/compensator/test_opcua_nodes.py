"""Offsets in nodes: the server of the package asyncua with all its standard nodes accepts them, or states a reason."""

import asyncio
import math
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from coded import raises
from pydantic import ValidationError

pytest.importorskip("asyncua", reason="the package asyncua is not installed")

from asyncua import Server, ua

from errormotion.errors import InstrumentError
from errormotion.instruments.compensator import opcua_nodes
from errormotion.instruments.compensator.opcua_nodes import OpcUaNodes, OpcUaNodesSettings
from errormotion.instruments.simulators.controller.opcua.space import SmallServer
from errormotion.instruments.transports.opc_security import Credentials

LIMIT = 50e-6
OFFSET = (12.345e-6, -50e-6, 1e-6)
X, Y, Z = (f"ns=2;s=Offset.{axis}" for axis in "XYZ")
BEAT, STOP, READ_ONLY, NAME, UNSIGNED, LIST = (
    f"ns=2;s={name}" for name in ("Beat", "Stop", "ReadOnly", "Name", "Unsigned", "List")
)
GIVEN: dict[str, Any] = {"offset": (X, Y, Z), "heartbeat": BEAT, "timeout": 5.0}


class Control:
    """A server in its own thread: with all its standard nodes, or with those of a small server."""

    def __init__(self, *, small: bool = False) -> None:
        self._small = small
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        self.port = 0
        self.start()

    def run(self, work):
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(30)

    def start(self) -> None:
        self.run(self._start())

    async def _start(self) -> None:
        self.server = Server(SmallServer() if self._small else None)
        await self.server.init()
        self.server.iserver.disabled_clock = True
        self.server.set_endpoint(f"opc.tcp://127.0.0.1:{self.port}/plc")
        self.server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
        await self.server.register_namespace("PLC")
        double, name = ua.VariantType.Double, ua.VariantType.String
        nodes = [(X, 0.0, double), (Y, 0.0, double), (Z, 0.0, double), (BEAT, 7, ua.VariantType.UInt32)]
        nodes += [(STOP, 0, ua.VariantType.Byte), (READ_ONLY, 0.0, double), (NAME, "a", name)]
        nodes += [(LIST, [1.0, 2.0, 3.0], double)]
        for node, value, kind in [*nodes, (UNSIGNED, 0, ua.VariantType.UInt16)]:
            made = await self.server.nodes.objects.add_variable(ua.NodeId.from_string(node), node[7:], value, kind)
            if node != READ_ONLY:
                await made.set_writable()
        await self.server.start()
        self.port = self.server.bserver.port

    @property
    def url(self) -> str:
        return f"opc.tcp://127.0.0.1:{self.port}/plc"

    def value(self, node: str) -> ua.DataValue:
        return self.run(self.server.get_node(node).read_data_value(raise_on_bad_status=False))

    def set(self, node: str, value: Any, kind: ua.VariantType) -> None:
        self.run(self.server.write_attribute_value(ua.NodeId.from_string(node), ua.DataValue(ua.Variant(value, kind))))

    def spoil(self, node: str) -> None:
        data = ua.DataValue(StatusCode=ua.StatusCode(ua.StatusCodes.BadNoCommunication))
        self.run(self.server.write_attribute_value(ua.NodeId.from_string(node), data))

    def stop(self) -> None:
        self.run(self.server.stop())

    def close(self) -> None:
        self.stop()
        self.run(self._loop.shutdown_default_executor())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()


@pytest.fixture(scope="module")
def shared() -> Iterator[Control]:
    control = Control()
    yield control
    control.close()


@pytest.fixture
def control(shared: Control) -> Control:
    for node in (X, Y, Z):
        shared.set(node, 0.0, ua.VariantType.Double)
    shared.set(BEAT, 7, ua.VariantType.UInt32)
    shared.set(STOP, 0, ua.VariantType.Byte)
    return shared


def made(control: Control, **more: Any) -> OpcUaNodes:
    return OpcUaNodes(control.url, OpcUaNodesSettings(**{**GIVEN, **more}))


def test_the_server_receives_the_offset_in_its_unit(control: Control) -> None:
    with made(control) as compensator:
        compensator.arm(LIMIT)
        compensator.write(OFFSET)
        assert [control.value(node).Value.Value for node in (X, Y, Z)] == pytest.approx([0.012345, -0.05, 0.001])
        beat = control.value(BEAT)
        assert (beat.Value.Value, beat.Value.VariantType) == (8, ua.VariantType.UInt32)
        assert beat.SourceTimestamp is None  # servers may refuse a time
        assert compensator.read().offset == pytest.approx(OFFSET)
        compensator.write(OFFSET)
        assert control.value(BEAT).Value.Value == 9


def test_the_heartbeat_continues_after_a_restart(control: Control) -> None:
    for expected in (8, 9):
        with made(control) as compensator:
            compensator.arm(LIMIT)
            compensator.write((0.0, 0.0, 0.0))
        assert control.value(BEAT).Value.Value == expected


@pytest.mark.parametrize(
    ("kind", "first", "beats"),
    [
        (ua.VariantType.Boolean, True, [False, True, False]),
        (ua.VariantType.Byte, 254, [255, 0, 1]),
        (ua.VariantType.Int16, 32766, [32767, 0, 1]),
        (ua.VariantType.UInt64, 1 << 40, [1, 2, 3]),
    ],
)
def test_the_heartbeat_fits_its_type(control: Control, kind: ua.VariantType, first: Any, beats: list[Any]) -> None:
    node = f"ns=2;s=Beat.{kind.name}"

    async def add() -> None:
        variable = await control.server.nodes.objects.add_variable(ua.NodeId.from_string(node), node[7:], first, kind)
        await variable.set_writable()

    control.run(add())
    found = []
    with made(control, heartbeat=node) as compensator:
        compensator.arm(LIMIT)
        for _ in beats:
            compensator.write((0.0, 0.0, 0.0))
            found.append(control.value(node).Value.Value)
    assert found == beats


def test_integers_are_rounded_within_the_limit(control: Control) -> None:
    async def add() -> None:
        for axis in "XYZ":
            node = ua.NodeId.from_string(f"ns=2;s=Whole.{axis}")
            variable = await control.server.nodes.objects.add_variable(node, axis, 0, ua.VariantType.Int16)
            await variable.set_writable()

    control.run(add())
    nodes = tuple(f"ns=2;s=Whole.{axis}" for axis in "XYZ")
    with made(control, offset=nodes, scale=7e-7) as compensator:
        compensator.arm(20e-6)  # 28.57 counts
        compensator.write((20e-6, -20e-6, 1e-6))
        assert [control.value(node).Value.Value for node in nodes] == [28, -28, 1]
    with (
        made(control, offset=nodes, scale=1e-9) as compensator,
        raises("offset.range.too_small"),
    ):
        compensator.arm(LIMIT)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"offset": (X, Y, READ_ONLY)}, "'ns=2;s=ReadOnly': expected a number that can be written; .* writable False"),
        ({"offset": (X, Y, NAME)}, "'ns=2;s=Name': .*found type String"),
        ({"offset": (X, Y, UNSIGNED)}, "'ns=2;s=Unsigned': .*found type UInt16"),
        ({"offset": (X, Y, "ns=2;s=none")}, "'ns=2;s=none': .*status BadNodeIdUnknown"),
        ({"offset": (X, Y, "nonsense")}, "'nonsense' is not the id of a node"),
        ({"heartbeat": NAME}, "'ns=2;s=Name'"),
        ({"stop": "ns=2;s=none"}, "'ns=2;s=none' has the status BadNodeIdUnknown; expected a number"),
        ({"stop": NAME}, "'ns=2;s=Name' has the value a, which is not a number"),
        ({"busy": LIST}, "'ns=2;s=List' has an array of 3 values"),
        ({"offset": (X, Y, LIST)}, "'ns=2;s=List': .*found type array of Double"),
    ],
)
def test_nodes_that_cannot_be_used_are_named_when_it_is_opened(
    control: Control, settings: dict[str, Any], message: str
) -> None:
    compensator = made(control, **settings)
    with pytest.raises(InstrumentError, match=message):
        compensator.open()
    assert control.value(BEAT).Value.Value == 7


def test_unknown_values_are_not_zero(control: Control) -> None:
    with made(control, stop=STOP) as compensator:
        assert compensator.read().fault == ""
        control.set(STOP, 2, ua.VariantType.Byte)
        assert compensator.read().fault == "the server states stop (ns=2;s=Stop is 2)"
        control.spoil(STOP)
        control.spoil(Y)
        found = compensator.read()
        assert found.fault == "stop is unknown: ns=2;s=Stop has the status BadNoCommunication"
        assert (found.offset[0], found.offset[2]) == (0.0, 0.0)
        assert math.isnan(found.offset[1])


def test_an_unusable_node_is_named(control: Control) -> None:
    with made(control) as compensator:
        compensator.arm(LIMIT)
        compensator._types[0] = "Float"  # the server requires a Double
        with raises("opc.write.refused"):
            compensator.write(OFFSET)


@pytest.mark.slow
def test_a_server_that_is_restarted_is_found_again() -> None:
    control = Control(small=True)
    try:
        with made(control, timeout=2.0) as compensator:
            compensator.arm(LIMIT)
            compensator.write(OFFSET)
            control.stop()
            with pytest.raises(InstrumentError):
                compensator.write(OFFSET)
            control.start()
            for _ in range(50):
                try:
                    compensator.open()
                    compensator.write(OFFSET)
                except InstrumentError:
                    time.sleep(0.1)
                else:
                    break
            assert control.value(X).Value.Value == pytest.approx(0.012345)
    finally:
        control.close()


ANSWERS: list[Any] = [None, 3, {}, [], ["Good"], [None] * 4, [{}] * 4, [{"value": "a"}] * 4, [{"value": 10**400}] * 4]


@pytest.mark.parametrize("answer", ANSWERS, ids=range(len(ANSWERS)))
def test_any_answer_only_raises_typed_errors(control: Control, answer: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    with made(control, stop=STOP) as compensator:
        compensator.arm(LIMIT)
        monkeypatch.setattr(opcua_nodes, "request", lambda line, content: answer)
        for use in (compensator.identify, compensator.read, lambda: compensator.write(OFFSET)):
            try:
                found = use()
            except InstrumentError:
                continue
            offset = getattr(found, "offset", (math.nan,))
            assert all(map(math.isnan, offset))
        fresh = made(control)
        with pytest.raises(InstrumentError):
            fresh.open()
        fresh.close()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"offset": (X, X, Z)}, "Offset.X' is named twice"),
        ({"stop": BEAT}, "Beat' is named twice"),
        ({"heartbeat": ""}, "found an empty string"),
        ({"scale": 0.0}, "greater than 0"),
        ({"offset": (X, Y)}, "Field required"),
    ],
)
def test_invalid_settings_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        OpcUaNodesSettings(**{**GIVEN, **settings})


def test_a_missing_file_with_the_password_is_named(tmp_path) -> None:
    with raises("opc.password.unreadable"):
        Credentials.read("", "user", str(tmp_path / "none"))
