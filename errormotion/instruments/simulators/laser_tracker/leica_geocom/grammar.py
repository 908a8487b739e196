"""The ASCII protocol of GeoCOM: requests, types of parameters, and replies.

Request ``%R1Q,<RPC>[,<TrId>]:[<P0>][,<P1>...]<CR><LF>``, reply ``%R1P,<RC_COM>,<TrId>:<RC>[,<P0>...]<CR><LF>``; a line
feed before a request clears the receive buffer (Reference Manual TPS1200/TS30/TM30 1.50, p. 8, 10 and 11).
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum


class Code(IntEnum):
    """Return codes that the simulated station uses."""

    OK = 0
    IVPARAM = 2
    FATAL = 4
    TMC_ANGLE_OK = 1285  # no distance
    TMC_DIST_ERROR = 1292  # no aim
    TMC_BUSY = 1293
    COM_CANT_DECODE_REQ = 3080
    COM_PROC_UNAVAIL = 3081
    COM_NOT_GEOCOM = 3094
    COM_OVERRUN = 3100
    COM_NO_CHECKSUM = 3110
    AUT_NO_TARGET = 8710


class RefusedError(Exception):
    """A call that the station refuses.

    Attributes
    ----------
    code : int
        Its return code.
    """

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


LINE_END = b"\r\n"
LONGEST = 512
"""Bytes of the longest request; a longer one is an overrun (the number is assumed)."""

_REQUEST = re.compile(r"%R1Q,([0-9]{1,5})(?:,([0-9]{1,5}))?(?:,([0-9]{1,5}))?:(.*)", re.ASCII)
_INTEGER = re.compile(r"-?[0-9]{1,10}|0[xX][0-9a-fA-F]{1,8}", re.ASCII)
_DOUBLE = re.compile(r"-?[0-9]{1,20}(\.[0-9]{0,20})?([eE][-+]?[0-9]{1,3})?", re.ASCII)

Value = int | float | str

CALLS: dict[int, tuple[str, str]] = {
    0: ("COM_NullProc", ""),
    108: ("COM_GetDoublePrecision", ""),
    110: ("COM_GetSWVersion", ""),
    2003: ("TMC_GetAngle1", "i"),
    2008: ("TMC_DoMeasure", "ii"),
    2020: ("TMC_SetEdmMode", "i"),
    2026: ("TMC_GetFace", ""),
    2028: ("TMC_SetAtmCorr", "dddd"),
    2029: ("TMC_GetAtmCorr", ""),
    2082: ("TMC_GetCoordinate", "ii"),
    2108: ("TMC_GetSimpleMea", "ii"),
    2151: ("TMC_GetAtmPpm", ""),
    5003: ("CSV_GetInstrumentNo", ""),
    5004: ("CSV_GetInstrumentName", ""),
    5008: ("CSV_GetDateTime", ""),
    5011: ("CSV_GetIntTemp", ""),
    5034: ("CSV_GetSWVersion", ""),
    9027: ("AUT_MakePositioning", "ddiii"),
    9028: ("AUT_ChangeFace", "iii"),
    9037: ("AUT_FineAdjust", "ddi"),
}
"""Name and parameters of each call: i integer, d double."""


@dataclass(frozen=True)
class Request:
    """A valid request.

    Attributes
    ----------
    name : str
        Of the call.
    transaction : int
        0 if the request has none.
    values : tuple
        The parameters.
    """

    name: str
    transaction: int
    values: tuple[Value, ...]


class ProtocolError(Exception):
    """A request that the communication layer refuses, with its code and transaction."""

    def __init__(self, code: Code, transaction: int = 0) -> None:
        super().__init__(code)
        self.code, self.transaction = code, transaction


def parse(line: bytes) -> Request:
    """Return the request of a line without its end.

    Raises
    ------
    ProtocolError
        Not a GeoCOM request, an unknown call, or a wrong number or type of parameters.
    """
    if len(line) > LONGEST:
        raise ProtocolError(Code.COM_OVERRUN)
    match = _REQUEST.fullmatch(line.decode("latin-1"))
    if match is None:
        raise ProtocolError(Code.COM_NOT_GEOCOM)
    number, transaction = int(match[1]), int(match[2] or 0)
    if match[3] is not None:
        raise ProtocolError(Code.COM_NO_CHECKSUM, transaction)
    if number not in CALLS:
        raise ProtocolError(Code.COM_PROC_UNAVAIL, transaction)
    name, types = CALLS[number]
    words = match[4].split(",") if match[4] else []
    if len(words) != len(types):
        raise ProtocolError(Code.COM_CANT_DECODE_REQ, transaction)
    values = tuple(_value(word, kind) for word, kind in zip(words, types, strict=True))
    if any(value is None for value in values):
        raise ProtocolError(Code.COM_CANT_DECODE_REQ, transaction)
    return Request(name, transaction, tuple(value for value in values if value is not None))


def _value(word: str, kind: str) -> Value | None:
    """Return a parameter; None if it is invalid."""
    if kind == "i":
        if not _INTEGER.fullmatch(word):
            return None
        value = int(word, 16) if word[:2] in ("0x", "0X") else int(word)
        return value if -(2**31) <= value < 2**32 else None
    return float(word) if _DOUBLE.fullmatch(word) else None


@dataclass(frozen=True)
class Byte:
    """A value that is sent as a byte, as two hexadecimal digits between apostrophes."""

    value: int


def encode(values: Iterable[Value | Byte], decimals: int) -> str:
    """Return values as in a reply.

    Doubles have at most the stated number of decimals; trailing zeros are omitted (assumed).
    """
    texts = []
    for value in values:
        if isinstance(value, Byte):
            texts.append(f"'{value.value:02x}'")
        elif isinstance(value, str):
            texts.append(f'"{value}"')
        elif isinstance(value, float):
            whole, _, part = f"{value:.{decimals}f}".partition(".")
            texts.append(f"{whole}.{part.rstrip('0') or '0'}")
        else:
            texts.append(str(int(value)))
    return ",".join(texts)


def reply(code: int, transaction: int, values: str = "") -> bytes:
    """Return the reply to a call that was executed, with its return code."""
    return f"%R1P,0,{transaction}:{int(code)}{',' if values else ''}{values}".encode("ascii") + LINE_END


def refusal(code: int, transaction: int) -> bytes:
    """Return the reply to a call that was not executed: the communication code, then 0 (assumed)."""
    return f"%R1P,{int(code)},{transaction}:0".encode("ascii") + LINE_END
