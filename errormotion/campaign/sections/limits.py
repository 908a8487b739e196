"""Limits of a machine, checked for all tests before anything moves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from errormotion.datasets.units import Length, Speed, Velocity, format_quantity
from errormotion.errors import MethodError
from errormotion.plugins import MachineLimits, Step

AXES = ("X", "Y", "Z")
OTHER_AXES = ("A", "B", "C", "U", "V", "W")
"""Axes of `[machine]` that nothing moves."""
_ROUNDING = 1e-9


def without_limits(data: Any) -> tuple[Any, list[str]]:
    """Return ``[limits]`` without the axes that a machine may have and that have no limits, and a mistake for each."""
    if not isinstance(data, dict):
        return data, []
    others = [axis for axis in data if axis in OTHER_AXES]
    mistakes = [
        f"limits.{axis}: the axis {axis} has no limits here, since no method and no driver moves it; [limits] can "
        f"state {', '.join(Limits.model_fields)}. State the range of {axis} as machine.travel.{axis}, and remove this"
        for axis in others
    ]
    return {key: each for key, each in data.items() if key not in others}, mistakes


class Limits(BaseModel):
    """``[limits]`` of a bench file; quantities without a limit are not checked."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    X: tuple[Length, Length] | None = Field(default=None, description="lowest and highest position of X")
    Y: tuple[Length, Length] | None = Field(default=None, description="lowest and highest position of Y")
    Z: tuple[Length, Length] | None = Field(default=None, description="lowest and highest position of Z")
    feed: Velocity | None = Field(default=None, description="highest feed", gt=0)
    spindle_speed: Speed | None = Field(default=None, description="highest spindle speed", ge=0)

    @model_validator(mode="after")
    def _ordered(self) -> Limits:
        for axis in AXES:
            span = getattr(self, axis)
            if span is not None and not span[0] < span[1]:
                raise ValueError(
                    f"{axis}: expected the lowest position, then the highest; found {span[0]}, {span[1]} m"
                )
        return self

    def of_machine(self, forbidden: str = "") -> MachineLimits:
        """Return the limits in the form for drivers; ``forbidden`` as in `MachineLimits`."""
        spans = {axis: span for axis in AXES if (span := getattr(self, axis)) is not None}
        return MachineLimits(spans, self.feed, self.spindle_speed, forbidden)


@dataclass(frozen=True)
class Extent:
    """Requirements of a test on a machine.

    Attributes
    ----------
    seconds : float
        Duration of the steps whose duration is known, s.
    path : float
        Length of all moves, m.
    low, high : (3,) tuple of float
        Lowest and highest position of X, Y, Z, m; NaN for an axis that does not move.
    feed : float
        Highest feed, m/s; 0 if nothing moves.
    spindle_speed : float
        Highest spindle speed, 1/min.
    touches, moves : int
    rapid : int
        Moves at rapid traverse.
    untimed : int
        Steps whose duration is unknown.
    """

    seconds: float
    path: float
    low: tuple[float, ...]
    high: tuple[float, ...]
    feed: float
    spindle_speed: float
    touches: int
    moves: int
    rapid: int = 0
    untimed: int = 0


def extent(steps: Sequence[Step]) -> Extent:
    """Return the requirements of steps on a machine."""
    moving = [step for step in steps if step.place is not None]
    places = np.array([step.place for step in moving], float).reshape(-1, 3)
    ways = np.sqrt(np.nansum(np.diff(places, axis=0) ** 2, axis=1))
    return Extent(
        math.fsum(step.seconds for step in steps if not math.isnan(step.seconds)),
        math.fsum(ways),
        tuple(np.fmin.reduce(places, axis=0, initial=np.nan).tolist()),
        tuple(np.fmax.reduce(places, axis=0, initial=np.nan).tolist()),
        max((step.feed for step in moving if not math.isnan(step.feed)), default=0.0),
        max((abs(step.spindle_speed) for step in steps), default=0.0),
        sum(step.what == "touch" for step in steps),
        sum(step.what == "move" for step in steps),
        sum(math.isnan(step.feed) for step in moving),
        sum(math.isnan(step.seconds) for step in steps),
    )


def violations(moves: Extent, limits: Limits) -> list[str]:
    """Return every violation of the limits, one sentence each."""
    exceeded = []
    for k, axis in enumerate(AXES):
        span = getattr(limits, axis)
        if span is None or math.isnan(moves.low[k]):
            continue
        if moves.low[k] < span[0] - _ROUNDING or moves.high[k] > span[1] + _ROUNDING:
            exceeded.append(
                f"{axis} would move from {_mm(moves.low[k])} to {_mm(moves.high[k])}; its limits are {_mm(span[0])} "
                f"and {_mm(span[1])}"
            )
    if limits.feed is not None and moves.feed > limits.feed * (1 + _ROUNDING):
        exceeded.append(f"the feed would be {_feed(moves.feed)}; its limit is {_feed(limits.feed)}")
    if limits.spindle_speed is not None and moves.spindle_speed > limits.spindle_speed:
        exceeded.append(
            f"the spindle would turn at {moves.spindle_speed:g} /min; its limit is {limits.spindle_speed:g} /min"
        )
    return exceeded


def steps_of(method: Any, settings: Any, instruments: dict[str, Any]) -> list[Step] | None:
    """Return every step of the machine in a test; None if the method does not state its motions.

    Parameters
    ----------
    method : class of a method
    settings : its settings
    instruments : dict
        Settings of the instruments of the bench by kind.

    Raises
    ------
    MethodError
        The method cannot determine its motions, or states an invalid step.
    """
    motions = method().motions(settings, instruments)
    if motions is None:
        return None
    steps: list[Any] = list(motions)
    for number, step in enumerate(steps):
        if not isinstance(step, Step) or not _possible(step):
            raise MethodError(
                f"motions of '{method.info.id}': expected steps with finite positions X, Y, Z (NaN for an axis that "
                f"does not move), feeds above 0 (NaN for rapid) and finite spindle speeds; found step {number}: {step}",
                code="method.motions.form",
            )
    return steps


def _possible(step: Any) -> bool:
    if not math.isfinite(step.spindle_speed) or math.isinf(step.seconds) or step.seconds < 0:
        return False
    if step.place is None:
        return True
    return (
        len(step.place) == 3
        and not any(math.isinf(x) for x in step.place)
        and not all(math.isnan(x) for x in step.place)
        and (math.isnan(step.feed) or 0 < step.feed < math.inf)
    )


def announcement(test: str, steps: Sequence[Step] | None, limits: Limits) -> str:
    """Return the motions of a test and their limits in one line; ``steps`` as from `steps_of`."""
    if steps is None:
        return f"{test}: the method states no motions; no command to the machine is allowed."
    reached = extent(steps)
    parts = []
    for k, axis in enumerate(AXES):
        if not math.isnan(reached.low[k]):
            planned = f"{axis} {_mm(reached.low[k])} to {_mm(reached.high[k])}"
            span = getattr(limits, axis)
            parts.append(f"{planned} ({'no limits' if span is None else f'limits {_mm(span[0])} and {_mm(span[1])}'})")
    if reached.feed:
        limit = "no limit" if limits.feed is None else f"limit {_feed(limits.feed)}"
        parts.append(f"feed up to {_feed(reached.feed)} ({limit})")
    if reached.rapid:
        held = "not limited" if limits.feed is None else f"limited to {_feed(limits.feed)}"
        parts.append(f"rapid moves: {reached.rapid} ({held})")
    if reached.spindle_speed:
        limit = "no limit" if limits.spindle_speed is None else f"limit {limits.spindle_speed:g} /min"
        parts.append(f"spindle up to {reached.spindle_speed:g} /min ({limit})")
    return f"{test}: the machine will move: {', '.join(parts)}." if parts else f"{test}: nothing will move."


def moves(steps: Sequence[Step] | None) -> bool:
    """Return whether an axis or the spindle moves; ``steps`` as from `steps_of`."""
    return any(step.place is not None or step.spindle_speed != 0 for step in steps or ())


NO_MOTIONS = "the method '{}' does not state its motions ('motions'); whether they stay within the limits is unknown"


def _mm(value: float) -> str:
    return format_quantity(value, "mm", 7)


def _feed(value: float) -> str:
    return format_quantity(value, "mm/min", 6)
