"""The tracker: readings of its reflector, dead path, air values of the correction, and lock."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from errormotion.instruments.simulators.laser_tracker.leica_emscon.measures import Triple
from errormotion.instruments.simulators.virtual_world.tracker_scene import TrackerScene, cartesian, refraction_index
from errormotion.instruments.transports import Address

if TYPE_CHECKING:
    from errormotion.instruments.simulators.virtual_world.world import VirtualWorld

NEST = (0.0, math.pi / 2, 0.3)
"""Direction (rad) and distance (m) of the position at the tracker for a reflector."""
STATION_SIGMA = 5e-3
"""Standard deviation of the position of the tracker at a station, m."""
NO_METEO, METEO_READ, METEO_REFRACTION = 0, 1, 2


class Tracker:
    """A tracker that follows the reflector at the machine's tool.

    Parameters of the address: those of `TrackerScene`; ``noise`` (m, of one distance), ``angle_noise`` (rad),
    ``dead_path`` (m; default: random, up to 10 mm whenever an interferometer locks on to its reflector, up to 0.1 mm
    once for absolute distances).

    Parameters
    ----------
    world, address, rng
        As of `TrackerScene`.
    absolute : bool
        Whether it measures distances absolutely, as the AT4xx do.
    obstructed : callable
        Whether the n-th use of the beam is broken.
    """

    def __init__(
        self,
        world: VirtualWorld,
        address: Address,
        rng: np.random.Generator,
        *,
        absolute: bool,
        obstructed: Callable[[int], bool],
    ) -> None:
        self.scene = TrackerScene(world, address)
        self.absolute = absolute
        self.noise = address.number("noise", 0.5e-6)
        self.angle_noise = address.number("angle_noise", 3e-6)
        self._given_dead_path = address.number("dead_path", math.nan)
        self._world, self._rng, self._obstructed = world, rng, obstructed
        self._uses = 0
        self.broken = False
        self.nested = False  # the reflector is in the nest at the tracker
        self.pointing = NEST  # direction of the beam without a reflector
        self.meteo = NO_METEO
        self._set_air = (20.0, 101_325.0, 50.0)
        self._index = refraction_index(*self._set_air)
        self.dead_path = self.new_dead_path()

    def new_dead_path(self) -> float:
        """Return a dead path, m: that of the address, or a random one."""
        drawn = float(self._rng.uniform(-1.0, 1.0)) * (1e-4 if self.absolute else 1e-2)
        return drawn if math.isnan(self._given_dead_path) else self._given_dead_path

    def carry_to(self, position: Sequence[float]) -> None:
        """Set up the tracker near a position in machine coordinates, m; distances get a new start value."""
        self.scene.station = np.array(position, dtype=float) + STATION_SIGMA * self._rng.normal(size=3)
        self.broken = self.nested = False
        self.dead_path = self.new_dead_path()

    # ------------------------------------------------------------------ air

    def air(self, when: float | None = None) -> tuple[float, float, float]:
        """Return temperature (degC), pressure (Pa) and humidity (%) that the server uses."""
        return self._set_air if self.meteo == NO_METEO else self.scene.air(when)

    def set_air(self, temperature: float, pressure: float, humidity: float) -> None:
        """Set the values of a client, and the refraction index that follows from them."""
        self._set_air = (temperature, pressure, humidity)
        self._index = refraction_index(*self._set_air)

    def index(self, when: float | None = None) -> float:
        """Return the refraction index with which the server corrects distances."""
        if self.meteo == METEO_REFRACTION:
            self._index = refraction_index(*self.scene.air(when))
        return self._index

    def set_index(self, index: float) -> None:
        """Set the refraction index of a client."""
        self._index = index

    # ------------------------------------------------------------------ beam

    def use_beam(self) -> bool:
        """Count one use of the beam; return whether that breaks it."""
        broken = self._obstructed(self._uses)
        self._uses += 1
        if broken and not self.broken:
            self.broken = True
            return True
        return False

    def obstructed(self) -> bool:
        """Whether the beam is blocked now."""
        return self._obstructed(self._uses)

    def can_lock(self) -> bool:
        """Whether a broken beam can lock on to the reflector again."""
        return self.broken and not self.obstructed()

    def lock(self) -> None:
        """Lock on to the reflector; an interferometer then starts from a new distance."""
        self.broken = False
        if not self.absolute:
            self.dead_path = self.new_dead_path()

    def near(self, spherical: Triple, radius: float) -> bool:
        """Whether the reflector is within a radius (m) of a position; it is removed from the nest for that."""
        self.nested = False
        wanted = cartesian(*spherical)
        actual = cartesian(*self.scene.seen(np.array([self._world.time]))[0])
        across = wanted - actual * (wanted @ actual) / (actual @ actual)
        return float(np.linalg.norm(across)) <= radius and float(wanted @ actual) > 0

    def seen(self, times: np.ndarray[Any, Any] | None = None) -> np.ndarray[Any, Any]:
        """Return readings of azimuth, zenith angle and distance, (n, 3), rad and m."""
        times = np.array([self._world.time]) if times is None else times
        true = np.tile(NEST, (len(times), 1)) if self.nested else self.scene.seen(times)
        noise = self._rng.normal(size=true.shape) * (self.angle_noise, self.angle_noise, self.noise)
        index = refraction_index(*self.scene.air(float(times[0])))
        if self.meteo == METEO_REFRACTION:
            self._index = index
        true[:, 2] *= index / self._index
        true[:, 2] += self.dead_path
        return np.asarray(true + noise)

    def now(self) -> Triple:
        """Return one reading."""
        azimuth, zenith, distance = self.seen()[0]
        return float(azimuth), float(zenith), float(distance)
