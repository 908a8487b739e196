"""Calls for settings, pointing and identity; the measuring calls are in `measuring`.

A method has the name of its call. It returns the values of the reply, or raises `RefusedError`.
"""

# ruff: noqa: D102 -- a getter or setter without further rules is described by its name, which is the manual's

from __future__ import annotations

import datetime
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from errormotion.instruments.simulators.laser_tracker.leica_geocom.codes import Code, RefusedError
from errormotion.instruments.simulators.laser_tracker.leica_geocom.grammar import Byte, Value
from errormotion.instruments.simulators.laser_tracker.leica_geocom.measuring import Measuring
from errormotion.instruments.simulators.laser_tracker.leica_geocom.telescope import FIELD, Telescope

if TYPE_CHECKING:
    from errormotion.instruments.simulators.virtual_world.world import VirtualWorld

Values = tuple[Value | Byte, ...]

EPOCH = datetime.datetime(2026, 1, 5, 8, 0, 0)
"""Date and time of the station when the world's clock is 0."""
HEATING = 6.0
"""Temperature in the station above that of the air, K."""
LOCKED_OUT, LOCKED_IN = 0, 1
PRISMS: dict[int, tuple[str, float, int]] = {
    0: ("Leica Circ Prism", 0.0, 1),
    1: ("Leica Mini Prism", 0.0175, 1),
    2: ("Leica Tape", 0.0344, 2),
    3: ("Leica 360 Prism", 0.0231, 1),
    4: ("User 1", 0.0, 1),
    5: ("User 2", 0.0, 1),
    6: ("User 3", 0.0, 1),
    7: ("Leica 360 Mini", 0.030, 1),
    8: ("Leica Mini 0", 0.0, 1),
    12: ("MPR122", 0.0281, 1),
}
"""Name (assumed), additive constant, m, and type of reflector (1 prism, 2 tape) of each kind of prism."""
REFLECTOR, REFLECTORLESS_PROGRAMS = 0, (3, 6, 9)
MEASURING_PROGRAMS = 12


@dataclass(frozen=True)
class Model:
    """Properties of a model: name, accuracy class, components (bits), class without reflector."""

    name: str
    accuracy: int
    parts: int
    reflectorless: int


MODELS = {
    "TS30": Model("TS30 0.5", 300, 0x0E3C, 4),
    "TCRP1201": Model("TCRP1201+", 203, 0x0E3C, 4),
    "TM30": Model("TM30 1.0", 301, 0x0E2C, 4),
}
SERIAL_NUMBER = 364123
FIRMWARE = (6, 50, 0)
GEOCOM = (1, 50, 0)


def check(valid: bool) -> None:
    """Raise `RefusedError` if a parameter is invalid."""
    if not valid:
        raise RefusedError(Code.IVPARAM)


@dataclass
class Settings:
    """Settings that do not affect measurements."""

    decimals: int = 15
    delay: int = 0
    binary: int = 0
    laser: int = 0
    guide_light: int = 0
    fine_adjust: int = 0
    program: int = 0
    target: int = REFLECTOR
    prism: int = 0
    tolerance: tuple[float, float] = (8.7e-6, 8.7e-6)
    timeout: tuple[float, float] = (10.0, 10.0)
    controller: int | None = None
    recognition: bool = True
    lock: bool = True
    powered: bool = True
    asleep: bool = False


class Commands(Measuring):
    """The calls of one station.

    Parameters
    ----------
    world : VirtualWorld
    telescope : Telescope
    model : Model
    """

    def __init__(self, world: VirtualWorld, telescope: Telescope, model: Model) -> None:
        super().__init__(world, telescope)
        self.model = model
        self.settings = Settings(lock=telescope.locked)

    def do(self, name: str, values: tuple[Value, ...]) -> Values:
        """Execute a call; return the values of its reply.

        Raises
        ------
        RefusedError
        """
        found = getattr(self, name)(*values)
        return found if isinstance(found, tuple) else () if found is None else (found,)

    # ------------------------------------------------------------------ COM

    def COM_NullProc(self) -> None:
        """Do nothing."""

    def COM_Local(self) -> None:
        """End the online mode; the next request starts it again (assumed)."""

    def COM_GetDoublePrecision(self) -> int:
        return self.settings.decimals

    def COM_SetDoublePrecision(self, digits: int) -> None:
        check(0 <= digits <= 15)
        self.settings.decimals = digits

    def COM_SetSendDelay(self, delay: int) -> None:
        check(0 <= delay <= 50)
        self.settings.delay = delay

    def COM_GetSWVersion(self) -> Values:
        return GEOCOM

    def COM_SwitchOnTPS(self, mode: int) -> None:
        check(mode in (0, 1))
        self.settings.powered, self.settings.asleep = True, False

    def COM_SwitchOffTPS(self, mode: int) -> None:
        check(mode in (0, 1))
        self.settings.powered, self.settings.asleep = mode != 0, mode == 1

    def COM_GetBinaryAvailable(self) -> int:
        return self.settings.binary

    def COM_SetBinaryAvailable(self, available: int) -> None:
        """Refuse to switch the binary protocol on: the simulated station has none."""
        check(available in (0, 1))
        if available:
            raise RefusedError(Code.COM_NO_BINARY)

    # ------------------------------------------------------------------ CSV, BMM

    def CSV_GetInstrumentNo(self) -> int:
        return SERIAL_NUMBER

    def CSV_GetInstrumentName(self) -> str:
        return self.model.name

    def CSV_GetSWVersion(self) -> Values:
        return FIRMWARE

    def CSV_GetDateTime(self) -> Values:
        """Return the year, and month, day, hour, minute and second as bytes."""
        now = EPOCH + datetime.timedelta(seconds=self.world.time)
        return (now.year, *map(Byte, (now.month, now.day, now.hour, now.minute, now.second)))

    def CSV_GetVBat(self) -> float:
        return 12.5

    def CSV_GetIntTemp(self) -> float:
        return float(round(self.telescope.scene.air()[0] + HEATING))

    def CSV_GetDeviceConfig(self) -> Values:
        return self.model.accuracy, self.model.parts

    def CSV_CheckPower(self) -> Values:
        """Return the charge, %, the source in use and the suggested one."""
        return 87, 2, 2

    def CSV_GetReflectorlessClass(self) -> int:
        return self.model.reflectorless

    def BMM_BeepNormal(self) -> None:
        pass

    def BMM_BeepAlarm(self) -> None:
        pass

    # ------------------------------------------------------------------ EDM, BAP

    def EDM_Laserpointer(self, on: int) -> None:
        check(on in (0, 1))
        self.settings.laser = on

    def EDM_GetEglIntensity(self) -> int:
        return self.settings.guide_light

    def EDM_SetEglIntensity(self, intensity: int) -> None:
        check(0 <= intensity <= 3)
        self.settings.guide_light = intensity

    def BAP_GetPrismType(self) -> int:
        return self.settings.prism

    def BAP_SetPrismType(self, kind: int) -> None:
        """Set a kind of prism, and its constant."""
        check(kind in PRISMS)
        self.settings.prism, self.prism_constant = kind, PRISMS[kind][1]

    def BAP_GetPrismDef(self, kind: int) -> Values:
        check(kind in PRISMS)
        return PRISMS[kind]

    def BAP_GetTargetType(self) -> int:
        return self.settings.target

    def BAP_SetTargetType(self, kind: int) -> None:
        check(kind in (0, 1))
        self.settings.target = kind

    def BAP_GetMeasPrg(self) -> int:
        return self.settings.program

    def BAP_SetMeasPrg(self, program: int) -> None:
        check(0 <= program < MEASURING_PROGRAMS)
        self.settings.program = program
        self.settings.target = int(program in REFLECTORLESS_PROGRAMS)

    def BAP_MeasDistanceAngle(self, mode: int) -> Values:
        """Measure as the mode states; return directions, distance and the mode."""
        check(0 <= mode <= 6)
        if self.settings.recognition and mode in (2, 3, 4):
            self.telescope.aim()
        return (*self.measure_at_once(mode), mode)

    # ------------------------------------------------------------------ AUT, AUS, MOT

    def AUT_GetATRStatus(self) -> int:
        return int(self.settings.recognition)

    def AUT_SetATRStatus(self, on: int) -> None:
        """Switch the target recognition; without it there is no lock."""
        check(on in (0, 1))
        self.settings.recognition = bool(on)
        if not on:
            self._unlock()

    def AUT_GetLockStatus(self) -> int:
        return int(self.settings.lock)

    def AUT_SetLockStatus(self, on: int) -> None:
        """Switch the lock mode, and with it the target recognition on; off ends a lock."""
        check(on in (0, 1))
        if on:
            self.settings.lock = self.settings.recognition = True
        else:
            self._unlock()

    AUS_GetUserAtrState, AUS_SetUserAtrState = AUT_GetATRStatus, AUT_SetATRStatus
    AUS_GetUserLockState, AUS_SetUserLockState = AUT_GetLockStatus, AUT_SetLockStatus

    def _unlock(self) -> None:
        self.telescope.direction()  # keeps the last direction of the reflector
        self.settings.lock = self.telescope.locked = False

    def AUT_LockIn(self) -> None:
        """Follow the reflector in the field of view; the lock mode must be on."""
        if not self.settings.lock:
            raise RefusedError(Code.AUT_NOT_ENABLED)
        self.telescope.aim()
        self.telescope.locked = True

    def MOT_ReadLockStatus(self) -> int:
        return LOCKED_IN if self.telescope.locked else LOCKED_OUT

    def AUT_ReadTol(self) -> Values:
        return self.settings.tolerance

    def AUT_SetTol(self, horizontal: float, vertical: float) -> None:
        check(horizontal > 0 and vertical > 0)
        self.settings.tolerance = horizontal, vertical

    def AUT_ReadTimeout(self) -> Values:
        return self.settings.timeout

    def AUT_SetTimeout(self, horizontal: float, vertical: float) -> None:
        """Set the time limits for turning, s: 7 to 60."""
        check(7.0 <= horizontal <= 60.0 and 7.0 <= vertical <= 60.0)
        self.settings.timeout = horizontal, vertical

    def AUT_GetFineAdjustMode(self) -> int:
        return self.settings.fine_adjust

    def AUT_SetFineAdjustMode(self, mode: int) -> None:
        check(mode in (0, 1))
        self.settings.fine_adjust = mode

    def AUT_MakePositioning(self, horizontal: float, zenith: float, position: int, target: int, dummy: int) -> None:
        """Turn to a direction, and with ``target`` aim at the reflector near it."""
        check(position in (0, 1) and target in (0, 1) and dummy == 0)
        check(math.isfinite(horizontal) and 0.0 <= zenith <= 2.0 * math.pi)
        if target and not self.settings.recognition:
            raise RefusedError(Code.AUT_NOT_ENABLED)
        self.telescope.turn_to(horizontal, zenith)
        self._found(target)

    def AUT_ChangeFace(self, position: int, target: int, dummy: int) -> None:
        """Turn to the other face, and with ``target`` aim at the reflector there."""
        check(position in (0, 1) and target in (0, 1) and dummy == 0)
        if target and not self.settings.recognition:
            raise RefusedError(Code.AUT_NOT_ENABLED)
        self.telescope.change_face()
        self._found(target)

    def _found(self, target: int) -> None:
        if target:
            self.telescope.aim()
            self.telescope.locked = self.settings.lock

    def AUT_FineAdjust(self, horizontal: float, vertical: float, dummy: int) -> None:
        """Aim at the reflector within a window, rad, that is not less than the field of view."""
        check(horizontal >= 0 and vertical >= 0 and dummy == 0)
        if not self.settings.recognition:
            raise RefusedError(Code.AUT_NOT_ENABLED)
        self.telescope.aim(max(FIELD, horizontal / 2), max(FIELD, vertical / 2))

    AUT_Search = AUT_FineAdjust  # a search ends with the reflector in the field; here at its centre

    def MOT_StartController(self, mode: int) -> None:
        """Start the motors; positioning (0), with velocities (1) or free (others)."""
        check(mode in (0, 1, 2, 4))
        self.settings.controller = mode

    def MOT_StopController(self, mode: int) -> None:
        """Stop the motors, normally (0) or at once (1)."""
        check(mode in (0, 1))
        self.settings.controller = None

    def MOT_SetVelocity(self, horizontal: float, vertical: float) -> None:
        """Refuse velocities: the simulated station only turns to directions; the limit is that of the manual, rad/s."""
        check(abs(horizontal) <= math.pi and abs(vertical) <= math.pi)
        raise RefusedError(Code.MOT_NOT_OCONST if self.settings.controller != 1 else Code.NOT_IMPL)
