"""Inputs of a CiA 404 node: their objects, their units, and the PDOs that contain them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from errormotion.errors import InstrumentError
from errormotion.instruments.thermometer.cia404 import DIGITS, STATUS, UNIT, Number, Scale, scale_of
from errormotion.instruments.transports.can.node import CanNode
from errormotion.instruments.transports.can.pdo import TransmitPdo
from errormotion.instruments.transports.can.sdo import NO_OBJECT, NO_SUBINDEX, SdoRefusal

_MISSING = (NO_OBJECT, NO_SUBINDEX)


@dataclass(frozen=True)
class Input:
    """Location of an input, and the meaning of its number.

    Attributes
    ----------
    number : Number
    subindex : int
        0 if the object has no subindices.
    scale : Scale
    status : tuple of int, or None
        Index and subindex of its status; None if it has none.
    """

    number: Number
    subindex: int
    scale: Scale
    status: tuple[int, int] | None


def find_inputs(
    node: CanNode, subindices: Sequence[int], *, numbers: Iterable[Number], unit: int | None, digits: int | None
) -> list[Input]:
    """Return the inputs of a node.

    Parameters
    ----------
    node : CanNode
    subindices : sequence of int
        Subindices of the inputs.
    numbers : iterable of Number
        Formats of the value that are tried, in order.
    unit : int or None
        Code of the unit; None: as stated by the node.
    digits : int or None
        Decimal digits of whole numbers; None: as stated by the node.

    Raises
    ------
    InstrumentError
        The node has no such input, or neither the node nor the settings state unit or digits.
    """
    forms = tuple(numbers)
    return [_find(node, subindex, forms, unit, digits) for subindex in subindices]


def find_pdos(node: CanNode, inputs: Sequence[Input]) -> list[TransmitPdo]:
    """Return the PDOs with values or states of these inputs that a node sends at SYNC or at an interval.

    Raises
    ------
    InstrumentError
        None of the values is sent in this way.
    """
    sent = [pdo for pdo in node.transmit_pdos() if pdo.cyclic or pdo.timed]
    values = {(each.number.index, each.subindex) for each in inputs}
    states = {each.status for each in inputs if each.status is not None}
    if not any(pdo.place(*value) for pdo in sent for value in values):
        raise InstrumentError(
            f"{node.url}: node {node.node} sends none of its inputs in a PDO at SYNC or at an interval; map "
            f"{', '.join(f'0x{index:04X}:{subindex}' for index, subindex in sorted(values))} "
            "with the manufacturer's tool, with a transmission type of 1 to 240 or an event timer, or set "
            "transfer = 'sdo'",
            code="thermometer.inputs.not_sent",
        )
    return [pdo for pdo in sent if any(pdo.place(*entry) for entry in values | states)]


def _find(node: CanNode, subindex: int, numbers: Sequence[Number], unit: int | None, digits: int | None) -> Input:
    number, at = _value(node, subindex, numbers)
    where = f"{node.url}: node {node.node}, input {subindex}"
    decimals = 0
    if number.whole:
        stated = _entry(node, DIGITS, subindex, 1) if digits is None else digits
        if stated is None:
            what = (
                f"its values 0x{number.index:04X} are whole numbers, and it states no decimal digits (0x{DIGITS:04X})"
            )
            raise InstrumentError(
                f"{where}: {what}; state them in the setting 'digits'", code="thermometer.digits.unknown"
            )
        decimals = stated
    code = _entry(node, UNIT, subindex, 4) if unit is None else unit
    if code is None:
        raise InstrumentError(
            f"{where} states no unit (0x{UNIT:04X}); state it in the setting 'unit': degC, K or degF",
            code="thermometer.unit.unknown",
        )
    return Input(number, at, scale_of(code, decimals), _status(node, subindex))


def _value(node: CanNode, subindex: int, numbers: Sequence[Number]) -> tuple[Number, int]:
    """Return the first format of the value that the node has, and its subindex."""
    for number in numbers:
        if _has(node, number.index, subindex):
            return number, subindex
    for number in numbers:  # an object without subindices belongs to the first input
        if subindex == 1 and _has(node, number.index, 0) and len(node.upload(number.index, 0)) == number.size:
            return number, 0
    asked = " or ".join(f"0x{number.index:04X}:{subindex}" for number in numbers)
    raise InstrumentError(
        f"{node.url}: node {node.node} has no input {subindex}: {asked} does not exist; state the subindices of its "
        "inputs in the setting 'inputs'",
        code="thermometer.input.missing",
    )


def _status(node: CanNode, subindex: int) -> tuple[int, int] | None:
    """Return index and subindex of the status of an input, or of one status for all inputs; None without a status."""
    if _has(node, STATUS, subindex):
        return STATUS, subindex
    if not _has(node, STATUS, 1) and _has(node, STATUS, 0):
        return STATUS, 0
    return None


def _entry(node: CanNode, index: int, subindex: int, size: int) -> int | None:
    """Return an entry of an input, or the one without subindices; None if the node has neither."""
    for at in (subindex, 0):
        if at == 0 and _has(node, index, 1):  # the number of entries
            return None
        try:
            return node.unsigned(index, at, size)
        except SdoRefusal as refusal:
            if refusal.number not in _MISSING:
                raise
    return None


def _has(node: CanNode, index: int, subindex: int) -> bool:
    try:
        node.upload(index, subindex)
    except SdoRefusal as refusal:
        return refusal.number not in _MISSING
    return True
