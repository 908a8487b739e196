"""Calls and return codes of GeoCOM."""

from __future__ import annotations

NULL = 0
GET_ANGLES = 2003
DO_MEASURE = 2008
SET_DISTANCE_MODE = 2020
SET_AIR = 2028
GET_AIR = 2029
GET_MEASUREMENT = 2108
GET_AIR_PPM = 2151
GET_NUMBER = 5003
GET_NAME = 5004
GET_TEMPERATURE = 5011
GET_SOFTWARE = 5034
POSITION = 9027
FINE_ADJUST = 9037

_NAMES = {
    NULL: "COM_NullProc",
    GET_ANGLES: "TMC_GetAngle1",
    DO_MEASURE: "TMC_DoMeasure",
    SET_DISTANCE_MODE: "TMC_SetEdmMode",
    SET_AIR: "TMC_SetAtmCorr",
    GET_AIR: "TMC_GetAtmCorr",
    GET_MEASUREMENT: "TMC_GetSimpleMea",
    GET_AIR_PPM: "TMC_GetAtmPpm",
    GET_NUMBER: "CSV_GetInstrumentNo",
    GET_NAME: "CSV_GetInstrumentName",
    GET_TEMPERATURE: "CSV_GetIntTemp",
    GET_SOFTWARE: "CSV_GetSWVersion",
    POSITION: "AUT_MakePositioning",
    FINE_ADJUST: "AUT_FineAdjust",
}

MEASURE_DEFAULT, MEASURE_CLEAR = 1, 3
"""Programs of TMC_DoMeasure: measure a distance in the mode that is set; clear the last distance."""
INCLINATION = {"measured": 0, "automatic": 1, "plane": 2}
DISTANCE_MODES = {"standard": 2, "fast": 3, "precise": 13}

OK = 0
NOT_FULLY_CORRECTED = 1283
ACCURACY_NOT_GUARANTEED = 1284
WARNINGS = (NOT_FULLY_CORRECTED, ACCURACY_NOT_GUARANTEED)
"""Return codes of a measurement whose values are valid nevertheless."""
NO_DISTANCE = (1285, 1288, 1289, 1290, 1291, 1292, 1294)
"""Return codes of a measurement without a distance; a repeated request returns the same."""
BUSY = 1293
NO_TARGET = (8704, 8706, 8710, 8711, 8712, 8713, 8716)
"""Return codes of a search that found no reflector."""
UNAVAILABLE = (3080, 3081)
"""Communication codes of a call that the station does not have."""

_TEXTS = {
    1: "undefined",
    2: "invalid parameter",
    3: "invalid result",
    4: "fatal error",
    5: "not implemented",
    6: "timeout",
    8: "aborted",
    12: "the station shuts down",
    13: "the station is busy",
    27: "not supported by this station",
    NOT_FULLY_CORRECTED: "not corrected by all sensors",
    ACCURACY_NOT_GUARANTEED: "accuracy not guaranteed",
    1285: "angles only, no valid distance",
    1288: "angles only, not corrected by all sensors",
    1289: "angles only, accuracy not guaranteed",
    1290: "no valid angles",
    1291: "distance meter with wrong ppm or prism settings",
    1292: "no distance, the beam has no reflector",
    BUSY: "the measuring system is busy",
    1294: "no signal",
    3077: "timeout",
    3080: "request not understood",
    3081: "call unknown to this station",
    8704: "position not reached in time",
    8706: "error of the angle measurement",
    8707: "error of the motors",
    8708: "position not reached exactly",
    8709: "error of the deviation measurement",
    8710: "no reflector found",
    8711: "several reflectors found",
    8712: "bad conditions for the target recognition",
    8713: "error of the detector",
    8714: "target recognition is off: switch it on at the station",
    8716: "position not reached exactly",
}


def name(call: int) -> str:
    """Return the name of a call in the manufacturer's manual."""
    return f"{_NAMES.get(call, 'unknown')} ({call})"


def text(code: int) -> str:
    """Return the meaning of a return code."""
    return _TEXTS.get(code, "see the station's GeoCOM manual")
