"""Return codes of GeoCOM: Reference Manual TPS1200/TS30/TM30 1.50, sections 3.7, 7, 17, and its table of codes."""

from __future__ import annotations

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
