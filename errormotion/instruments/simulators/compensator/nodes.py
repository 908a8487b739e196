"""An OPC UA server (package asyncua) whose machine applies offsets from its nodes."""

from __future__ import annotations

from typing import Any

import numpy as np
from asyncua import ua
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.server.address_space import AddressSpace, AttributeService
from asyncua.ua.attribute_ids import AttributeIds
from asyncua.ua.status_codes import StatusCodes

from errormotion.instruments.simulators.compensator.machine import MachinePart
from errormotion.instruments.simulators.controller.opcua.listening import FaultyServer, Outgoing
from errormotion.instruments.simulators.controller.opcua.serving import ServingThread, prepare_server
from errormotion.instruments.simulators.controller.opcua.space import Ids, Space, number
from errormotion.instruments.simulators.faults import parse_fault
from errormotion.instruments.transports import Address
from errormotion.instruments.transports.loopback.serving import listening_at, not_listening, reachable_at

AXES = "XYZ"
MM = 1e-3
WRITABLE = 3
"""Access level: can be read and written."""
NAMESPACE = "urn:errormotion:machine"
OWNER = "Owner"
INDEX = 2
"""Index of the namespace of the nodes."""


class SimulatedNodes:
    """A machine with the nodes ``Offset.X`` to ``Z`` and ``Heartbeat`` for writing.

    The offset in effect is in ``Applied.X`` to ``Z``; further nodes are ``Stop`` and ``Busy``, all in namespace 2.
    Offsets are Double in mm, the heartbeat is a UInt32, the states are Boolean. With the parameter ``owner=1``, the
    node ``Owner``, UInt16, is that of the owner: it is set to 0 when the watchdog has expired. Further parameters of
    the address: those of `MachinePart`.

    Faults in addition to those of all devices: ``unavailable`` (values have a bad status) and ``refused`` (writes are
    refused).

    Attributes
    ----------
    url : str
        Address for the client.
    machine : MachinePart
    driver_settings : mapping
        Settings of the compensator for this server.
    """

    faults = ("silence", "split", "garbage", "drop", "disconnect", "late", "unavailable", "refused")

    def __init__(self, address: Address) -> None:
        self.fault = parse_fault(address, self.faults)
        self.machine = MachinePart(address)
        self.owned = bool(address.whole("owner", 0, 1))
        self._outgoing = Outgoing(self.fault, np.random.default_rng(int(address.number("seed", 0))), lambda: None)
        self._path = address.path or "nodes"
        self._host, self._port = listening_at()
        self._server: FaultyServer | None = None
        self._closed = False
        self._beat: Any = None
        self._thread = ServingThread("sim-nodes")
        try:
            self._thread.run(self._start())
        except OSError as error:
            self.close()
            raise not_listening(self._host, self._port, error) from None
        except BaseException:
            self.close()
            raise
        self.url = f"opc.tcp://{reachable_at(self._host, self._port)}/{self._path}"

    def close(self) -> None:
        """End the server; idempotent."""
        closed, self._closed = self._closed, True
        if not closed:
            self._thread.end(self._stop())

    def report_delivered(self, samples: int) -> None:
        """Do nothing: there is no stream."""

    @property
    def driver_settings(self) -> dict[str, Any]:
        """Settings of the compensator for this server."""
        return {
            "offset": tuple(self._id(f"Offset.{axis}").to_string() for axis in AXES),
            "heartbeat": self._id("Heartbeat").to_string(),
            "applied": tuple(self._id(f"Applied.{axis}").to_string() for axis in AXES),
            "stop": self._id("Stop").to_string(),
            "busy": self._id("Busy").to_string(),
            "scale": "1 mm",
            **({"owner": self._id(OWNER).to_string()} if self.owned else {}),
        }

    def write(self, space: AddressSpace) -> None:
        """Apply the offset in the nodes."""
        offset = [self._value(space, f"Offset.{axis}") for axis in AXES]
        beat = self._value(space, "Heartbeat")
        alive, self._beat = beat != self._beat, beat
        self.machine.order([value * MM for value in offset], alive=alive)

    def own(self) -> None:
        """Start the watchdog of a new owner."""
        self.machine.begin()

    # ------------------------------------------------------------------ in the thread of the server

    async def _start(self) -> None:
        server, inner = await prepare_server(self._outgoing, self._host, self._port, self._path)
        await server.register_namespace(NAMESPACE)
        space = Space(inner)
        for axis in AXES:
            self._add(space, inner.aspace, f"Offset.{axis}", 0.0, ua.VariantType.Double, writable=True)
        self._add(space, inner.aspace, "Heartbeat", 0, ua.VariantType.UInt32, writable=True)
        if self.owned:
            self._add(space, inner.aspace, OWNER, 0, ua.VariantType.UInt16, writable=True)
        self._beat = 0
        for i, axis in enumerate(AXES):
            self._live(space, f"Applied.{axis}", ua.VariantType.Double, lambda i=i: self.machine.offset[i] / MM)
        self._live(space, "Stop", ua.VariantType.Boolean, lambda: bool(self.machine.fault))
        self._live(space, "Busy", ua.VariantType.Boolean, lambda: bool(self.machine.busy))
        inner.attribute_service = _Attributes(inner.aspace, self)
        await server.start()
        self._server, self._port = server, server.port

    def _add(
        self, space: Space, addresses: AddressSpace, name: str, value: Any, kind: ua.VariantType, *, writable: bool
    ) -> None:
        node = self._id(name)
        title = ua.QualifiedName(name, ua.UInt16(INDEX))
        data_type = number(getattr(Ids, kind.name))
        space.variable(node, title, number(Ids.ObjectsFolder), data_type, ua.Variant(value, kind))
        if writable:
            for attribute in (AttributeIds.AccessLevel, AttributeIds.UserAccessLevel):
                addresses[node].attributes[attribute].value = ua.DataValue(
                    ua.Variant(ua.Byte(WRITABLE), ua.VariantType.Byte)
                )

    def _live(self, space: Space, name: str, kind: ua.VariantType, read: Any) -> None:
        def value() -> ua.DataValue:
            if self.fault.kind == "unavailable" and self._outgoing.reached:
                return ua.DataValue(StatusCode=ua.StatusCode(ua.UInt32(StatusCodes.BadNoCommunication)))
            return ua.DataValue(ua.Variant(read(), kind))

        title = ua.QualifiedName(name, ua.UInt16(INDEX))
        data_type = number(getattr(Ids, kind.name))
        space.variable(self._id(name), title, number(Ids.ObjectsFolder), data_type, value)

    def _id(self, name: str) -> ua.NodeId:
        return ua.NodeId(ua.String(name), ua.Int16(INDEX))

    def _value(self, space: AddressSpace, name: str) -> Any:
        value = space.read_attribute_value(self._id(name), AttributeIds.Value).Value
        return value.Value if value is not None else None

    async def _stop(self) -> None:
        server, self._server = self._server, None
        if server is not None:
            await server.stop()


class _Attributes(AttributeService):
    """Reads and writes attributes; the machine applies the values of one request together.

    Parameters
    ----------
    space : AddressSpace
    device : SimulatedNodes
    """

    def __init__(self, space: AddressSpace, device: SimulatedNodes) -> None:
        super().__init__(space)
        self._space, self._device = space, device
        self._owner = ua.NodeId(ua.String(OWNER), ua.Int16(INDEX))

    def read(self, params: ua.ReadParameters) -> list[ua.DataValue]:
        """Read attributes; an owner whose heartbeat has ended is none."""
        if self._device.owned and not self._device.machine.alive:
            for each in params.NodesToRead:
                if each.NodeId == self._owner and each.AttributeId == AttributeIds.Value:
                    free = ua.DataValue(ua.Variant(ua.UInt16(0), ua.VariantType.UInt16))
                    self._space[self._owner].attributes[AttributeIds.Value].value = free
        return super().read(params)

    async def write(self, params: ua.WriteParameters, user: User = User(role=UserRole.Admin)) -> list[ua.StatusCode]:  # noqa: B008 - as in the base class
        """Write attributes; return the status of each."""
        ours = any(each.NodeId.NamespaceIndex == INDEX for each in params.NodesToWrite)  # others: the server itself
        if ours and self._device.fault.kind == "refused":
            return [ua.StatusCode(ua.UInt32(StatusCodes.BadUserAccessDenied)) for _ in params.NodesToWrite]
        found = await super().write(params, user)
        if [each.NodeId for each in params.NodesToWrite] == [self._owner]:
            self._device.own()
        elif ours:
            self._device.write(self._space)
        return found
