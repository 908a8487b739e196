"""Protocol of the LJ-X8000A: requests, replies, and the layout of its high-speed stream. Little-endian throughout.

Sources: docs/reference/devices/keyence_ljx.md; facts marked (m) are from memory. A request is a 16-byte head and a
payload that starts with its opcode. A reply has the length of its body at byte 12, the command that it answers at 16,
its return code at 17, the active program at 24 and its data from 28 on.

A profile of the stream is a header of six words (reserved, trigger count, encoder count, three reserved), the heights
with 20 bits each from the least significant bit on, the intensities with 10 bits each if they are switched on, and the
sum of all words before it. The intensities follow the last height without padding, at bit 20 n; the sizes of heights
and of intensities are each rounded up to a word. The compiled functions of `kernels` process streams; this module has
the constants and the commands.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from errormotion.errors import InstrumentError, ProtocolError

STREAM_PORT = 24692

# ------------------------------------------------------------------ requests and replies

#: The byte that differs between the generations of controllers.
GENERATIONS: Mapping[str, int] = {"LJ-X8000": 0x03, "LJ-V7000": 0x01}

GET_ERROR, CLEAR_ERROR, DESCRIBE = 0x04, 0x05, 0x06
TRIGGER, START_MEASURING, STOP_MEASURING, CLEAR_MEMORY, LASER = 0x21, 0x22, 0x23, 0x27, 0x2A
SET_X_PITCH, GET_X_PITCH, CHANGE_PROGRAM = 0x36, 0x37, 0x39
PREPARE_STREAM, STOP_STREAM, START_STREAM = 0x47, 0x48, 0xA0
GET_COUNTS, GET_TEMPERATURE, GET_STATUS = 0x4B, 0x4C, 0x65

REQUEST_HEAD = 16
REPLY_HEAD = 28
BODY_LENGTH, COMMAND, RETURN_CODE, PROGRAM = 12, 16, 17, 24  # positions in a reply
BODY = 16  # position at which the body of a reply starts
MAX_REPLY_BYTES = 3000 * 1024
"""Longest reply, bytes: the receive buffer of the manufacturer's Linux library."""
FROM_NEXT = 2  # argument of PREPARE_STREAM: start with the next profile
PROGRAMS = 16

LENGTH = 1e-8  # m: unit of the Z unit, of X start and of the X pitch
TEMPERATURE = 0.01  # degC

RETURN_CODES: Mapping[int, str] = {
    0x21: "another model of controller",
    0x31: "unknown command",
    0x32: "wrong length of the command",
    0x41: "not possible in this mode or state of the controller",
    0x42: "parameter out of range, such as the number of a program",
    0x80: "not possible in this mode",
    0x81: "not possible with the present setting of batch measurement, or no such start position",
    0xA0: "no connection for the stream",
    0xA1: "the stream is already running",
    0xA2: "another command code was expected, or the stream was not prepared",
    0xA3: "another start code was expected",
    0xA4: "the profiles to be sent have been deleted",
}


def request(opcode: int, arguments: bytes = b"", *, generation: str = "LJ-X8000") -> bytes:
    """Return the bytes of a request.

    The request for the errors is published byte by byte:

    >>> request(GET_ERROR).hex(" ")
    '10 00 00 00 03 00 f0 00 00 00 00 00 04 00 00 00 04 00 00 00'
    """
    payload = bytes((opcode, 0, 0, 0)) + arguments
    variant = bytes((GENERATIONS[generation], 0, 0xF0, 0))
    return struct.pack("<I4sII", REQUEST_HEAD + len(payload) - 4, variant, 0, len(payload)) + payload


def parse_request(frame: bytes) -> tuple[int, bytes, str]:
    """Return opcode, arguments and generation of a request; ProtocolError if it is invalid."""
    if len(frame) < REQUEST_HEAD + 4:
        raise ProtocolError(
            f"A request has at least {REQUEST_HEAD + 4} bytes; found {frame.hex(' ')}", code="protocol.request.form"
        )
    length, variant, _, size = struct.unpack_from("<I4sII", frame)
    names = [name for name, number in GENERATIONS.items() if variant == bytes((number, 0, 0xF0, 0))]
    if not names or length + 4 != len(frame) or size != len(frame) - REQUEST_HEAD:
        raise ProtocolError(f"Expected a request; found {frame[:32].hex(' ')}", code="protocol.request.form")
    return frame[REQUEST_HEAD], frame[REQUEST_HEAD + 4 :], names[0]


@dataclass(frozen=True)
class Reply:
    """A reply: return code (0: done), active program, data, answered command (0: not stated)."""

    code: int
    program: int
    data: bytes
    command: int = 0

    def unpack(self, layout: str, offset: int = 0) -> tuple[Any, ...]:
        """Return the values that ``struct`` reads from the data; ProtocolError if they are too short."""
        try:
            return struct.unpack_from("<" + layout, self.data, offset)
        except struct.error:
            raise ProtocolError(
                f"Expected a reply with {offset + struct.calcsize('<' + layout)} bytes of data; found {len(self.data)}",
                code="protocol.reply.length",
            ) from None


def reply_length(head: bytes) -> int:
    """Return the length of a reply from its first four bytes; ProtocolError if it is not possible."""
    length: int = struct.unpack("<I", head)[0] + 4
    if not REPLY_HEAD <= length <= MAX_REPLY_BYTES:
        raise ProtocolError(
            f"A reply has {REPLY_HEAD} to {MAX_REPLY_BYTES} bytes; found {length} (its first bytes are "
            f"{head.hex(' ')})",
            code="protocol.reply.length",
        )
    return length


def parse_reply(frame: bytes) -> Reply:
    """Return a decoded reply; ProtocolError if one of its two lengths is wrong.

    A body length of 0 is accepted: the manufacturer's client does not read it.
    """
    if len(frame) < REPLY_HEAD or reply_length(frame[:4]) != len(frame):
        raise ProtocolError(
            f"Expected a reply; found {len(frame)} bytes, {frame[:REPLY_HEAD].hex(' ')}", code="protocol.reply.form"
        )
    body: int = struct.unpack_from("<I", frame, BODY_LENGTH)[0]
    if body not in (0, len(frame) - BODY):
        raise ProtocolError(
            f"A reply of {len(frame)} bytes has a body of {len(frame) - BODY}; found the length {body} at byte "
            f"{BODY_LENGTH}: {frame[:REPLY_HEAD].hex(' ')}",
            code="protocol.reply.length",
        )
    return Reply(frame[RETURN_CODE], frame[PROGRAM], frame[REPLY_HEAD:], frame[COMMAND])


def reply(data: bytes = b"", *, code: int = 0, program: int = 0, command: int = 0) -> bytes:
    """Return the bytes of a reply."""
    head = bytearray(REPLY_HEAD)
    struct.pack_into("<I", head, 0, REPLY_HEAD + len(data) - 4)
    struct.pack_into("<I", head, BODY_LENGTH, REPLY_HEAD + len(data) - BODY)
    head[COMMAND], head[RETURN_CODE], head[PROGRAM] = command, code, program
    return bytes(head) + data


def refusal(opcode: int, code: int) -> InstrumentError:
    """Return the error for a return code."""
    return InstrumentError(
        f"The profiler refuses request {opcode:02X}: error {0x8000 + code:04X} ({RETURN_CODES.get(code, 'unknown')})",
        code="instrument.refused",
    )


_UNITS, _UNIT_SIZE, _MODEL_SIZE, _SERIAL_SIZE = 16, 52, 32, 16  # positions in the data of DESCRIBE


def parse_description(reply: Reply) -> list[tuple[str, str]]:
    """Return model and serial number of the controller and of the head, if any."""
    count = min(reply.unpack("B")[0], 2)
    fields = [reply.unpack(f"{_MODEL_SIZE}s{_SERIAL_SIZE}s", _UNITS + i * _UNIT_SIZE) for i in range(count)]
    return [(_text(model), _text(serial)) for model, serial in fields]


def description(units: list[tuple[str, str]]) -> bytes:
    """Return the data of a reply to DESCRIBE."""
    records = [
        model.encode().ljust(_MODEL_SIZE, b"\0") + serial.encode().ljust(_SERIAL_SIZE, b"\0") for model, serial in units
    ]
    return bytes((len(units),)).ljust(_UNITS, b"\0") + b"".join(record.ljust(_UNIT_SIZE, b"\0") for record in records)


def _text(field: bytes) -> str:
    return field.partition(b"\0")[0].decode("ascii", errors="replace").strip()


def parse_errors(reply: Reply) -> list[int]:
    """Return the codes in a reply to GET_ERROR."""
    count = reply.unpack("B")[0]
    return list(reply.unpack(f"{count}H", 4)) if count else []


# ------------------------------------------------------------------ the stream

HEADER_WORDS = 6
TRIGGER_WORD, ENCODER_WORD = 1, 2
INTENSITY = 0x40  # bit of the kind
HEIGHT_BITS, INTENSITY_BITS, WORD_BITS = 20, 10, 32
MIN_HEIGHT = -(1 << 19) + 4  # smaller numbers are codes of points without height
MAX_POINTS = 3200
MAX_PROFILE_BYTES = 4 * (HEADER_WORDS + MAX_POINTS * (HEIGHT_BITS + INTENSITY_BITS) // WORD_BITS + 1)
"""Longest profile of a stream."""

NOTIFY = 0xFFFFFFFF
NOTIFY_WORDS = 2
STOPPED = 0xFFFF  # bits of a notice that state the stream has ended

# Why a point has no height. The index in this list is the code of the compiled functions; the first four are the
# raw values 0x80000 to 0x80003.
REASONS: tuple[str, ...] = ("alarm", "invalid", "blind spot", "unprocessed", "lost", "garbled")
SENTINELS = 4
LOST, GARBLED = 4, 5


@dataclass(frozen=True)
class StreamLayout:
    """Layout of the profiles of a stream, from the reply to PREPARE_STREAM.

    Attributes
    ----------
    start_code : int
        To be sent with START_STREAM.
    kind : int
        Bits, such as ``INTENSITY``.
    points : int
    z_unit : float
        Height of one step, m.
    x_start, x_pitch : float
        m.
    """

    start_code: int
    kind: int
    points: int
    z_unit: float
    x_start: float
    x_pitch: float

    @property
    def with_intensity(self) -> bool:
        """Whether the profiles contain intensities."""
        return bool(self.kind & INTENSITY)

    @property
    def height_words(self) -> int:
        """Number of words of the heights of a profile."""
        return -(-self.points * HEIGHT_BITS // WORD_BITS)

    @property
    def intensity_words(self) -> int:
        """Number of words added by the intensities, which start at bit ``HEIGHT_BITS * points`` of the data."""
        return -(-self.points * INTENSITY_BITS // WORD_BITS) if self.with_intensity else 0

    @property
    def words(self) -> int:
        """Number of words of a complete profile, with header and checksum."""
        return HEADER_WORDS + self.height_words + self.intensity_words + 1

    @property
    def x(self) -> np.ndarray[Any, Any]:
        """Positions of the points on the line, m."""
        return self.x_start + self.x_pitch * np.arange(self.points)


_LAYOUT = "iIBBHHHii"  # from byte 32 of the reply on: start code, -, kind, -, -, points, Z unit, X start, X pitch


def parse_layout(reply: Reply) -> StreamLayout:
    """Return the layout from a reply to PREPARE_STREAM.

    Raises
    ------
    ProtocolError
        No points, too many points, or a unit of 0.
    """
    code, _, kind, _, _, points, z_unit, x_start, x_pitch = reply.unpack(_LAYOUT, 4)
    if not 0 < points <= MAX_POINTS or z_unit == 0:
        raise ProtocolError(
            f"Expected profiles of 1 to {MAX_POINTS} points with a Z unit; the profiler announces {points} points "
            f"and the unit {z_unit}",
            code="profiler.profile.form",
        )
    return StreamLayout(code, kind, points, z_unit * LENGTH, x_start * LENGTH, x_pitch * LENGTH)


def layout_data(layout: StreamLayout) -> bytes:
    """Return the data of a reply to PREPARE_STREAM."""
    lengths = (round(length / LENGTH) for length in (layout.z_unit, layout.x_start, layout.x_pitch))
    return bytes(4) + struct.pack("<" + _LAYOUT, layout.start_code, 0, layout.kind, 0, 0, layout.points, *lengths)


def notice(bits: int) -> bytes:
    """Return a notify packet."""
    return struct.pack("<II", NOTIFY, bits)
