"""Targets of the tracker: its reflectors, positions in its frame, a beam without a reflector."""

from __future__ import annotations

import math
from dataclasses import dataclass

from errormotion.errors import InstrumentError


class BeamBrokenError(InstrumentError):
    """The beam has no reflector, and the search found none."""

    code = "tracker.beam.broken"


@dataclass(frozen=True)
class Reflector:
    """A reflector, with its number and name in the tracker, its kind, and its surface offset in m."""

    number: int
    name: str
    kind: str
    surface_offset: float


def polar(position: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return azimuth, zenith angle (rad) and distance (m) of a position in the tracker's frame.

    Raises
    ------
    InstrumentError
        Not three finite numbers, or the origin.
    """
    values = tuple(float(x) for x in position)
    if len(values) != 3 or not all(map(math.isfinite, values)) or not any(values):
        raise InstrumentError(
            f"Expected a position x, y, z in the tracker's frame, m, other than the origin; found {position!r}",
            code="position.form",
        )
    x, y, z = values
    return math.atan2(y, x), math.atan2(math.hypot(x, y), z), math.hypot(x, y, z)
