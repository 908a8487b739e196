"""Packets that a server of emScon sends, for tests of the driver's codec."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any

from errormotion.instruments.laser_tracker.leica_emscon import codec


def encode_answer(number: int, status: int = 0, /, **values: Any) -> bytes:
    """Return the answer to a command; with a status other than 0 it has no values."""
    body = struct.pack("<II", number, status)
    return codec._packet(
        codec.COMMAND,
        body + (codec.COMMANDS[number].answer.pack(values) if status == 0 and number in codec.COMMANDS else b""),
    )


def encode_change(change: int) -> bytes:
    """Return the message of a status change."""
    return codec._packet(codec.CHANGE, struct.pack("<I", change))


def encode_result(
    kind: int, values: Mapping[str, Any], *, status: int = 0, points: Sequence[Mapping[str, Any]] = ()
) -> bytes:
    """Return a measurement, a level or a reflector position."""
    values = {**values, "count": len(points)}
    body = struct.pack("<I", status) + codec.RESULTS[kind].pack(values)
    return codec._packet(kind, body + b"".join(codec.POINTS[kind].pack(point) for point in points))
