"""Packets of an emScon server: little-endian structures, packed, over TCP port 700.

Every packet starts with its size in bytes (i32, header included) and its type (u32). A command is the header, its
number, and parameters; the answer repeats the number and adds a status, then values if the status is 0. Unsolicited
packets arrive between the answers: reflector positions, levels, status changes, errors such as a broken beam.

The layouts are those of the interface's C definitions, versions 3.6 and 3.8. ``long``, ``int`` and enumerations have
four bytes; names are 32 characters of UTF-16. Results of measurements have a status after the header and no command
number: 156 bytes for a single measurement.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from errormotion.errors import ProtocolError

HEADER = struct.Struct("<iI")
MAX_PACKET_BYTES = 1 << 16
"""Longest packet: 712 points with covariances; at 1000 points per second, the server sends at least 3 packets per
second."""
NAME = "64s"

# ---------------------------------------------------------------------- types of packets

COMMAND, ERROR, SINGLE, MULTI, LEVEL, REFLECTOR, CHANGE, SINGLE2, MULTI2 = 0, 1, 2, 3, 6, 7, 8, 9, 10
UNUSED_TYPES = frozenset({4, 5, 11})  # of probes with six freedoms: ignored

# ---------------------------------------------------------------------- commands

GET_SYSTEM_STATUS, SET_UNITS, GET_UNITS, INITIALIZE = 1, 5, 6, 7
SET_ENVIRONMENT, GET_ENVIRONMENT, SET_REFRACTION, GET_REFRACTION = 20, 21, 22, 23
SET_MODE, SET_COORDINATES, GET_COORDINATES, SET_STATIONARY, SET_CONTINUOUS_TIME = 24, 26, 27, 28, 30
SET_REFLECTOR, GET_REFLECTOR, GET_REFLECTORS, SET_SEARCH = 40, 41, 42, 43
SET_SYSTEM_SETTINGS, GET_SYSTEM_SETTINGS, START_MEASUREMENT, STOP_MEASUREMENT = 47, 48, 49, 52
GO_POSITION, FIND_REFLECTOR, UNKNOWN, GET_DIRECTION, GO_BIRD_BATH2 = 55, 63, 64, 66, 95
GET_TRACKER_INFO, GO_AND_MEASURE, GET_METEO_STATION = 132, 135, 139

METRE, RADIAN, CELSIUS, MILLIBAR, RELATIVE = 0, 0, 0, 0, 0
SPHERICAL = 7  # counterclockwise: azimuth, zenith angle, distance
STATIONARY, CONTINUOUS_TIME = 0, 1
SPHERE = 0  # region if none is used: headers up to 3.6 only have 0 and 1, newer ones also 10, not applicable
INITIALISED = 5  # tracker processor
METEO_OFF, METEO_READ, METEO_REFRACTION = 0, 1, 2


@dataclass(frozen=True)
class Layout:
    """Names and `struct` codes of the fields of a packet after its header."""

    fields: tuple[tuple[str, str], ...]

    @cached_property
    def packed(self) -> struct.Struct:
        """The fields as a structure."""
        return struct.Struct("<" + "".join(code for _, code in self.fields))

    def pack(self, values: Mapping[str, Any]) -> bytes:
        """Return fields as bytes; missing ones are 0."""
        return self.packed.pack(
            *(
                _pack_name(values.get(name, "")) if code == NAME else values.get(name, 0.0 if code == "d" else 0)
                for name, code in self.fields
            )
        )

    def unpack(self, data: bytes, offset: int = 0) -> dict[str, Any]:
        """Return fields by name."""
        values = self.packed.unpack_from(data, offset)
        return {
            name: _unpack_name(value) if code == NAME else value
            for (name, code), value in zip(self.fields, values, strict=True)
        }


def _layout(text: str = "") -> Layout:
    """Return a layout from words such as ``d:temperature``."""
    return Layout(tuple((name, code) for code, _, name in (word.partition(":") for word in text.split())))


def _pack_name(text: str) -> bytes:
    return text.encode("utf-16-le")[:62].ljust(64, b"\0")


def _unpack_name(data: bytes) -> str:
    return data.decode("utf-16-le", errors="replace").partition("\0")[0]


_AIR = "d:temperature d:pressure d:humidity"
_POSITION = "d:val1 d:val2 d:val3"
_REFRACTION = "d:ifm d:adm"
_UNITS = "I:length I:angle I:temperature I:pressure I:humidity"
_SYSTEM = (
    "I:meteo i:transformation i:orientation i:keep_last i:unsolicited i:reflector_position i:try_mode i:level i:camera"
)
_TRACKER = (
    f"I:type {NAME}:name i:serial_number i:compensation i:adm i:camera i:level d:level_offset d:longest d:shortest "
    "i:data_rate i:faces d:azimuth_range d:zenith_range I:accuracy_model i:major i:minor"
)


@dataclass(frozen=True)
class Command:
    """A command: its name for messages, its parameters, the values of its answer."""

    name: str
    request: Layout
    answer: Layout


#: Commands by number.
COMMANDS: Mapping[int, Command] = {
    number: Command(name, _layout(request), _layout(answer))
    for number, name, request, answer in (
        (
            GET_SYSTEM_STATUS,
            "GetSystemStatus",
            "",
            "I:last I:processor I:laser I:adm i:major i:minor i:build I:meteo i:flags i:serial_number",
        ),
        (SET_UNITS, "SetUnits", _UNITS, ""),
        (GET_UNITS, "GetUnits", "", _UNITS),
        (INITIALIZE, "Initialize", "", ""),
        (SET_ENVIRONMENT, "SetEnvironmentParams", _AIR, ""),
        (GET_ENVIRONMENT, "GetEnvironmentParams", "", _AIR),
        (SET_REFRACTION, "SetRefractionParams", _REFRACTION, ""),
        (GET_REFRACTION, "GetRefractionParams", "", _REFRACTION),
        (SET_MODE, "SetMeasurementMode", "I:mode", ""),
        (SET_COORDINATES, "SetCoordinateSystemType", "I:kind", ""),
        (GET_COORDINATES, "GetCoordinateSystemType", "", "I:kind"),
        (SET_STATIONARY, "SetStationaryModeParams", "i:milliseconds i:use_adm", ""),
        (SET_CONTINUOUS_TIME, "SetContinuousTimeModeParams", "i:milliseconds i:count i:use_region I:region", ""),
        (SET_REFLECTOR, "SetReflector", "i:number", ""),
        (GET_REFLECTOR, "GetReflector", "", "i:number"),
        (GET_REFLECTORS, "GetReflectors", "", f"i:total i:number I:kind d:surface_offset {NAME}:name"),
        (SET_SEARCH, "SetSearchParams", "d:radius i:milliseconds", ""),
        (SET_SYSTEM_SETTINGS, "SetSystemSettings", _SYSTEM, ""),
        (GET_SYSTEM_SETTINGS, "GetSystemSettings", "", _SYSTEM),
        (START_MEASUREMENT, "StartMeasurement", "", ""),
        (STOP_MEASUREMENT, "StopMeasurement", "", ""),
        (GO_POSITION, "GoPosition", f"{_POSITION} i:use_adm", ""),
        (FIND_REFLECTOR, "FindReflector", "d:distance", ""),
        (GET_DIRECTION, "GetDirection", "", "d:azimuth d:zenith"),
        (GO_BIRD_BATH2, "GoBirdBath2", "i:clockwise", ""),
        (GET_TRACKER_INFO, "GetTrackerInfo", "", _TRACKER),
        (GO_AND_MEASURE, "GoAndMeasure", _POSITION, ""),
        (GET_METEO_STATION, "GetMeteoStationInfo", "", f"I:type {NAME}:name i:major i:minor"),
    )
}

_SPREAD = "d:std1 d:std2 d:std3 d:std_total"
_COVARIANCE = "d:cov12 d:cov13 d:cov23"
_POINTING = "d:pointing1 d:pointing2 d:pointing3"
_PRIOR = "d:prior1 d:prior2 d:prior3 d:prior_total"
_PRIOR_COVARIANCE = "d:prior_cov12 d:prior_cov13 d:prior_cov23"

#: Fields after the status of packets that are not answers.
RESULTS: Mapping[int, Layout] = {
    SINGLE: _layout(f"I:mode i:try_mode {_POSITION} {_SPREAD} {_POINTING} {_PRIOR} {_AIR}"),
    SINGLE2: _layout(
        f"I:mode i:try_mode {_POSITION} {_SPREAD} {_COVARIANCE} {_POINTING} {_PRIOR} {_PRIOR_COVARIANCE} {_AIR}"
    ),
    MULTI: _layout(f"i:count I:mode i:try_mode {_AIR}"),
    MULTI2: _layout(f"i:count I:mode i:try_mode {_AIR}"),
    LEVEL: _layout("I:level_status d:tilt_x d:tilt_y d:temperature"),
    REFLECTOR: _layout(_POSITION),
}

#: One point of a continuous measurement.
POINTS: Mapping[int, Layout] = {
    MULTI: _layout(f"I:status i:seconds i:microseconds {_POSITION}"),
    MULTI2: _layout(f"I:status i:seconds i:microseconds {_POSITION} {_PRIOR} {_PRIOR_COVARIANCE}"),
}


@dataclass(frozen=True)
class Packet:
    """A decoded packet from the server.

    Attributes
    ----------
    kind : int
        Type of the packet.
    command : int
        Number of the command that it answers; -1 if it is not an answer.
    status : int
        Status of the result; for a status change, number of the change.
    values : mapping of str to int, float or str
    points : list of mapping
        Points of a continuous measurement.
    """

    kind: int
    command: int = -1
    status: int = 0
    values: Mapping[str, Any] = field(default_factory=dict)
    points: Sequence[Mapping[str, Any]] = ()


def _packet(kind: int, body: bytes) -> bytes:
    return HEADER.pack(HEADER.size + len(body), kind) + body


# ---------------------------------------------------------------------- client's side


def encode_command(number: int, /, **values: Any) -> bytes:
    """Return a command as bytes."""
    return _packet(COMMAND, struct.pack("<I", number) + COMMANDS[number].request.pack(values))


def decode_header(data: bytes | bytearray) -> tuple[int, int]:
    """Return the number of bytes after the header, and the type.

    Raises
    ------
    ProtocolError
        Not a header: bytes were lost or added.
    """
    size, kind = HEADER.unpack(data)
    known = kind in RESULTS or kind in (COMMAND, ERROR, CHANGE) or kind in UNUSED_TYPES
    if not (HEADER.size + 4 <= size <= MAX_PACKET_BYTES and known):
        raise ProtocolError(
            f"Expected the header of an emScon packet; found {data.hex(' ')}, {size} bytes of type {kind}. Check "
            "that the address is that of an emScon server",
            code="protocol.reply.form",
        )
    return size - HEADER.size, kind


def decode_packet(kind: int, body: bytes) -> Packet:
    """Return a packet from its type and the bytes after its header.

    Raises
    ------
    ProtocolError
        The size does not match the type.
    """
    try:
        return _decode(kind, body)
    except struct.error:
        raise ProtocolError(
            f"An emScon packet of type {kind} is too short: {len(body) + HEADER.size} bytes, {body[:16].hex(' ')}",
            code="protocol.reply.length",
        ) from None


def _decode(kind: int, body: bytes) -> Packet:
    if kind in (COMMAND, ERROR):
        number, status = struct.unpack_from("<II", body)
        known = COMMANDS.get(number)
        values = known.answer.unpack(body, 8) if kind == COMMAND and status == 0 and known else {}
        return Packet(kind, number, status, values)
    (status,) = struct.unpack_from("<I", body)
    if kind not in RESULTS:
        return Packet(kind, status=status)
    layout = RESULTS[kind]
    values = layout.unpack(body, 4)
    points = tuple(_points(kind, body, 4 + layout.packed.size, values["count"])) if kind in POINTS else ()
    return Packet(kind, status=status, values=values, points=points)


def _points(kind: int, body: bytes, start: int, count: int) -> Iterator[Mapping[str, Any]]:
    layout = POINTS[kind]
    size = layout.packed.size
    if not 0 <= count == (len(body) - start) // size:
        raise ProtocolError(
            f"Expected a packet of {count} points with {size} bytes each; found {len(body) - start} bytes",
            code="protocol.reply.length",
        )
    for offset in range(start, start + count * size, size):
        yield layout.unpack(body, offset)
