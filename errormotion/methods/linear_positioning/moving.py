"""Motions of a test with a moving axis (ISO 230-3): cold readings, moves with readings in between, cooling."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

from errormotion.errors import MethodError

if TYPE_CHECKING:
    from errormotion.methods.linear_positioning.settings import LinearPositioningSettings, Moving


@dataclass(frozen=True)
class Cycle:
    """One reading of both ends, and the motion before it.

    Attributes
    ----------
    strokes : int
        Moves back and forth before the reading, at the feed of the moving axis.
    rest : float
        Dwell before the reading, s.
    moving : bool
        Whether the axis moved before the reading.
    cold : bool
        Whether the axis has not moved yet in the test.
    """

    strokes: int
    rest: float
    moving: bool
    cold: bool


def moving_of(settings: LinearPositioningSettings) -> Moving:
    """Return the settings of the moving axis; MethodError if there are none."""
    if settings.moving is None:
        raise MethodError(
            "moving: expected the settings of the moving axis; found none", code="moving_axis.settings.missing"
        )
    return settings.moving


def ends(settings: LinearPositioningSettings) -> tuple[float, float]:
    """Return both ends of the stroke, those of the travel, m; MethodError if they are outside the limits."""
    low, high = settings.travel
    check_limits(settings, low, high)
    return low, high


def check_limits(settings: LinearPositioningSettings, low: float, high: float) -> None:
    """Raise MethodError if the axis would leave its limits between two positions, m."""
    if settings.limits is not None:
        lowest, highest = settings.limits
        if low < lowest - 1e-9 or high > highest + 1e-9:
            overrun = "" if settings.moving is not None else f", with an overrun of {settings.overrun * 1e3:g} mm"
            raise MethodError(
                f"limits: expected {settings.axis} from {lowest * 1e3:.3f} to {highest * 1e3:.3f} mm; the test needs "
                f"{low * 1e3:.3f} to {high * 1e3:.3f} mm{overrun}. Shorten the travel of the test.",
                code="motion.limit.position",
            )


def cycles(settings: LinearPositioningSettings) -> Iterator[Cycle]:
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


def stroke_time(settings: LinearPositioningSettings) -> float:
    """Return the duration of a stroke back and forth, s; accelerations are neglected."""
    low, high = ends(settings)
    return 2.0 * (high - low) / moving_of(settings).feed


def reading_time(settings: LinearPositioningSettings) -> float:
    """Return the duration of a reading of both ends, s."""
    low, high = ends(settings)
    return 2.0 * ((high - low) / settings.feed + settings.dwell)


def stops(settings: LinearPositioningSettings) -> Iterator[tuple[float, float, float]]:
    """Yield every stop of the axis: position, m, feed of the move to it, m/s, and dwell, s.

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
