"""Values, ids and first messages of OPC UA against published bytes, through the package and the transport."""

import math
from typing import Any

import pytest
from wire_vectors import Vector, vectors

from errormotion.instruments.transports import opc

ua = pytest.importorskip("asyncua.ua")
binary = pytest.importorskip("asyncua.ua.ua_binary")
Buffer = pytest.importorskip("asyncua.common.utils").Buffer


def layer(name: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("vector", vectors("opcua", name), ids=str)


def same(found: Any, expected: Any) -> bool:
    return found == expected or (isinstance(expected, float) and math.isnan(expected) and math.isnan(found))


@layer("scalar")
def test_scalars(vector: Vector) -> None:
    kind = ua.VariantType[vector.expected["type"]]
    data = Buffer(bytes((kind.value,)) + vector.data)  # a variant is the number of the type, and the value
    assert same(opc.plain(binary.variant_from_binary(data).Value), vector.expected["value"])
    assert len(data) == 0


@layer("variant")
def test_variants(vector: Vector) -> None:
    assert opc.plain(binary.variant_from_binary(Buffer(vector.data)).Value) == vector.expected["value"]


@layer("node id")
def test_ids_of_nodes(vector: Vector) -> None:
    found = binary.nodeid_from_binary(Buffer(vector.data))
    assert found.to_string() == vector.expected["text"]
    sent = binary.nodeid_to_binary(ua.NodeId.from_string(vector.expected["text"]))  # there are forms of several lengths
    assert binary.nodeid_from_binary(Buffer(sent)).to_string() == vector.expected["text"]


@layer("data value")
def test_values_with_status_and_time(vector: Vector) -> None:
    found = opc._plain(binary.struct_from_binary(ua.DataValue, Buffer(vector.data)))
    time = found["time"] and found["time"].removesuffix("+00:00")
    expected = {"value": None, "time": None} | vector.expected
    assert {**found, "time": time} == expected


@layer("message")
def test_first_messages(vector: Vector) -> None:
    data = Buffer(vector.data)
    assert binary.header_from_binary(data).MessageType == vector.data[:3]
    found = binary.struct_from_binary(getattr(ua, vector.expected["kind"]), data)
    stated = {name: value for name, value in vector.expected.items() if name != "kind"}
    assert {name: getattr(found, name) for name in stated} == stated
    assert len(data) == 0
