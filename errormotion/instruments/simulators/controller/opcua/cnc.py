"""The object CncInterface of OPC 40502 1.00, with the types of the published NodeSet ``Opc.Ua.CNC.NodeSet.xml``.

Components are those of Tables 7 to 15; units are those of the instances in the NodeSet. Quantities that the virtual
machine does not have (torque, zero offsets, ...) have the status BadNoData.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

from asyncua import ua

from errormotion.instruments.simulators.controller.opcua.machine import AXES, Machine
from errormotion.instruments.simulators.controller.opcua.space import UA, Ids, Space, number

NAMESPACE = "http://opcfoundation.org/UA/CNC"
UNITS = "http://www.opcfoundation.org/UA/units/un/cefact"
VERSION = "1.00"
CHANNEL, SPINDLE = "Channel1", "S1"

# UNECE codes, and displayed units
MM, PERCENT, NEWTON_METRE, WATT = ("MMT", "mm"), ("P1", "%"), ("NU", "N·m"), ("WTT", "W")
PER_MINUTE, MM_PER_MINUTE, DEGREE = ("RPM", "r/min"), ("H81", "mm/min"), ("DD", "°")
Unit = tuple[str, str]

# ids of types in the NodeSet
_POSITION_TYPE, _POSITION_DATA, _POSITION_ENCODING = 2001, 3007, 5001
_COMPONENT, _CHANNEL, _DRIVE, _AXIS, _SPINDLE, _INTERFACE = 1001, 1002, 1003, 1004, 1005, 1007
_AXIS_LIST, _SPINDLE_LIST, _CHANNEL_LIST = 1008, 1009, 1010
_OBJECT_TYPES = (
    *((_COMPONENT, "CncComponentType", 0), (_CHANNEL, "CncChannelType", _COMPONENT)),
    *((_DRIVE, "CncDriveType", _COMPONENT), (_AXIS, "CncAxisType", _DRIVE), (_SPINDLE, "CncSpindleType", _DRIVE)),
    *((_INTERFACE, "CncInterfaceType", 0), (_AXIS_LIST, "CncAxisListType", 0)),
    *((_SPINDLE_LIST, "CncSpindleListType", 0), (_CHANNEL_LIST, "CncChannelListType", 0)),
)
_ENUMERATIONS = {
    "CncSpindleTurnDirection": (3001, 6146, ("None", "CW", "CCW")),
    "CncChannelProgramStatus": (3002, 6225, ("Stopped", "Running", "Waiting", "Interrupted", "Canceled")),
    "CncChannelStatus": (3003, 6223, ("Active", "Interrupted", "Reset")),
    "CncAxisStatus": (3004, 6976, ("InPosition", "Moving", "Parked")),
    "CncSpindleStatus": (3005, 6224, ("Stopped", "InTargetArea", "Accelerating", "Decelerating", "Parked")),
    "CncOperationMode": (3006, 7106, ("Manual", "MDA", "Automatic")),
}
_MODES = {"manual": 0, "mdi": 1, "automatic": 2}


@dataclass(frozen=True)
class Item:
    """A component of an object.

    Attributes
    ----------
    name : str
    data : str
        ``Double``, ``UInt32``, ``Boolean``, ``String``, ``NodeId``, an enumeration, or ``position`` (a group).
    source : str
        Name of the reading, or the part of it after the name of the axis; empty: unknown.
    unit : (str, str), optional
        Code and text.
    constant : object, optional
        A value that does not change, instead of a reading.
    rank : int
        -1: one value; 1: a list.
    """

    name: str
    data: str
    source: str = ""
    unit: Unit | None = None
    constant: Any = None
    rank: int = -1


_DRIVES = (
    Item("ActChannel", "NodeId", "channel"),
    Item("ActPower", "Double", unit=WATT),
    Item("ActTorque", "Double", unit=NEWTON_METRE),
    Item("CmdTorque", "Double", unit=NEWTON_METRE),
    Item("IsInactive", "Boolean", constant=False),
    Item("IsVirtual", "Boolean", constant=False),
)
_AXES = (
    *_DRIVES,
    Item("ActLoad", "Double", unit=PERCENT),
    Item("ActStatus", "CncAxisStatus", "moving"),
    Item("IsReferenced", "Boolean", "homed"),
    Item("IsRotational", "Boolean", constant=False),
    Item("PosDirect", "position", "axis", MM),
    Item("PosIndirect", "position", "axis", MM),
    Item("ZeroOffset", "Double", unit=MM),
)
_SPINDLES = (
    *_DRIVES,
    Item("ActLoad", "Double", "load", PERCENT),
    Item("ActGear", "UInt32", constant=1),
    Item("ActOverride", "Double", unit=PERCENT, constant=100.0),
    Item("ActSpeed", "Double", "speed", PER_MINUTE),
    Item("ActStatus", "CncSpindleStatus", "spindle"),
    Item("ActTurnDirection", "CncSpindleTurnDirection", "direction"),
    Item("AnglePos", "position", "none", DEGREE),
    Item("CmdGear", "UInt32", constant=1),
    Item("CmdOverride", "Double", unit=PERCENT, constant=100.0),
    Item("CmdSpeed", "Double", "set speed", PER_MINUTE),
)
_CHANNELS = (
    Item("ActFeedrate", "Double", "feed", MM_PER_MINUTE),
    Item("ActGFunctions", "UInt32", constant=[], rank=1),
    Item("ActJogIncrement", "Double", unit=MM),
    Item("ActMainProgramFile", "String", "program"),
    Item("ActMainProgramName", "String", "program"),
    Item("ActMFunctions", "UInt32", constant=[], rank=1),
    Item("ActModalOffsetFunction", "UInt32", constant=53),
    Item("ActOperationMode", "CncOperationMode", "mode"),
    Item("ActOverride", "Double", unit=PERCENT, constant=100.0),
    Item("ActProgramBlock", "String", constant=[], rank=1),
    Item("ActProgramFile", "String", "program"),
    Item("ActProgramName", "String", "program"),
    Item("ActProgramStatus", "CncChannelProgramStatus", "moving"),
    Item("ActStatus", "CncChannelStatus", "channel status"),
    Item("BlockMode", "Boolean", constant=False),
    Item("CmdFeedrate", "Double", unit=MM_PER_MINUTE),
    Item("CmdOperationMode", "CncOperationMode", "mode"),
    Item("CmdOverride", "Double", unit=PERCENT, constant=100.0),
    Item("DryRunFeed", "Double", unit=MM_PER_MINUTE),
    Item("FeedHold", "Boolean", constant=False),
    *(Item(f"PosTcp{system}{axis}", "position", f"{axis}.", MM) for system in ("Bcs", "Wcs") for axis in AXES),
    *(Item(f"PosTcp{system}{axis}", "position", "none", DEGREE) for system in ("Bcs", "Wcs") for axis in "ABC"),
    Item("ToolId", "UInt32"),
)


class Model:
    """Adds the model to a space.

    Parameters
    ----------
    space : Space
    machine : Machine
    own, model : int
        Indices of the namespaces of the server and of the model.
    unit_names : int
        Index of the namespace of the property EngineeringUnits of a group of positions.
    """

    def __init__(self, space: Space, machine: Machine, own: int, model: int, unit_names: int) -> None:
        self._space, self._machine = space, machine
        self._own, self._model, self._unit_names = own, model, unit_names

    def add(self, properties: dict[str, str]) -> None:
        """Add the types and the object CncInterface with its properties."""
        self._add_types()
        root = self._id("CncInterface")
        folder = number(Ids.ObjectsFolder)
        self._space.object(root, self._name("CncInterface"), folder, self._type(_INTERFACE), Ids.Organizes)
        for name, text in properties.items():
            value = ua.Variant(text, ua.VariantType.String)
            node = self._id(f"CncInterface.{name}")
            kind = number(Ids.String)
            self._space.variable(node, self._name(name), root, kind, value, reference=Ids.HasProperty)
        lists = (("CncAxisList", _AXIS_LIST), ("CncChannelList", _CHANNEL_LIST), ("CncSpindleList", _SPINDLE_LIST))
        for name, kind_of_list in lists:
            node = self._id(f"CncInterface.{name}")
            self._space.object(node, self._name(name), root, self._type(kind_of_list))
        for axis in AXES:
            self._component("CncAxisList", axis, _AXIS, _AXES)
        self._component("CncSpindleList", SPINDLE, _SPINDLE, _SPINDLES)
        channel = self._component("CncChannelList", CHANNEL, _CHANNEL, _CHANNELS)
        value = ua.Variant(1, ua.VariantType.UInt32)
        node = self._id(f"CncInterface.CncChannelList.{CHANNEL}.Id")
        kind = number(Ids.UInt32)
        self._space.variable(node, self._name("Id"), channel, kind, value, reference=Ids.HasProperty)

    # ------------------------------------------------------------------ types

    def _add_types(self) -> None:
        space, name = self._space, self._name
        for node, text, parent in _OBJECT_TYPES:
            above = self._type(parent) if parent else number(Ids.BaseObjectType)
            space.type(self._type(node), name(text), ua.NodeClass.ObjectType, above)
        above = number(Ids.BaseDataVariableType)
        space.type(self._type(_POSITION_TYPE), name("CncPositionVariableType"), ua.NodeClass.VariableType, above)
        data = self._type(_POSITION_DATA)
        space.type(data, name("CncPositionDataType"), ua.NodeClass.DataType, number(Ids.Structure))
        kind = number(Ids.DataTypeEncodingType)
        encoding, title = self._type(_POSITION_ENCODING), ua.QualifiedName("Default Binary")
        space.object(encoding, title, data, kind, Ids.HasEncoding)
        for text, (node, values, fields) in _ENUMERATIONS.items():
            enumeration = self._type(node)
            space.type(enumeration, name(text), ua.NodeClass.DataType, number(Ids.Enumeration))
            listed = [ua.EnumValueType(ua.Int64(i), ua.LocalizedText(field)) for i, field in enumerate(fields)]
            space.variable(
                self._type(values),
                ua.QualifiedName("EnumValues"),
                enumeration,
                number(Ids.EnumValueType),
                ua.Variant(listed, ua.VariantType.ExtensionObject),
                reference=Ids.HasProperty,
                rank=1,
            )

    # ------------------------------------------------------------------ instances

    def _component(self, parent: str, name: str, definition: int, items: tuple[Item, ...]) -> ua.NodeId:
        path = f"CncInterface.{parent}.{name}"
        node = self._id(path)
        self._space.object(node, self._name(name), self._id(f"CncInterface.{parent}"), self._type(definition))
        for item in items:
            if item.data == "position":
                self._group(node, path, item, name)
            else:
                self._item(node, path, item)
        return node

    def _item(self, parent: ua.NodeId, path: str, item: Item) -> None:
        node = self._id(f"{path}.{item.name}")
        definition = number(Ids.AnalogItemType if item.unit else Ids.DataItemType)
        if item.data in _ENUMERATIONS:
            data_type, kind = self._type(_ENUMERATIONS[item.data][0]), ua.VariantType.Int32
        else:
            data_type, kind = number(getattr(Ids, item.data)), ua.VariantType[item.data]

        def read() -> ua.DataValue:
            return self._machine.value(node, self._reading(item), kind)

        name = self._name(item.name)
        self._space.variable(node, name, parent, data_type, read, definition=definition, rank=item.rank)
        if item.unit:
            self._unit(node, f"{path}.{item.name}", item.unit, UA)

    def _group(self, parent: ua.NodeId, path: str, item: Item, axis: str) -> None:
        """Add a group of positions: a structure of three, each of them, and their unit."""
        path = f"{path}.{item.name}"
        prefix = f"{axis}." if item.source == "axis" else item.source
        names = [f"{prefix}{part}" for part in ("actual", "set", "left")]
        machine, node, kind = self._machine, self._id(path), ua.VariantType.Double

        def whole() -> ua.DataValue:
            values = [machine.reading(name) for name in names]
            if values[0] is None:
                return machine.value(node, None, ua.VariantType.ExtensionObject)
            body = struct.pack("<3d", *(float("nan") if value is None else value for value in values))
            structure = ua.ExtensionObject(self._type(_POSITION_ENCODING), ua.ByteString(body))
            return machine.value(node, structure, ua.VariantType.ExtensionObject)

        definition = self._type(_POSITION_TYPE)
        data_type = self._type(_POSITION_DATA)
        self._space.variable(node, self._name(item.name), parent, data_type, whole, definition=definition)
        for part, name in zip(("ActPos", "CmdPos", "RemDist"), names, strict=True):
            single = self._id(f"{path}.{part}")

            def read(single: ua.NodeId = single, name: str = name) -> ua.DataValue:
                return machine.value(single, machine.reading(name), kind)

            self._space.variable(single, self._name(part), node, number(Ids.Double), read)
        if item.unit:
            self._unit(node, path, item.unit, self._unit_names)

    def _unit(self, parent: ua.NodeId, path: str, unit: Unit, names: int) -> None:
        code, text = unit
        information = ua.EUInformation(
            UNITS, ua.Int32(int.from_bytes(code.encode(), "big")), ua.LocalizedText(text), ua.LocalizedText(text)
        )
        self._space.variable(
            self._id(f"{path}.EngineeringUnits"),
            ua.QualifiedName("EngineeringUnits", ua.UInt16(names)),
            parent,
            number(Ids.EUInformation),
            ua.Variant(information, ua.VariantType.ExtensionObject),
            reference=Ids.HasProperty,
        )

    def _reading(self, item: Item) -> Any:
        """Return the present value of an item; None if it is unknown."""
        machine = self._machine
        match item.source:
            case "":
                return item.constant
            case "channel":
                return self._id(f"CncInterface.CncChannelList.{CHANNEL}")
            case "mode":
                return _MODES.get(machine.reading("mode"))
            case "moving":
                return int(machine.reading("moving"))
            case "channel status":
                return 0 if machine.reading("moving") else 2
            case source:
                return machine.reading(source)

    # ------------------------------------------------------------------ names

    def _id(self, path: str) -> ua.NodeId:
        return ua.NodeId(ua.String(path), ua.Int16(self._own))

    def _type(self, identifier: int) -> ua.NodeId:
        return number(identifier, self._model)

    def _name(self, text: str) -> ua.QualifiedName:
        return ua.QualifiedName(text, ua.UInt16(self._model))
