"""``opcua_nodes``: offsets in nodes of an OPC UA server, with a heartbeat node.

The PLC or the control behind the server adds the offsets. It must have a watchdog on the heartbeat, a slew limit and
its own limit of the offset.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, ClassVar, Self

from pydantic import Field, model_validator

from errormotion.datasets.units import Length, Time
from errormotion.errors import InstrumentError, ProtocolError
from errormotion.instruments.compensator.owner import NO_OWNER, Owner
from errormotion.instruments.driver import Driver
from errormotion.instruments.interlock import ROUNDING, OffsetInterlock
from errormotion.instruments.transports import Transport
from errormotion.instruments.transports.opc import open_session, request
from errormotion.instruments.transports.opc_security import Credentials
from errormotion.plugins import Applied, CompensatorSubject, Identity, InstrumentInfo, PluginSettings

SIGNED = {"SByte": 7, "Int16": 15, "Int32": 31, "Int64": 63}
UNSIGNED = {"Boolean": 1, "Byte": 8, "UInt16": 16, "UInt32": 32, "UInt64": 64}
"""Integer types, and the number of bits of their largest value."""
FRACTIONS = ("Float", "Double")
OWNER_BITS = 15
"""Number of bits of the number of an owner."""
BEATS = 1 << 15
"""Number of values of the heartbeat, unless its type has fewer."""
IDENTITY = {"manufacturer": "i=2263", "model": "i=2261", "firmware": "i=2264"}
"""Nodes that every server has: ManufacturerName, ProductName, SoftwareVersion."""


class OpcUaNodesSettings(PluginSettings):
    """Settings of a server with nodes for offsets."""

    offset: tuple[str, str, str] = Field(description="ids of the nodes for the offset of X, Y, Z: 'ns=2;s=Offset.X'")
    heartbeat: str = Field(description="id of the node that changes at each write; an integer or a Boolean")
    applied: tuple[str, str, str] | None = Field(
        default=None, description="ids of the nodes with the offset in effect; default: those of `offset`"
    )
    stop: str = Field(default="", description="id of a node that is neither 0 nor false while no offsets are accepted")
    busy: str = Field(
        default="", description="id of a node that is neither 0 nor false while the offset must not change"
    )
    owner: str = Field(
        default="",
        description="id of an integer node with the number of the program that writes, 0 for none, which the machine "
        "sets to 0 when its watchdog ends a compensation; a second program is refused",
    )
    scale: Length = Field(default=1e-3, description="offset for the number 1 in a node", gt=0, le=1)
    security: str = Field(
        default="", description="'Basic256Sha256,SignAndEncrypt,client.der,client.pem'; empty: no encryption"
    )
    user: str = Field(default="", description="name of the user; empty: anonymous")
    password_file: str = Field(default="", description="file whose first line is the user's password")
    timeout: Time = Field(default=1.0, description="time limit for one request", gt=0, le=10)

    @model_validator(mode="after")
    def _different(self) -> Self:
        ids = [*self.offset, *(self.applied or ()), *filter(None, (self.heartbeat, self.stop, self.busy, self.owner))]
        if double := next((each for each in ids if ids.count(each) > 1), None):
            raise ValueError(f"the node '{double}' is named twice")
        if not all((*self.offset, self.heartbeat)):
            raise ValueError("'offset' and 'heartbeat': expected ids of nodes; found an empty string")
        return self

    @property
    def read(self) -> tuple[str, ...]:
        """Ids of the nodes that are read for the state."""
        return *(self.applied or self.offset), *filter(None, (self.stop, self.busy))


class OpcUaNodes(Driver):
    """Writes offsets to nodes of an OPC UA server, all and the heartbeat by one request.

    Parameters
    ----------
    address : str
        ``opc.tcp://host:4840``, ``sim://cframe/nodes``.
    settings : OpcUaNodesSettings
    record : Path, optional
        Recording of the session.
    """

    info: ClassVar[InstrumentInfo] = InstrumentInfo(
        id="opcua_nodes",
        kind="compensator",
        summary="Offsets in nodes of an OPC UA server of a PLC or a control, with a heartbeat.",
        status="peer_verified",
        simulator="errormotion.instruments.simulators.compensator.nodes:SimulatedNodes",
    )
    Settings: ClassVar[type[OpcUaNodesSettings]] = OpcUaNodesSettings
    settings: OpcUaNodesSettings

    @classmethod
    def conformance(cls) -> CompensatorSubject:
        """Return the subject of the conformance kit."""
        faults = ("silence", "split", "garbage", "disconnect", "unavailable", "refused")
        return CompensatorSubject(cls, settings={"timeout": 0.8}, faults=faults, dead_address="opc.tcp://127.0.0.1:9")

    def __init__(self, address: str, settings: OpcUaNodesSettings | None = None, *, record: Path | None = None) -> None:
        super().__init__(address, settings, record=record)
        self._interlock = OffsetInterlock(f"{self.info.id} at {address}")
        self._types: list[str] = []
        self._beat, self._beats = 0, BEATS
        self._owner = Owner(f"{self.info.id} at {address}", self._read_owner, self._write_owner)
        self._owner_type = ""
        self.note = "" if self.settings.owner else NO_OWNER

    def close(self) -> None:
        """Disconnect and disarm; the watchdog at the other end ramps to zero. Idempotent."""
        self._interlock.disarm()
        self._owner.release()
        super().close()

    def identify(self) -> Identity:
        """Return the product that the server reports."""
        known = {name: _text(each) for name, each in zip(IDENTITY, self._values(IDENTITY.values()), strict=True)}
        return Identity(
            manufacturer=known["manufacturer"],
            model=known["model"],
            serial_number="unknown",
            firmware=known["firmware"],
            simulated=self.transport.simulated,
            details={"address": self.address},
        )

    def arm(self, limit: float) -> None:
        """Permit offsets up to a limit for each axis, m; nothing is sent but the owner, if it has a node.

        Raises
        ------
        InstrumentError
            A node of integers cannot represent this limit, or another program is the owner.
        """
        scale = self.settings.scale
        for node, kind in zip(self.settings.offset, self._types, strict=False):
            if kind in FRACTIONS:
                continue
            largest = ((1 << SIGNED[kind]) - 1) * scale
            if not scale <= limit <= largest:
                raise InstrumentError(
                    f"{self.address}: node '{node}' ({kind}) represents offsets from {scale * 1e6:g} um to "
                    f"{largest * 1e6:g} um; the limit is {limit * 1e6:g} um. Change 'scale'",
                    code="offset.range.too_small",
                )
        if self.settings.owner:
            self._owner.take()
        self._interlock.arm(limit)

    def read(self) -> Applied:
        """Return the offset in effect, m, NaN where the status of a value is not Good, and the states of the server.

        Raises
        ------
        InstrumentError
            The connection is lost, the server refuses, or its answer is invalid.
        """
        settings = self.settings
        answers = dict(zip(settings.read, self._values(settings.read), strict=True))
        x, y, z = (_number(answers[node]) * settings.scale for node in settings.applied or settings.offset)
        return Applied((x, y, z), _state(answers, "busy", settings.busy), _state(answers, "stop", settings.stop))

    def write(self, offset: Sequence[float]) -> None:
        """Write the offset of X, Y, Z, m, and the next value of the heartbeat.

        Raises
        ------
        InstrumentError
            The driver is not armed, another program is the owner, or an offset is beyond the limit or not finite: no
            offset was sent. Or the connection is lost, or the server did not accept a value.
        """
        line, settings = self.transport, self.settings
        numbers = [self._held(kind, x) for kind, x in zip(self._types, self._interlock.offset(offset), strict=False)]
        if settings.owner:
            self._owner.require()
        self._beat = (self._beat + 1) % self._beats
        beat = bool(self._beat) if self._types[-1] == "Boolean" else self._beat
        nodes = (*settings.offset, settings.heartbeat)
        values = [list(each) for each in zip(nodes, self._types, [*numbers, beat], strict=True)]
        self._send(line, values, "the offset")

    def _send(self, line: Transport, values: list[list[Any]], what: str) -> None:
        """Write values, each with its node and type."""
        statuses = request(line, {"write": values})
        if not isinstance(statuses, list) or len(statuses) != len(values):
            raise ProtocolError(
                f"{self.address}: expected {len(values)} statuses; found {str(statuses)[:80]}",
                code="protocol.opc.count",
            )
        refused = [
            f"{node}: {str(each)[:60]}" for (node, *_), each in zip(values, statuses, strict=True) if each != "Good"
        ]
        if refused:
            raise InstrumentError(
                f"{self.address}: the server did not accept {what}: {', '.join(refused)}", code="opc.write.refused"
            )

    def _read_owner(self) -> int:
        (found,) = self._values([self.settings.owner])
        number = _number(found)
        if not math.isfinite(number):
            raise InstrumentError(
                f"{self.address}: node '{self.settings.owner}' {_reason(found)}; expected the owner",
                code="opc.node.no_value",
            )
        return int(number)

    def _write_owner(self, number: int) -> None:
        self._send(self.transport, [[self.settings.owner, self._owner_type, number]], "the owner")

    def _held(self, kind: str, offset: float) -> float:
        """Return the number that represents an offset, m, in a node of this type, never beyond the limit."""
        scale = self.settings.scale
        if kind in FRACTIONS:
            return offset / scale
        most = int(self._interlock.limit * (1 + ROUNDING) / scale)
        return min(max(round(offset / scale), -most), most)

    def _values(self, nodes: Any) -> list[Any]:
        answers = request(self.transport, {"read": list(nodes)})
        whole = isinstance(answers, list) and len(answers) == len(list(nodes))
        if not whole or not all(isinstance(each, dict) for each in answers):
            raise ProtocolError(
                f"{self.address}: expected the values of nodes; found {str(answers)[:80]}", code="protocol.opc.form"
            )
        return list(answers)

    def _connect(self) -> Transport:
        settings = self.settings
        return open_session(
            self.address,
            Credentials.read(settings.security, settings.user, settings.password_file),
            timeout=settings.timeout,
            simulator=self.info.simulator,
            record=self._record,
        )

    def _start_session(self) -> None:
        """Check the nodes, and continue from the last heartbeat, so that the first write changes it."""
        settings = self.settings
        nodes = (*settings.offset, settings.heartbeat, *filter(None, (settings.owner,)))
        descriptions = request(self.transport, {"describe": list(nodes)})
        if (
            not isinstance(descriptions, list)
            or len(descriptions) != len(nodes)
            or not all(isinstance(each, dict) for each in descriptions)
        ):
            raise ProtocolError(
                f"{self.address}: expected descriptions of nodes; found {str(descriptions)[:80]}",
                code="protocol.opc.form",
            )
        types = [str(each.get("type")) for each in descriptions]
        self._types, self._owner_type = types[:4], types[-1]
        for node, each, kind in zip(nodes, descriptions, types, strict=True):
            allowed: Collection[str] = (*SIGNED, *FRACTIONS)
            if node == settings.heartbeat:
                allowed = (*SIGNED, *UNSIGNED)
            elif node == settings.owner:
                allowed = [name for name, bits in {**SIGNED, **UNSIGNED}.items() if bits >= OWNER_BITS]
            if each.get("status") != "Good" or not each.get("writable") or kind not in allowed or each.get("array"):
                array = "array of " if each.get("array") else ""
                raise InstrumentError(
                    f"{self.address}: node '{node}': expected a number that can be written; found type "
                    f"{array}{kind[:40]}, status {str(each.get('status'))[:60]}, writable {each.get('writable')}",
                    code="opc.node.not_writable",
                )
        (beat,) = self._values([settings.heartbeat])
        known = _number(beat)
        self._beats = min(BEATS, 1 << {**SIGNED, **UNSIGNED}[self._types[-1]])
        self._beat = int(known) % self._beats if math.isfinite(known) else 0
        for node, value in zip(settings.read, self._values(settings.read), strict=True):
            if value.get("status") != "Good" or not isinstance(value.get("value"), bool | int | float):
                raise InstrumentError(
                    f"{self.address}: node '{node}' {_reason(value)}; expected a number", code="opc.node.no_value"
                )


def _number(answer: dict[str, Any]) -> float:
    value = answer.get("value")
    if not isinstance(value, bool | int | float):
        return math.nan
    try:
        return float(value)
    except OverflowError:  # an integer beyond the range of float
        return math.nan


def _state(answers: dict[str, Any], name: str, node: str) -> str:
    """Return a message if a state is active or cannot be read; else an empty string."""
    if not node:
        return ""
    value = _number(answers[node])
    if math.isnan(value):
        return f"{name} is unknown: {node} {_reason(answers[node])}"
    return f"the server states {name} ({node} is {value:g})" if value else ""


def _reason(answer: dict[str, Any]) -> str:
    """Return why the value of a node is not a number."""
    value, status = answer.get("value"), str(answer.get("status"))[:60]
    if status != "Good":
        return f"has the status {status}"
    if isinstance(value, list):
        return f"has an array of {len(value)} values"
    return f"has the value {str(value)[:40]}, which is not a number"


def _text(answer: dict[str, Any]) -> str:
    value = answer.get("value")
    return value if isinstance(value, str) and value.strip() else "unknown"
