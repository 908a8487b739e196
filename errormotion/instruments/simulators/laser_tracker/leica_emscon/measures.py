"""Units and coordinate systems of an emScon client: conversion from SI and spherical coordinates, and back.

The numbers are those of the header ``Enum.h`` of the TPI 3.6 (ES_LengthUnit to ES_CoordinateSystemType).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

Triple = tuple[float, float, float]

LENGTHS = (1.0, 1e-3, 1e-6, 0.3048, 0.9144, 0.0254)
"""Metre, millimetre, micron, foot, yard, inch in m."""
ANGLES = (1.0, math.pi / 180.0, math.pi / 200.0)
"""Radian, degree, gon in rad."""
PRESSURES = (100.0, 100.0, 1000.0, 133.322387415, 6894.757293168, 249.08891, 3386.388640341)
"""mbar, hPa, kPa, mmHg, psi, inH2O (at 4 degC, assumed), inHg (at 0 degC) in Pa."""
SYSTEMS = 8
"""Coordinate systems: RHR, LHRX, LHRY, LHRZ, CCW, CCC, SCW, SCC."""
RHR, LHRX, LHRY, LHRZ, CCW, CCC, SCW, SCC = range(SYSTEMS)
_SIGNS = {RHR: (1, 1, 1), LHRX: (-1, 1, 1), LHRY: (1, -1, 1), LHRZ: (1, 1, -1)}


@dataclass(frozen=True)
class Units:
    """The units of one client, by their numbers: length, angle, temperature, pressure, humidity."""

    length: int = 0
    angle: int = 0
    temperature: int = 0
    pressure: int = 0
    humidity: int = 0

    @property
    def wrong(self) -> int:
        """Position of the first invalid number, from 1; 0 if all are valid."""
        counts = (len(LENGTHS), len(ANGLES), 2, len(PRESSURES), 1)
        for position, (field, count) in enumerate(zip(fields(self), counts, strict=True), 1):
            if not 0 <= getattr(self, field.name) < count:
                return position
        return 0

    def out(self, kind: str, value: float) -> float:
        """Return a value in SI (degC, %) in the client's unit; ``kind`` is L, A, T, P or anything else."""
        match kind:
            case "L":
                return value / LENGTHS[self.length]
            case "A":
                return value / ANGLES[self.angle]
            case "T":
                return 1.8 * value + 32.0 if self.temperature else value
            case "P":
                return value / PRESSURES[self.pressure]
        return value

    def into(self, kind: str, value: float) -> float:
        """Return a value of the client in SI (degC, %)."""
        match kind:
            case "L":
                return value * LENGTHS[self.length]
            case "A":
                return value * ANGLES[self.angle]
            case "T":
                return (value - 32.0) / 1.8 if self.temperature else value
            case "P":
                return value * PRESSURES[self.pressure]
        return value


def kinds(system: int) -> str:
    """Return the kinds of the three coordinates of a system: LLL, LAL (distance, angle, height), or AAL."""
    return "LLL" if system <= LHRZ else "LAL" if system <= CCC else "AAL"


def to_system(spherical: Triple, system: int) -> Triple:
    """Return azimuth, zenith angle (rad) and distance (m) in a coordinate system.

    Left-handed systems have one axis reversed; in clockwise systems the sign of the azimuth is reversed. Cylindrical
    coordinates are the distance from the vertical axis, the azimuth and the height (the order is assumed).
    """
    azimuth, zenith, distance = spherical
    across, height = distance * math.sin(zenith), distance * math.cos(zenith)
    if system in _SIGNS:
        sx, sy, sz = _SIGNS[system]
        return sx * across * math.cos(azimuth), sy * across * math.sin(azimuth), sz * height
    turned = -azimuth if system in (CCW, SCW) else azimuth
    return (across, turned, height) if system in (CCW, CCC) else (turned, zenith, distance)


def from_system(values: Triple, system: int) -> Triple:
    """Return azimuth, zenith angle (rad) and distance (m) of coordinates in a system."""
    a, b, c = values
    if system in (SCW, SCC):
        return (-a if system == SCW else a), b, c
    if system in (CCW, CCC):
        return (-b if system == CCW else b), math.atan2(a, c), math.hypot(a, c)
    sx, sy, sz = _SIGNS[system]
    x, y, z = sx * a, sy * b, sz * c
    return math.atan2(y, x), math.atan2(math.hypot(x, y), z), math.sqrt(x * x + y * y + z * z)


def deviations(spherical: Triple, sigmas: Triple, system: int) -> Triple:
    """Return the standard deviations of coordinates in a system, from those of azimuth, zenith angle and distance."""
    azimuth, zenith, distance = spherical
    s, c = math.sin(zenith), math.cos(zenith)
    sigma_a, sigma_z, sigma_d = sigmas
    across = math.hypot(s * sigma_d, distance * c * sigma_z)
    height = math.hypot(c * sigma_d, distance * s * sigma_z)
    if system in (SCW, SCC):
        return sigmas
    if system in (CCW, CCC):
        return across, sigma_a, height
    side = distance * s * sigma_a
    ca, sa = math.cos(azimuth), math.sin(azimuth)
    return math.hypot(ca * across, sa * side), math.hypot(sa * across, ca * side), height
