"""The ASCII protocol of GeoCOM: requests, types of parameters, and replies.

Request ``%R1Q,<RPC>[,<TrId>]:[<P0>][,<P1>...]<CR><LF>``, reply ``%R1P,<RC_COM>,<TrId>:<RC>[,<P0>...]<CR><LF>``; a line
feed before a request clears the receive buffer (Reference Manual TPS1200/TS30/TM30 1.50, p. 8, 10 and 11).
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from errormotion.instruments.simulators.laser_tracker.leica_geocom.codes import Code

LINE_END = b"\r\n"
LONGEST = 512
"""Bytes of the longest request; a longer one is an overrun (the number is assumed)."""

_REQUEST = re.compile(r"%R1Q,([0-9]{1,5})(?:,([0-9]{1,5}))?(?:,([0-9]{1,5}))?:(.*)", re.ASCII)
_INTEGER = re.compile(r"-?[0-9]{1,10}|0[xX][0-9a-fA-F]{1,8}", re.ASCII)
_DOUBLE = re.compile(r"-?[0-9]{1,20}(\.[0-9]{0,20})?([eE][-+]?[0-9]{1,3})?", re.ASCII)
_BYTE = re.compile(r"'([0-9a-fA-F]{2})'", re.ASCII)
_STRING = re.compile(r'"((?:[^"\\]|\\.)*)"')
_WORD = re.compile(r'"(?:[^"\\]|\\.)*"|[^,"]+')

Value = int | float | str

CALLS: dict[int, tuple[str, str]] = {
    0: ("COM_NullProc", ""),
    1: ("COM_Local", ""),
    107: ("COM_SetDoublePrecision", "i"),
    108: ("COM_GetDoublePrecision", ""),
    109: ("COM_SetSendDelay", "i"),
    110: ("COM_GetSWVersion", ""),
    111: ("COM_SwitchOnTPS", "i"),
    112: ("COM_SwitchOffTPS", "i"),
    113: ("COM_GetBinaryAvailable", ""),
    114: ("COM_SetBinaryAvailable", "i"),
    1004: ("EDM_Laserpointer", "i"),
    1058: ("EDM_GetEglIntensity", ""),
    1059: ("EDM_SetEglIntensity", "i"),
    1070: ("EDM_IsContMeasActive", "i"),
    2003: ("TMC_GetAngle1", "i"),
    2006: ("TMC_SetInclineSwitch", "i"),
    2007: ("TMC_GetInclineSwitch", ""),
    2008: ("TMC_DoMeasure", "ii"),
    2009: ("TMC_GetStation", ""),
    2010: ("TMC_SetStation", "dddd"),
    2011: ("TMC_GetHeight", ""),
    2012: ("TMC_SetHeight", "d"),
    2014: ("TMC_GetAngSwitch", ""),
    2020: ("TMC_SetEdmMode", "i"),
    2021: ("TMC_GetEdmMode", ""),
    2022: ("TMC_GetSignal", ""),
    2023: ("TMC_GetPrismCorr", ""),
    2024: ("TMC_SetPrismCorr", "d"),
    2026: ("TMC_GetFace", ""),
    2028: ("TMC_SetAtmCorr", "dddd"),
    2029: ("TMC_GetAtmCorr", ""),
    2030: ("TMC_SetRefractiveCorr", "idd"),
    2031: ("TMC_GetRefractiveCorr", ""),
    2082: ("TMC_GetCoordinate", "ii"),
    2107: ("TMC_GetAngle5", "i"),
    2108: ("TMC_GetSimpleMea", "ii"),
    2113: ("TMC_SetOrientation", "d"),
    2116: ("TMC_GetSimpleCoord", "ii"),
    2117: ("TMC_QuickDist", ""),
    2126: ("TMC_GetSlopeDistCorr", ""),
    2151: ("TMC_GetAtmPpm", ""),
    2167: ("TMC_GetFullMeas", "ii"),
    5003: ("CSV_GetInstrumentNo", ""),
    5004: ("CSV_GetInstrumentName", ""),
    5008: ("CSV_GetDateTime", ""),
    5009: ("CSV_GetVBat", ""),
    5011: ("CSV_GetIntTemp", ""),
    5034: ("CSV_GetSWVersion", ""),
    5035: ("CSV_GetDeviceConfig", ""),
    5039: ("CSV_CheckPower", ""),
    5100: ("CSV_GetReflectorlessClass", ""),
    6001: ("MOT_StartController", "i"),
    6002: ("MOT_StopController", "i"),
    6004: ("MOT_SetVelocity", "dd"),
    6021: ("MOT_ReadLockStatus", ""),
    9007: ("AUT_SetTol", "dd"),
    9008: ("AUT_ReadTol", ""),
    9011: ("AUT_SetTimeout", "dd"),
    9012: ("AUT_ReadTimeout", ""),
    9013: ("AUT_LockIn", ""),
    9018: ("AUT_SetATRStatus", "i"),
    9019: ("AUT_GetATRStatus", ""),
    9020: ("AUT_SetLockStatus", "i"),
    9021: ("AUT_GetLockStatus", ""),
    9027: ("AUT_MakePositioning", "ddiii"),
    9028: ("AUT_ChangeFace", "iii"),
    9029: ("AUT_Search", "ddi"),
    9030: ("AUT_GetFineAdjustMode", ""),
    9031: ("AUT_SetFineAdjustMode", "i"),
    9037: ("AUT_FineAdjust", "ddi"),
    11003: ("BMM_BeepNormal", ""),
    11004: ("BMM_BeepAlarm", ""),
    17008: ("BAP_SetPrismType", "i"),
    17009: ("BAP_GetPrismType", ""),
    17017: ("BAP_MeasDistanceAngle", "i"),
    17018: ("BAP_GetMeasPrg", ""),
    17019: ("BAP_SetMeasPrg", "i"),
    17021: ("BAP_SetTargetType", "i"),
    17022: ("BAP_GetTargetType", ""),
    17023: ("BAP_GetPrismDef", "i"),
    18005: ("AUS_SetUserAtrState", "i"),
    18006: ("AUS_GetUserAtrState", ""),
    18007: ("AUS_SetUserLockState", "i"),
    18008: ("AUS_GetUserLockState", ""),
}
"""Name and parameters of each call: i integer, d double, s string, y byte."""


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
    found = _REQUEST.fullmatch(line.decode("latin-1"))
    if found is None:
        raise ProtocolError(Code.COM_NOT_GEOCOM)
    number, transaction = int(found[1]), int(found[2] or 0)
    if found[3] is not None:
        raise ProtocolError(Code.COM_NO_CHECKSUM, transaction)
    if number not in CALLS:
        raise ProtocolError(Code.COM_PROC_UNAVAIL, transaction)
    name, types = CALLS[number]
    words = _split(found[4])
    if words is None or len(words) != len(types):
        raise ProtocolError(Code.COM_CANT_DECODE_REQ, transaction)
    values = tuple(_value(word, kind) for word, kind in zip(words, types, strict=True))
    if any(value is None for value in values):
        raise ProtocolError(Code.COM_CANT_DECODE_REQ, transaction)
    return Request(name, transaction, tuple(value for value in values if value is not None))


def _split(text: str) -> list[str] | None:
    """Return the words between the commas, or None if one is missing."""
    words: list[str] = []
    position = 0
    while position < len(text):
        found = _WORD.match(text, position)
        if found is None:
            return None
        words.append(found[0])
        position = found.end()
        if position < len(text):
            if text[position] != "," or position + 1 == len(text):
                return None
            position += 1
    return words


def _value(word: str, kind: str) -> Value | None:
    """Return a parameter; None if it is invalid."""
    if kind == "i":
        if not _INTEGER.fullmatch(word):
            return None
        value = int(word, 16) if word[:2] in ("0x", "0X") else int(word)
        return value if -(2**31) <= value < 2**32 else None
    if kind == "d":
        return float(word) if _DOUBLE.fullmatch(word) else None
    if kind == "y":
        found = _BYTE.fullmatch(word)
        return int(found[1], 16) if found else None
    quoted = _STRING.fullmatch(word)
    return quoted[1] if quoted else None


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
