"""SDO uploads of CANopen: the frames of a transfer, and the client that reads an object dictionary entry by entry.

Source: CiA 301 (application layer). A transfer is expedited (up to 4 bytes in one frame) or in segments of 7 bytes.

A late answer must not be read as the answer to a later request: an answer is only accepted with the index and subindex
of the request. After a timeout the client first reads another entry (`BARRIERS`, in turn) and ignores all answers until
its answer: a server answers in the order of the requests, so that no older answer can follow.
"""

from __future__ import annotations

import queue
import struct
import time
from collections.abc import Callable
from contextlib import suppress
from itertools import cycle

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError

FRAME_BYTES = 8
MAX_TRANSFER = 1024
"""Longest entry that is read, bytes."""
MAX_TIME = 10
"""Longest duration of a transfer in segments, as a multiple of the time limit for one answer."""
MAX_STRAY = 64
"""Largest number of frames that are ignored while the client waits for an answer."""
BARRIERS = ((0x1001, 0), (0x1018, 1), (0x1000, 0))
"""Entries that every node has (error register, vendor, device type)."""
NO_OBJECT, NO_SUBINDEX, TIMED_OUT, GENERAL = 0x06020000, 0x06090011, 0x05040000, 0x08000000
ABORTS = {
    0x05030000: "Toggle bit not alternated",
    0x05040000: "SDO protocol timed out",
    0x05040001: "Client/server command specifier not valid or unknown",
    0x05040002: "Invalid block size",
    0x05040003: "Invalid sequence number",
    0x05040004: "CRC error",
    0x05040005: "Out of memory",
    0x06010000: "Unsupported access to an object",
    0x06010001: "Attempt to read a write only object",
    0x06010002: "Attempt to write a read only object",
    0x06020000: "Object does not exist",
    0x06040041: "Object cannot be mapped to the PDO",
    0x06040042: "PDO length exceeded",
    0x06040043: "General parameter incompatibility",
    0x06040047: "General internal incompatibility in the device",
    0x06060000: "Access failed due to a hardware error",
    0x06070010: "Data type and length code do not match",
    0x06070012: "Data type does not match, length of service parameter too high",
    0x06070013: "Data type does not match, length of service parameter too low",
    0x06090011: "Subindex does not exist",
    0x06090030: "Value range of parameter exceeded",
    0x06090031: "Value of parameter written too high",
    0x06090032: "Value of parameter written too low",
    0x06090036: "Maximum value is less than minimum value",
    0x060A0023: "Resource not available",
    0x08000000: "General error",
    0x08000020: "Data cannot be transferred or stored to the application",
    0x08000021: "Data cannot be transferred or stored to the application because of local control",
    0x08000022: "Data cannot be transferred or stored to the application because of the present device state",
    0x08000023: "Object dictionary dynamic generation fails or no object dictionary is present",
    0x08000024: "No data available",
}
_UPLOAD, _SEGMENT, _ABORT = 0x40, 0x60, 0x80
_TOGGLE = 0x10


class SdoRefusal(InstrumentError):  # noqa: N818 - a refusal is an answer
    """The node has aborted the transfer.

    Attributes
    ----------
    number : int
        SDO abort code.
    """

    code = "can.sdo.refused"

    def __init__(self, number: int, what: str) -> None:
        self.number = number
        meaning = f", {ABORTS[number]}" if number in ABORTS else ""
        super().__init__(f"{what} is refused: Code 0x{number:08X}{meaning}")


def upload_request(index: int, subindex: int) -> bytes:
    """Return the frame that requests an entry."""
    return struct.pack("<BHB4x", _UPLOAD, index, subindex)


def segment_request(toggle: int) -> bytes:
    """Return the frame that requests the next segment; ``toggle`` 0 or 1."""
    return bytes((_SEGMENT | toggle << 4, 0, 0, 0, 0, 0, 0, 0))


def abort_request(index: int, subindex: int, code: int) -> bytes:
    """Return the frame by which the client aborts a transfer."""
    return struct.pack("<BHBI", _ABORT, index, subindex, code)


def upload_reply(frame: bytes, index: int, subindex: int) -> bytes | int | None:
    """Return the answer of a node to a request for an entry.

    Returns
    -------
    bytes, int or None
        The data; or the number of bytes that follow in segments (0: not stated); or None for an answer to another
        request.

    Raises
    ------
    SdoRefusal
        The node aborts.
    ProtocolError
        The frame is not such an answer.
    """
    if len(frame) != FRAME_BYTES:
        raise ProtocolError(
            f"an SDO answer has {FRAME_BYTES} bytes; found {frame.hex(' ') or 'none'}", code="protocol.can.form"
        )
    command, at, sub, number = struct.unpack("<BHBI", frame)
    kind = command & 0xE0
    if kind not in (_UPLOAD, _ABORT):
        raise ProtocolError(f"{frame.hex(' ')} is not an answer to an SDO upload", code="protocol.can.form")
    if (at, sub) != (index, subindex):
        return None
    if kind == _ABORT:
        raise SdoRefusal(number, f"0x{index:04X}:{subindex}")
    if command & 2:  # expedited; without bit 0 the number of bytes is not stated
        return frame[4 : 8 - (command >> 2 & 3 if command & 1 else 0)]
    return number if command & 1 else 0


def segment_reply(frame: bytes, toggle: int) -> tuple[bytes, bool] | None:
    """Return the data of a segment and whether it is the last one; None for an answer to another request.

    Raises
    ------
    SdoRefusal
        The node aborts.
    ProtocolError
        The frame is not such an answer.
    """
    if len(frame) != FRAME_BYTES:
        raise ProtocolError(
            f"an SDO answer has {FRAME_BYTES} bytes; found {frame.hex(' ') or 'none'}", code="protocol.can.form"
        )
    command = frame[0]
    if command & 0xE0 == _ABORT:
        at, sub, code = struct.unpack("<HBI", frame[1:])
        raise SdoRefusal(code, f"0x{at:04X}:{sub}")
    if command & 0xE0:
        return None
    if bool(command & _TOGGLE) != bool(toggle):
        return None
    return frame[1 : 8 - (command >> 1 & 7)], bool(command & 1)


class SdoClient:
    """Reads entries of the object dictionary of a node.

    Parameters
    ----------
    send : callable
        ``send(frame, reset)`` sends a request, and calls ``reset`` after all frames received before it.
    timeout : float
        Time limit for an answer, s.

    Attributes
    ----------
    answers : queue.Queue
        Frames from the node, added by the receiving thread.
    late : int
        Number of answers that were ignored because they were late or belonged to another request.
    others : int
        Number of those since the last request.
    """

    def __init__(self, send: Callable[[bytes, Callable[[], None] | None], None], timeout: float) -> None:
        self._send = send
        self.timeout = timeout
        self.answers: queue.Queue[bytes] = queue.Queue()
        self.late = self.others = 0
        self._settled = True
        self._barriers = cycle(BARRIERS)

    def upload(self, index: int, subindex: int) -> bytes:
        """Return the bytes of an entry.

        Raises
        ------
        SdoRefusal
            The node aborts.
        InstrumentTimeoutError
            No answer within the time limit.
        ProtocolError
            The answer is invalid.
        """
        if not self._settled:
            self._settle((index, subindex))
        return self._exchange(index, subindex)

    def _settle(self, requested: tuple[int, int]) -> None:
        """Wait until no answer to an earlier request can follow."""
        barrier = next(self._barriers)
        if barrier == requested:
            barrier = next(self._barriers)
        with suppress(SdoRefusal):  # a refusal is also an answer
            self._exchange(*barrier)

    def _exchange(self, index: int, subindex: int) -> bytes:
        was_settled, self._settled = self._settled, False
        self._send(upload_request(index, subindex), self._forget)
        end = time.monotonic() + self.timeout
        for self.others in range(MAX_STRAY):
            try:
                reply = upload_reply(self._next(end), index, subindex)
            except SdoRefusal:
                self._settled = True
                raise
            except ProtocolError:
                if not was_settled:  # an old answer
                    self.late += 1
                    continue
                raise
            if reply is not None:
                break
            self.late += 1
        else:
            raise ProtocolError(f"{MAX_STRAY} answers to other requests", code="protocol.reply.other")
        data = reply if isinstance(reply, bytes) else self._segments(index, subindex, reply)
        self._settled = True
        return data

    def _segments(self, index: int, subindex: int, size: int) -> bytes:
        """Return the data that follow in segments."""
        if size > MAX_TRANSFER:
            raise self._ended(index, subindex, f"expected at most {MAX_TRANSFER} bytes; the node announced {size}")
        data, toggle = b"", 0
        last = time.monotonic() + MAX_TIME * self.timeout
        while True:
            self._send(segment_request(toggle), None)
            segment = segment_reply(self._next(min(last, time.monotonic() + self.timeout)), toggle)
            if segment is None:
                raise self._ended(index, subindex, "received a segment of another transfer")
            data += segment[0]
            if len(data) > MAX_TRANSFER:
                raise self._ended(index, subindex, f"received more than {MAX_TRANSFER} bytes")
            if segment[1]:
                break
            if not segment[0]:
                raise self._ended(index, subindex, "received a segment without data")
            toggle ^= 1
        if size and len(data) != size:
            raise ProtocolError(
                f"0x{index:04X}:{subindex}: expected {size} bytes; received {len(data)}", code="protocol.reply.length"
            )
        return data

    def _ended(self, index: int, subindex: int, why: str) -> ProtocolError:
        self._send(abort_request(index, subindex, GENERAL), None)
        return ProtocolError(f"0x{index:04X}:{subindex}: {why}", code="protocol.can.form")

    def _next(self, end: float) -> bytes:
        try:
            return self.answers.get(timeout=max(end - time.monotonic(), 0.0))
        except queue.Empty:
            raise InstrumentTimeoutError(
                f"no SDO answer within {self.timeout:g} s", code="instrument.no_answer"
            ) from None

    def _forget(self) -> None:
        while True:
            try:
                self.answers.get_nowait()
            except queue.Empty:
                return
            self.late += 1
