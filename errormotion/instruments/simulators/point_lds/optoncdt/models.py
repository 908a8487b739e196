"""The models according to the manuals: commands, rates, errors, description and order of values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from errormotion.instruments.simulators.point_lds.optoncdt.grammar import Command

QUERY = Command(writes=False)
ACTION = Command()
SWITCH = "ON|OFF"

_COMMON: dict[str, Command] = {
    "HELP": Command(["[<text>]"], writes=False),
    "GETINFO": QUERY,
    "RESET": ACTION,
    "ECHO": Command([SWITCH], "ON", writes=False),
    "PRINT": Command(["[ALL]"], writes=False),
    "LOGIN": Command(["<text>"], writes=False),
    "LOGOUT": QUERY,
    "GETUSERLEVEL": QUERY,
    "STDUSER": Command(["USER|PROFESSIONAL"], "PROFESSIONAL"),
    "PASSWD": Command(["<text> <text> <text>"]),
    "TRIGGERAT": Command(["INPUT|OUTPUT"], "INPUT"),
    "TRIGGERCOUNT": Command(["<0..16383>"], "1"),
    "TRIGGERSW": ACTION,
    "GETOUTINFO_RS422": QUERY,
}

_ILD2300: dict[str, Command] = _COMMON | {
    "SYNC": Command(["NONE|SLAVE|MASTER|MASTER_ALT TERMON|TERMOFF"], "NONE TERMOFF"),
    "RESETCNT": Command(["{TIMESTAMP MEASCNT TRIGCNT}"]),
    "TRIGGER": Command(["NONE|EDGE|PULSE|SOFTWARE TERMON|TERMOFF"], "NONE TERMOFF"),
    "TRIGGERLEVEL": Command(["HIGH|LOW"], "HIGH"),
    "TRIGGEROUT": Command(["TRIGGERED|ALL"], "TRIGGERED"),
    "IPCONFIG": Command(["DHCP|STATIC [<text>] [<text>] [<text>]"], "STATIC 169.254.168.150 255.255.0.0 0.0.0.0"),
    "BAUDRATE": Command(["9600|115200|230400|460800|691200|921600|2000000|3000000|4000000"], "691200"),
    "STORE": Command(["<1..8>"]),
    "READ": Command(["ALL|DEVICE|MEAS <1..8>"]),
    "SETDEFAULT": Command(["ALL|NODEVICE"]),
    "MEASMODE": Command(["DIST_DIFFUSE|DIST_DIRECT|THICKNESS|VIDEO"], "DIST_DIFFUSE"),
    "MEASPEAK": Command(["DISTA|DISTW|DIST1"], "DISTA"),
    "MEASRATE": Command(["1.5|2.5|5|10|20|30|49"], "20"),
    "LASERPOW": Command(["FULL|REDUCED|OFF"], "FULL"),
    "VSAVERAGE": Command(["NONE|REC2|REC4|REC8|MOV2|MOV3|MOV4"], "NONE"),
    "AVERAGE": Command(["NONE", "MOVING [2|4|8|16|32|64|128]", "RECURSIVE [<1..32768>]", "MEDIAN [3|5|7|9]"], "NONE"),
    "SPIKECORR": Command([f"{SWITCH} [<1..10>] [<number>] [<1..100>]"], "OFF"),
    "STATISTICDEPTH": Command(["ALL|2|4|8|16|32|64|128|256|512|1024|2048|4096|8192|16384"], "ALL"),
    "RESETSTATISTIC": ACTION,
    "MASTERMV": Command(["NONE", "MASTER <number>"], "NONE"),
    "OUTPUT": Command(["NONE|RS422|ETHERNET"], "NONE"),
    "OUTREDUCE": Command(["<1..3000000>"], "1"),
    "OUTHOLD": Command(["NONE|INFINITE|<1..1024>"], "NONE"),
    "GETOUTINFO_ETH": QUERY,
    "OUTDIST_RS422": Command(["NONE", "{DIST1 DIST2}"], "DIST1"),
    "OUTTHICK_RS422": Command(["NONE|THICK12"], "NONE"),
    "OUTSTATISTIC_RS422": Command(["NONE", "{MIN MAX PEAK2PEAK}"], "NONE"),
    "OUTSTATISTIC_ETH": Command(["NONE", "{MIN MAX PEAK2PEAK}"], "NONE"),
    "OUTADD_RS422": Command(["NONE", "{TEMP SHUTTER COUNTER TIMESTAMP INTENSITY STATE}"], "NONE"),
    "OUTADD_ETH": Command(["NONE", "{SHUTTER COUNTER TIMESTAMP INTENSITY STATE TRIGCNT TEMP}"], "NONE"),
    "OUTVIDEO": Command(["NONE", "{RAW CORR}"], "NONE"),
}

_ILD1420: dict[str, Command] = _COMMON | {
    "LANGUAGE": Command(["DE|EN|CN"], "EN"),
    "RESETCNT": Command(["{TIMESTAMP MEASCNT}"]),
    "TRIGGER": Command(["NONE|EDGE|PULSE|SOFTWARE"], "NONE"),
    "MFILEVEL": Command(["HTL_HIGH|HTL_LOW|TTL_HIGH|TTL_LOW"], "HTL_HIGH"),
    "BAUDRATE": Command(["9600|19200|56000|115200|128000|230400|256000|460800|691200|921600|1000000"], "921600"),
    "BASICSETTINGS": Command(["READ|STORE"]),
    "SETDEFAULT": Command(["ALL|MEASSETTINGS|BASICSETTINGS"]),
    "MEASPEAK": Command(["DISTA|DISTW|DIST1"], "DISTA"),
    "MEASRATE": Command(["0.25|0.5|1|2|4"], "2"),
    "LASERPOW": Command(["FULL|OFF"], "FULL"),
    "AVERAGE": Command(["NONE", "MOVING 2|4|8|16|32|64|128", "RECURSIVE <2..32000>", "MEDIAN 3|5|7|9"], "NONE"),
    "MASTERMV": Command(["NONE", "MASTER <number>"], "NONE"),
    "OUTPUT": Command(["NONE|RS422|ANALOG"], "NONE"),
    "OUTREDUCEDEVICE": Command(["NONE", "{RS422 ANALOG}"], "NONE"),
    "OUTREDUCECOUNT": Command(["<1..3000000>"], "1"),
    "OUTHOLD": Command(["NONE|INFINITE|<1..1024>"], "NONE"),
    "OUTADD_RS422": Command(["NONE", "{SHUTTER COUNTER TIMESTAMP INTENSITY STATE DIST_RAW}"], "NONE"),
}


@dataclass(frozen=True)
class Model:
    """One model of the series.

    Attributes
    ----------
    commands : mapping of str to Command
        By name.
    errors : mapping of str to str
        Answer by reason.
    description : sequence of str
        Lines of GETINFO, templates with ``range`` (mm) and ``number``.
    order : sequence of str
        All values of a block in the order in which they are sent.
    largest : int
        Last raw value of a distance, including the reserve beyond the range.
    range : float
        mm; used if neither the address nor the machine states it.
    """

    commands: Mapping[str, Command]
    errors: Mapping[str, str]
    description: tuple[str, ...]
    order: tuple[str, ...]
    largest: int
    range: float
    rates: Mapping[str, float] = field(default_factory=dict)

    def rate(self, text: str) -> float:
        """Return the measuring rate for a parameter of MEASRATE, Hz."""
        return self.rates.get(text, float(text) * 1e3)


MODELS: dict[str, Model] = {
    "ILD2300": Model(
        commands=_ILD2300,
        errors={
            "command": "E01 Unknown command",
            "parameter": "E02 Incorrect parameter type",
            "count": "E03 Wrong number of parameters",
            "range": "E05 Parameter out of range",
            "access": "E06 Access denied",
            "long": "E11 Entered command is too long",
            "state": "E14 Command not available in this mode",
            "timeout": "E32 Timeout",
            "passwords": "E36 The new passwords are not identical",
        },
        description=(
            "Name: ILD2300",
            "Serial: {number:08d}",
            "Option: 000",
            "Article: 4120178",
            "MAC-Address: 00-0C-12-01-03-04",
            "Measuring range: {range:.2f}mm",
            "Name CalTab: DIFFUSE",
            "Version: 0003.066.087",
            "Imagetype: User",
        ),
        order=(
            "TEMP",
            "SHUTTER",
            "COUNTER",
            "TIMESTAMP",
            "INTENSITY",
            "DIST1",
            "DIST2",
            "STATE",
            "THICK12",
            "MIN",
            "MAX",
            "PEAK2PEAK",
        ),
        largest=65519,
        range=2.0,
        rates={"49": 49.14e3},
    ),
    "ILD1420": Model(
        commands=_ILD1420,
        errors={
            "command": "E210 Unknown command",
            "character": "E204 Received unsupported character",
            "parameter": "E234 Wrong or unknown parameter type",
            "count": "E232 Wrong parameter count",
            "range": "E236 Value is out of range or the format is invalid",
            "access": "E202 Access denied",
            "long": "E214 Entered command is too long to be processed",
            "state": "E200 I/O operation failed",
            "timeout": "E104 Timeout",
            "passwords": "E350 The new passwords are not identical",
        },
        description=(
            "Name: ILD1420-{range:g}",
            "Serial: {number:08d}",
            "Option: 000",
            "Article: 4120212",
            "Cable head: Wire",
            "Measuring range: {range:.2f}mm",
            "Version: 001.010",
            "Hardware-rev: 00",
            "Boot-version: 001.000",
        ),
        order=(
            "DIST1",
            "SHUTTER",
            "INTENSITY",
            "STATE",
            "COUNTER",
            "TIMESTAMP_LO",
            "TIMESTAMP_HI",
            "DIST_RAW",
        ),
        largest=65520,
        range=10.0,
    ),
}

NEWER_RATES = Command(["0.25|0.5|1|2|4|8"], "2")
"""MEASRATE of newer sensors of the 1420 series."""
