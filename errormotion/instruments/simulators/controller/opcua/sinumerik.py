"""Variables of a SINUMERIK, by their paths.

Sources: Siemens, SINUMERIK Access MyMachine / OPC UA, Configuration Manual 12/2017, 5.3.1 with Table 5-1 (form of the
ids, lists, upper and lower case) and Commissioning Manual 10/2015, 4.2 (result of browsing: paths without index, which
stand for the first unit and row; BadAttributeIdInvalid for variables that the configuration does not have); SINUMERIK
840D sl, NC variables (names, units, values of ``opMode`` and ``progStatus``).

Assumptions: the types of the values, the ids of the folders, BadNodeIdUnknown for a path that does not exist, and that
metric positions are displayed.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from asyncua import ua
from asyncua.ua.status_codes import StatusCodes

from errormotion.instruments.simulators.controller.opcua.machine import AXES, Machine
from errormotion.instruments.simulators.controller.opcua.space import Ids, Reader, Space, number

NAMESPACE = "SinumerikVarProvider"
INDEX = 2
"""Index of the namespace of the variables."""
R_PARAMETERS = 100
MAX_ID = 200
"""Largest number of characters of an id."""
_ID = re.compile(r"(/\w+/\w+/\w+)(?:\[u(\d{1,4})(?:, ?(\d{1,4})(?:, ?(#?)(\d{1,4}))?)?\])?", re.ASCII)
_MODES = {"manual": 0, "mdi": 1, "automatic": 2}
_RUNNING, _ABORTED = 3, 5
_ACTIVE, _RESET = 1, 3
_DOUBLE, _TEXT, _WORD = ua.VariantType.Double, ua.VariantType.String, ua.VariantType.UInt16


@dataclass(frozen=True)
class Variable:
    """A variable: its rows, the type of a value, and a function that reads a row (from 0)."""

    rows: int
    kind: ua.VariantType
    read: Callable[[Machine, int], Any]


def _axis(part: str) -> Variable:
    return Variable(3, _DOUBLE, lambda machine, row: machine.reading(f"{AXES[row]}.{part}"))


def _one(name: str, kind: ua.VariantType = _DOUBLE) -> Variable:
    return Variable(1, kind, lambda machine, _: machine.reading(name))


_AXIS = {
    "name": Variable(3, _TEXT, lambda _, row: AXES[row]),
    "actToolBasePos": _axis("actual"),
    "cmdToolBasePos": _axis("set"),
    "toolBaseDistToGo": _axis("left"),
}
VARIABLES = {
    **{f"/Channel/{area}/{name}": each for area in ("GeometricAxis", "MachineAxis") for name, each in _AXIS.items()},
    "/Channel/Spindle/actSpeed": _one("speed"),
    "/Channel/Spindle/cmdSpeed": _one("set speed"),
    "/Channel/Spindle/driveLoad": _one("load"),
    "/Channel/State/actFeedRateIpo": _one("feed"),
    "/Channel/State/chanStatus": Variable(
        1, _WORD, lambda machine, _: _ACTIVE if machine.reading("moving") else _RESET
    ),
    "/Channel/State/progStatus": Variable(
        1, _WORD, lambda machine, _: _RUNNING if machine.reading("moving") else _ABORTED
    ),
    "/Channel/ProgramInfo/progName": _one("program", _TEXT),
    "/Channel/Parameter/R": Variable(R_PARAMETERS, _DOUBLE, lambda *_: 0.0),
    "/Bag/State/opMode": Variable(1, _WORD, lambda machine, _: _MODES.get(machine.reading("mode"))),
}
_TYPES = {_DOUBLE: Ids.Double, _TEXT: Ids.String, _WORD: Ids.UInt16}


def add(space: Space, machine: Machine) -> None:
    """Add the tree of variables, below the folder Sinumerik; further units and rows are read by their ids."""
    folders = {"": _folder(space, "Sinumerik", "/Sinumerik", number(Ids.ObjectsFolder))}
    for path, variable in VARIABLES.items():
        *above, name = path.split("/")
        for depth in range(2, len(above) + 1):
            here = "/".join(above[:depth])
            if here not in folders:
                folders[here] = _folder(space, above[depth - 1], here, folders["/".join(above[: depth - 1])])
        data_type = number(_TYPES[variable.kind])
        title = ua.QualifiedName(name, ua.UInt16(INDEX))
        space.variable(_id(path), title, folders["/".join(above)], data_type, _row(machine, variable, 0))
        # not found by browsing; as nodes they can be subscribed to
        for row in range(min(variable.rows, len(AXES))):
            node = _id(f"{path}[u1,{row + 1}]")
            space.variable(node, title, None, data_type, _row(machine, variable, row))
        if variable.rows == 1:
            space.variable(_id(f"{path}[u1]"), title, None, data_type, _row(machine, variable, 0))


def value(machine: Machine, node: ua.NodeId) -> ua.DataValue | None:
    """Return the value of a variable by its id; None if the id is not that of a variable."""
    identifier = node.Identifier
    if node.NamespaceIndex != INDEX or not isinstance(identifier, str) or len(identifier) > MAX_ID:
        return None
    match = _ID.fullmatch(identifier)
    if match is None or match[1] not in VARIABLES:
        return None
    variable = VARIABLES[match[1]]
    unit, first = int(match[2] or 1), int(match[3] or 1)
    last = first
    if match[5]:
        last = first + int(match[5]) - 1 if match[4] else int(match[5])
    if unit != 1 or not 1 <= first <= last <= variable.rows:
        return ua.DataValue(ua.Variant(), ua.StatusCode(ua.UInt32(StatusCodes.BadAttributeIdInvalid)))
    rows = [variable.read(machine, row) for row in range(first - 1, last)]
    if not match[5]:
        return machine.value(identifier, rows[0], variable.kind)
    return machine.value(identifier, None if None in rows else rows, variable.kind)


def _folder(space: Space, name: str, path: str, parent: ua.NodeId) -> ua.NodeId:
    title = ua.QualifiedName(name, ua.UInt16(INDEX))
    return space.object(_id(path), title, parent, number(Ids.FolderType), Ids.Organizes)


def _id(path: str) -> ua.NodeId:
    return ua.NodeId(ua.String(path), ua.Int16(INDEX))


def _row(machine: Machine, variable: Variable, row: int) -> Reader:
    return lambda: machine.value((variable, row), variable.read(machine, row), variable.kind)
