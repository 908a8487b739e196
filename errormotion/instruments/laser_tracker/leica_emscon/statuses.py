"""Meanings of the status numbers of an emScon server.

Numbers are those of the interface's C definitions 3.6 and newer. Errors of the tracker processor have further numbers,
listed in its manual; they are reported as received.
"""

from __future__ import annotations

from collections.abc import Mapping

OK, BUSY, NOT_IMPLEMENTED = 0, 1, 2
NO_DISTANCE, NOT_INITIALISED = 37, 39
NOT_READY, NO_RESULT, SYSTEM_NOT_READY = 10004, 10009, 10014

_PARAMETER = {
    **{number: f"wrong parameter {number - 3}" for number in range(4, 11)},
    **{11 + 2 * k: f"parameter {k + 1} outside its range, but accepted" for k in range(6)},
    **{12 + 2 * k: f"parameter {k + 1} outside its range" for k in range(6)},
    **{number: f"wrong parameter {number - 39}" for number in range(47, 56)},
}

RESULTS: Mapping[int, str] = {
    **_PARAMETER,
    BUSY: "the server is busy",
    NOT_IMPLEMENTED: "the command is not implemented in this tracker",
    3: "wrong parameter",
    23: "wrong current reflector",
    24: "no centre of a circle found",
    25: "no centre of a sphere found",
    26: "no tracker processor found",
    27: "no weather station found",
    28: "no point has been measured yet",
    29: "no camera",
    30: "no absolute distance meter",
    31: "no level",
    32: "wrong firmware of the tracker processor",
    33: "the server's database was not found",
    34: "the licence has expired",
    35: "the command is not possible in the present mode",
    36: "an unknown error",
    NO_DISTANCE: "no distance is set: the interferometer has lost its count",
    38: "no tracker is connected",
    NOT_INITIALISED: "the tracker is not initialised",
    40: "a module has not started",
    41: "a module did not answer in time",
    42: "a module's data could not be read",
    43: "a module's data could not be written",
    44: "not in the camera's position",
    45: "the tracker processor has service firmware",
    46: "the tracker is controlled by another system",
    56: "no such compensation",
    57: "temperature, pressure or humidity outside the range",
    58: "a compensation is running",
    59: "an internal process is running",
    60: "no copy protection dongle found",
    61: "a module is not activated",
    62: "a module has a wrong version",
    90: "nothing to import",
    94: "no temperature from the weather station",
    95: "no pressure from the weather station",
    96: "no humidity from the weather station",
    98: "invalid input",
    10002: "no valid compensation of the distance meter",
    10003: "fault of the pressure sensor",
    NOT_READY: "not ready to measure: no reflector in the beam, or not initialised",
    10005: "the distance meter is starting",
    10007: "no target recognition",
    10008: "no overview camera",
    NO_RESULT: "the measurement gave no result: the reflector moved, or the beam was broken",
    10010: "the sensor is not level",
    10011: "another client is connected",
    10012: "the sensor has not warmed up",
    10013: "the sensor is not stable",
    SYSTEM_NOT_READY: "the system is not ready to measure",
    10015: "the sensor does not answer its controller",
    10016: "no battery in the sensor",
    10017: "the compensator is not allowed",
    10018: "the sensor has reached its working temperature",
    10019: "not level enough to initialise",
    10020: "the distance meter has a fault",
    10021: "the target recognition has a fault",
}

#: Statuses without a distance that are not faults of the tracker.
NO_TARGET = frozenset({NO_DISTANCE, NOT_READY, NO_RESULT, SYSTEM_NOT_READY})

#: Messages of a server about itself that were not requested.
MEASURE_NOT_READY, MEASURE_BUSY, MEASURE_READY = 25, 26, 27
REFRACTION_CHANGED, ENVIRONMENT_CHANGED, DISTANCE_SET, UNITS_CHANGED, COORDINATES_CHANGED = 3, 2, 0, 6, 12
SYSTEM_SETTINGS_CHANGED = 8
FRAME_CHANGED = frozenset({UNITS_CHANGED, COORDINATES_CHANGED, SYSTEM_SETTINGS_CHANGED})
"""Changes after which the frame or units of positions may differ."""
CHANGES: Mapping[int, str] = {
    DISTANCE_SET: "distance set",
    1: "laser warmed up",
    ENVIRONMENT_CHANGED: "environment changed",
    REFRACTION_CHANGED: "refraction index changed",
    4: "search parameters changed",
    5: "parameters of the distance meter changed",
    UNITS_CHANGED: "units changed",
    7: "reflector changed",
    SYSTEM_SETTINGS_CHANGED: "system settings changed",
    9: "temperature range changed",
    10: "camera parameters changed",
    11: "compensation changed",
    COORDINATES_CHANGED: "coordinates changed",
    15: "station orientation changed",
    16: "transformation changed",
    17: "measurement mode changed",
    18: "parameters of single measurements changed",
    19: "parameters of continuous measurements changed",
    24: "statistics changed",
    MEASURE_NOT_READY: "not ready to measure",
    MEASURE_BUSY: "measuring",
    MEASURE_READY: "ready to measure",
    28: "number of measurements reached",
    30: "face 1",
    31: "face 2",
    151: "initialisation changed",
    152: "level changed",
    850: "sensor detected",
    851: "sensor disconnected",
    853: "battery changed",
    997: "connection to the tracker closes",
    998: "server closes",
    999: "server started",
}

#: Statuses of one point of a continuous measurement.
POINTS: Mapping[int, str] = {
    1: "fast",  # a warning; the value is valid
    2: "too fast",
    3: "reflector",
    4: "trigger",
}

TARGETS: Mapping[int, str] = {
    0: "unknown",
    1: "corner cube",
    2: "cat's eye",
    3: "glass prism",
    4: "RFI prism",
    5: "red ring 1.5 in",
    6: "red ring 0.5 in",
    7: "break-resistant 1.5 in",
    8: "break-resistant 0.5 in",
    9: "tooling ball 0.5 in",
    10: "autocollimation mirror",
    11: "red ring 0.875 in",
}

STATIONS: Mapping[int, str] = {0: "none", 1: "Thommen", 2: "AT"}


def result_text(status: int) -> str:
    """Return the meaning of a result status."""
    return RESULTS.get(status, "an error of the tracker processor; its manual lists the number")
