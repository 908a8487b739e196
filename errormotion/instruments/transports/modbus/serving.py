"""Modbus server for simulators: answers requests to read and to write registers.

After the Modbus application protocol V1.1b3 (PDUs, exceptions), the guide to Modbus messaging on TCP/IP V1.0b (MBAP)
and the guide to Modbus over serial line V1.02 (RTU). It shares no code with the client.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Literal

READ_FUNCTIONS = (3, 4)
WRITE_ONE, WRITE_SEVERAL = 6, 16
MAX_WRITTEN = 123
ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE = 1, 2, 3
MAX_REGISTERS = 125
MAX_RTU_BYTES = 256
PARTIAL_LIFETIME = 0.5
"""Time without data on a serial line after which an incomplete request is dropped, s.

A serial line ends a frame after 3.5 characters of silence (4 ms at 9600 baud). Connections on loopback do not keep such
times: a frame ends by its length, and this limit only drops remains.
"""

_MBAP = 7  # bytes of the header, with the unit
_LENGTHS = (2, 254)  # smallest and largest value of its length field: unit, function, at most 252 bytes of data
_DIRECT_UNITS = (0, 255)  # address a TCP device with any unit
_BROADCAST = 0  # on a serial line: never answered
# Bytes of an RTU request by function, checksum included: fixed, or (fixed part, position of a count of further bytes).
_RTU_SIZES: Mapping[int, int | tuple[int, int]] = {
    **dict.fromkeys((1, 2, 3, 4, 5, 6, 8), 8),
    **dict.fromkeys((7, 11, 12, 17), 4),
    **dict.fromkeys((15, 16), (9, 6)),
    **dict.fromkeys((20, 21), (5, 2)),
    22: 10,
    23: (13, 10),
    24: 6,
    43: 7,
}


def _table() -> tuple[int, ...]:
    """Return the change of the CRC register by each value of its low byte: polynomial A001, shifted right."""
    values = []
    for value in range(256):
        crc = value
        for _ in range(8):
            crc, carry = crc >> 1, crc & 1
            crc ^= carry * 0xA001
        values.append(crc)
    return tuple(values)


_CRC = _table()


def _crc(data: bytes, crc: int = 0xFFFF) -> int:
    for byte in data:
        crc = crc >> 8 ^ _CRC[(crc ^ byte) & 0xFF]
    return crc


def checksum(data: bytes) -> bytes:
    """Return the CRC of a serial frame, low byte first (guide to serial line, appendix B)."""
    return struct.pack("<H", _crc(data))


class ModbusServer:
    """Answers requests for registers, however their bytes are split or joined.

    Parameters
    ----------
    framing : str
        ``tcp`` or ``rtu``.
    unit : int
        Address of the device. Requests to others are not answered, except to 0 and 255 on TCP.
    function : int
        3 (holding registers) or 4 (input registers); every other function is refused with exception 1.
    blocks : mapping of int to int
        Existing register blocks: first register to number of registers. Others are refused with exception 2.
    registers : callable
        Returns all registers by number, or the code of an exception; called at each accepted request.
    write : callable, optional
        Takes registers that are written, number to value, all of one request; returns 0, or the code of an exception.
        Default: functions 6 and 16 are refused with exception 1.

    Attributes
    ----------
    lost : bool
        Whether a header has stated an impossible length, so that the start of the next request is unknown and the
        connection has to be closed. ``reset`` clears it.
    """

    def __init__(
        self,
        framing: Literal["tcp", "rtu"],
        unit: int,
        function: int,
        blocks: Mapping[int, int],
        registers: Callable[[], Mapping[int, int] | int],
        write: Callable[[Mapping[int, int]], int] | None = None,
    ) -> None:
        self._write = write
        self._framing, self._unit, self._function = framing, unit, function
        self._blocks, self._registers = dict(blocks), registers
        self._rest = b""
        self._last = 0.0  # time of the last bytes, s
        self.lost = False

    def reset(self) -> None:
        """Discard the bytes of an incomplete request, as for a new connection."""
        self._rest, self.lost = b"", False

    def receive(self, data: bytes) -> Iterator[bytes]:
        """Yield the answers to the requests that the next bytes complete."""
        now = time.monotonic()
        if self._framing == "rtu" and now - self._last > PARTIAL_LIFETIME:
            self._rest = b""
        self._last = now
        self._rest += data
        split = self._split_tcp if self._framing == "tcp" else self._split_rtu
        while (frame := split()) is not None:
            if answer := self._answer_tcp(frame) if self._framing == "tcp" else self._answer_rtu(frame):
                yield answer

    # ------------------------------------------------------------------ TCP

    def _split_tcp(self) -> bytes | None:
        """Return the next complete request; None if there is none yet."""
        if self.lost or len(self._rest) < _MBAP - 1:
            return None
        length = int.from_bytes(self._rest[4:6], "big")
        if not _LENGTHS[0] <= length <= _LENGTHS[1]:
            self._rest, self.lost = b"", True
            return None
        size = _MBAP - 1 + length
        if len(self._rest) < size:
            return None
        frame, self._rest = self._rest[:size], self._rest[size:]
        return frame

    def _answer_tcp(self, frame: bytes) -> bytes:
        transaction, protocol, _, unit = struct.unpack_from(">HHHB", frame)
        if protocol or unit not in (self._unit, *_DIRECT_UNITS):
            return b""
        pdu = self.respond(frame[_MBAP:])
        return struct.pack(">HHHB", transaction, 0, 1 + len(pdu), unit) + pdu

    # ------------------------------------------------------------------ RTU

    def _split_rtu(self) -> bytes | None:
        """Return the next request with a valid checksum; None if there is none yet. Other bytes are dropped."""
        while len(self._rest) >= 2:
            size = self._rtu_size(self._rest)
            if size is None:
                size = next(self._checked_sizes(), 0) or self._next_known()
                if not size:
                    self._rest = self._rest[-MAX_RTU_BYTES:]
                    return None
            elif size > len(self._rest):
                return None
            if _is_frame(self._rest[:size]):
                frame, self._rest = self._rest[:size], self._rest[size:]
                return frame
            self._rest = self._rest[1:]
        return None

    @staticmethod
    def _rtu_size(data: bytes) -> int | None:
        """Return the size of the request that starts data, as far as known; None for an unknown function."""
        size = _RTU_SIZES.get(data[1])
        if not isinstance(size, tuple):
            return size
        fixed, position = size
        return fixed + (data[position] if len(data) > position else 1)

    def _checked_sizes(self) -> Iterator[int]:
        """Yield the sizes at which the bytes so far are a request of an unknown function with a valid checksum."""
        crc = 0xFFFF
        for size, byte in enumerate(self._rest[:MAX_RTU_BYTES], 1):
            crc = _crc(bytes((byte,)), crc)
            if size >= 4 and not crc:  # the CRC of a frame including its CRC is 0
                yield size

    def _next_known(self) -> int:
        """Drop the bytes before the next request of a known function; return the size of the request, 0 without one."""
        for start in range(1, len(self._rest) - 3):
            size = self._rtu_size(self._rest[start:])
            if size is not None and _is_frame(self._rest[start : start + size]):
                self._rest = self._rest[start:]
                return size
        return 0

    def _answer_rtu(self, frame: bytes) -> bytes:
        if frame[0] != self._unit or self._unit == _BROADCAST:
            return b""
        body = frame[:1] + self.respond(frame[1:-2])
        return body + checksum(body)

    # ------------------------------------------------------------------ PDU

    def respond(self, pdu: bytes) -> bytes:
        """Return the answer to a request without its framing.

        The order of the checks is that of sections 6.3, 6.4, 6.6 and 6.12: function, number of registers, addresses,
        reading or writing.
        """
        function = pdu[0]
        if function in (WRITE_ONE, WRITE_SEVERAL) and self._write is not None:
            refusal = self._written(function, pdu[1:], self._write)
            return bytes((function | 0x80, refusal)) if refusal else pdu[:5]
        answer = self._read(function, pdu[1:])
        if isinstance(answer, int):
            return bytes((function | 0x80, answer))
        return struct.pack(f">BB{len(answer)}H", function, 2 * len(answer), *answer)

    def _read(self, function: int, arguments: bytes) -> list[int] | int:
        if function != self._function or function not in READ_FUNCTIONS:
            return ILLEGAL_FUNCTION
        if len(arguments) != 4:
            return ILLEGAL_VALUE
        first, count = struct.unpack(">HH", arguments)
        if not 1 <= count <= MAX_REGISTERS:
            return ILLEGAL_VALUE
        if not self._exist(first, count):
            return ILLEGAL_ADDRESS
        registers = self._registers()
        if isinstance(registers, int):
            return registers
        return [registers.get(number, 0) for number in range(first, first + count)]

    def _written(self, function: int, arguments: bytes, write: Callable[[Mapping[int, int]], int]) -> int:
        """Write registers; return 0, or the code of an exception."""
        first, count, data = int.from_bytes(arguments[:2], "big"), 1, arguments[2:]
        if function == WRITE_SEVERAL:
            count, data = int.from_bytes(arguments[2:4], "big"), arguments[5:]
            if not 1 <= count <= MAX_WRITTEN or arguments[4:5] != bytes((2 * count,)):
                return ILLEGAL_VALUE
        if len(data) != 2 * count:
            return ILLEGAL_VALUE
        if not self._exist(first, count):
            return ILLEGAL_ADDRESS
        return write(dict(enumerate(struct.unpack(f">{count}H", data), start=first)))

    def _exist(self, first: int, count: int) -> bool:
        return any(start <= first and first + count <= start + size for start, size in self._blocks.items())


def _is_frame(data: bytes) -> bool:
    return len(data) >= 4 and not _crc(data)
