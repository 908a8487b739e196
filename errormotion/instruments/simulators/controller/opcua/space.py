"""The address space: the standard nodes of a small server, and functions to add nodes.

The package asyncua loads more than 6000 standard nodes, which takes seconds. This module adds those that a client of a
small server needs; OPC 10000-7 requires the type system only of larger profiles.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from asyncua import ua
from asyncua.server.address_space import AddressSpace, AttributeService
from asyncua.server.internal_server import InternalServer
from asyncua.ua.attribute_ids import AttributeIds
from asyncua.ua.object_ids import ObjectIds

from errormotion.errors import InstrumentError

Reader = Callable[[], ua.DataValue]
Ids = ObjectIds
UA = 0
"""Index of the namespace of OPC UA."""

_TYPES = (
    (Ids.References, "References", 0, ua.NodeClass.ReferenceType),
    (Ids.HierarchicalReferences, "HierarchicalReferences", Ids.References, ua.NodeClass.ReferenceType),
    (Ids.NonHierarchicalReferences, "NonHierarchicalReferences", Ids.References, ua.NodeClass.ReferenceType),
    (Ids.HasChild, "HasChild", Ids.HierarchicalReferences, ua.NodeClass.ReferenceType),
    (Ids.Organizes, "Organizes", Ids.HierarchicalReferences, ua.NodeClass.ReferenceType),
    (Ids.Aggregates, "Aggregates", Ids.HasChild, ua.NodeClass.ReferenceType),
    (Ids.HasSubtype, "HasSubtype", Ids.HasChild, ua.NodeClass.ReferenceType),
    (Ids.HasProperty, "HasProperty", Ids.Aggregates, ua.NodeClass.ReferenceType),
    (Ids.HasComponent, "HasComponent", Ids.Aggregates, ua.NodeClass.ReferenceType),
    (Ids.HasTypeDefinition, "HasTypeDefinition", Ids.NonHierarchicalReferences, ua.NodeClass.ReferenceType),
    (Ids.HasEncoding, "HasEncoding", Ids.NonHierarchicalReferences, ua.NodeClass.ReferenceType),
    (Ids.BaseObjectType, "BaseObjectType", 0, ua.NodeClass.ObjectType),
    (Ids.FolderType, "FolderType", Ids.BaseObjectType, ua.NodeClass.ObjectType),
    (Ids.ServerType, "ServerType", Ids.BaseObjectType, ua.NodeClass.ObjectType),
    (Ids.ServerCapabilitiesType, "ServerCapabilitiesType", Ids.BaseObjectType, ua.NodeClass.ObjectType),
    (Ids.OperationLimitsType, "OperationLimitsType", Ids.FolderType, ua.NodeClass.ObjectType),
    (Ids.DataTypeEncodingType, "DataTypeEncodingType", Ids.BaseObjectType, ua.NodeClass.ObjectType),
    (Ids.BaseVariableType, "BaseVariableType", 0, ua.NodeClass.VariableType),
    (Ids.BaseDataVariableType, "BaseDataVariableType", Ids.BaseVariableType, ua.NodeClass.VariableType),
    (Ids.PropertyType, "PropertyType", Ids.BaseVariableType, ua.NodeClass.VariableType),
    (Ids.DataItemType, "DataItemType", Ids.BaseDataVariableType, ua.NodeClass.VariableType),
    (Ids.AnalogItemType, "AnalogItemType", Ids.DataItemType, ua.NodeClass.VariableType),
    (Ids.ServerStatusType, "ServerStatusType", Ids.BaseDataVariableType, ua.NodeClass.VariableType),
    (Ids.BuildInfoType, "BuildInfoType", Ids.BaseDataVariableType, ua.NodeClass.VariableType),
    (Ids.BaseDataType, "BaseDataType", 0, ua.NodeClass.DataType),
    (Ids.Number, "Number", Ids.BaseDataType, ua.NodeClass.DataType),
    (Ids.Integer, "Integer", Ids.Number, ua.NodeClass.DataType),
    (Ids.UInteger, "UInteger", Ids.Number, ua.NodeClass.DataType),
    (Ids.Enumeration, "Enumeration", Ids.BaseDataType, ua.NodeClass.DataType),
    (Ids.Structure, "Structure", Ids.BaseDataType, ua.NodeClass.DataType),
    (Ids.Boolean, "Boolean", Ids.BaseDataType, ua.NodeClass.DataType),
    (Ids.Double, "Double", Ids.Number, ua.NodeClass.DataType),
    (Ids.String, "String", Ids.BaseDataType, ua.NodeClass.DataType),
    (Ids.DateTime, "DateTime", Ids.BaseDataType, ua.NodeClass.DataType),
    (Ids.NodeId, "NodeId", Ids.BaseDataType, ua.NodeClass.DataType),
    (Ids.LocalizedText, "LocalizedText", Ids.BaseDataType, ua.NodeClass.DataType),
    (Ids.Int32, "Int32", Ids.Integer, ua.NodeClass.DataType),
    (Ids.Byte, "Byte", Ids.UInteger, ua.NodeClass.DataType),
    (Ids.UInt16, "UInt16", Ids.UInteger, ua.NodeClass.DataType),
    (Ids.UInt32, "UInt32", Ids.UInteger, ua.NodeClass.DataType),
    (Ids.UtcTime, "UtcTime", Ids.DateTime, ua.NodeClass.DataType),
    (Ids.ServerState, "ServerState", Ids.Enumeration, ua.NodeClass.DataType),
    (Ids.ServerStatusDataType, "ServerStatusDataType", Ids.Structure, ua.NodeClass.DataType),
    (Ids.BuildInfo, "BuildInfo", Ids.Structure, ua.NodeClass.DataType),
    (Ids.EUInformation, "EUInformation", Ids.Structure, ua.NodeClass.DataType),
    (Ids.Range, "Range", Ids.Structure, ua.NodeClass.DataType),
    (Ids.EnumValueType, "EnumValueType", Ids.Structure, ua.NodeClass.DataType),
)
_FOLDERS = (
    (Ids.ObjectsFolder, "Objects", Ids.RootFolder),
    (Ids.TypesFolder, "Types", Ids.RootFolder),
    (Ids.ViewsFolder, "Views", Ids.RootFolder),
    (Ids.ObjectTypesFolder, "ObjectTypes", Ids.TypesFolder),
    (Ids.VariableTypesFolder, "VariableTypes", Ids.TypesFolder),
    (Ids.DataTypesFolder, "DataTypes", Ids.TypesFolder),
    (Ids.ReferenceTypesFolder, "ReferenceTypes", Ids.TypesFolder),
)
_FOLDER_OF = {
    ua.NodeClass.ReferenceType: Ids.ReferenceTypesFolder,
    ua.NodeClass.ObjectType: Ids.ObjectTypesFolder,
    ua.NodeClass.VariableType: Ids.VariableTypesFolder,
    ua.NodeClass.DataType: Ids.DataTypesFolder,
}
_BUILD = ("ProductUri", "ManufacturerName", "ProductName", "SoftwareVersion", "BuildNumber")
_LIMITS = (
    *("MaxNodesPerRead", "MaxNodesPerHistoryReadData", "MaxNodesPerHistoryReadEvents", "MaxNodesPerWrite"),
    *("MaxNodesPerHistoryUpdateData", "MaxNodesPerHistoryUpdateEvents", "MaxNodesPerMethodCall", "MaxNodesPerBrowse"),
    *("MaxNodesPerRegisterNodes", "MaxNodesPerTranslateBrowsePathsToNodeIds", "MaxNodesPerNodeManagement"),
    "MaxMonitoredItemsPerCall",
)


def number(identifier: int, namespace: int = UA) -> ua.NodeId:
    """Return a numeric id of a node."""
    return ua.NodeId(ua.Int32(identifier), ua.Int16(namespace))


class Space:
    """Adds nodes to the address space of a server."""

    def __init__(self, server: InternalServer) -> None:
        self._nodes = server.node_mgt_service
        self._addresses = server.aspace

    def add(
        self,
        node: ua.NodeId,
        name: ua.QualifiedName,
        attributes: ua.NodeAttributes,
        parent: ua.NodeId | None,
        *,
        reference: int = Ids.HasComponent,
        definition: ua.NodeId | None = None,
    ) -> ua.NodeId:
        """Add a node with its name, below a parent (None: none), and return its id."""
        attributes.DisplayName = ua.LocalizedText(name.Name)
        item = ua.AddNodesItem(
            RequestedNewNodeId=node,
            BrowseName=name,
            ParentNodeId=parent or ua.NodeId(),
            ReferenceTypeId=number(reference),
            TypeDefinition=definition or ua.NodeId(),
            NodeAttributes=attributes,
        )
        item.NodeClass = _class_of(attributes)  # not an argument in older versions of the package
        left = list(self._nodes.try_add_nodes([item], check=False))
        if left or node not in self._addresses:
            raise InstrumentError(
                f"the simulated OPC UA server cannot add the node {node.to_string()}", code="simulator.node.not_added"
            )
        return node

    def object(
        self,
        node: ua.NodeId,
        name: ua.QualifiedName,
        parent: ua.NodeId,
        definition: ua.NodeId,
        reference: int = Ids.HasComponent,
    ) -> ua.NodeId:
        """Add an object."""
        return self.add(node, name, ua.ObjectAttributes(), parent, reference=reference, definition=definition)

    def type(self, node: ua.NodeId, name: ua.QualifiedName, kind: ua.NodeClass, parent: ua.NodeId) -> ua.NodeId:
        """Add a type below the type that it refines."""
        attributes: ua.NodeAttributes
        match kind:
            case ua.NodeClass.ObjectType:
                attributes = ua.ObjectTypeAttributes()
            case ua.NodeClass.VariableType:
                attributes = ua.VariableTypeAttributes(DataType=number(Ids.BaseDataType))
            case ua.NodeClass.DataType:
                attributes = ua.DataTypeAttributes()
            case _:
                attributes = ua.ReferenceTypeAttributes()
        reference = Ids.Organizes if parent in _TYPE_FOLDERS else Ids.HasSubtype
        return self.add(node, name, attributes, parent, reference=reference)

    def variable(
        self,
        node: ua.NodeId,
        name: ua.QualifiedName,
        parent: ua.NodeId | None,
        data_type: ua.NodeId,
        value: ua.Variant | Reader,
        *,
        definition: ua.NodeId | None = None,
        reference: int = Ids.HasComponent,
        rank: int = -1,
    ) -> ua.NodeId:
        """Add a variable with a constant value, or with a function that reads it; clients cannot write it."""
        attributes = ua.VariableAttributes(DataType=data_type, ValueRank=ua.Int32(rank))
        attributes.AccessLevel = attributes.UserAccessLevel = ua.Byte(1)  # bit 0: it can be read
        attributes.Value = value if isinstance(value, ua.Variant) else ua.Variant()
        if definition is None:
            definition = number(Ids.PropertyType if reference == Ids.HasProperty else Ids.BaseDataVariableType)
        self.add(node, name, attributes, parent, reference=reference, definition=definition)
        if not isinstance(value, ua.Variant):
            self.live(node, value)
        return node

    def live(self, node: ua.NodeId, read: Reader) -> None:
        """Read the value of a variable at each request."""
        self._addresses.set_attribute_value_callback(node, AttributeIds.Value, lambda _node, _attribute: read())


_TYPE_FOLDERS = {number(folder) for folder in _FOLDER_OF.values()}


def _class_of(attributes: ua.NodeAttributes) -> ua.NodeClass:
    return ua.NodeClass[type(attributes).__name__.removesuffix("Attributes")]


class SmallServer(InternalServer):
    """The services of asyncua with the standard nodes of a small server."""

    async def load_standard_address_space(self, shelf_file: Path | None = None) -> None:  # noqa: ARG002 - none is needed
        """Add the standard nodes."""
        space = Space(self)
        name = ua.QualifiedName
        space.add(number(Ids.RootFolder), name("Root"), ua.ObjectAttributes(), None)
        for folder, text, parent in _FOLDERS:
            space.add(number(folder), name(text), ua.ObjectAttributes(), number(parent), reference=Ids.Organizes)
        for node, text, parent, kind in _TYPES:
            space.type(number(node), name(text), kind, number(parent or _FOLDER_OF[kind]))
        _add_server(space)


def _add_server(space: Space) -> None:
    name, server = ua.QualifiedName, number(Ids.Server)
    space.object(server, name("Server"), number(Ids.ObjectsFolder), number(Ids.ServerType), Ids.Organizes)
    text, unsigned, empty = number(Ids.String), number(Ids.UInt32), ua.Variant()
    none = ua.Variant([], ua.VariantType.String)
    for identifier, title in ((Ids.Server_ServerArray, "ServerArray"), (Ids.Server_NamespaceArray, "NamespaceArray")):
        space.variable(number(identifier), name(title), server, text, none, reference=Ids.HasProperty, rank=1)
    level, byte = number(Ids.Server_ServiceLevel), number(Ids.Byte)
    space.variable(level, name("ServiceLevel"), server, byte, empty, reference=Ids.HasProperty)

    status, kind = number(Ids.Server_ServerStatus), number(Ids.ServerStatusType)
    structure = number(Ids.ServerStatusDataType)
    space.variable(status, name("ServerStatus"), server, structure, empty, definition=kind)
    for identifier, title, data_type in (
        (Ids.Server_ServerStatus_StartTime, "StartTime", Ids.UtcTime),
        (Ids.Server_ServerStatus_CurrentTime, "CurrentTime", Ids.UtcTime),
        (Ids.Server_ServerStatus_State, "State", Ids.ServerState),
        (Ids.Server_ServerStatus_SecondsTillShutdown, "SecondsTillShutdown", Ids.UInt32),
    ):
        space.variable(number(identifier), name(title), status, number(data_type), empty)
    build, kind = number(Ids.Server_ServerStatus_BuildInfo), number(Ids.BuildInfoType)
    space.variable(build, name("BuildInfo"), status, number(Ids.BuildInfo), empty, definition=kind)
    for title in _BUILD:
        space.variable(number(getattr(Ids, f"Server_ServerStatus_BuildInfo_{title}")), name(title), build, text, empty)
    date = number(Ids.Server_ServerStatus_BuildInfo_BuildDate)
    space.variable(date, name("BuildDate"), build, number(Ids.UtcTime), empty)

    capabilities, limits = Ids.Server_ServerCapabilities, Ids.Server_ServerCapabilities_OperationLimits
    kind = number(Ids.ServerCapabilitiesType)
    space.object(number(capabilities), name("ServerCapabilities"), server, kind)
    kind = number(Ids.OperationLimitsType)
    space.object(number(limits), name("OperationLimits"), number(capabilities), kind)
    for title in _LIMITS:
        node = number(getattr(Ids, f"Server_ServerCapabilities_OperationLimits_{title}"))
        space.variable(node, name(title), number(limits), unsigned, empty, reference=Ids.HasProperty)


class Attributes(AttributeService):
    """Reads attributes; all values of one request belong to the same instant.

    Parameters
    ----------
    space : AddressSpace
    refresh : callable
        Called before a request is answered.
    further : callable, optional
        Returns the value of a node that is not in the space, or None.
    """

    def __init__(
        self,
        space: AddressSpace,
        refresh: Callable[[], None],
        further: Callable[[ua.NodeId], ua.DataValue | None] | None = None,
    ) -> None:
        super().__init__(space)
        self._space = space
        self._refresh = refresh
        self._further = further

    def read(self, params: ua.ReadParameters) -> list[ua.DataValue]:
        """Return the attributes of a request."""
        self._refresh()
        return [self._read(each.NodeId, each.AttributeId) for each in params.NodesToRead]

    def _read(self, node: ua.NodeId, attribute: AttributeIds) -> ua.DataValue:
        if self._further is not None and attribute == AttributeIds.Value and node not in self._space:
            found = self._further(node)
            if found is not None:
                return found
        return self._space.read_attribute_value(node, attribute)
