"""Diagonals of a volume: their ends, their stops, and the squareness that two of them determine.

The errors of a machine displace its tool by E(p) at the position p. Along the unit vector u of a diagonal an instrument
reads the deviation u . (E(p) - E(p_0)). A squareness g of two axes, a shear of their plane, causes a deviation
proportional to the distance s::

    Y to X, about Z:  E_x = -g y    u . E = -g u_x u_y s
    Z to Y, about X:  E_y = -g z    u . E = -g u_y u_z s
    Z to X, about Y:  E_x = +g z    u . E = +g u_x u_z s

The product of the two components has opposite signs for the two diagonals of a face, while linear errors of the axes,
the scale of the instrument and uniform expansion act on both alike. The squareness is therefore the difference of the
two slopes over the difference of the two coefficients.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.linear_positioning.planning.targets import randomised, standard_count

if TYPE_CHECKING:
    from errormotion.methods.linear_positioning.settings import Diagonals, LinearPositioningSettings

SQUARENESS = {"EC0Y": (0, 1, -1.0), "EA0Z": (1, 2, -1.0), "EB0Z": (0, 2, 1.0)}
"""The two axes of a face, and the sign of the shear by a squareness (ISO 230-1) along a diagonal."""
DECIMALS = 6
"""Of a commanded position in m: 1 um, the resolution of programs."""
ZERO_COMPONENT = 1e-6
"""Component of a unit vector below which the axis is at rest along the diagonal."""


@dataclass(frozen=True)
class Line:
    """One diagonal.

    Attributes
    ----------
    name : str
    start : ndarray, (3,)
        Corner at which it starts, m.
    unit : ndarray, (3,)
    length : float
        m.
    """

    name: str
    start: Array
    unit: Array
    length: float

    def point(self, distance: float) -> Array:
        """Return the position of the axes at a distance from the start, (3,), m."""
        return np.asarray(np.round(self.start + distance * self.unit, DECIMALS))


def diagonals_of(settings: LinearPositioningSettings) -> Diagonals:
    """Return the settings of the diagonals; MethodError if there are none."""
    if settings.diagonals is None:
        raise MethodError(
            "diagonals: expected the settings of the diagonals; found none", code="diagonal.settings.missing"
        )
    return settings.diagonals


def lines(settings: LinearPositioningSettings) -> list[Line]:
    """Return the diagonals in their order."""
    diagonals = diagonals_of(settings)
    result = []
    for name in diagonals.names:
        ends = []
        for letter, (low, high), rest in zip(name, diagonals.volume, settings.start, strict=True):
            ends.append({"P": (low, high), "N": (high, low), "0": (rest, rest)}[letter])
        start, end = np.array(ends).T
        length = float(np.linalg.norm(end - start))
        result.append(Line(name, start, (end - start) / length, length))
    return result


def distances(settings: LinearPositioningSettings) -> Array:
    """Return the distance of each stop from the start of its diagonal, (diagonal, stop), m; with random parts.

    The commanded positions are rounded to 1 um in each axis; the distances are those of the rounded positions.
    """
    diagonals = lines(settings)
    count = settings.count or max(standard_count(line.length) for line in diagonals)
    rows = []
    for line in diagonals:
        points = [line.point(float(distance)) for distance in randomised(0.0, line.length, count, settings)]
        rows.append([float((point - line.start) @ line.unit) for point in points])
    return np.array(rows)


def squareness_of(units: Sequence[Array]) -> Iterator[tuple[str, int, int, float]]:
    """Yield each squareness that two diagonals determine: name, their indices, difference of their coefficients."""
    for name, (a, b, sign) in SQUARENESS.items():
        c = 3 - a - b
        flat = {k: unit[a] * unit[b] for k, unit in enumerate(units) if abs(unit[c]) < ZERO_COMPONENT}
        pairs = [(k, other) for k, one in flat.items() for other, two in flat.items() if k < other and one * two < 0.0]
        for k, other in pairs:
            yield name, k, other, sign * float(flat[k] - flat[other])
