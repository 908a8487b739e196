"""The telescope: direction, target recognition, and distance meter."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from errormotion.instruments.simulators.laser_tracker.leica_geocom.grammar import Code, RefusedError
from errormotion.instruments.simulators.virtual_world.tracker_scene import TrackerScene
from errormotion.instruments.transports import Address

if TYPE_CHECKING:
    from errormotion.instruments.simulators.virtual_world.world import VirtualWorld

STATION_SIGMA = 5e-3
"""Standard deviation of the position of the station at a set-up, m."""
BEAM = 1.5e-3
"""Half angle within which the distance meter has a signal from the reflector, rad (assumed)."""
FIELD = math.radians(1.5) / 2
"""Half of the field of view of the target recognition, rad (1.5 degrees: brochure of the TS30)."""
ZERO_CELSIUS = 273.15


def atmospheric_ppm(pressure: float, dry: float, wet: float) -> float:
    """Return the atmospheric correction, 1e-6.

    Parameters
    ----------
    pressure, dry, wet : float
        mbar; dry and wet temperature, degC.

    Notes
    -----
    User manual of the TPS1200, "atmospheric correction" (658 nm; 0 at 12 degC, 1013.25 mbar and 60 %); humidity from
    the wet temperature by Sprung's formula.
    """
    vapour = _saturation(wet) - 6.62e-4 * pressure * (dry - wet)
    humidity = min(100.0, max(0.0, 100.0 * vapour / _saturation(dry)))
    return _ppm(pressure, dry, humidity)


def _saturation(temperature: float) -> float:
    """Return the pressure of saturated vapour, mbar."""
    return 6.1078 * math.pow(10.0, 7.5 * temperature / (237.3 + temperature))


def _ppm(pressure: float, temperature: float, humidity: float) -> float:
    thinner = 1.0 + temperature / ZERO_CELSIUS
    exponent = 7.5 * temperature / (237.3 + temperature) + 0.7857
    return 286.34 - (0.29525 * pressure - 4.126e-4 * humidity * math.pow(10.0, exponent)) / thinner


class Telescope:
    """A motorized telescope with target recognition.

    Parameters of the address: those of `TrackerScene`; ``noise`` (m, of one distance), ``angle_noise`` (rad, of one
    direction), ``dead_path`` (m, error of every distance; 0), ``prism_constant`` (m, of the reflector; 0), ``locked``
    (1: at the start it follows the reflector; 0: it keeps the direction of the reflector at the start).

    Attributes
    ----------
    pointing : tuple
        Horizontal direction, clockwise, and zenith angle, rad, in the first face.
    face : int
        0 or 1.
    locked : bool
        Whether it follows the reflector.
    """

    def __init__(
        self,
        world: VirtualWorld,
        address: Address,
        rng: np.random.Generator,
        obstructed: Callable[[int], bool],
    ) -> None:
        self.scene = TrackerScene(world, address)
        self.noise = address.number("noise", 0.3e-3)
        self.angle_noise = address.number("angle_noise", 2.4e-6)
        self.dead_path = address.number("dead_path", 0.0)
        self.prism = address.number("prism_constant", 0.0)
        self._world, self._rng, self._obstructed = world, rng, obstructed
        self._uses = 0
        self.face = 0
        self.locked = bool(address.number("locked", 1))
        self.pointing = self._target()[:2]

    def carry_to(self, position: Sequence[float]) -> None:
        """Set up the station near a position in machine coordinates, m, and aim at the reflector."""
        self.scene.station = np.array(position, dtype=float) + STATION_SIGMA * self._rng.normal(size=3)
        self.pointing = self._target()[:2]

    def _target(self) -> tuple[float, float, float]:
        azimuth, zenith, distance = self.scene.seen(np.array([self._world.time]))[0]
        return -float(azimuth), float(zenith), float(distance)  # directions are clockwise

    def blocked(self) -> bool:
        """Count one use of the beam; return whether it is blocked, which ends the lock."""
        found = self._obstructed(self._uses)
        self._uses += 1
        if found:
            self.locked = False
        return found

    # ------------------------------------------------------------------ pointing

    def direction(self) -> tuple[float, float]:
        """Return the circle readings, rad, of the face in use."""
        if self.locked:
            self.pointing = self._target()[:2]
        horizontal, zenith = (self.pointing + self._rng.normal(size=2) * self.angle_noise).tolist()
        if self.face:
            horizontal, zenith = horizontal + math.pi, 2.0 * math.pi - zenith
        return horizontal % (2.0 * math.pi), zenith % (2.0 * math.pi)

    def turn_to(self, horizontal: float, zenith: float) -> None:
        """Turn to circle readings, rad; a lock ends."""
        self.locked = False
        zenith %= 2.0 * math.pi
        self.face = int(zenith > math.pi)
        if self.face:
            horizontal, zenith = horizontal - math.pi, 2.0 * math.pi - zenith
        self.pointing = (horizontal, zenith)

    def change_face(self) -> None:
        """Turn to the same direction in the other face; a lock ends."""
        self.direction()
        self.locked = False
        self.face = 1 - self.face

    def sees(self, horizontal: float, vertical: float) -> bool:
        """Whether the reflector is within half angles (rad) of the telescope's direction."""
        actual = self._target()
        across = (actual[0] - self.pointing[0] + math.pi) % (2.0 * math.pi) - math.pi
        return abs(across) * math.sin(actual[1]) <= horizontal and abs(actual[1] - self.pointing[1]) <= vertical

    def aim(self, horizontal: float = FIELD, vertical: float = FIELD) -> None:
        """Point at the reflector if it is within half angles, rad.

        Raises
        ------
        RefusedError
            There is no reflector.
        """
        if not self.locked and not self.sees(horizontal, vertical):
            raise RefusedError(Code.AUT_NO_TARGET)
        if self.blocked():
            raise RefusedError(Code.AUT_NO_TARGET)
        self.pointing = self._target()[:2]

    # ------------------------------------------------------------------ distance

    def distance(self, ppm: float) -> float:
        """Return one distance.

        Parameters
        ----------
        ppm : float
            Atmospheric correction that is set, 1e-6.

        Raises
        ------
        RefusedError
            No signal.
        """
        if self.blocked() or not (self.locked or self.sees(BEAM, BEAM)):
            raise RefusedError(Code.TMC_DIST_ERROR)
        temperature, pressure, humidity = self.scene.air(self._world.time)
        raw = self._target()[2] * (1.0 - 1e-6 * _ppm(pressure / 100.0, temperature, humidity))
        raw += self.dead_path - self.prism + self.noise * float(self._rng.normal())
        return raw * (1.0 + 1e-6 * ppm)
