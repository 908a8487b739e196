"""One probing cycle, and the whole warm-up: what is touched in which order, and how the machine gets there.

The same steps make the moves, the NC programs and the dry run, so that what was checked is what is done.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.normal_vector.acquisition import touching
from errormotion.plugins import Step, Touch

if TYPE_CHECKING:
    from errormotion.methods.normal_vector.settings import Settings

    Array = Array

Place = tuple[float, float, float]

TIP_RADIUS = 3e-3
"""Taken where neither the settings nor the probe say, m."""
SHORTEST = 1e-3
"""Waits and moves below this are none, s."""
EARLY = 0.1
"""By so much of an interval a cycle may be early: one that is printed begins with its first touch."""
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


def itinerary(touches: Sequence[Touch], clearance: float, here: Place | None = None) -> Iterator[Touch | Place]:
    """Yield the way through the touches of a cycle: places to go to, and touches to make from where the machine is.

    From touch to touch the tip rises by the clearance (m) above the starts of the touches of its ball, or of all balls
    where it goes to another one; it goes across, and down. It goes up first from ``here``, where that is known.
    """
    high = safe_height(touches, clearance)
    above = high
    if here is not None:
        above = max(here[2], high)
        yield here[0], here[1], above
    before: Touch | None = None
    for touch in touches:
        top = above
        if before is not None:
            top = safe_height([t for t in touches if t.item == touch.item], clearance)
            top = top if before.item == touch.item else high
            yield before.start[0], before.start[1], top
        yield touch.start[0], touch.start[1], top
        yield touch.start
        yield touch
        before = touch
    if before is not None:
        yield before.start[0], before.start[1], high


def safe_height(touches: Sequence[Touch], clearance: float) -> float:
    """Return the height at which the tip passes over what is touched, m."""
    return max(touch.start[2] for touch in touches) + clearance


def cycle_steps(settings: Settings, probe: Any = None, here: Place | None = None) -> list[Step]:
    """Return every step of one cycle.

    Parameters
    ----------
    settings : Settings
    probe : settings of the bench's touch probe, optional
        Its feeds and its clearance hold where it has some; else those of the method.
    here : (3,) tuple of float, optional
        Where the machine is before, m; else the way to the first touch does not count.
    """
    tip = settings.tip_radius or float(getattr(probe, "tip_radius", TIP_RADIUS))
    clearance = float(getattr(probe, "clearance", settings.clearance))
    feed = float(getattr(probe, "approach_feed", settings.positioning_feed))
    search = float(getattr(probe, "search_feed", settings.probing_feed))
    slow = _slow_seconds(probe)
    touches, _ = cycle_touches(settings, tip)
    steps: list[Step] = []
    for item in itinerary(touches, clearance, here) if touches else ():
        if isinstance(item, Touch):
            way = settings.approach
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
    """Return how long the slow contacts behind the first one take, s: back a little, and to the contact again."""
    names = ("back_off", "approach_feed", "touch_feed", "repeats")
    if probe is None or not all(hasattr(probe, name) for name in names):
        return 0.0
    return float(probe.repeats * probe.back_off * (1 / probe.approach_feed + 1 / probe.touch_feed))


@dataclass(frozen=True)
class Part:
    """The warm-up before a cycle, and the cycle.

    Attributes
    ----------
    number : int
        Of the cycle, 0 for the cold one.
    warm_up : list of Step
    settle : float
        Rest between both, s.
    here : (3,) tuple of float or None
        Where the cycle begins, m; None: not known.
    cycle : list of Step
    """

    number: int
    warm_up: list[Step]
    settle: float
    here: Place | None
    cycle: list[Step]


def parts(settings: Settings, probe: Any = None) -> Iterator[Part]:
    """Yield the cold cycle, and every later one with the warm-up before it; ``probe`` as for `cycle_steps`."""
    now, cold, number = 0.0, 0.0, 0
    here: Place | None = None
    while (number := due(settings, number, now)) < cycles(settings):
        warm_up: list[Step] = []
        settle = settings.settle
        if number:
            end = number * settings.interval
            warm_up = warm_up_steps(settings, now - cold, end - cold, here)
            here = next((step.place for step in reversed(warm_up) if step.place is not None), here)
            now = max(now, end)
            settle = settings.settle if warm_up and warm_up[-1].spindle_speed else 0.0
        steps = cycle_steps(settings, probe, here)
        yield Part(number, warm_up, settle, here, steps)
        now += settle + math.fsum(step.seconds for step in steps)
        cold = cold if number else now
        here = steps[-1].place if steps else here
        number += 1


def campaign_steps(settings: Settings, instruments: Mapping[str, Any] | None = None) -> list[Step]:
    """Return every step of the cold cycle, the warm-up and all its cycles.

    Parameters
    ----------
    settings : Settings
    instruments : mapping of str to settings, optional
        Settings of the bench's instruments by their kind.

    Raises
    ------
    MethodError
        A cycle takes longer than the interval from one to the next.
    """
    steps: list[Step] = []
    for part in parts(settings, (instruments or {}).get("touch_probe")):
        length = math.fsum(step.seconds for step in part.cycle) + part.settle
        if length >= settings.interval:
            raise MethodError(
                f"interval: expected more than the {length:.0f} s that a cycle takes, so that the machine warms up in "
                f"between; found {settings.interval:g} s"
            )
        steps += part.warm_up
        if part.settle:
            steps.append(Step("rest", None, math.nan, part.settle, 0.0))
        steps += part.cycle
    return steps


def warm_up_steps(settings: Settings, begin: float, end: float, here: Place | None = None) -> list[Step]:
    """Return what the machine does between two times of the warm-up, s: spindle speeds, moves to and fro, or rests.

    The moves begin with the first one, from ``here``, where that is known.
    """
    steps: list[Step] = []
    now, number = begin, 0
    while end - now > SHORTEST:
        speed, until = speed_at(settings, now)
        until = min(until, end)
        if settings.moves:
            place = settings.moves[number % len(settings.moves)]
            seconds = math.dist(place, place if here is None else here) / settings.moves_feed
            if here is None or (seconds <= SHORTEST and len(set(settings.moves)) > 1):
                number, here = number + 1, place
                continue
            if SHORTEST < seconds <= end - now:
                steps.append(Step("move", place, settings.moves_feed, seconds, speed))
                number, here, now = number + 1, place, now + seconds
                continue
        steps.append(Step("rest", None, math.nan, until - now, speed))
        now = until
    return steps


def speed_at(settings: Settings, time: float) -> tuple[float, float]:
    """Return the spindle speed (1/min) at a time of the warm-up, and the time at which it changes, s."""
    speed = 0.0
    for event in settings.schedule:
        if event.at > time + 1e-9:
            return speed, event.at
        speed = event.spindle_speed
    return speed, math.inf


def cycles(settings: Settings) -> int:
    """Return the number of probing cycles, the cold one included."""
    return int(settings.duration / settings.interval + 1e-9) + 1


def due(settings: Settings, number: int, now: float) -> int:
    """Return which cycle is next at a time since the cold one began, s, if it is ``number`` or a later one.

    One that is late is made at once; one whose successor is due as well is left out.
    """
    return max(number, int((now + SHORTEST) // settings.interval))


def following(settings: Settings, last: float) -> int:
    """Return which cycle follows one that began at a time since the cold one began, s; perhaps a little early."""
    return int(last / settings.interval + EARLY) + 1


def planned_history(part: Part, settings: Settings) -> tuple[float, float]:
    """Return mean spindle speed (1/min) and mean feed (m/s) from the cycle before to this one."""
    turned = math.fsum(step.spindle_speed * step.seconds for step in part.warm_up)
    way = math.fsum(step.feed * step.seconds for step in part.warm_up if step.place is not None)
    return turned / settings.interval, way / settings.interval


def _tuple(place: Array) -> Place:
    x, y, z = (float(value) for value in place)
    return x, y, z
