"""Readings of instruments: profiles, height maps, tracker measurements, the geometry of a frame.

For `Samples`, `Touch`, `Contact` and `Identity` see `errormotion.plugins`. All values are in SI units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.plugins.contracts import Samples

NAN = math.nan


@dataclass(frozen=True, kw_only=True)
class Profiles(Samples):
    """A block of profiles. ``values`` (point, n) are heights in m, ``rate`` is profiles per second.

    ``dropped`` counts profiles, ``invalid`` counts points by reason.

    Attributes
    ----------
    x : ndarray, float64, (point,)
        Positions of the points on the line, m.
    trigger : ndarray, int64, (n,)
        Count of triggers by the device, including those of lost profiles.
    encoder : ndarray, float64, (n,)
        Count of encoder pulses by the device, corrected for overflow; NaN for a lost profile.
    intensity : ndarray, uint16, (n, point), or None
        Brightness of the points, 0 to 1023, if the device sends it; 0 for a lost profile.
    y : ndarray, float64, (n,), or None
        Positions of the profiles along the feed, m, if known.
    """

    x: Array
    trigger: NDArray[np.int64]
    encoder: Array
    intensity: NDArray[np.uint16] | None = None
    y: Array | None = None

    @property
    def heights(self) -> Array:
        """The same heights as rows, (n, point), contiguous."""
        return self.values.T


@dataclass(frozen=True)
class Scan:
    """A height map.

    Attributes
    ----------
    path : Path
        Its file.
    heights : ndarray, float64, (n, point)
        m; NaN without value.
    x : ndarray, float64, (point,)
        Positions of the points on the line, m.
    y : ndarray, float64, (n,)
        Positions of the profiles along the feed, m; increasing or decreasing.
    """

    path: Path
    heights: Array
    x: Array
    y: Array


@dataclass(frozen=True)
class Environment:
    """The air along a beam: temperature in degC, pressure in Pa, relative humidity in %; NaN if unknown."""

    temperature: float = NAN
    pressure: float = NAN
    humidity: float = NAN


@dataclass(frozen=True)
class Measurement:
    """One reflector, measured by one tracker at one time.

    Attributes
    ----------
    distance : float
        From the tracker to the reflector, m, as stated by the tracker: corrected with its ``refraction_index``. NaN
        without value.
    angles : (float, float)
        Azimuth, counterclockwise about the tracker's z, and zenith angle, rad.
    std : (float, float, float)
        Standard deviations of distance (m), azimuth and zenith angle (rad), as stated by the tracker.
    environment : Environment
        The air as measured by the tracker.
    refraction_index : float
        The optical path is ``distance * refraction_index``.
    valid : bool
        Whether the distance is known.
    reason : str
        Reason of a missing distance; empty if it is known.
    dead_path : int
        Number of the dead path, common to consecutive measurements; it increases when the distance is set again.
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
        """Position of the reflector in the tracker's frame, m, with the uncertainty of the angles."""
        azimuth, zenith = self.angles
        across = self.distance * math.sin(zenith)
        return across * math.cos(azimuth), across * math.sin(azimuth), self.distance * math.cos(zenith)


@dataclass(frozen=True)
class FrameGeometry:
    """Nominal geometry of a frame of distance sensors around a bar, in machine coordinates.

    A reading d of a channel puts a point of the bar's surface at origin + d direction.

    Attributes
    ----------
    channels : tuple of str
    nominal_origin : ndarray, (channel, 3)
        Position of reading 0 of each beam, m.
    nominal_direction : ndarray, (channel, 3)
        Unit vectors from the sensor to the bar.
    bar_radius : float
        m.
    levels : ndarray, (2,)
        z of L1 and L2, m.
    range : float
        Measuring range, m.
    noise : ndarray, (channel,)
        Standard deviation of a single sample, m.
    expansion : ndarray, (channel, 3)
        Displacement of the origins per kelvin of the frame, m/K, along the measured axis.
    reference_temperature : float
        Temperature for which the origins apply, degC.
    """

    channels: tuple[str, ...]
    nominal_origin: Array
    nominal_direction: Array
    bar_radius: float
    levels: Array
    range: float
    noise: Array
    expansion: Array
    reference_temperature: float

    def origins_at(self, temperature: float | Array) -> Array:
        """Return the origins with the frame at a temperature, m, (..., channel, 3).

        They compensate the effect of the expansion of the frame on the readings.
        """
        warming = np.asarray(temperature, dtype=float)[..., None, None] - self.reference_temperature
        return np.asarray(self.nominal_origin + warming * self.expansion)
