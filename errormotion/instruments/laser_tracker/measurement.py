"""What every laser tracker hands over: measurements of one reflector, the air they were made in, a broken beam."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from errormotion.errors import InstrumentError

NAN = math.nan


class BeamBrokenError(InstrumentError):
    """The beam has lost its reflector, and nothing brought it back."""


@dataclass(frozen=True)
class Environment:
    """The air along the beam: temperature in degC, pressure in Pa, relative humidity in %; NaN where unknown."""

    temperature: float = NAN
    pressure: float = NAN
    humidity: float = NAN


@dataclass(frozen=True)
class Reflector:
    """A reflector that a tracker knows: its number and name there, its kind, and its surface offset in m."""

    number: int
    name: str
    kind: str
    surface_offset: float


@dataclass(frozen=True)
class Measurement:
    """One reflector, seen from one tracker at one time.

    Attributes
    ----------
    distance : float
        From the tracker to the reflector, m, as the tracker tells it: corrected with its own ``refraction_index``.
        NaN where there is none.
    angles : (float, float)
        Azimuth, counterclockwise about the tracker's z, and zenith angle, rad.
    std : (float, float, float)
        Standard deviations of distance (m), azimuth and zenith angle (rad), as the tracker tells them.
    environment : Environment
        With which the tracker measured.
    refraction_index : float
        By which the tracker has divided the optical path. The optical path is ``distance * refraction_index``.
    valid : bool
        Whether there is a distance.
    reason : str
        Why there is none; empty where there is one.
    dead_path : int
        Measurements of one number share one dead path. It goes up whenever the distance was set anew.
    """

    distance: float = NAN
    angles: tuple[float, float] = (NAN, NAN)
    std: tuple[float, float, float] = (NAN, NAN, NAN)
    environment: Environment = field(default_factory=Environment)
    refraction_index: float = NAN
    valid: bool = False
    reason: str = ""
    dead_path: int = 0

    @property
    def position(self) -> tuple[float, float, float]:
        """Place of the reflector in the tracker's frame, m; only as good as the angles are."""
        azimuth, zenith = self.angles
        across = self.distance * math.sin(zenith)
        return across * math.cos(azimuth), across * math.sin(azimuth), self.distance * math.cos(zenith)


def polar(place: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return azimuth, zenith angle (rad) and distance (m) of a place in the tracker's frame.

    Raises
    ------
    InstrumentError
        Not three finite numbers, or the tracker itself.
    """
    values = tuple(float(x) for x in place)
    if len(values) != 3 or not all(map(math.isfinite, values)) or not any(values):
        raise InstrumentError(f"Expected a place x, y, z in m, seen from the tracker; found {place!r}")
    x, y, z = values
    return math.atan2(y, x), math.atan2(math.hypot(x, y), z), math.hypot(x, y, z)
