"""What the axis does in a test of its own heat (ISO 230-3): cold readings, moves with readings between, cooling."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from errormotion.errors import MethodError

if TYPE_CHECKING:
    from errormotion.methods.linear_positioning.settings import Moving, Settings


@dataclass(frozen=True)
class Cycle:
    """One reading of both ends, and what comes before it.

    Attributes
    ----------
    strokes : int
        Moves there and back with the feed of the test before the reading.
    rest : float
        Rest before the reading, s.
    moving : bool
        Whether the axis moved before the reading.
    cold : bool
        Whether it has not moved yet.
    """

    strokes: int
    rest: float
    moving: bool
    cold: bool


def moving_of(settings: Settings) -> Moving:
    """Return the settings of the moving axis; MethodError where there are none."""
    if settings.moving is None:
        raise MethodError("moving: expected the settings of the moving axis; found none")
    return settings.moving


def ends(settings: Settings) -> tuple[float, float]:
    """Return both ends of the stroke, m: those of the travel, whose overrun stays within the limits."""
    low, high = settings.travel
    if settings.limits is not None:
        least, most = settings.limits
        if low < least - 1e-9 or high > most + 1e-9:
            raise MethodError(
                f"limits: expected {settings.axis} from {least * 1e3:.3f} to {most * 1e3:.3f} mm; the test needs "
                f"{low * 1e3:.3f} to {high * 1e3:.3f} mm."
            )
    return low, high


def cycles(settings: Settings) -> Iterator[Cycle]:
    """Yield the readings in their order: cold, while the axis moves, and while it cools."""
    moving = moving_of(settings)
    for _ in range(moving.cold):
        yield Cycle(0, 0.0, moving=False, cold=True)
    strokes = max(1, math.floor((moving.interval - reading_time(settings)) / stroke_time(settings)))
    for _ in range(math.ceil(moving.duration / moving.interval - 1e-9)):
        yield Cycle(strokes, 0.0, moving=True, cold=False)
    rest = max(0.0, moving.interval - reading_time(settings))
    for _ in range(math.floor(moving.cooling / moving.interval + 1e-9)):
        yield Cycle(0, rest, moving=False, cold=False)


def stroke_time(settings: Settings) -> float:
    """Return the duration of a stroke there and back, s; accelerations are neglected."""
    low, high = ends(settings)
    return 2.0 * (high - low) / moving_of(settings).feed


def reading_time(settings: Settings) -> float:
    """Return the duration of a reading of both ends, s."""
    low, high = ends(settings)
    return 2.0 * ((high - low) / settings.feed + settings.dwell)


def stops(settings: Settings) -> Iterator[tuple[float, float, float]]:
    """Yield every position at which the axis stops, m, the feed towards it, m/s, and how long it rests there, s.

    The axis starts at its lower end. A reading is taken at the upper end, approached forward, and then at the lower
    one, approached backward.
    """
    low, high = ends(settings)
    fast = moving_of(settings).feed
    yield low, settings.feed, 0.0
    for cycle in cycles(settings):
        for _ in range(cycle.strokes):
            yield high, fast, 0.0
            yield low, fast, 0.0
        if cycle.rest > 0:
            yield low, settings.feed, cycle.rest
        yield high, settings.feed, settings.dwell
        yield low, settings.feed, settings.dwell
