"""Packets of emScon: every command of the header with the layout of its request and its reply, and the results.

From ``ES_C_API_Def.h`` of the TPI 3.6 (all trackers) and the same file of the AT4xx: little-endian, 4-byte alignment. A
layout has one letter for each field:

* ``i`` a 32-bit number, enumeration or flag, ``d`` a double, ``u`` and ``w`` text of 32 and 128 UTF-16 units;
* doubles in the client's units: ``L`` length, ``A`` angle, ``T`` temperature, ``P`` pressure;
* ``C`` a position, three doubles in the client's coordinate system; ``S`` three steps or deviations of such ones.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from errormotion.instruments.simulators.laser_tracker.leica_emscon.measures import (
    SCC,
    Units,
    from_system,
    kinds,
    to_system,
)

HEADER = struct.Struct("<iI")
"""Size of the packet, bytes, and its type."""
BASIC = HEADER.size + 8
"""Bytes of a reply without data: header, command, status."""
MAX_REQUEST = 256
"""Bytes; the longest request of the header has 128."""
COMMAND, ERROR, SINGLE, MULTI, NIVEL, REFLECTOR, CHANGE, SINGLE2, MULTI2 = 0, 1, 2, 3, 6, 7, 8, 9, 10
UNKNOWN = 64
"""Number of the command in an error without a command."""


class Layout(NamedTuple):
    """Name of a command, layout of its request and of its reply."""

    name: str
    request: str = ""
    reply: str = ""


COMMANDS: Mapping[int, Layout] = {
    0: Layout("ExitApplication"),
    1: Layout("GetSystemStatus", "", "iiiiiiiiii"),
    2: Layout("GetTrackerStatus", "", "i"),
    3: Layout("SetTemperatureRange", "i"),
    4: Layout("GetTemperatureRange", "", "i"),
    5: Layout("SetUnits", "iiiii"),
    6: Layout("GetUnits", "", "iiiii"),
    7: Layout("Initialize"),
    8: Layout("ReleaseMotors"),
    9: Layout("ActivateCameraView"),
    10: Layout("Park"),
    11: Layout("SwitchLaser", "i"),
    12: Layout("SetStationOrientationParams", "LLLAAA"),
    13: Layout("GetStationOrientationParams", "", "LLLAAA"),
    14: Layout("SetTransformationParams", "LLLAAAd"),
    15: Layout("GetTransformationParams", "", "LLLAAAd"),
    16: Layout("SetBoxRegionParams", "CC"),
    17: Layout("GetBoxRegionParams", "", "CC"),
    18: Layout("SetSphereRegionParams", "CL"),
    19: Layout("GetSphereRegionParams", "", "CL"),
    20: Layout("SetEnvironmentParams", "TPd"),
    21: Layout("GetEnvironmentParams", "", "TPd"),
    22: Layout("SetRefractionParams", "dd"),
    23: Layout("GetRefractionParams", "", "dd"),
    24: Layout("SetMeasurementMode", "i"),
    25: Layout("GetMeasurementMode", "", "i"),
    26: Layout("SetCoordinateSystemType", "i"),
    27: Layout("GetCoordinateSystemType", "", "i"),
    28: Layout("SetStationaryModeParams", "ii"),
    29: Layout("GetStationaryModeParams", "", "ii"),
    30: Layout("SetContinuousTimeModeParams", "iiii"),
    31: Layout("GetContinuousTimeModeParams", "", "iiii"),
    32: Layout("SetContinuousDistanceModeParams", "Liii"),
    33: Layout("GetContinuousDistanceModeParams", "", "Liii"),
    34: Layout("SetSphereCenterModeParams", "LiiL"),
    35: Layout("GetSphereCenterModeParams", "", "LiiL"),
    36: Layout("SetCircleCenterModeParams", "LiiL"),
    37: Layout("GetCircleCenterModeParams", "", "LiiL"),
    38: Layout("SetGridModeParams", "Siii"),
    39: Layout("GetGridModeParams", "", "Siii"),
    40: Layout("SetReflector", "i"),
    41: Layout("GetReflector", "", "i"),
    42: Layout("GetReflectors", "", "iiiLu"),
    43: Layout("SetSearchParams", "Li"),
    44: Layout("GetSearchParams", "", "Li"),
    45: Layout("SetAdmParams", "Lii"),
    46: Layout("GetAdmParams", "", "Lii"),
    47: Layout("SetSystemSettings", "iiiiiiiii"),
    48: Layout("GetSystemSettings", "", "iiiiiiiii"),
    49: Layout("StartMeasurement"),
    51: Layout("StartNivelMeasurement"),
    52: Layout("StopMeasurement"),
    53: Layout("ChangeFace"),
    54: Layout("GoBirdBath"),
    55: Layout("GoPosition", "Ci"),
    56: Layout("GoPositionHVD", "AALi"),
    57: Layout("PositionRelativeHV", "AA"),
    58: Layout("PointLaser", "C"),
    59: Layout("PointLaserHVD", "AAL"),
    60: Layout("MoveHV", "ii"),
    61: Layout("GoNivelPosition", "i"),
    62: Layout("GoLastMeasuredPoint"),
    63: Layout("FindReflector", "L"),
    65: Layout("LookForTarget", "CL", "AA"),
    66: Layout("GetDirection", "", "AA"),
    67: Layout("CallOrientToGravity", "", "AA"),
    68: Layout("ClearTransformationNominalPointList"),
    69: Layout("ClearTransformationActualPointList"),
    70: Layout("AddTransformationNominalPoint", "ddddddddd"),
    71: Layout("AddTransformationActualPoint", "ddddddddd"),
    72: Layout("SetTransformationInputParams", "i" + 14 * "d"),
    73: Layout("GetTransformationInputParams", "", "i" + 14 * "d"),
    74: Layout("CallTransformation", "", 17 * "d"),
    75: Layout("GetTransformedPoints", "", "i" + 13 * "d"),
    76: Layout("ClearDrivePointList"),
    77: Layout("AddDrivePoint", "iC"),
    78: Layout("CallIntermediateCompensation", "", "ddi"),
    79: Layout("SetCompensation", "i"),
    80: Layout("SetStatisticMode", "ii"),
    81: Layout("GetStatisticMode", "", "ii"),
    82: Layout("GetStillImage", "i", "iii"),  # type, size, first byte of the image, filled up to 4
    83: Layout("SetCameraParams", "iii"),
    84: Layout("GetCameraParams", "", "iii"),
    85: Layout("GetCompensation", "", "i"),
    86: Layout("GetCompensations", "", "iiuwui"),
    87: Layout("CheckBirdBath", "", "AALAAL"),
    88: Layout("GetTrackerDiagnostics", "", 10 * "d" + "iTii"),
    89: Layout("GetADMInfo", "", "iii"),
    90: Layout("GetTPInfo", "", "iiiiiiiiii"),
    91: Layout("GetNivelInfo", "", "iii"),
    92: Layout("SetLaserOnTimer", "ii"),
    93: Layout("GetLaserOnTimer", "", "ii"),
    94: Layout("ConvertDisplayCoordinates", "iddd", "ddd"),
    95: Layout("GoBirdBath2", "i"),
    96: Layout("SetTriggerSource", "i"),
    97: Layout("GetTriggerSource", "", "i"),
    98: Layout("GetFace", "", "i"),
    99: Layout("GetCameras", "", "iiiiuw"),
    100: Layout("GetCamera", "", "ii"),
    101: Layout("SetMeasurementCameraMode", "i"),
    102: Layout("GetMeasurementCameraMode", "", "i"),
    103: Layout("GetProbes", "", "iiiiiuw"),
    104: Layout("GetProbe", "", "i"),
    105: Layout("GetTipAdapters", "", "iiiiiidduw"),
    106: Layout("GetTipAdapter", "", "ii"),
    107: Layout("GetTCamToTrackerCompensations", "", "iiiiiiuw"),
    108: Layout("GetTCamToTrackerCompensation", "", "i"),
    109: Layout("SetTCamToTrackerCompensation", "i"),
    110: Layout("GetProbeCompensations", "", "iiiiiiiuw"),
    111: Layout("GetProbeCompensation", "", "i"),
    112: Layout("SetProbeCompensation", "i"),
    113: Layout("GetTipToProbeCompensations", "", "iiiiiiuw"),
    114: Layout("GetTipToProbeCompensation", "", "i"),
    115: Layout("SetExternTriggerParams", "iiii"),
    116: Layout("GetExternTriggerParams", "", "iiii"),
    117: Layout("GetErrorEllipsoid", "ddddddddd", "dddddd"),
    118: Layout("GetMeasurementCameraInfo", "", "iiiiuiiiiiLLiiddi"),
    119: Layout("GetMeasurementProbeInfo", "", 14 * "i"),
    120: Layout("SetLongSystemParameter", "ii"),
    121: Layout("GetLongSystemParameter", "i", "ii"),
    122: Layout("GetMeasurementStatusInfo", "", "ii"),
    123: Layout("GetCompensations2", "", "iiuwuwii"),
    124: Layout("GetCurrentPrismPosition", "", "C"),
    125: Layout("SetDoubleSystemParameter", "id"),
    126: Layout("GetDoubleSystemParameter", "i", "id"),
    127: Layout("GetObjectTemperature", "", "T"),
    128: Layout("GetTriggerBoardInfo", "", "iiii"),
    129: Layout("GetOverviewCameraInfo", "", "iuidddii"),
    130: Layout("ClearCommandQueue", "i"),
    131: Layout("GetADMInfo2", "", "iuiiiLLiL"),
    132: Layout("GetTrackerInfo", "", "iuiiiiiALLiiAAiii"),
    133: Layout("GetNivelInfo2", "", "iuiiiddd"),
    134: Layout("RestoreStartupConditions"),
    135: Layout("GoAndMeasure", "C"),
    136: Layout("GetTipToProbeCompensations2", "", "iiiiiiiuwu"),
    137: Layout("SetTipAdapter", "i"),
    138: Layout("GetATRInfo", "", "iuiiiiiiLLAd"),
    139: Layout("GetMeteoStationInfo", "", "iuii"),
    140: Layout("GetAT4xxInfo", "", "iu" + 13 * "i" + "LLLAAA"),
    142: Layout("GetSystemSoftwareVersion", "", "u"),
}
AT4XX = frozenset((
    *(0, 1, 2, 5, 6, 7, 9, 10, 12, 13, 14, 15, *range(20, 30), *range(40, 45), 47, 48, 49, *range(51, 64), 66, 67),
    *(79, 80, 81, 83, 84, 85, 86, 90, 91, 92, 93, 95, 98, *range(120, 124), *range(125, 128), *range(129, 136)),
    *(138, 139, 140, 142),
))  # fmt: skip
"""Commands in the header of the AT4xx; it does not implement the others."""
NUMBERS: Mapping[str, int] = {layout.name: number for number, layout in COMMANDS.items()}

RESULTS: Mapping[int, str] = {
    SINGLE: "iii" + "C" + "Sd" + "ddd" + "Sd" + "TPd",
    SINGLE2: "iii" + "C" + "Sd" + "ddd" + "ddd" + "Sd" + "ddd" + "TPd",
    MULTI: "iiii" + "TPd",
    MULTI2: "iiii" + "TPd",
    NIVEL: "iiddT",
    REFLECTOR: "iC",
    CHANGE: "i",
    ERROR: "ii",
}
"""Layouts of the other packets after their header; of MULTI and MULTI2 without the points."""
POINTS: Mapping[int, str] = {MULTI: "iiiC", MULTI2: "iiiC" + "Sd" + "ddd"}
_SIZES = {"i": 4, "u": 64, "w": 256, "C": 24, "S": 24}


def size_of(layout: str) -> int:
    """Return the number of bytes of the fields of a layout."""
    return sum(_SIZES.get(letter, 8) for letter in layout)


class Wire:
    """Packs and unpacks in the units and the coordinate system of the client; values are in SI and spherical."""

    def __init__(self) -> None:
        self.units = Units()
        self.system = SCC

    def unpack(self, layout: str, data: bytes) -> list[Any]:
        """Return the fields of a request; ``data`` has the size of the layout."""
        values: list[Any] = []
        place = 0
        for letter in layout:
            size = _SIZES.get(letter, 8)
            part = data[place : place + size]
            place += size
            if letter == "i":
                values.append(struct.unpack("<i", part)[0])
            elif letter in "CS":
                triple = self._triple_into(struct.unpack("<3d", part))
                values.append(from_system(triple, self.system) if letter == "C" else triple)
            else:
                values.append(self.units.into(letter, struct.unpack("<d", part)[0]))
        return values

    def pack(self, layout: str, values: Sequence[Any]) -> bytes:
        """Return the bytes of fields."""
        parts = []
        for letter, value in zip(layout, values, strict=True):
            if letter == "i":
                parts.append(struct.pack("<i", int(value)))
            elif letter in "uw":
                units = _SIZES[letter]
                parts.append(str(value).encode("utf-16-le")[: units - 2].ljust(units, b"\0"))
            elif letter in "CS":
                triple = to_system(value, self.system) if letter == "C" else value
                parts.append(struct.pack("<3d", *map(self.units.out, kinds(self.system), triple)))
            else:
                parts.append(struct.pack("<d", self.units.out(letter, value)))
        return b"".join(parts)

    def reply(self, number: int, status: int = 0, values: Sequence[Any] | None = None) -> bytes:
        """Return the reply to a command; without data, the data are 0. The size is always that of the header."""
        layout = COMMANDS[number].reply if number in COMMANDS else ""
        data = bytes(size_of(layout)) if values is None else self.pack(layout, values)
        return HEADER.pack(BASIC + len(data), COMMAND) + struct.pack("<ii", number, status) + data

    def result(self, kind: int, values: Sequence[Any], points: Sequence[Sequence[Any]] = ()) -> bytes:
        """Return a packet other than a reply."""
        data = self.pack(RESULTS[kind], values)
        if points:
            data += b"".join(self.pack(POINTS[kind], point) for point in points)
        return HEADER.pack(HEADER.size + len(data), kind) + data

    def _triple_into(self, triple: tuple[float, ...]) -> tuple[float, float, float]:
        a, b, c = map(self.units.into, kinds(self.system), triple)
        return a, b, c
