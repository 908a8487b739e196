"""Modbus frames for reading (functions 3 and 4) and writing (6 and 16) registers, in the framings RTU and TCP (MBAP).

Requests, answers, framing and checksum are those of pymodbus, whose PDUs and framers do no input and output. What they
pass over is an error here: another unit, stray bytes, a wrong checksum, a length that does not fit. Pure functions
from bytes to numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

from pymodbus.framer import FramerRTU, FramerSocket
from pymodbus.pdu import DecodePDU, ExceptionResponse, ModbusPDU
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadHoldingRegistersResponse,
    ReadInputRegistersRequest,
    ReadInputRegistersResponse,
    WriteMultipleRegistersRequest,
    WriteMultipleRegistersResponse,
    WriteSingleRegisterRequest,
    WriteSingleRegisterResponse,
)

from errormotion.errors import InstrumentError, ProtocolError

Framing = Literal["tcp", "rtu"]
EXCEPTIONS = {
    1: "illegal function",
    2: "illegal data address",
    3: "illegal data value",
    4: "server device failure",
    5: "acknowledge, wait",
    6: "server device busy",
    8: "memory parity error",
    10: "gateway path unavailable",
    11: "gateway target device failed to respond",
}
MAX_FRAME: Mapping[str, int] = {"tcp": 260, "rtu": 256}
"""Bytes of the longest frame by framing."""
WRITE_ONE, WRITE_SEVERAL = 6, 16
MAX_WRITTEN = 123
"""Largest number of registers in one request of function 16."""
_HEAD = 7  # bytes of an MBAP header
_SHORTEST = 5  # bytes of the shortest RTU answer, a refusal
_MAX_MBAP_LENGTH = 254  # bytes after its length field
_DECODER = DecodePDU(is_server=False)
_FRAMERS = {"tcp": FramerSocket(_DECODER), "rtu": FramerRTU(_DECODER)}
_READS: Mapping[int, tuple[type[ModbusPDU], type[ModbusPDU]]] = {
    3: (ReadHoldingRegistersRequest, ReadHoldingRegistersResponse),
    4: (ReadInputRegistersRequest, ReadInputRegistersResponse),
}
_KNOWN = (*_READS, WRITE_ONE, WRITE_SEVERAL)


def crc16(data: bytes) -> bytes:
    """Return the checksum of an RTU frame, as it follows the frame: low byte first."""
    return FramerRTU.compute_CRC(data).to_bytes(2, "big")  # pymodbus swaps the bytes


def encode_request(framing: Framing, unit: int, function: int, register: int, count: int, number: int = 0) -> bytes:
    """Return the request for ``count`` registers from ``register`` on; ``number`` identifies a TCP transaction.

    Raises
    ------
    ValueError
        The function does not read registers, or not this number of them.
    """
    if function not in _READS:
        raise ValueError(f"function {function} does not read registers")
    return _FRAMERS[framing].buildFrame(
        _READS[function][0](address=register, count=count, dev_id=unit, transaction_id=number)
    )


def encode_write(
    framing: Framing, unit: int, function: int, register: int, values: Sequence[int], number: int = 0
) -> bytes:
    """Return the request that writes registers from ``register`` on: one by function 6, up to 123 by function 16.

    Raises
    ------
    ValueError
        The function does not write this number of registers.
    """
    count = len(values)
    if function == WRITE_ONE and count == 1:
        kind: type[ModbusPDU] = WriteSingleRegisterRequest
    elif function == WRITE_SEVERAL and 1 <= count <= MAX_WRITTEN:
        kind = WriteMultipleRegistersRequest
    else:
        raise ValueError(f"function {function} does not write {count} registers")
    return _FRAMERS[framing].buildFrame(
        kind(address=register, registers=list(values), dev_id=unit, transaction_id=number)
    )


def encode_answer(framing: Framing, unit: int, function: int, registers: Sequence[int], number: int = 0) -> bytes:
    """Return the answer with these registers."""
    return _FRAMERS[framing].buildFrame(
        _READS[function][1](registers=list(registers), dev_id=unit, transaction_id=number)
    )


def missing(framing: Framing, data: bytes) -> int:
    """Return the number of bytes that an incomplete answer still needs, as far as known from its start."""
    if framing == "rtu":
        size = _SHORTEST
        if len(data) >= 2 and data[1] & 0x7F in _KNOWN and (kind := _DECODER.lookupPduClass(data)) is not None:
            size = kind.calculateRtuFrameSize(data) or _SHORTEST
    elif len(data) < _HEAD - 1:
        size = _HEAD + 2
    else:
        protocol, length = _head(data)[1:3]
        valid = not protocol and length <= _MAX_MBAP_LENGTH
        size = 6 + length if valid else 0  # no further bytes are expected without a header
    return max(size - len(data), 0)


def decode_answer(
    framing: Framing, data: bytes, unit: int, function: int, count: int, number: int = 0
) -> list[int] | None:
    """Return the registers of a complete answer; None for the late answer to an earlier request (TCP only).

    Raises
    ------
    ProtocolError
        The answer is too short, or its checksum, unit, function or number of registers is wrong.
    ModbusRefusal
        The device answers with an exception.
    """
    pdu = _pdu(framing, data, unit, function, number)
    if pdu is None:
        return None
    if pdu[1] != 2 * count or len(pdu) != 2 + 2 * count:
        raise ProtocolError(
            f"Expected {count} registers; found {len(pdu) - 2} bytes: {_hex(data)}", code="protocol.reply.length"
        )
    return list(_decoded(pdu, data).registers)


def decode_written(
    framing: Framing, data: bytes, unit: int, function: int, register: int, values: Sequence[int], number: int = 0
) -> list[int] | None:
    """Return the values if a complete answer confirms that they were written; None as in `decode_answer`.

    Raises
    ------
    ProtocolError
        The answer is too short, or its checksum, unit, function or registers are wrong.
    ModbusRefusal
        The device answers with an exception.
    """
    pdu = _pdu(framing, data, unit, function, number)
    if pdu is None:
        return None
    expected: ModbusPDU = WriteMultipleRegistersResponse(address=register, count=len(values))
    if function == WRITE_ONE:
        expected = WriteSingleRegisterResponse(address=register, registers=list(values))
    confirmation = bytes((function,)) + expected.encode()
    if pdu != confirmation:
        raise ProtocolError(
            f"Expected the confirmation {confirmation.hex(' ')}; found {_hex(data)}",
            code="protocol.modbus.confirmation",
        )
    return list(values)


class ModbusRefusal(InstrumentError):  # noqa: N818 - a refusal is an answer
    """The device has refused a request.

    Attributes
    ----------
    number : int
        Exception code of Modbus.
    """

    code = "modbus.refused"

    def __init__(self, number: int, what: str) -> None:
        self.number = number
        super().__init__(f"{what} is refused: exception {number} ({EXCEPTIONS.get(number, 'unknown')})")


def _pdu(framing: Framing, data: bytes, unit: int, function: int, number: int) -> bytes | None:
    """Return the function code and the bytes after it; None for the late answer to an earlier request (TCP only)."""
    found = _unframed_rtu(data) if framing == "rtu" else _unframed_tcp(data, number)
    if found is None:
        return None
    answered, pdu = found
    if answered != unit:
        raise ProtocolError(
            f"Expected an answer of unit {unit}; found that of unit {answered}: {_hex(data)}",
            code="protocol.modbus.unit",
        )
    if pdu[0] == function | 0x80 and len(pdu) == 2:
        refusal = _decoded(pdu, data)
        assert isinstance(refusal, ExceptionResponse)
        raise ModbusRefusal(refusal.exception_code, f"Function {function} of unit {unit}")
    if pdu[0] != function:
        raise ProtocolError(
            f"Expected an answer to function {function}; found {_hex(data)}", code="protocol.modbus.form"
        )
    return pdu


def _decoded(pdu: bytes, data: bytes) -> ModbusPDU:
    """Return the content of an answer whose length has been checked."""
    found = _DECODER.decode(pdu)
    if found is None:
        raise ProtocolError(f"Expected an answer of Modbus; found {_hex(data)}", code="protocol.modbus.form")
    return found


def _unframed_rtu(data: bytes) -> tuple[int, bytes]:
    if len(data) < _SHORTEST:
        raise ProtocolError(
            f"Expected a Modbus answer of at least {_SHORTEST} bytes; found {data.hex(' ') or 'nothing'}",
            code="protocol.reply.length",
        )
    if not FramerRTU.check_CRC(data[:-2], int.from_bytes(data[-2:], "big")):
        expected = crc16(data[:-2]).hex(" ")
        raise ProtocolError(
            f"The answer {_hex(data)} has the checksum {data[-2:].hex(' ')}; expected {expected}",
            code="protocol.checksum",
        )
    return data[0], data[1:-2]


def _unframed_tcp(data: bytes, number: int) -> tuple[int, bytes] | None:
    if len(data) < _HEAD + 2:
        raise ProtocolError(
            f"Expected a Modbus answer of at least {_HEAD + 2} bytes; found {data.hex(' ')}",
            code="protocol.reply.length",
        )
    (answered, protocol, length), unit = _head(data), data[_HEAD - 1]
    if protocol or length != len(data) - 6:
        raise ProtocolError(f"Expected the header of a Modbus answer; found {_hex(data)}", code="protocol.modbus.form")
    if answered != number:
        if (number - answered) % (1 << 16) < 1 << 15:
            return None
        raise ProtocolError(
            f"Expected the answer to transaction {number}; found that to {answered}", code="protocol.reply.number"
        )
    return unit, data[_HEAD:]


def _head(data: bytes) -> tuple[int, int, int]:
    """Return transaction, protocol and length of an MBAP header."""
    first, second, third = (int.from_bytes(data[i : i + 2], "big") for i in (0, 2, 4))
    return first, second, third


def _hex(data: bytes) -> str:
    return data[:24].hex(" ") + (" ..." if len(data) > 24 else "")
