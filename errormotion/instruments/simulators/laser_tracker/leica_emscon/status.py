"""Numbers of the header that the simulated server answers and reports (ES_ResultStatus, ES_SystemStatusChange)."""

from __future__ import annotations

from enum import IntEnum


class Status(IntEnum):
    """Status of a reply."""

    OK = 0
    BUSY = 1
    NOT_IMPLEMENTED = 2
    WRONG_PARAMETER = 3
    NO_VIDEO_CAMERA = 29
    USAGE_CONFLICT = 35
    NOT_INITIALISED = 39
    AIR_OUT_OF_RANGE = 57
    NO_MEASUREMENT_CAMERA = 67
    NO_PROBE = 75
    NO_TIP = 83
    MODE_6D_NOT_ALLOWED = 92
    NO_TRIGGER_BOARD = 99
    NOT_READY = 10004
    NO_RESULT = 10009


def wrong(position: int) -> int:
    """Return the status for a wrong parameter; positions start at 1."""
    return 3 + position if position <= 7 else 39 + position


def out_of_range(position: int) -> int:
    """Return the status for a rejected parameter out of range; positions start at 1."""
    return 10 + 2 * position


class Event(IntEnum):
    """Changes of the system that the server reports without a request."""

    DISTANCE_SET = 0
    ENVIRONMENT = 2
    REFRACTION = 3
    SEARCH = 4
    ADM = 5
    UNITS = 6
    REFLECTOR = 7
    SYSTEM_SETTINGS = 8
    TEMPERATURE_RANGE = 9
    CAMERA = 10
    COORDINATES = 12
    BOX_REGION = 13
    SPHERE_REGION = 14
    ORIENTATION = 15
    TRANSFORMATION = 16
    MODE = 17
    STATIONARY = 18
    CONTINUOUS_TIME = 19
    CONTINUOUS_DISTANCE = 20
    GRID = 21
    CIRCLE_CENTRE = 22
    SPHERE_CENTRE = 23
    STATISTICS = 24
    NOT_READY = 25
    BUSY = 26
    READY = 27
    COUNT_REACHED = 28
    TRIGGER_SOURCE = 29
    TRIGGER = 41
    INITIALISATION = 151
