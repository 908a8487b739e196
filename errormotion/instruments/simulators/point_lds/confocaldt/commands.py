"""Commands of a confocalDT 24x1: their forms, the models, the errors."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from errormotion.instruments.simulators.point_lds.optoncdt.grammar import Command

QUERY = Command(writes=False)
ACTION = Command()
STATISTICS = "{MIN MAX PEAK2PEAK}"
ADDITIONAL = ("SHUTTER", "MEASRATE", "COUNTER", "TIMESTAMP", "INTENSITY", "STATE", "ENC1", "ENC2", "ENC3")
_FURTHER = "{" + " ".join((*ADDITIONAL, "TRIGTIMEDIFF")) + "}"

COMMANDS: Mapping[str, Command] = {
    "HELP": Command(["[<text>]"], writes=False),
    "GETINFO": QUERY,
    "ECHO": Command(["ON|OFF"], "ON", writes=False),
    "PRINT": Command(["[ALL]"], writes=False),
    "SYNC": Command(["NONE|MASTER|SLAVE|SLAVE_EXT"], "NONE"),
    "RESET": ACTION,
    "GETTEMP": QUERY,
    "LOGIN": Command(["<text>"], writes=False),
    "LOGOUT": QUERY,
    "GETUSERLEVEL": QUERY,
    "STDUSER": Command(["USER|PROFESSIONAL"], "PROFESSIONAL"),
    "PASSWD": Command(["<text> <text> <text>"]),
    "SENSORTABLE": QUERY,
    "SENSORHEAD": Command(["<0..19>"], "0"),
    "SENSORINFO": QUERY,
    "DARKCORR": ACTION,
    "DARKCORRTHRES": Command(["<number>"], "50.0"),
    "IPCONFIG": Command(["DHCP|STATIC [<text>] [<text>] [<text>]"], "STATIC 169.254.168.150 255.255.0.0 0.0.0.0"),
    "MEASTRANSFER": Command(
        ["NONE", "SERVER/TCP [<1024..65535>]", "CLIENT/TCP|CLIENT/UDP [<text>] [<1024..65535>]"], "SERVER/TCP 1024"
    ),
    "MEASMODE": Command(["DISTANCE|THICKNESS"], "DISTANCE"),
    "SHUTTERMODE": Command(["SEARCH|MEAS|MANUAL|2TIMEALT|2TIMES"], "MEAS"),
    "MEASRATE": Command(["<number>"], "1.0"),
    "SHUTTER": Command(["<number> [<number>]"], "100.000"),
    "ROI": Command(["<0..511> <0..511>"], "0 511"),
    "VSAVERAGE": Command(["NONE|REC2|REC4|REC8|MOV2|MOV3|MOV4|MED3"], "NONE"),
    "AVERAGE": Command(
        ["NONE", "MOVING 2|4|8|16|32|64|128|256|512|1024", "RECURSIVE <2..32768>", "MEDIAN 3|5|7|9"], "NONE"
    ),
    "RESETSTATISTIC": ACTION,
    "MASTERMV": Command(["NONE", "MASTER <number>"], "NONE"),
    "OUTPUT": Command(["NONE|RS422|ETHERNET|ETHERCAT"], "NONE"),
    "OUTREDUCE": Command(["<1..1000> [ANALOG|RS422|ETHERNET|NONE]"], "1"),
    "OUTHOLD": Command(["NONE|<0..1024>"], "NONE"),
    "OUTDIST_ETH": Command(["NONE", "{DIST1 DIST2}"], "DIST1"),
    "OUTTHICK_ETH": Command(["NONE|THICK12"], "NONE"),
    "OUTSTATISTIC_ETH": Command(["NONE", STATISTICS], "NONE"),
    "OUTADD_ETH": Command(["NONE", _FURTHER], "NONE"),
    "OUTADD_RS422": Command(["NONE", _FURTHER], "NONE"),
    "SWITCHMD2": Command(["0|1"], "0"),
}

ERRORS: Mapping[str, str] = {
    "command": "E01 Unknown command",
    "parameter": "E02 Incorrect parameter type",
    "count": "E03 Wrong number of parameters",
    "range": "E05 Parameter out of range",
    "access": "E06 Access denied",
    "long": "E11 Parameter is too long",
    "state": "E14 Command not available in this mode",
    "timeout": "E32 Timeout",
    "passwords": "E36 The new passwords are not identical",
    "sensor": "E39 Sensor is not available",
}
"""Answer by reason; numbers and texts that are not in the manual are assumptions."""

_ONE_DECIMAL = re.compile(r"\d{1,3}(\.\d)?")


@dataclass(frozen=True)
class Model:
    """Limits of MEASRATE (kHz) and SHUTTER (us), and the order number."""

    least: float
    most: float
    exposure: float
    article: int

    def allows_rate(self, text: str) -> bool:
        """Whether MEASRATE takes this parameter."""
        return bool(_ONE_DECIMAL.fullmatch(text)) and self.least <= float(text) <= self.most

    def allows_exposure(self, text: str) -> bool:
        """Whether SHUTTER takes this parameter."""
        return 0.1 <= float(text) <= self.exposure


MODELS: Mapping[str, Model] = {
    "IFC2451": Model(0.1, 10.0, 10000.0, 2418004),
    "IFC2461": Model(0.1, 25.0, 10000.0, 2418005),
    "IFC2471": Model(0.3, 70.0, 3333.325, 2418006),
}
"""The order number of the IFC2451 is that of the manual's example; the others are assumptions."""
