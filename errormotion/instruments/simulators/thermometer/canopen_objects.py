"""Object dictionary of a simulated CANopen device, and its SDO server (CiA 301: uploads and downloads, abort codes)."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

TOGGLE_NOT_ALTERNATED = 0x05030000
UNKNOWN_COMMAND = 0x05040001
WRITE_ONLY = 0x06010001
READ_ONLY = 0x06010002
NO_OBJECT = 0x06020000
NOT_MAPPABLE = 0x06040041
PDO_TOO_LONG = 0x06040042
TOO_LONG = 0x06070012
TOO_SHORT = 0x06070013
NO_SUBINDEX = 0x06090011
VALUE_OUT_OF_RANGE = 0x06090030
NO_SIGNATURE = 0x08000020
WRONG_STATE = 0x08000022
NO_DATA = 0x08000024

FORMATS = {"u8": "<B", "u16": "<H", "u32": "<I", "i16": "<h", "i32": "<i", "f32": "<f"}
MAX_OBJECT = 256  # bytes; longer data of a client are refused


class Refused(Exception):  # noqa: N818 - a refusal is not a failure
    """The device answers with an SDO abort.

    Attributes
    ----------
    code : int
        The abort code.
    """

    def __init__(self, code: int) -> None:
        super().__init__(f"abort code 0x{code:08X}")
        self.code = code


@dataclass(frozen=True)
class Entry:
    """A sub-index of an object.

    Attributes
    ----------
    kind : str
        ``u8``, ``u16``, ``u32``, ``i16``, ``i32``, ``f32`` or ``text``.
    read : callable, optional
        Returns the present value; None: write-only.
    write : callable, optional
        Sets a new value, may raise `Refused`; None: read-only.
    mappable : bool
        Whether a TPDO may contain it.
    """

    kind: str
    read: Callable[[], Any] | None
    write: Callable[[Any], None] | None = None
    mappable: bool = False

    def encode(self, value: Any) -> bytes:
        """Return a value as bytes on the bus, little-endian."""
        return str(value).encode("ascii") if self.kind == "text" else struct.pack(FORMATS[self.kind], value)

    @property
    def bits(self) -> int:
        """Length of a number, bit."""
        return 8 * struct.calcsize(FORMATS[self.kind])


class Dictionary:
    """Objects by index and sub-index."""

    def __init__(self) -> None:
        self._entries: dict[tuple[int, int], Entry] = {}
        self._indices: set[int] = set()

    def add(self, index: int, subindex: int, entry: Entry) -> None:
        """Add one entry."""
        self._entries[index, subindex] = entry
        self._indices.add(index)

    def constant(self, index: int, kind: str, value: Any) -> None:
        """Add a constant variable."""
        self.add(index, 0, Entry(kind, lambda: value))

    def array(self, index: int, entries: list[Entry]) -> None:
        """Add an array or record: sub-index 0 is the highest sub-index, the entries follow from 1 on."""
        self.constant(index, "u8", len(entries))
        for k, entry in enumerate(entries, 1):
            self.add(index, k, entry)

    def find(self, index: int, subindex: int) -> Entry:
        """Return an entry; `Refused` if it does not exist."""
        entry = self._entries.get((index, subindex))
        if entry is None:
            raise Refused(NO_SUBINDEX if index in self._indices else NO_OBJECT)
        return entry

    def read(self, index: int, subindex: int) -> bytes:
        """Return the bytes of a value."""
        entry = self.find(index, subindex)
        if entry.read is None:
            raise Refused(WRITE_ONLY)
        return entry.encode(entry.read())

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """Set a value from bytes."""
        entry = self.find(index, subindex)
        if entry.write is None:
            raise Refused(READ_ONLY)
        if entry.kind == "text":
            entry.write(data.decode("ascii", "replace"))
            return
        if len(data) * 8 != entry.bits:
            raise Refused(TOO_LONG if len(data) * 8 > entry.bits else TOO_SHORT)
        entry.write(struct.unpack(FORMATS[entry.kind], data)[0])


class SdoServer:
    """The default SDO server: one transfer at a time, expedited or in segments of 7 bytes; no block transfer.

    Parameters
    ----------
    dictionary : Dictionary
    """

    def __init__(self, dictionary: Dictionary) -> None:
        self._dictionary = dictionary
        self._object = (0, 0)
        self._toggle = 0
        self._upload: bytes | None = None
        self._download: bytearray | None = None
        self._expected = 0

    def answer(self, request: bytes) -> bytes | None:
        """Return the answer to a request of 8 bytes; None without an answer."""
        if len(request) != 8:  # an SDO has 8 bytes; other frames are not for this service
            return None
        command = request[0] >> 5
        if command in (1, 2, 5, 6):
            self._object = (int.from_bytes(request[1:3], "little"), request[3])
        try:
            if command == 4:  # the client aborts its transfer
                self._end()
                return None
            steps = {0: self._next_in, 1: self._begin_in, 2: self._begin_out, 3: self._next_out}
            if command not in steps:
                raise Refused(UNKNOWN_COMMAND)
            return steps[command](request).ljust(8, b"\0")
        except Refused as refusal:
            self._end()
            return b"\x80" + self._name() + refusal.code.to_bytes(4, "little")

    def _begin_out(self, request: bytes) -> bytes:  # noqa: ARG002 - signature of all steps
        self._end()
        data = self._dictionary.read(*self._object)
        if 0 < len(data) <= 4:
            return bytes((0x43 | (4 - len(data)) << 2,)) + self._name() + data
        self._upload = data
        return b"\x41" + self._name() + len(data).to_bytes(4, "little")

    def _next_out(self, request: bytes) -> bytes:
        if self._upload is None:
            raise Refused(UNKNOWN_COMMAND)
        toggle = self._alternate(request)
        piece, self._upload = self._upload[:7], self._upload[7:]
        last = not self._upload
        if last:
            self._upload = None
        return bytes((toggle | (7 - len(piece)) << 1 | last,)) + piece

    def _begin_in(self, request: bytes) -> bytes:
        self._end()
        self._dictionary.find(*self._object)
        sized, count = request[0] & 1, int.from_bytes(request[4:], "little")
        if request[0] & 2:
            size = 4 - (request[0] >> 2 & 3) if sized else self._natural_size()
            self._dictionary.write(*self._object, request[4 : 4 + size])
        elif sized and count > MAX_OBJECT:
            raise Refused(TOO_LONG)
        else:
            self._download, self._expected = bytearray(), count if sized else -1
        return b"\x60" + self._name()

    def _next_in(self, request: bytes) -> bytes:
        if self._download is None:
            raise Refused(UNKNOWN_COMMAND)
        toggle = self._alternate(request)
        self._download += request[1 : 8 - (request[0] >> 1 & 7)]
        if len(self._download) > MAX_OBJECT:
            raise Refused(TOO_LONG)
        if request[0] & 1:
            data, self._download = bytes(self._download), None
            if self._expected not in (-1, len(data)):
                raise Refused(TOO_LONG if len(data) > self._expected else TOO_SHORT)
            self._dictionary.write(*self._object, data)
        return bytes((0x20 | toggle,))

    def _natural_size(self) -> int:
        entry = self._dictionary.find(*self._object)
        return 4 if entry.kind == "text" else entry.bits // 8

    def _alternate(self, request: bytes) -> int:
        toggle = request[0] & 0x10
        if toggle != self._toggle:
            raise Refused(TOGGLE_NOT_ALTERNATED)
        self._toggle ^= 0x10
        return toggle

    def _name(self) -> bytes:
        return self._object[0].to_bytes(2, "little") + bytes((self._object[1],))

    def _end(self) -> None:
        self._upload = self._download = None
        self._toggle = 0
