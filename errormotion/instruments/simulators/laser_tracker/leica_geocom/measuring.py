"""The calls of theodolite measurement and calculation (TMC): angles, distances, coordinates and their corrections.

Reference Manual TPS1200/TS30/TM30 1.50, section 17. A distance is started by one call and read by another, which waits
for it within a time limit; the world's clock advances by the waiting time, unless a stream controls it.
"""

# ruff: noqa: D102 -- a getter or setter without further rules is described by its name, which is the manual's

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from errormotion.instruments.simulators.laser_tracker.leica_geocom.grammar import Code, RefusedError
from errormotion.instruments.simulators.laser_tracker.leica_geocom.telescope import Telescope, atmospheric_ppm

if TYPE_CHECKING:
    from errormotion.instruments.simulators.virtual_world.world import VirtualWorld

STOP, DEFAULT, TRACK, CLEAR, SIGNAL, MEASURE, RAPID, RED, FREQUENCY = 0, 1, 2, 3, 4, 6, 8, 10, 11
PROGRAMS = (STOP, DEFAULT, TRACK, CLEAR, SIGNAL, MEASURE, RAPID, RED, FREQUENCY)
INCLINATIONS = 3
EDM_MODES = range(1, 15)
STANDARD, CONTINUOUS = 2, (6, 7, 8, 9)
DURATIONS = {3: 0.8, 6: 0.3, 7: 0.3, 8: 0.3, 9: 0.15, 13: 7.0}
"""Duration of one distance in some EDM modes, s; in the others 2.4 (technical data of the TPS1200)."""
DURATION = 2.4
EXCHANGE = 0.05
"""Duration of a call without waiting, s."""
MAX_WAIT = 60_000
"""Longest waiting time of a call, ms, whatever is requested (assumed)."""
ACCURACY = 2.4e-6
"""Stated standard deviation of angles and inclinations, rad."""
WAVELENGTH = 6.58e-7

Numbers = tuple[float, ...]


class Measuring:
    """The measuring calls.

    Parameters
    ----------
    world : VirtualWorld
    telescope : Telescope

    Attributes
    ----------
    warning : int
        Return code of the last call that was executed: 0, or a missing part of its values.
    """

    def __init__(self, world: VirtualWorld, telescope: Telescope) -> None:
        self.world, self.telescope = world, telescope
        self.warning = 0
        self._air = (WAVELENGTH, 1013.25, 12.0, 8.55)
        self._edm = STANDARD
        self._ready: float | None = None  # time at which the distance is complete, s; None: none was started
        self._signal = False
        self._distance: float | None = None
        self._continuous = False

    # ------------------------------------------------------------------ distances

    def TMC_DoMeasure(self, program: int, inclination: int) -> None:
        """Start, stop or clear a distance."""
        _check(program in PROGRAMS and 0 <= inclination < INCLINATIONS)
        self._signal = program == SIGNAL
        if program != STOP:
            self._distance = None
        self._ready = None
        self._continuous = program in (TRACK, RAPID, RED) or (program == DEFAULT and self._edm in CONTINUOUS)
        if program in (DEFAULT, TRACK, MEASURE, RAPID, RED):
            duration = 0.3 if program in (TRACK, RAPID, RED) else DURATIONS.get(self._edm, DURATION)
            self._ready = self.world.time + duration

    def _wait(self, milliseconds: int) -> float | None:
        """Return the distance, or None if it is not complete within the time limit.

        Raises
        ------
        RefusedError
            No signal.
        """
        if self._distance is not None and not self._continuous:
            return self._distance
        if self._ready is None:
            return self._distance
        limit = max(min(milliseconds, MAX_WAIT) / 1000.0, EXCHANGE)
        missing = max(0.0, self._ready - self.world.time)
        self._pass(min(missing, limit))
        if missing > limit and not self.world.streaming:
            return None
        if not self._continuous:
            self._ready = None
        self._distance = None
        self._distance = self.telescope.distance(self._ppm())
        return self._distance

    def _pass(self, seconds: float) -> None:
        if seconds > 0 and not self.world.streaming:
            self.world.elapse(seconds)

    def _ppm(self) -> float:
        return atmospheric_ppm(*self._air[1:])

    def _measured(self, wait: int, inclination: int) -> tuple[float, float, float]:
        """Return directions and distance, 0 if missing, and set the warning."""
        _check(wait >= 0 and 0 <= inclination < INCLINATIONS)
        if self._signal:
            raise RefusedError(Code.TMC_BUSY)
        failed = False
        try:
            distance = self._wait(wait)
        except RefusedError:
            failed, distance = True, None
        angles = self.telescope.direction()
        if failed:
            self.warning = Code.TMC_DIST_ERROR
        elif distance is None:
            self.warning = Code.TMC_ANGLE_OK
        return (*angles, distance or 0.0)

    def TMC_GetSimpleMea(self, wait: int, inclination: int) -> Numbers:
        """Return directions, rad, and the distance, m."""
        return self._measured(wait, inclination)

    # ------------------------------------------------------------------ angles

    def TMC_GetAngle1(self, inclination: int) -> tuple[float | int, ...]:
        """Return directions, accuracy and time (ms), inclinations, accuracy and time, and the face."""
        self._incline(inclination)
        time = self._clock()
        return (*self.telescope.direction(), ACCURACY, time, 0.0, 0.0, ACCURACY, time, self.telescope.face)

    def _incline(self, inclination: int) -> None:
        _check(0 <= inclination < INCLINATIONS)
        if self._signal:
            raise RefusedError(Code.TMC_BUSY)

    def _clock(self) -> int:
        return round(1000.0 * self.world.time) % 2**31

    def TMC_GetFace(self) -> int:
        return self.telescope.face

    # ------------------------------------------------------------------ coordinates

    def _coordinates(self, horizontal: float, zenith: float, distance: float) -> tuple[float, float, float]:
        across = distance * math.sin(zenith)
        return across * math.sin(horizontal), across * math.cos(horizontal), distance * math.cos(zenith)

    def TMC_GetCoordinate(self, wait: int, inclination: int) -> tuple[float | int, ...]:
        """Return coordinates and their time, ms, of the distance, and of the continuous angles."""
        measured = self._measured(wait, inclination)
        coordinates = self._coordinates(*measured) if measured[2] else (0.0, 0.0, 0.0)
        return (*coordinates, self._clock(), *coordinates, self._clock())

    # ------------------------------------------------------------------ corrections

    def TMC_SetEdmMode(self, mode: int) -> None:
        _check(mode in EDM_MODES)
        self._edm = mode

    def TMC_GetAtmCorr(self) -> Numbers:
        return self._air

    def TMC_SetAtmCorr(self, wavelength: float, pressure: float, dry: float, wet: float) -> None:
        """Set wavelength, m, pressure, mbar, and dry and wet temperature, degC; the limits are assumed."""
        _check(wavelength > 0 and 400.0 <= pressure <= 1200.0 and -60.0 <= wet <= 80.0 and -60.0 <= dry <= 80.0)
        self._air = wavelength, pressure, dry, wet

    def TMC_GetAtmPpm(self) -> float:
        return self._ppm()


def _check(valid: bool) -> None:
    if not valid:
        raise RefusedError(Code.IVPARAM)
