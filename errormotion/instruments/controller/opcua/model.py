"""The information model OPC UA for CNC Systems (OPC 40502): assignment of quantities to nodes.

The object ``CncInterface`` has lists of axes, spindles and channels (clause 8.1). Names of objects and variables, and
values of enumerations, are those of clauses 6.6 to 6.9 and 7.2.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from errormotion.datasets.units import convert
from errormotion.errors import DatasetError, InstrumentError
from errormotion.instruments.controller.opcua.settings import UNITS, OpcUaSettings

NAMESPACE = "http://opcfoundation.org/UA/CNC"
OBJECTS = "i=85"
"""The folder of all objects of a server."""
NODE_TIME = "i=2258"
"""Node of the time of the server."""
MODES = {"0": "manual", "1": "mdi", "2": "automatic"}
"""Modes by the value of CncOperationMode."""
HOMED = "homed."
"""Prefix of the quantities that report whether an axis is referenced."""
IDENTITY = {"VendorName": "manufacturer", "CncTypeName": "model", "VendorRevision": "firmware"}

#: Units by the code of the property EngineeringUnits: the characters of the UNECE code (Recommendation 20) as a number.
UNIT_CODES = {
    int.from_bytes(code.encode("ascii"), "big"): unit
    for code, unit in {
        "MMT": "mm",
        "MTR": "m",
        "INH": "inch",
        "4H": "um",
        "RPM": "1/min",
        "RPS": "1/s",
        "P1": "%",
        "C16": "mm/s",
        "MTS": "m/s",
        "2X": "m/min",
        "H81": "mm/min",
    }.items()
}

UNIT = "EngineeringUnits"
"""Name of the property that states a unit."""
FRACTIONS = {"%": 0.01, "percent": 0.01, "1": 1.0}
"""Units of dimensionless numbers."""

Browse = Callable[[str], Sequence[Mapping[str, Any]]]
"""Returns the children of a node."""


def interface(namespaces: Sequence[str], browse: Browse) -> str:
    """Return the id of the object CncInterface; empty if the server has none."""
    if NAMESPACE not in namespaces:
        return ""
    index = namespaces.index(NAMESPACE)
    ids = [each["id"] for each in browse(OBJECTS) if each["name"] == "CncInterface" and each["namespace"] == index]
    return ids[0] if ids else ""


def quantities(root: str, browse: Browse, settings: OpcUaSettings) -> tuple[dict[str, str], dict[str, str]]:
    """Return the ids of nodes by quantity (`settings.KEYS`), and of the properties that state their units.

    The unit of a position is a property of its group, ``PosDirect`` or ``PosIndirect`` (clause 7.3.2).

    Raises
    ------
    InstrumentError
        The server has no axis, spindle or channel with the name in the settings; or several, and the settings state
        none.
    """
    parts = children(browse, root)
    nodes: dict[str, str] = {}
    units: dict[str, str] = {}
    axes = children(browse, parts.get("CncAxisList", ""))
    for axis, name in zip("XYZ", settings.axes, strict=True):
        axis_parts = children(browse, _one("axis", axes, name))
        position = children(browse, axis_parts.get(f"Pos{settings.feedback.capitalize()}", ""))
        both = {"ActPos": f"position.{axis}", "CmdPos": f"commanded_position.{axis}"}
        nodes |= _present(position, both) | _present(axis_parts, {"IsReferenced": f"{HOMED}{axis}"})
        if UNIT in position:
            units |= dict.fromkeys(both.values(), position[UNIT])
    spindle = children(browse, _one("spindle", children(browse, parts.get("CncSpindleList", "")), settings.spindle))
    nodes |= _present(spindle, {"ActSpeed": "spindle_speed", "ActLoad": "spindle_load"})
    channel = children(browse, _one("channel", children(browse, parts.get("CncChannelList", "")), settings.channel))
    names = {"ActFeedrate": "feed", "ActOperationMode": "mode", "ActProgramName": "program"}
    return nodes | _present(channel, names | {"ActProgramStatus": "execution"}), units


def children(browse: Browse, node: str) -> dict[str, str]:
    """Return the ids of the children of a node by name; none for an empty node id."""
    return {each["name"]: each["id"] for each in browse(node)} if node else {}


def factor(key: str, stated: Any, settings: OpcUaSettings) -> float:
    """Return the factor that converts a number of a quantity: from the unit of the settings, else of the server.

    Parameters
    ----------
    key : str
        One of `settings.NUMBERS`.
    stated : object
        Value of the property EngineeringUnits; None if the node has none.
    settings : OpcUaSettings

    Raises
    ------
    InstrumentError
        No unit, an unknown one, or one of another quantity.
    """
    name = key.partition(".")[0]
    if name in settings.units:
        return _scaled(settings.units[name], UNITS[name], f"The setting units.{name}")
    if isinstance(stated, dict):
        code, unit = stated.get("code"), str(stated.get("unit", ""))
        if isinstance(code, int) and code in UNIT_CODES:
            return _scaled(UNIT_CODES[code], UNITS[name], f"'{key}'")
        if unit:
            return _scaled({"rpm": "1/min", "r/min": "1/min"}.get(unit, unit), UNITS[name], f"'{key}'")
    raise InstrumentError(
        f"'{key}': the server does not state its unit; state it in the settings: units.{name} = 'mm'",
        code="opc.unit.missing",
    )


def _scaled(unit: str, target: str, what: str) -> float:
    if target == "1" and unit in FRACTIONS:
        return FRACTIONS[unit]
    try:
        return float(convert(1.0, unit, target))
    except DatasetError as error:
        raise InstrumentError(
            f"{what}: expected a unit that converts to {target}; found '{unit}' ({error})", code="opc.unit.other"
        ) from None


def _present(parts: Mapping[str, str], names: Mapping[str, str]) -> dict[str, str]:
    return {key: parts[name] for name, key in names.items() if name in parts}


def _one(what: str, nodes: Mapping[str, str], name: str) -> str:
    """Return the node with a name; without a name the only node, or an empty id if there is none."""
    if name:
        if name in nodes or not nodes:
            return nodes.get(name, "")
        raise InstrumentError(
            f"The server has no {what} '{name}'; it has {', '.join(sorted(nodes))}", code="opc.object.unknown"
        )
    if len(nodes) > 1:
        raise InstrumentError(
            f"The server has several: {what} {', '.join(sorted(nodes))}; state one in the settings",
            code="opc.object.ambiguous",
        )
    return next(iter(nodes.values()), "")
