"""Steps of a probing cycle and of the whole warm-up: order of the touches, and paths between them.

Moves, NC programs and the dry run all use these steps: the checked motions are those that are executed.
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
    from errormotion.methods.normal_vector.settings import NormalVectorSettings

Position = tuple[float, float, float]

TIP_RADIUS = 3e-3
"""Radius of the tip if neither the settings nor the probe state it, m."""
MIN_STEP = 1e-3
"""Shorter waits and moves are omitted, s."""
EARLY_START = 0.1
"""Largest advance of a cycle, in intervals: a printed cycle starts with its first touch."""
_SAME_POSITION = 1e-9  # m


def cycle_touches(settings: NormalVectorSettings, tip_radius: float) -> tuple[list[Touch], list[tuple[int, int]]]:
    """Return the touches of one cycle in their order, and the numbers of ball and touch of each.

    A touch starts ``approach`` before the contact with a ball at its approximate position, and ends ``overtravel``
    beyond it.
    """
    normal = touching.normals(settings)
    centre = np.array([ball.centre for ball in settings.balls], dtype=float)
    reach = np.array([ball.radius for ball in settings.balls]) + tip_radius
    order = list(_order(len(settings.balls), settings.touches, settings.order == "there and back"))
    touches = []
    for ball, touch in order:
        n = normal[ball, touch]
        start = centre[ball] + (reach[ball] + settings.approach) * n
        # the target is not beyond the centre of the ball
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


def itinerary(touches: Sequence[Touch], clearance: float, here: Position | None = None) -> Iterator[Touch | Position]:
    """Yield the path through the touches of a cycle: positions to approach, and touches to make from there.

    Between two touches the tip rises by the clearance (m) above the starts of the touches of this ball, or of all balls
    on the path to another ball; then it moves horizontally, and down. It rises first from ``here``, if this is known.
    """
    high = safe_height(touches, clearance)
    above = high
    if here is not None:
        above = max(here[2], high)
        yield here[0], here[1], above
    previous: Touch | None = None
    for touch in touches:
        top = above
        if previous is not None:
            top = safe_height([t for t in touches if t.item == touch.item], clearance)
            top = top if previous.item == touch.item else high
            yield previous.start[0], previous.start[1], top
        yield touch.start[0], touch.start[1], top
        yield touch.start
        yield touch
        previous = touch
    if previous is not None:
        yield previous.start[0], previous.start[1], high


def safe_height(touches: Sequence[Touch], clearance: float) -> float:
    """Return the height at which the tip passes over the balls, m."""
    return max(touch.start[2] for touch in touches) + clearance


def cycle_steps(settings: NormalVectorSettings, probe: Any = None, here: Position | None = None) -> list[Step]:
    """Return every step of one cycle.

    Parameters
    ----------
    settings : NormalVectorSettings
    probe : settings of the bench's touch probe, optional
        Its feeds and its clearance have priority over those of the method.
    here : (3,) tuple of float, optional
        Position of the machine before the cycle, m; if unknown, the path to the first touch takes no time.
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
            distance = settings.approach
            contact = _tuple(np.array(item.start) + distance * _unit(np.subtract(item.target, item.start)))
            steps.append(Step("touch", contact, search, distance / search + slow))
            steps.append(Step("move", item.start, feed, distance / feed))
            here = item.start
            continue
        length = 0.0 if here is None else math.dist(item, here)
        if here is None or length > _SAME_POSITION:
            steps.append(Step("move", item, feed, length / feed))
        here = item
    return steps


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))


def _slow_seconds(probe: Any) -> float:
    """Return the duration of the slow contacts after the first one, s: retraction and renewed approach."""
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
        Position at the start of the cycle, m; None if unknown.
    cycle : list of Step
    """

    number: int
    warm_up: list[Step]
    settle: float
    here: Position | None
    cycle: list[Step]


def parts(settings: NormalVectorSettings, probe: Any = None) -> Iterator[Part]:
    """Yield the cold cycle, and every later one with the warm-up before it; ``probe`` as for `cycle_steps`."""
    now, cold, number = 0.0, 0.0, 0
    here: Position | None = None
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


def campaign_steps(settings: NormalVectorSettings, instruments: Mapping[str, Any] | None = None) -> list[Step]:
    """Return every step of the cold cycle, the warm-up and all its cycles.

    Parameters
    ----------
    settings : NormalVectorSettings
    instruments : mapping of str to settings, optional
        Settings of the bench's instruments by their kind.

    Raises
    ------
    MethodError
        A cycle takes longer than the interval.
    """
    steps: list[Step] = []
    for part in parts(settings, (instruments or {}).get("touch_probe")):
        length = math.fsum(step.seconds for step in part.cycle) + part.settle
        if length >= settings.interval:
            raise MethodError(
                f"interval: expected more than the duration of a cycle, {length:.0f} s, so that the machine warms up "
                f"between the cycles; found {settings.interval:g} s",
                code="probing.interval.too_short",
            )
        steps += part.warm_up
        if part.settle:
            steps.append(Step("rest", None, math.nan, part.settle, 0.0))
        steps += part.cycle
    return steps


def warm_up_steps(settings: NormalVectorSettings, start: float, end: float, here: Position | None = None) -> list[Step]:
    """Return the steps between two times of the warm-up, s: spindle speeds, and moves or rests.

    The first move starts at ``here``, if this is known.
    """
    steps: list[Step] = []
    now, number = start, 0
    while end - now > MIN_STEP:
        speed, until = speed_at(settings, now)
        until = min(until, end)
        if settings.moves:
            target = settings.moves[number % len(settings.moves)]
            seconds = math.dist(target, target if here is None else here) / settings.moves_feed
            if here is None or (seconds <= MIN_STEP and len(set(settings.moves)) > 1):
                number, here = number + 1, target
                continue
            if MIN_STEP < seconds <= end - now:
                steps.append(Step("move", target, settings.moves_feed, seconds, speed))
                number, here, now = number + 1, target, now + seconds
                continue
        steps.append(Step("rest", None, math.nan, until - now, speed))
        now = until
    return steps


def speed_at(settings: NormalVectorSettings, time: float) -> tuple[float, float]:
    """Return the spindle speed (1/min) at a time of the warm-up, and the time of its next change, s."""
    speed = 0.0
    for event in settings.schedule:
        if event.at > time + 1e-9:
            return speed, event.at
        speed = event.spindle_speed
    return speed, math.inf


def cycles(settings: NormalVectorSettings) -> int:
    """Return the number of probing cycles, including the cold one."""
    return int(settings.duration / settings.interval + 1e-9) + 1


def due(settings: NormalVectorSettings, number: int, now: float) -> int:
    """Return the number of the next cycle, ``number`` or later, at a time since the start of the cold cycle, s.

    A late cycle starts immediately; it is omitted if its successor is due as well.
    """
    return max(number, int((now + MIN_STEP) // settings.interval))


def following(settings: NormalVectorSettings, last: float) -> int:
    """Return the number of the cycle after one that started at a time since the start of the cold cycle, s."""
    return int(last / settings.interval + EARLY_START) + 1


def planned_history(part: Part, settings: NormalVectorSettings) -> tuple[float, float]:
    """Return mean spindle speed (1/min) and mean feed (m/s) between the previous cycle and this one."""
    turned = math.fsum(step.spindle_speed * step.seconds for step in part.warm_up)
    path = math.fsum(step.feed * step.seconds for step in part.warm_up if step.place is not None)
    return turned / settings.interval, path / settings.interval


def _tuple(position: Array) -> Position:
    x, y, z = (float(value) for value in position)
    return x, y, z
