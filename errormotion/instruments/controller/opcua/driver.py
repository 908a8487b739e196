"""Driver of controls with an OPC UA server: the state of the machine, read-only."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, ClassVar

from errormotion.errors import InstrumentError, ProtocolError
from errormotion.instruments.controller.opcua import model
from errormotion.instruments.controller.opcua.settings import NUMBERS, TEXTS, OpcUaSettings
from errormotion.instruments.driver import Driver
from errormotion.instruments.transports import Transport
from errormotion.instruments.transports.opc import open_session, request
from errormotion.instruments.transports.opc_security import Credentials
from errormotion.plugins import Identity, InstrumentInfo, InstrumentSubject


class OpcUa(Driver):
    """A machine whose control has an OPC UA server; read-only.

    Parameters
    ----------
    address : str
        ``opc.tcp://host:4840``, ``sim://cframe/opcua``, ``replay://file``.
    settings : OpcUaSettings, optional
    record : Path, optional
        Recording of the session.
    """

    info: ClassVar[InstrumentInfo] = InstrumentInfo(
        id="opcua",
        kind="controller",
        summary="Any control with an OPC UA server, read-only: positions, spindle, feed, mode, program",
        status="peer_verified",
        simulator="errormotion.instruments.simulators.controller.opcua:SimulatedServer",
    )
    Settings: ClassVar[type[OpcUaSettings]] = OpcUaSettings
    settings: OpcUaSettings

    @classmethod
    def conformance(cls) -> InstrumentSubject:
        """Return the subject of the conformance kit."""
        return InstrumentSubject(cls, "sim://cframe/opcua", {"timeout": 1.5})

    def __init__(self, address: str, settings: OpcUaSettings | None = None, *, record: Path | None = None) -> None:
        super().__init__(address, settings, record=record)
        self._nodes: dict[str, str] = {}
        self._units: dict[str, str] = {}
        self._factors: dict[str, float] = {}
        self._identity: dict[str, str] = {}
        self._in_model: frozenset[str] = frozenset()
        self._started_at: float | None = None

    def identify(self) -> Identity:
        """Return the identity of the control that the server reports."""
        return Identity(
            manufacturer=self._identity.get("manufacturer", "unknown"),
            model=self._identity.get("model", "OPC UA server"),
            serial_number="unknown",
            firmware=self._identity.get("firmware", "unknown"),
            simulated=self.transport.simulated,
            details={"address": self.address, "quantities": ", ".join(sorted(self._nodes))},
        )

    def read(self) -> dict[str, Any]:
        """Return the present state, without values that are None."""
        return {name: value for name, value in self.state().items() if value is not None}

    def state(self) -> dict[str, Any]:
        """Return the state of the machine as the server reports it.

        Returns
        -------
        dict
            ``time`` (s on the server's clock since the driver was first opened), ``position`` and
            ``commanded_position`` (X, Y, Z, m), ``position_time`` (when the position last changed, s on the same
            clock), ``spindle_speed`` (1/min), ``spindle_load`` (fraction), ``feed`` (m/s), ``mode`` (``manual``,
            ``mdi``, ``automatic``, the text of the server, or empty), ``program``, ``running``, ``estop`` (None if no
            node reports it), ``homed`` (whether all axes are; None if no node reports it), ``enabled`` (None: not
            read), ``alarms`` (empty: not read), ``unavailable``: names of unknown values, and ``reasons``: why, by
            name of the quantity (``position.X``), for those that have a node. Unknown numbers are NaN.

        Raises
        ------
        ProtocolError
            An answer without the values that were requested.
        InstrumentTimeoutError
            No answer within the time limit.
        InstrumentError
            The connection is lost, or the server refuses.
        """
        keys = list(self._nodes)
        clock, *answers = self._read([model.NODE_TIME, *self._nodes.values()])
        values = dict(zip(keys, answers, strict=True))
        now = _seconds(clock.get("value"))
        if self._started_at is None and math.isfinite(now):
            self._started_at = now
        start = math.nan if self._started_at is None else self._started_at
        number = {key: self._number(key, values.get(key)) for key in NUMBERS}
        text = {key: _text(values.get(key)) for key in TEXTS}
        moved = [_seconds(values[f"position.{axis}"]["time"]) for axis in "XYZ" if f"position.{axis}" in values]
        state: dict[str, Any] = {
            "time": now - start,
            "position": [number[f"position.{axis}"] for axis in "XYZ"],
            "commanded_position": [number[f"commanded_position.{axis}"] for axis in "XYZ"],
            "position_time": max(moved, default=math.nan) - start,
            **{key: number[key] for key in ("spindle_speed", "spindle_load", "feed")},
            "mode": model.MODES.get(text["mode"], "") if "mode" in self._in_model else text["mode"],
            "program": text["program"],
            "running": text["execution"] in self.settings.running,
            "homed": _all_of([values[key].get("value") for key in keys if key.startswith(model.HOMED)]),
            "enabled": None,
            "estop": text["estop"] in self.settings.stopped if text["estop"] else None,
            "alarms": [],
        }
        state["unavailable"] = [
            *(key for key in ("position", "commanded_position") if any(math.isnan(x) for x in state[key])),
            *(key for key in ("spindle_speed", "spindle_load", "feed") if math.isnan(state[key])),
            *(key for key in TEXTS if _scalar(values.get(key)) is None),
        ]
        state["reasons"] = {
            key: reason
            for key, answer in values.items()
            if not key.startswith(model.HOMED) and (reason := _reason(key, answer))
        }
        return state

    # ------------------------------------------------------------------ values

    def _number(self, key: str, answer: Mapping[str, Any] | None) -> float:
        value = _scalar(answer)
        if isinstance(value, bool) or not isinstance(value, int | float):
            return math.nan
        try:
            return float(value) * self._factors[key]
        except OverflowError:  # an integer beyond the range of float
            return math.nan

    # ------------------------------------------------------------------ requests

    def _read(self, nodes: Sequence[str]) -> list[Mapping[str, Any]]:
        answers = request(self.transport, {"read": list(nodes)})
        whole = isinstance(answers, list) and len(answers) == len(nodes)
        if not whole or not all(isinstance(each, dict) and {"value", "time"} <= each.keys() for each in answers):
            raise ProtocolError(
                f"{self.address}: expected the values of {len(nodes)} nodes; found {str(answers)[:80]}",
                code="protocol.opc.count",
            )
        return list(answers)

    def _browse(self, node: str) -> list[Mapping[str, Any]]:
        nodes = request(self.transport, {"browse": node})
        if not isinstance(nodes, list) or not all(_is_child(each) for each in nodes):
            raise ProtocolError(
                f"{self.address}: expected the children of {node}; found {str(nodes)[:80]}", code="protocol.opc.form"
            )
        return nodes

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
        server = request(self.transport, {"server": True})
        namespaces = server.get("namespaces") if isinstance(server, dict) else None
        if not isinstance(namespaces, list):
            raise ProtocolError(
                f"{self.address}: expected the namespaces of the server; found {str(server)[:80]}",
                code="protocol.opc.form",
            )
        root = model.interface(namespaces, self._browse)
        found: dict[str, str] = {}
        if root:
            found, self._units = model.quantities(root, self._browse, self.settings)
            parts = model.children(self._browse, root)
            named = [name for name in model.IDENTITY if name in parts]
            values = self._read([parts[name] for name in named]) if named else []
            self._identity = {model.IDENTITY[name]: _text(value) for name, value in zip(named, values, strict=True)}
        self._in_model = frozenset(found.keys() - self.settings.nodes.keys())
        self._nodes = found | self.settings.nodes
        if not self._nodes:
            raise InstrumentError(
                f"The server at {self.address} has no object CncInterface (OPC 40502); state nodes in the settings, "
                "as in nodes.spindle_speed = 'ns=2;s=/Channel/Spindle/actSpeed[u1,1]'",
                code="opc.object.missing",
            )
        self._factors = {key: self._factor(key) for key in NUMBERS if key in self._nodes}
        for key, value in zip(self._nodes, self._read(list(self._nodes.values())), strict=True):
            if key in self.settings.nodes and value["value"] is None and value.get("status") != "Good":
                raise InstrumentError(
                    f"nodes.{key} = '{self._nodes[key]}': the server answers {value.get('status')}",
                    code="opc.node.no_value",
                )

    def _factor(self, key: str) -> float:
        """Return the factor from the unit of a node to that of the state."""
        if key.partition(".")[0] in self.settings.units:
            return model.factor(key, None, self.settings)
        unit = model.children(self._browse, self._nodes[key]).get(model.UNIT, "")
        if not unit and key not in self.settings.nodes:
            unit = self._units.get(key, "")
        return model.factor(key, self._read([unit])[0]["value"] if unit else None, self.settings)


def _is_child(each: Any) -> bool:
    """Whether an object describes a node like `transports.opc`."""
    return (
        isinstance(each, dict)
        and all(isinstance(each.get(name), str) for name in ("id", "name"))
        and "namespace" in each
    )


def _seconds(time: Any) -> float:
    """Return a time as s since 1970; NaN if it is invalid."""
    try:
        return datetime.fromisoformat(time).timestamp()
    except (TypeError, ValueError, OverflowError):
        return math.nan


def _all_of(answers: Sequence[Any]) -> bool | None:
    """Return whether all answers are true; None if one is unknown, or there are none."""
    if not answers or not all(isinstance(answer, bool) for answer in answers):
        return None
    return all(answers)


def _scalar(answer: Mapping[str, Any] | None) -> Any:
    """Return the value of a node; None without a node or a good status, and for an array or a structure."""
    value = None if answer is None else answer.get("value")
    return None if isinstance(value, list | dict) else value


def _reason(key: str, answer: Mapping[str, Any]) -> str:
    """Return why the value of a quantity is unknown; empty if it is known."""
    value = answer.get("value")
    if isinstance(value, list):
        return f"the node has an array of {len(value)} values; expected a single value"
    if isinstance(value, dict):
        return "the node has a structure; expected a single value"
    if value is None:
        status = str(answer.get("status", "Good"))[:60]
        return f"the status is {status}" if status != "Good" else "the node has no value, or one of an unknown type"
    if key in NUMBERS and (isinstance(value, bool) or not isinstance(value, int | float)):
        return f"expected a number; found {str(value)[:40]!r}"
    if key in NUMBERS and isinstance(value, float) and not math.isfinite(value):
        return f"the number is {value}"
    return ""


def _text(answer: Mapping[str, Any] | None) -> str:
    value = _scalar(answer)
    return "" if value is None else str(value)
