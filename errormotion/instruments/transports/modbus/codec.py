"""Modbus frames for reading (functions 3 and 4) and writing (6 and 16) registers, in the framings RTU and TCP (MBAP).

After the Modbus application protocol 1.1b3 and the serial line guide 1.02. Pure functions from bytes to numbers.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Literal

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
_MAX_MBAP_LENGTH = 254  # bytes after its length field


def crc16(data: bytes) -> bytes:
    """Return the checksum of an RTU frame, as it follows the frame: low byte first (polynomial A001, start FFFF)."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc.to_bytes(2, "little")


def encode_request(framing: Framing, unit: int, function: int, register: int, count: int, number: int = 0) -> bytes:
    """Return the request for ``count`` registers from ``register`` on; ``number`` identifies a TCP transaction."""
    return _frame(framing, unit, struct.pack(">BHH", function, register, count), number)


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
        pdu = struct.pack(">BHH", function, register, values[0])
    elif function == WRITE_SEVERAL and 1 <= count <= MAX_WRITTEN:
        pdu = struct.pack(f">BHHB{count}H", function, register, count, 2 * count, *values)
    else:
        raise ValueError(f"function {function} does not write {count} registers")
    return _frame(framing, unit, pdu, number)


def encode_answer(framing: Framing, unit: int, function: int, registers: Sequence[int], number: int = 0) -> bytes:
    """Return the answer with these registers."""
    pdu = struct.pack(f">BB{len(registers)}H", function, 2 * len(registers), *registers)
    return _frame(framing, unit, pdu, number)


def _frame(framing: Framing, unit: int, pdu: bytes, number: int) -> bytes:
    if framing == "rtu":
        body = bytes((unit,)) + pdu
        return body + crc16(body)
    return struct.pack(">HHHB", number, 0, len(pdu) + 1, unit) + pdu


def missing(framing: Framing, data: bytes) -> int:
    """Return the number of bytes that an incomplete answer still needs, as far as known from its start."""
    if framing == "rtu":
        size = 5 if len(data) < 3 or data[1] & 0x80 else 8 if data[1] in (WRITE_ONE, WRITE_SEVERAL) else 5 + data[2]
    elif len(data) < _HEAD - 1:
        size = _HEAD + 2
    else:
        protocol, length = struct.unpack(">HH", data[2:6])
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
        raise ProtocolError(f"Expected {count} registers; found {len(pdu) - 2} bytes: {_hex(data)}")
    return list(struct.unpack(f">{count}H", pdu[2:]))


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
    expected = struct.pack(">BHH", function, register, values[0] if function == WRITE_ONE else len(values))
    if pdu != expected:
        raise ProtocolError(f"Expected the confirmation {expected.hex(' ')}; found {_hex(data)}")
    return list(values)


class ModbusRefusal(InstrumentError):  # noqa: N818 - a refusal is an answer
    """The device has refused a request.

    Attributes
    ----------
    code : int
        Exception code of Modbus.
    """

    def __init__(self, code: int, what: str) -> None:
        self.code = code
        super().__init__(f"{what} is refused: exception {code} ({EXCEPTIONS.get(code, 'unknown')})")


def _pdu(framing: Framing, data: bytes, unit: int, function: int, number: int) -> bytes | None:
    """Return the function code and the bytes after it; None for the late answer to an earlier request (TCP only)."""
    found = _unframed_rtu(data) if framing == "rtu" else _unframed_tcp(data, number)
    if found is None:
        return None
    answered, pdu = found
    if answered != unit:
        raise ProtocolError(f"Expected an answer of unit {unit}; found that of unit {answered}: {_hex(data)}")
    if pdu[0] == function | 0x80 and len(pdu) == 2:
        raise ModbusRefusal(pdu[1], f"Function {function} of unit {unit}")
    if pdu[0] != function:
        raise ProtocolError(f"Expected an answer to function {function}; found {_hex(data)}")
    return pdu


def _unframed_rtu(data: bytes) -> tuple[int, bytes]:
    if len(data) < 5:
        raise ProtocolError(f"Expected a Modbus answer of at least 5 bytes; found {data.hex(' ') or 'nothing'}")
    if data[-2:] != (expected := crc16(data[:-2])):
        raise ProtocolError(
            f"The answer {_hex(data)} has the checksum {data[-2:].hex(' ')}; expected {expected.hex(' ')}"
        )
    return data[0], data[1:-2]


def _unframed_tcp(data: bytes, number: int) -> tuple[int, bytes] | None:
    if len(data) < _HEAD + 2:
        raise ProtocolError(f"Expected a Modbus answer of at least {_HEAD + 2} bytes; found {data.hex(' ')}")
    answered, protocol, length, unit = struct.unpack(">HHHB", data[:_HEAD])
    if protocol or length != len(data) - 6:
        raise ProtocolError(f"Expected the header of a Modbus answer; found {_hex(data)}")
    if answered != number:
        if (number - answered) % (1 << 16) < 1 << 15:
            return None
        raise ProtocolError(f"Expected the answer to transaction {number}; found that to {answered}")
    return unit, data[_HEAD:]


def _hex(data: bytes) -> str:
    return data[:24].hex(" ") + (" ..." if len(data) > 24 else "")
