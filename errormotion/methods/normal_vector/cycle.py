"""One probing cycle, and the whole warm-up: what is touched in which order, and how the machine gets there.

The same steps make the moves, the NC programs and the dry run, so that what was checked is what is done.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from errormotion.methods.normal_vector import touching
from errormotion.plugins import Step, Touch

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from errormotion.methods.normal_vector.settings import Settings

    Array = NDArray[np.float64]

TIP_RADIUS = 3e-3
"""Taken where neither the settings nor the probe say, m."""
SLOWEST = 1e-9
_HERE = 1e-9  # m


def cycle_touches(settings: Settings, tip_radius: float) -> tuple[list[Touch], list[tuple[int, int]]]:
    """Return the touches of one cycle in their order, and which ball and which of its touches each of them is.

    A touch begins ``approach`` before the contact that is due for a ball at its rough place, and ends ``overtravel``
    behind it.
    """
    normal = touching.normals(settings)
    centre = np.array([ball.centre for ball in settings.balls], dtype=float)
    reach = np.array([ball.radius for ball in settings.balls]) + tip_radius
    order = list(_order(len(settings.balls), settings.touches, settings.order == "there and back"))
    touches = []
    for ball, touch in order:
        n = normal[ball, touch]
        start = centre[ball] + (reach[ball] + settings.approach) * n
        # a ball is not pierced: the tip ends before its centre at the latest
        target = centre[ball] + max(reach[ball] - settings.overtravel, 0.0) * n
        touches.append(Touch(_tuple(start), _tuple(target), item=ball))
    return touches, order


def _order(balls: int, touches: int, back: bool) -> Iterator[tuple[int, int]]:
    half = (touches + 1) // 2 if back else touches
    for ball in range(balls):
        for touch in range(half):
            yield ball, touch
    for ball in reversed(range(balls)):
        for touch in range(half, touches):
            yield ball, touch


def itinerary(touches: Sequence[Touch], clearance: float) -> Iterator[Touch | tuple[float, float, float]]:
    """Yield the way through the touches of a cycle: places to go to, and touches to make from where the machine is.

    From touch to touch the tip rises by the clearance (m) above the starts of the touches of its ball, or of all balls
    where it goes to another one; it goes across, and down.
    """
    high = max(touch.start[2] for touch in touches) + clearance
    before: Touch | None = None
    for touch in touches:
        same = before is not None and before.item == touch.item
        top = max(t.start[2] for t in touches if t.item == touch.item) + clearance if same else high
        if before is not None:
            yield before.start[0], before.start[1], top
        yield touch.start[0], touch.start[1], top
        yield touch.start
        yield touch
        before = touch
    if before is not None:
        yield before.start[0], before.start[1], high


def cycle_steps(settings: Settings, probe: Any = None) -> list[Step]:
    """Return every step of one cycle.

    Parameters
    ----------
    settings : Settings
    probe : settings of the bench's touch probe, optional
        Its feeds and its clearance hold where it has some; else those of the method.
    """
    tip = settings.tip_radius or float(getattr(probe, "tip_radius", TIP_RADIUS))
    clearance = max(settings.clearance, float(getattr(probe, "clearance", 0.0)))
    feed = float(getattr(probe, "approach_feed", settings.positioning_feed))
    search = float(getattr(probe, "search_feed", settings.probing_feed))
    slow = _slow_seconds(probe)
    touches, _ = cycle_touches(settings, tip)
    steps: list[Step] = []
    here: tuple[float, float, float] | None = None
    for item in itinerary(touches, clearance) if touches else ():
        if isinstance(item, Touch):
            way = float(settings.approach)
            contact = _tuple(np.array(item.start) + way * _unit(np.subtract(item.target, item.start)))
            steps.append(Step("touch", contact, search, way / search + slow))
            steps.append(Step("move", item.start, feed, way / feed))
            here = item.start
            continue
        length = 0.0 if here is None else math.dist(item, here)
        if here is None or length > _HERE:
            steps.append(Step("move", item, feed, length / feed))
        here = item
    return steps


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))


def _slow_seconds(probe: Any) -> float:
    """Return how long the slow contacts behind the first one take, s."""
    names = ("back_off", "margin", "touch_feed", "repeats")
    if probe is None or not all(hasattr(probe, name) for name in names):
        return 0.0
    return float(probe.repeats * (probe.back_off + probe.margin) * 2 / probe.touch_feed)


def campaign_steps(settings: Settings, instruments: Mapping[str, Any] | None = None) -> list[Step]:
    """Return every step of the cold cycle, the warm-up and all its cycles.

    Parameters
    ----------
    settings : Settings
    instruments : mapping of str to settings, optional
        Settings of the bench's instruments by their kind.
    """
    cycle = cycle_steps(settings, (instruments or {}).get("touch_probe"))
    length = math.fsum(step.seconds for step in cycle)
    steps = [*cycle]
    for number in range(1, cycles(settings)):
        begin, end = (number - 1) * settings.interval + length, number * settings.interval
        steps += warm_up_steps(settings, begin - length, max(end - length, begin - length))
        if settings.settle:
            steps.append(Step("rest", None, math.nan, settings.settle, 0.0))
        steps += cycle
    return steps


def warm_up_steps(settings: Settings, begin: float, end: float) -> list[Step]:
    """Return what the machine does between two times of the warm-up, s: spindle speeds, moves to and fro, or rests."""
    steps: list[Step] = []
    now, number = begin, 0
    while end - now > SLOWEST:
        speed, until = speed_at(settings, now)
        until = min(until, end)
        if settings.moves:
            place = settings.moves[number % len(settings.moves)]
            previous = settings.moves[number - 1]
            seconds = float(np.linalg.norm(np.subtract(place, previous))) / settings.moves_feed
            number += 1
            if now + seconds <= end and seconds > 0:
                steps.append(Step("move", place, settings.moves_feed, seconds, speed))
                now += seconds
                continue
        steps.append(Step("rest", None, math.nan, until - now, speed))
        now = until
    return steps


def speed_at(settings: Settings, time: float) -> tuple[float, float]:
    """Return the spindle speed (1/min) at a time of the warm-up, and the time at which it changes, s."""
    speed = 0.0
    for event in settings.schedule:
        if event.at > time + SLOWEST:
            return speed, event.at
        speed = event.spindle_speed
    return speed, math.inf


def cycles(settings: Settings) -> int:
    """Return the number of probing cycles, the cold one included."""
    return int(settings.duration // settings.interval) + 1


def _tuple(place: Array) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in place)
    return x, y, z


def planned_history(settings: Settings, number: int) -> tuple[float, float]:
    """Return mean spindle speed (1/min) and mean feed (m/s) between two cycles as the settings plan them."""
    if number == 0:
        return 0.0, 0.0
    steps = warm_up_steps(settings, (number - 1) * settings.interval, number * settings.interval)
    turned = math.fsum(step.spindle_speed * step.seconds for step in steps)
    way = math.fsum(step.feed * step.seconds for step in steps if step.place is not None)
    return turned / settings.interval, way / settings.interval
