"""Calls for pointing and identity; the measuring calls are in `measuring`.

The station has the calls that the driver and GeoComPy use; it refuses others as unknown.

A method has the name of its call. It returns the values of the reply, or raises `RefusedError`.
"""

# ruff: noqa: D102 -- a getter or setter without further rules is described by its name, which is the manual's

from __future__ import annotations

import datetime
import math
from typing import TYPE_CHECKING

from errormotion.instruments.simulators.laser_tracker.leica_geocom.grammar import Byte, Code, RefusedError, Value
from errormotion.instruments.simulators.laser_tracker.leica_geocom.measuring import Measuring
from errormotion.instruments.simulators.laser_tracker.leica_geocom.telescope import FIELD, Telescope

if TYPE_CHECKING:
    from errormotion.instruments.simulators.virtual_world.world import VirtualWorld

Values = tuple[Value | Byte, ...]

EPOCH = datetime.datetime(2026, 1, 5, 8, 0, 0)
"""Date and time of the station when the world's clock is 0."""
HEATING = 6.0
"""Temperature in the station above that of the air, K."""
DECIMALS = 15
"""Digits after the decimal point in a reply."""


MODELS = {"TS30": "TS30 0.5", "TCRP1201": "TCRP1201+", "TM30": "TM30 1.0"}
"""Name of the instrument of each model."""
SERIAL_NUMBER = 364123
FIRMWARE = (6, 50, 0)
GEOCOM = (1, 50, 0)


def check(valid: bool) -> None:
    """Raise `RefusedError` if a parameter is invalid."""
    if not valid:
        raise RefusedError(Code.IVPARAM)


class Commands(Measuring):
    """The calls of one station.

    Parameters
    ----------
    world : VirtualWorld
    telescope : Telescope
    model : str
        Name of the instrument.
    """

    def __init__(self, world: VirtualWorld, telescope: Telescope, model: str) -> None:
        super().__init__(world, telescope)
        self.model = model
        self._locks = telescope.locked  # whether the station follows a reflector that it has found

    def do(self, name: str, values: tuple[Value, ...]) -> Values:
        """Execute a call; return the values of its reply.

        Raises
        ------
        RefusedError
        """
        result = getattr(self, name)(*values)
        return result if isinstance(result, tuple) else () if result is None else (result,)

    # ------------------------------------------------------------------ COM

    def COM_NullProc(self) -> None:
        """Do nothing."""

    def COM_GetDoublePrecision(self) -> int:
        return DECIMALS

    def COM_GetSWVersion(self) -> Values:
        return GEOCOM

    # ------------------------------------------------------------------ CSV

    def CSV_GetInstrumentNo(self) -> int:
        return SERIAL_NUMBER

    def CSV_GetInstrumentName(self) -> str:
        return self.model

    def CSV_GetSWVersion(self) -> Values:
        return FIRMWARE

    def CSV_GetDateTime(self) -> Values:
        """Return the year, and month, day, hour, minute and second as bytes."""
        now = EPOCH + datetime.timedelta(seconds=self.world.time)
        return (now.year, *map(Byte, (now.month, now.day, now.hour, now.minute, now.second)))

    def CSV_GetIntTemp(self) -> float:
        return float(round(self.telescope.scene.air()[0] + HEATING))

    # ------------------------------------------------------------------ AUT

    def AUT_MakePositioning(self, horizontal: float, zenith: float, position: int, target: int, dummy: int) -> None:
        """Turn to a direction, and with ``target`` aim at the reflector near it."""
        check(position in (0, 1) and target in (0, 1) and dummy == 0)
        check(math.isfinite(horizontal) and 0.0 <= zenith <= 2.0 * math.pi)
        self.telescope.turn_to(horizontal, zenith)
        self._found(target)

    def AUT_ChangeFace(self, position: int, target: int, dummy: int) -> None:
        """Turn to the other face, and with ``target`` aim at the reflector there."""
        check(position in (0, 1) and target in (0, 1) and dummy == 0)
        self.telescope.change_face()
        self._found(target)

    def _found(self, target: int) -> None:
        if target:
            self.telescope.aim()
            self.telescope.locked = self._locks

    def AUT_FineAdjust(self, horizontal: float, vertical: float, dummy: int) -> None:
        """Aim at the reflector within a window, rad, that is not less than the field of view."""
        check(horizontal >= 0 and vertical >= 0 and dummy == 0)
        self.telescope.aim(max(FIELD, horizontal / 2), max(FIELD, vertical / 2))
