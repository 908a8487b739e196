"""PDOs of CANopen: the objects that a node sends, when it sends them, and their positions in a frame.

Source: CiA 301, objects 0x1800 ff. (communication) and 0x1A00 ff. (mapping).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from errormotion.errors import ProtocolError

COMMUNICATION, MAPPING = 0x1800, 0x1A00
SYNC_IDENTIFIER = 0x1005
"""Object with the identifier of SYNC."""
SYNC = 0x80
"""Identifier of SYNC, if a node does not state it."""
COB_ID, TRANSMISSION, INHIBIT, EVENT_TIMER = 1, 2, 3, 5
"""Subindices of the communication objects."""
MAX_ENTRIES = 64
"""Largest number of objects of a PDO; larger numbers mean other types of PDO."""
FRAME_BITS = 64
_INVALID, _EXTENDED = 1 << 31, 1 << 29
_MAX_CYCLIC = 240
_EVENT = (254, 255)


@dataclass(frozen=True)
class Mapped:
    """Position of an object in a frame.

    Attributes
    ----------
    index, subindex : int
    offset, bits : int
        First bit, counted from the lowest bit of the first byte, and number of bits.
    """

    index: int
    subindex: int
    offset: int
    bits: int

    def data(self, frame: bytes) -> bytes:
        """Return the bytes of the object, right-aligned.

        Raises
        ------
        ProtocolError
            The frame is too short.
        """
        if len(frame) * 8 < self.offset + self.bits:
            found = frame.hex(" ") or "none"
            raise ProtocolError(
                f"a PDO with 0x{self.index:04X}:{self.subindex} is too short; found {found}", code="protocol.can.pdo"
            )
        number = int.from_bytes(frame, "little") >> self.offset & (1 << self.bits) - 1
        return number.to_bytes(-(-self.bits // 8), "little")


@dataclass(frozen=True)
class TransmitPdo:
    """A PDO that a node sends.

    Attributes
    ----------
    number : int
        Number of the PDO, from 1.
    identifier : int
        Identifier of its frames, 11 bits.
    transmission : int
        0: at a SYNC after an event, 1 to 240: at every n-th SYNC, 254 and 255: after an event or the timer.
    event_timer : float
        Interval, s; 0: none.
    mapped : tuple of Mapped
    """

    number: int
    identifier: int
    transmission: int
    event_timer: float
    mapped: tuple[Mapped, ...]

    @property
    def cyclic(self) -> bool:
        """Whether it is sent at every n-th SYNC."""
        return 1 <= self.transmission <= _MAX_CYCLIC

    @property
    def timed(self) -> bool:
        """Whether it is sent at an interval."""
        return self.transmission in _EVENT and self.event_timer > 0

    def place(self, index: int, subindex: int) -> Mapped | None:
        """Return the position of an object; None if it is not in this PDO."""
        return next((each for each in self.mapped if (each.index, each.subindex) == (index, subindex)), None)


def decode_identifier(number: int) -> int | None:
    """Return the identifier of a PDO; None if the PDO is switched off, or its identifier has 29 bits."""
    return None if number & (_INVALID | _EXTENDED) else number & 0x7FF


def decode_mapping(entries: Sequence[int]) -> tuple[Mapped, ...]:
    """Return the positions of the objects of a PDO.

    Parameters
    ----------
    entries : sequence of int
        Entries of 0x1A00 ff.: index, subindex and number of bits, most significant byte first.

    Raises
    ------
    ProtocolError
        An object has no bits, or the objects exceed a frame.
    """
    mapped: list[Mapped] = []
    offset = 0
    for entry in entries:
        bits = entry & 0xFF
        if not 0 < bits <= FRAME_BITS - offset:
            raise ProtocolError(
                f"the mapping 0x{entry:08X} does not fit a frame of {FRAME_BITS} bits at bit {offset}",
                code="protocol.can.mapping",
            )
        mapped.append(Mapped(entry >> 16 & 0xFFFF, entry >> 8 & 0xFF, offset, bits))
        offset += bits
    return tuple(mapped)
