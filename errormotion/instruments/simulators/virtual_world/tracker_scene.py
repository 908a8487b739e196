"""The scene of a tracker beside a virtual machine: a reflector at the tool, measured through air.

The reflector is at the commanded position plus the machine's true volumetric error there, plus further errors that the
tracker's address states. All positions are in machine coordinates; the tracker is at ``station`` and is rotated about z
by ``heading``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.transports import Address

if TYPE_CHECKING:
    from errormotion.instruments.simulators.virtual_world.world import VirtualWorld

Array = np.ndarray[Any, Any]

STATION = "-1.2,-0.9,0.3"
WAVELENGTH = 0.632991  # um, in vacuum
MAGNUS = (611.2, 17.62, 243.12)  # Pa, 1, degC


def refraction_index(temperature: float, pressure: float, humidity: float) -> float:
    """Return the refraction index of air for a helium-neon laser: Birch and Downs, Metrologia 31 (1994) 315.

    Parameters
    ----------
    temperature, pressure, humidity : float
        degC, Pa, %; agrees with Ciddor's formula to about 1e-8 in a workshop.
    """
    wave = WAVELENGTH**-2
    standard = 1e-8 * (8342.54 + 2406147.0 / (130.0 - wave) + 15998.0 / (38.9 - wave))
    density = pressure * (1.0 + 1e-8 * (0.601 - 0.00972 * temperature) * pressure)
    dry = standard * density / (96095.43 * (1.0 + 0.003661 * temperature))
    vapour = humidity / 100.0 * MAGNUS[0] * np.exp(MAGNUS[1] * temperature / (MAGNUS[2] + temperature))
    return float(1.0 + dry - vapour * (3.7345 - 0.0401 * wave) * 1e-10)


def numbers(address: Address, name: str, default: str) -> tuple[float, ...]:
    """Return a parameter of several numbers, separated by commas."""
    text = address.params.get(name, default)
    try:
        return tuple(float(word) for word in text.split(","))
    except ValueError:
        raise InstrumentError(
            f"'{name}' in '{address.url}': expected numbers separated by commas; found '{text}'",
            code="simulator.setting",
        ) from None


class TrackerScene:
    """A reflector at the tool of a virtual machine, measured by a tracker beside it.

    Parameters
    ----------
    world : VirtualWorld
    address : Address
        ``station`` (m, m, m), ``heading`` (rad), ``lever`` (m, m, m: from the tool to the reflector), ``thermal`` (1:
        with the thermal errors of the machine), ``repeatability`` (m, one sigma per direction, drawn at each commanded
        position), ``air_temperature`` (degC; default: the machine's surroundings), ``air_pressure`` (Pa),
        ``air_humidity`` (%).

    Notes
    -----
    The error of repeatability is a function of the seed, the position and the instant of the arrival: it is the same
    for all instruments of a machine, and in a test that is continued in another process.
    """

    def __init__(self, world: VirtualWorld, address: Address) -> None:
        self.world = world
        self.station = np.array(numbers(address, "station", STATION))
        self.lever = np.array(numbers(address, "lever", "0,0,0"))
        if self.station.shape != (3,) or self.lever.shape != (3,):
            raise InstrumentError(
                f"'station' and 'lever' in '{address.url}': expected three numbers each, x,y,z in m",
                code="simulator.setting",
            )
        heading = address.number("heading", 0.0)
        c, s = np.cos(heading), np.sin(heading)
        self._turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])  # from the tracker's frame to the machine's
        self._thermal = bool(address.number("thermal", 0))
        self._repeatability = address.number("repeatability", 0.0)
        self._seed = abs(int(address.number("seed", 0)))
        self._arrival: tuple[Array, Array] | None = None
        self._last: tuple[Array, Array] | None = None
        self._air = tuple(
            address.number(f"air_{name}", default)
            for name, default in (("temperature", np.nan), ("pressure", 100_800.0), ("humidity", 43.0))
        )

    def air(self, when: float | None = None) -> tuple[float, float, float]:
        """Return temperature, pressure and humidity at a time of the world's clock, or now: degC, Pa, %."""
        temperature, pressure, humidity = self._air
        if np.isnan(temperature):
            sensors = self.world.machine.temperature_sensors
            times = np.array([self.world.time if when is None else when])
            temperature = float(self.world.machine.temperatures(times)[0, sensors.index("ambient")])
        return temperature, pressure, humidity

    def places(self, times: Array) -> Array:
        """Return true positions of the reflector, m, (n, 3), at times (n,) of the world's clock, s."""
        machine = self.world.machine
        commanded = np.atleast_2d(self.world.path.place(times) if self.world.motion is None else self.world.position())
        twist = self._geometric(commanded)
        if self._thermal:
            twist = twist + machine.thermal_twist(commanded, times)
        moved = commanded + self.lever + twist[:, :3] + np.cross(twist[:, 3:], self.lever)
        return np.broadcast_to(moved + self._arrived(commanded[-1]), (len(times), 3))

    def _geometric(self, commanded: Array) -> Array:
        """Return the geometric error twists of the machine; the last ones are kept, for a machine at rest."""
        if self._last is None or not np.array_equal(self._last[0], commanded):
            self._last = (commanded.copy(), self.world.machine.geometry.twist(commanded))
        return self._last[1]

    def _arrived(self, place: Array) -> Array:
        """Return the error of repeatability at the position at which the machine has arrived, m."""
        if self._repeatability == 0:
            return np.zeros(3)
        arrived = np.array([self.world.path.end, *place]) + 0.0  # no -0
        if self._arrival is None or not np.array_equal(self._arrival[0], arrived):
            rng = np.random.default_rng([self._seed, *map(int, arrived.view(np.uint64))])
            self._arrival = (arrived, self._repeatability * rng.normal(size=3))
        return self._arrival[1]

    def seen(self, times: Array) -> Array:
        """Return azimuth and zenith angle (rad) and distance (m) of the reflector, (n, 3)."""
        return spherical((self.places(times) - self.station) @ self._turn)


def spherical(places: Array) -> Array:
    """Return azimuth, zenith angle (rad) and distance (m) of positions (n, 3), m."""
    x, y, z = places.T
    return np.stack([np.arctan2(y, x), np.arctan2(np.hypot(x, y), z), np.linalg.norm(places, axis=1)], axis=1)


def cartesian(azimuth: float, zenith: float, distance: float) -> Array:
    """Return the position of a direction (rad) and distance (m)."""
    across = distance * np.sin(zenith)
    return np.array([across * np.cos(azimuth), across * np.sin(azimuth), distance * np.cos(zenith)])
